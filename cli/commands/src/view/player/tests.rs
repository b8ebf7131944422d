use std::path::Path;
use std::sync::mpsc::{Receiver, channel};

use b2p::cloud::ColouredVoxels;
use b2p::geometry::{Voxels, morton};
use b2p::{Limits, Placement, SequenceEncoder};

use super::*;
use crate::args::ModelArg;

/// A square of voxels that moves by one each frame.
fn square(frame: u64) -> ColouredVoxels {
    let at = |i: u32| morton::encode([10 + i % 20 + frame as u32, 10 + i / 20, 20]);
    let mut keys: Vec<u64> = (0..400).map(at).collect();
    keys.sort_unstable();
    ColouredVoxels {
        colours: keys.iter().map(|key| [*key as u8, 100, 50]).collect(),
        voxels: Voxels::new(6, keys),
        placement: Placement::VOXEL_GRID,
    }
}

/// Twelve frames in groups of four, a second apart.
fn sequence() -> Vec<u8> {
    let encoder = SequenceEncoder::new()
        .with_levels(4..=5)
        .with_group(4)
        .with_frame_rate(1, 1);
    let encoded = encoder.encode(12, |frame| Ok(square(frame)), |_| {});
    encoded.expect("squares can be coded")
}

fn sources() -> (Sources, Receiver<(u64, Arrived)>) {
    let (sender, heard) = channel();
    let sender = Mutex::new(sender);
    let loading = Loading {
        model: ModelArg {
            model: None,
            isa: None,
            precision: None,
        },
        per_voxel: None,
        up: None,
        limits: Limits::default(),
    };
    let tell = move |number, arrived| {
        let _ = sender.lock().unwrap().send((number, arrived));
    };
    (Sources::start(loading, Arc::new(tell)).unwrap(), heard)
}

fn wish(number: u64, path: &Path, level: Option<u8>) -> Wish {
    Wish {
        number,
        path: path.to_owned(),
        level,
        heads: Some(HeadSet::Surfels),
        camera: None,
    }
}

/// The clock of the sequence that is opened.
fn clock(heard: &Receiver<(u64, Arrived)>) -> Clock {
    let choices = |arrived| match arrived {
        Arrived::Choices(choices) => Some(choices),
        _ => None,
    };
    match heard.iter().find_map(|(_, arrived)| choices(arrived)) {
        Some(choices) => {
            assert_eq!(choices.levels, [4, 5]);
            Clock::new(choices.timeline.expect("a time line"), 1.0, false)
        }
        None => panic!("the player has ended"),
    }
}

/// The next frame that is shown, and its level; or what is said of one that is not.
fn next(heard: &Receiver<(u64, Arrived)>) -> std::result::Result<(u64, u8), String> {
    loop {
        match heard.recv().expect("a player").1 {
            Arrived::Scene(scene) => {
                let level = scene.made.expect("a level").0;
                return Ok((scene.frame.expect("a frame").number, level));
            }
            Arrived::Skipped(message) | Arrived::Failed(message) => return Err(message),
            _ => {}
        }
    }
}

/// Plays `bytes` with the clock at each of these frames, and gives what is shown.
fn shown(bytes: &[u8], frames: &[i64]) -> Vec<std::result::Result<(u64, u8), String>> {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), bytes).unwrap();
    let (mut sources, heard) = sources();
    sources.want(wish(0, file.path(), None));
    let (mut clock, mut last) = (clock(&heard), 0);
    let seen = frames.iter().map(|frame| {
        clock.step(frame - last, Instant::now());
        last = *frame;
        sources.play(&clock);
        next(&heard)
    });
    seen.collect()
}

#[test]
fn the_frame_is_shown_that_the_clock_stands_at() {
    let frames = [0, 1, 2, 7, 3, 11, 10];
    let expected: Vec<_> = frames.iter().map(|frame| Ok((*frame as u64, 5))).collect();
    assert_eq!(shown(&sequence(), &frames), expected);
}

#[test]
fn frames_of_a_damaged_group_are_skipped_with_a_message_and_the_next_group_plays() {
    let mut bytes = sequence();
    let (from, to) = {
        let reader = SequenceReader::new(&bytes[..], &Limits::default()).unwrap();
        let groups = &reader.index().groups;
        (
            groups[1].offset as usize,
            groups[1].offset as usize + groups[1].bytes as usize,
        )
    };
    bytes[(from + to) / 2] ^= 1;
    let shown = shown(&bytes, &[3, 4, 8]);
    assert_eq!((&shown[0], &shown[2]), (&Ok((3, 5)), &Ok((8, 5))));
    let message = shown[1].as_ref().expect_err("a damaged frame");
    assert!(message.starts_with("frames 4 to 7 are skipped: "), "{message}");
}

#[test]
fn a_running_clock_shows_frames_in_order_and_another_level_goes_on_from_there() {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), sequence()).unwrap();
    let (mut sources, heard) = sources();
    sources.want(wish(0, file.path(), None));
    let mut clock = clock(&heard);
    for _ in 0..3 {
        clock.change_speed(true, Instant::now());
    }
    clock.play(Instant::now());
    sources.play(&clock);
    let mut seen = vec![next(&heard).unwrap().0];
    while seen[seen.len() - 1] < 11 {
        seen.push(next(&heard).unwrap().0);
    }
    assert!(seen.windows(2).all(|pair| pair[0] < pair[1]), "{seen:?}");
    sources.want(wish(1, file.path(), Some(4)));
    assert_eq!(next(&heard), Ok((11, 4)));
    sources.want(wish(2, file.path(), None));
    let again = self::clock(&heard);
    sources.play(&again);
    let last = std::iter::repeat_with(|| next(&heard).unwrap().0).find(|frame| *frame == 0);
    assert_eq!(last, Some(0));
    sources.want(wish(3, Path::new("missing"), None));
    assert!(next(&heard).is_err());
}
