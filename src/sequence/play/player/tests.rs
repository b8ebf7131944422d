use super::*;
use crate::cloud::ColouredVoxels;
use crate::geometry::{Voxels, morton};
use crate::placement::Placement;
use crate::sequence::SequenceEncoder;

const FRAMES: u64 = 12;
/// Frames of a group.
const GROUP: u32 = 4;

/// A slanted plane that moves, ten frames a second.
fn sequence() -> Vec<u8> {
    let cloud = |frame: u64| {
        let voxel = |i: u32| {
            let key = morton::encode([i % 32, i / 32, i % 32 / 2 + frame as u32]);
            (key, [(i % 32 * 7) as u8, (i / 32 * 7) as u8, 50])
        };
        let mut voxels: Vec<(u64, [u8; 3])> = (0..32 * 32).map(voxel).collect();
        voxels.sort_unstable();
        Ok(ColouredVoxels {
            colours: voxels.iter().map(|voxel| voxel.1).collect(),
            voxels: Voxels::new(5, voxels.iter().map(|voxel| voxel.0).collect()),
            placement: Placement::VOXEL_GRID,
        })
    };
    let encoder = SequenceEncoder::new().with_levels(3..=5).with_group(GROUP);
    encoder.with_frame_rate(10, 1).encode(FRAMES, cloud, |_| {}).unwrap()
}

fn player(bytes: Vec<u8>) -> Player {
    Player::new(bytes, Decoder::new(), None, Some(HeadSet::Surfels)).unwrap()
}

/// The steps until nothing is to be done at this time: frames, and whether each was shown.
fn steps(player: &mut Player, now: Instant) -> Vec<(u64, bool)> {
    let made = std::iter::from_fn(|| player.next(now));
    made.map(|step| (step.frame, step.made.unwrap().is_some())).collect()
}

/// As the decoder of sequences gives it.
fn direct(bytes: &[u8], frame: u64) -> Gaussians {
    let reader = SequenceReader::new(bytes, Decoder::new().limits()).unwrap();
    let mut decoder = SequenceDecoder::new(Decoder::new());
    decoder.frame(&reader, frame).unwrap().gaussians().unwrap()
}

#[test]
fn a_clock_that_stands_gets_exactly_its_frame_by_way_of_those_it_is_predicted_from() {
    let (bytes, now) = (sequence(), Instant::now());
    let mut player = player(bytes.clone());
    assert_eq!(steps(&mut player, now), [(0, true)]);
    player.seek(0.65, now);
    let mut last = None;
    let mut seen = Vec::new();
    while let Some(step) = player.next(now) {
        seen.push(step.frame);
        last = step.made.unwrap();
    }
    assert_eq!(seen, [4, 5, 6]);
    assert_eq!(last.unwrap(), direct(&bytes, 6));
    player.step(1, now);
    assert_eq!(steps(&mut player, now), [(7, true)]);
    player.step(-1, now);
    assert_eq!(steps(&mut player, now), [(4, false), (5, false), (6, true)]);
    assert_eq!(player.dropped(), 0);
}

#[test]
fn frames_that_are_late_are_dropped_and_the_clock_is_kept() {
    let start = Instant::now();
    let at = |ms| start + Duration::from_millis(ms);
    let mut player = player(sequence());
    player.play(start);
    let step = player.next(start).unwrap();
    assert_eq!((step.frame, step.due), (0, Duration::ZERO));
    let step = player.next(at(10)).unwrap();
    assert_eq!((step.frame, step.due), (1, Duration::from_millis(90)));
    // The frame that is coded by itself is due.
    assert_eq!(player.next(at(520)).unwrap().frame, 4);
    assert_eq!(player.dropped(), 2);
    assert!(player.next(at(530)).unwrap().made.unwrap().is_some());
    assert!(player.next(at(710)).unwrap().made.unwrap().is_none());
    assert_eq!(player.dropped(), 3);
    // The next lap.
    assert_eq!(player.next(at(1210)).unwrap().frame, 0);
}

#[test]
fn a_slow_machine_gets_coarser_levels_and_a_pause_the_finest_one_of_the_frame_shown() {
    let start = Instant::now();
    let at = |ms| start + Duration::from_millis(ms);
    let mut player = player(sequence());
    player.play(start);
    let mut levels = Vec::new();
    for ms in [0, 100, 200] {
        levels.push(player.next(at(ms)).unwrap().rung.level);
        player.learn(0.3);
    }
    assert_eq!(levels, [5, 3, 3]);
    player.pause(at(290));
    let rungs: Vec<_> = std::iter::from_fn(|| player.next(at(300)))
        .map(|step| (step.frame, step.rung.level))
        .collect();
    assert_eq!(rungs, [(0, 5), (1, 5), (2, 5)]);
    assert!(player.next(at(9000)).is_none());
    player.play(at(9000));
    assert_eq!(player.next(at(9000)).unwrap().frame, 3);
}

#[test]
fn a_machine_that_is_slow_at_first_gets_the_finest_level_when_it_is_warm() {
    let start = Instant::now();
    let at = |ms| start + Duration::from_millis(ms);
    let mut player = player(sequence());
    player.play(start);
    let levels: Vec<_> = (0..60)
        .map(|i| {
            let level = player.next(at(100 * i)).unwrap().rung.level;
            player.learn(if i == 0 { 0.5 } else { 0.01 });
            level
        })
        .collect();
    assert_eq!((levels[0], levels[1]), (5, 3));
    assert!(levels[36..].iter().all(|level| *level == 5), "{levels:?}");
}

#[test]
fn a_pause_in_a_later_lap_holds_its_frame() {
    let start = Instant::now();
    let at = |ms| start + Duration::from_millis(ms);
    let mut player = player(sequence());
    player.play(start);
    for ms in [1200, 1300, 1310] {
        player.next(at(ms));
    }
    // Frame 2 was decoded ahead.
    player.pause(at(1320));
    assert!(player.next(at(5000)).is_none());
    player.play(at(5000));
    let step = player.next(at(5000)).unwrap();
    assert_eq!((step.frame, step.due), (3, Duration::from_millis(100)));
}

#[test]
fn damage_skips_the_frames_of_its_group() {
    let (mut bytes, now) = (sequence(), Instant::now());
    let reader = SequenceReader::new(&bytes[..], Decoder::new().limits()).unwrap();
    let place = reader.index().groups[1].offset as usize + 60;
    bytes[place] ^= 1;
    let mut player = player(bytes);
    player.seek(0.5, now);
    assert!(player.next(now).unwrap().made.is_err());
    assert!(player.next(now).is_none());
    player.seek(0.3, now);
    player.play(now);
    let frames: Vec<_> = (0..7)
        .map(|_| player.next(now).unwrap())
        .map(|step| (step.frame, step.made.is_ok()))
        .collect();
    let expected = [
        (0, true),
        (1, true),
        (2, true),
        (3, true),
        (4, false),
        (8, true),
        (9, true),
    ];
    assert_eq!(frames, expected);
}

#[test]
fn a_level_that_is_not_there_is_refused() {
    let refused = Player::new(sequence(), Decoder::new(), Some(9), None);
    assert!(matches!(refused, Err(Error::Usage(_))));
}
