//! The sequences of the suite: what is unusual about them is in their names.

use b2p::cloud::ColouredVoxels;
use b2p::container::Header;
use b2p::container::sequence::{FrameEntry, FrameKind, GroupEntry, Index, parse_table, table_bytes};
use b2p::encoder::transform::{Options, QualityTarget};
use b2p::geometry::{Voxels, morton};
use b2p::motion::{Blocks, Head, Modes};
use b2p::{Axes, Limits, Motion, Placement, SequenceEncoder, Up};

use crate::common::{Ball, cloud_of};

/// A coloured voxel.
type Voxel = ([u32; 3], [u8; 3]);

fn cloud(bits: u8, voxels: impl Iterator<Item = Voxel>) -> ColouredVoxels {
    let mut voxels: Vec<_> = voxels.map(|(at, colour)| (morton::encode(at), colour)).collect();
    voxels.sort_unstable();
    ColouredVoxels {
        voxels: Voxels::new(bits, voxels.iter().map(|voxel| voxel.0).collect()),
        colours: voxels.iter().map(|voxel| voxel.1).collect(),
        placement: Placement::VOXEL_GRID,
    }
}

/// A ball of 5 bits, `step` voxels further in each frame.
fn moving(frame: u64, step: [u32; 3]) -> impl Iterator<Item = Voxel> {
    let moved = move |(at, colour): Voxel| {
        let place = |axis: usize| at[axis] - 3 + step[axis] * frame as u32;
        ([0, 1, 2].map(place), colour)
    };
    Ball::new(5, 8.5).voxels().into_iter().map(moved)
}

/// A ball of 6 bits of whose voxels other ones are missing in each frame.
fn still(frame: u64) -> impl Iterator<Item = Voxel> {
    let is_there = move |(at, _): &Voxel| {
        let number = morton::encode(*at) ^ frame << 40;
        number.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 56 > 6
    };
    Ball::new(6, 14.0).voxels().into_iter().filter(is_there)
}

/// A small ball: where it is in frame 0, how far it moves in each frame, the first frame that it is in, and what each frame
/// adds to its colours.
type Mover = ([i32; 3], [i32; 3], u64, i32);

/// Small balls in a cube of 7 bits.
const BALLS: [Mover; 6] = [
    ([20, 20, 20], [4, 2, 0], 0, 0),
    ([100, 24, 30], [-6, -1, 3], 0, 0),
    ([30, 100, 100], [22, -20, 0], 0, 0),
    ([110, 104, 40], [-21, -23, 5], 0, 0),
    ([64, 64, 100], [0, 0, 0], 1, 0),
    ([64, 20, 110], [0, 0, 0], 0, 60),
];

/// [`BALLS`] at a frame.
fn many(frame: u64) -> impl Iterator<Item = Voxel> {
    let there = BALLS.into_iter().filter(move |ball| ball.2 <= frame);
    there.flat_map(move |(first, step, _, more)| {
        let frame = frame as i32;
        let moved = move |(at, colour): Voxel| {
            let place = |axis: usize| (first[axis] + step[axis] * frame + at[axis] as i32 - 8) as u32;
            (
                [0, 1, 2].map(place),
                colour.map(|c| (i32::from(c) + more * frame).min(255) as u8),
            )
        };
        Ball::new(4, 5.0).voxels().into_iter().map(moved)
    })
}

/// A bar of 6 bits that turns, by an eighth of its length in each frame.
fn turned(frame: u64) -> impl Iterator<Item = Voxel> {
    (0..40 * 36).map(move |i| {
        let (along, across, up) = (i % 40, i / 40 % 6, i / 240);
        let side = 20 + across + (along * frame as u32) / 8;
        let colour = [60 + 4 * along as u8, 20 * across as u8, 30 * up as u8];
        ([12 + along, side, 24 + up], colour)
    })
}

/// Two balls of 7 bits that move in other directions.
fn parting(frame: u64) -> impl Iterator<Item = Voxel> {
    let moves = [([40, 42, 40], [2, 1, 1]), ([84, 80, 82], [-1, 2, -2])];
    moves.into_iter().flat_map(move |(first, step)| {
        let place =
            move |at: [u32; 3], axis: usize| (first[axis] + step[axis] * frame as i32 + at[axis] as i32 - 32) as u32;
        let moved = move |(at, colour): Voxel| ([0, 1, 2].map(|axis| place(at, axis)), colour);
        Ball::new(6, 14.0).voxels().into_iter().map(moved)
    })
}

fn code(encoder: &SequenceEncoder, frames: u64, cloud: impl Fn(u64) -> ColouredVoxels + Sync) -> Vec<u8> {
    let coded = encoder.encode(frames, |frame| Ok(cloud(frame)), |_| {});
    coded.expect("small clouds are coded")
}

/// The same sequence with gaps before groups, other times in each of them, and without its finest level.
fn retimed_and_cut(bytes: &[u8]) -> Vec<u8> {
    let limits = Limits::default();
    let header = Header::parse_sequence(bytes, &limits).expect("a header");
    let mut index = Index::parse(bytes, &header, &limits).expect("an index");
    let (mut groups, mut end) = (Vec::new(), 0);
    for entry in &mut index.groups {
        let old = entry.take(bytes).expect("a group");
        let mut frames = parse_table(old, entry, &header, &limits).expect("a frame table");
        let (mut content, mut ticks) = (Vec::new(), 0);
        for (number, frame) in frames.iter_mut().enumerate() {
            frame.ticks = ticks;
            ticks += 1 + 299 * number as u32;
            frame.levels.pop();
            content.extend(&old[frame.offset as usize..][..frame.bytes() as usize]);
        }
        let group = [table_bytes(&frames).expect("a frame table"), content].concat();
        *entry = GroupEntry::of(&group, entry.frames, end + 7, ticks).expect("a small group");
        end += 7 + u64::from(ticks);
        groups.extend(group);
    }
    let mut header = header;
    header.top -= 1;
    header.voxels.pop();
    header.sections.pop();
    let mut changed = header.write_sequence();
    index.write(&mut changed).expect("an index");
    changed.extend(groups);
    changed
}

/// Two frames of level 0, the second predicted: nothing of its motion has an effect.
fn root_alone(bytes: &[u8]) -> Vec<u8> {
    let limits = Limits::default();
    let header = Header::parse_sequence(bytes, &limits).expect("a header");
    let mut index = Index::parse(bytes, &header, &limits).expect("an index");
    let old = index.groups[0].take(bytes).expect("a group");
    let mut frames = parse_table(old, &index.groups[0], &header, &limits).expect("a frame table");
    let content = &old[frames[0].offset as usize..];
    let head = Head {
        block_level: 0,
        unit_level: 3,
        reference_level: 0,
        root: Modes::default(),
        vector: [-8, 3, 0],
        divided: false,
        moves_coarse: false,
        warped: false,
        smooth: false,
    };
    let blocks = Blocks {
        vectors: vec![[7, 0, 8]],
        modes: Vec::new(),
    };
    let motion = head
        .write(0, [&[0], &[]], [&blocks, &Blocks::default()])
        .expect("a small vector")
        .concat();
    let mut second = FrameEntry {
        kind: FrameKind::Predicted,
        ticks: 1,
        ..frames[0].clone()
    };
    second.levels[0].motion = motion.len() as u32;
    frames.push(second);
    let group = [&table_bytes(&frames).expect("a frame table"), content, &motion, content].concat();
    index.groups[0] = GroupEntry::of(&group, 2, 0, 2).expect("a small group");
    let mut changed = header.write_sequence();
    index.write(&mut changed).expect("an index");
    changed.extend(group);
    changed
}

/// A sequence, what is unusual about it in its name, and whether no float had a part in it, so that every machine makes
/// the same bytes.
pub fn cases() -> Vec<(&'static str, Vec<u8>, bool)> {
    let moved = |levels, quality, motion| {
        let encoder = SequenceEncoder::new().with_levels(levels).with_quality(quality);
        encoder.with_motion(motion)
    };
    let warped = |levels, quality| moved(levels, quality, Motion::Warped);
    let divided = |levels, quality| moved(levels, quality, Motion::Parts);
    let of = |levels, quality| moved(levels, quality, Motion::Blocks);
    let (step, lossless) = (QualityTarget::Step, QualityTarget::Lossless);
    let slow = |frame| cloud(5, moving(frame, [1, 0, 0]));
    let fast = |frame| cloud(5, moving(frame, [2, 1, 3]));
    let turning = |frame| cloud(6, turned(frame));
    let grey = |frame| cloud(5, moving(frame, [0, 1, 0]).map(|(at, colour)| (at, [colour[1]; 3])));
    let kept = |frame| cloud(6, still(frame));
    // Nothing of the second half of the frames is like the first.
    let cut = |frame: u64| match frame {
        0 | 1 => slow(frame),
        _ => cloud_of(5, (0..420).map(|i| i * 77 + frame * 8).collect()),
    };
    let vary = |frame| cloud(7, many(frame));
    let apart = |frame| cloud(7, parting(frame));
    let far = |i: u64, frame: u64| i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 1 ^ (frame & i);
    let lone = |frame| cloud_of(21, (0..12).map(|i| far(i, frame)).collect());
    let axes = Axes {
        up: Some(Up::Z),
        ..Axes::default()
    };
    let sliced = Options {
        slice_voxels: 30,
        colour_slice: 25,
        filter: false,
        motion: Motion::Blocks,
        ..Options::default()
    };
    let groups = of(2..=4, step(30.0)).with_group(3);
    vec![
        ("still", code(&of(2..=5, step(20.0)).with_axes(axes), 4, kept), false),
        (
            "moving",
            code(&groups.clone().with_frame_rate(30_000, 1001), 7, slow),
            false,
        ),
        (
            "scalable",
            code(&of(1..=4, step(30.0)).with_scalability(true), 4, fast),
            false,
        ),
        ("fast", code(&of(2..=5, step(60.0)), 4, fast), false),
        ("grey", code(&of(0..=4, step(20.0)), 3, grey), false),
        ("whole-frame-in-a-group", code(&of(2..=4, step(30.0)), 4, cut), false),
        (
            "other-times-and-a-level-less",
            retimed_and_cut(&code(&groups.with_scalability(true), 5, slow)),
            false,
        ),
        ("many-vectors", code(&of(3..=6, step(60.0)), 3, vary), false),
        (
            "slices-and-no-filter",
            code(&SequenceEncoder::new().with_options(sliced).with_levels(2..=5), 3, slow),
            false,
        ),
        ("one-level", code(&of(3..=3, step(30.0)), 3, fast), false),
        ("root-alone", root_alone(&code(&of(0..=0, step(30.0)), 1, slow)), false),
        ("exact", code(&of(3..=5, lossless), 4, slow), false),
        ("exact-deepest", code(&of(20..=21, lossless), 3, lone), false),
        ("parts", code(&divided(4..=6, step(40.0)), 4, vary), false),
        (
            "parts-of-the-base-level",
            code(&divided(3..=6, step(60.0)), 3, vary),
            false,
        ),
        (
            "parts-scalable",
            code(&divided(3..=5, step(30.0)).with_scalability(true), 3, fast),
            false,
        ),
        ("parts-of-one-level", code(&divided(3..=3, step(30.0)), 3, fast), false),
        ("parts-exact", code(&divided(3..=5, lossless), 4, vary), false),
        ("coarse-colours", code(&divided(5..=6, step(24.0)), 4, apart), false),
        (
            "coarse-colours-scalable",
            code(&divided(4..=6, step(30.0)).with_scalability(true), 3, apart),
            false,
        ),
        ("warped", code(&warped(4..=6, step(40.0)), 4, apart), false),
        (
            "warped-from-the-first-level-on",
            code(&warped(1..=5, step(30.0)).with_group(3), 5, slow),
            false,
        ),
        (
            "warped-with-much-that-is-new",
            code(&warped(5..=7, step(60.0)), 3, vary),
            false,
        ),
        (
            "warped-of-one-level",
            code(&warped(4..=4, step(30.0)), 3, turning),
            false,
        ),
        ("warped-in-grey", code(&warped(2..=5, step(20.0)), 3, grey), false),
        ("smooth", code(&warped(3..=6, step(50.0)), 4, apart), false),
        (
            "smooth-from-the-first-level-on",
            code(&warped(1..=6, step(30.0)).with_group(3), 4, turning),
            false,
        ),
        (
            "smooth-with-much-that-is-new",
            code(&warped(4..=7, step(70.0)), 3, vary),
            false,
        ),
        ("smooth-of-one-level", code(&warped(5..=5, step(30.0)), 3, slow), false),
    ]
}
