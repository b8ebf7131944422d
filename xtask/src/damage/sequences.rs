//! What can be wrong with a sequence, and the clause of `docs/format.md` that it breaks.

use b2p::motion::{Blocks, Head, Mode, Modes};
use b2p::{Decoder, Limits, SequenceDecoder, SequenceReader};
use xxhash_rust::xxh3::xxh3_64;

use super::kinds::Kind;
use super::parts::{Chunk, varint};
use super::sequence_parts::Sequence;

/// Groups of 3, 3 and 1 frames of the levels 2 to 4 of 5 bits. Predicted frames have one block.
const MOVING: &str = "sequences/moving";
/// One group, whose frames have the levels 3 to 6 and blocks of level 2.
const MANY: &str = "sequences/many-vectors";
/// One group, whose frames have the levels 4 to 6 and blocks of level 2 that are divided.
const PARTS: &str = "sequences/parts";
const WARPED: &str = "sequences/warped";
/// One group, whose frames are the root.
const ROOT: &str = "sequences/root-alone";

/// All kinds of damage; `read` reads a sequence of the suite.
pub fn all(read: impl Fn(&str) -> Vec<u8>) -> Vec<Kind> {
    let mut kinds = Vec::new();
    let mut of = |stream: &'static str, of: &[fn(&mut Add)]| {
        let whole = Sequence::of(&read(stream));
        let mut add = |name: &'static str, clause: &'static str, damage: &dyn Fn(&mut Sequence)| {
            let mut sequence = whole.clone();
            damage(&mut sequence);
            let tries = vec![sequence.bytes()];
            kinds.push(Kind {
                name,
                stream,
                clause,
                tries,
            });
        };
        of.iter().for_each(|of| of(&mut add));
    };
    of(MOVING, &[headers, indices, entries, groups]);
    of(MOVING, &[tables, frame_entries, frames, motion, words]);
    of(
        ROOT,
        &[|add| {
            add("motion-that-no-level-needs-goes-on", "5.4.3", &|s| {
                s.motion(0).extend([0; 12])
            });
        }],
    );
    of(PARTS, &[divided]);
    of(WARPED, &[warped]);
    kinds.extend(crowded(&read(MANY)));
    kinds.extend(parts(&read(PARTS)));
    kinds
}

type Add<'a> = dyn FnMut(&'static str, &'static str, &dyn Fn(&mut Sequence)) + 'a;

fn headers(add: &mut Add) {
    add("sequence-header-checksum", "2.2.1", &|s| s.sum = 1);
    add("sequence-that-is-a-scene-too", "2.2.1", &|s| s.header[12] = 3);
    add("sequence-of-a-later-version", "2.2.1", &|s| s.header[13] = 1);
    add("sequence-points-none", "2.2.2", &|s| {
        s.header[24..32].copy_from_slice(&[0; 8])
    });
    add("sequence-origin-nan", "2.2.3", &|s| {
        s.header[32..40].copy_from_slice(&f64::NAN.to_le_bytes())
    });
    add("sequence-with-a-section", "17.1.2", &|s| s.header[84] = 1);
    add("sequence-with-fewer-points-than-a-frame", "17.1.2", &|s| {
        s.header[24] -= 1
    });
    add("sequence-with-fewer-voxels-than-a-frame", "17.1.2", &|s| {
        s.header[80] -= 1
    });
}

fn indices(add: &mut Add) {
    add("sequence-cut-after-the-header", "17.1.1", &|s| s.keep(s.header_bytes()));
    add("sequence-cut-in-the-index-header", "17.1.1", &|s| {
        s.keep(s.header_bytes() + 2)
    });
    add("sequence-cut-in-the-index", "17.1.1", &|s| {
        s.keep(s.header_bytes() + 30)
    });
    add("sequence-index-checksum", "3.1.1", &|s| s.chunks[0].sum = 1);
    add("sequence-index-of-slice-65536", "3.1.1", &|s| {
        s.chunks[0].slice = varint(65_536)
    });
    add("sequence-index-of-type-1", "3.1.2", &|s| s.chunks[0].kind = 1);
    add("sequence-index-is-a-frame-table", "17.2.1", &|s| s.chunks[0].kind = 11);
    add("sequence-index-of-level-1", "17.2.1", &|s| s.chunks[0].level = 1);
    add("sequence-index-of-slice-1", "17.2.1", &|s| {
        s.chunks[0].slice = varint(1)
    });
    add("sequence-index-of-no-group", "17.2.1", &|s| {
        s.more = -(s.groups.len() as i64)
    });
    add("sequence-index-of-one-group-more", "17.2.2", &|s| s.more = 1);
    add("sequence-index-of-one-group-less", "17.2.2", &|s| s.more = -1);
    add("sequence-index-of-4-billion-groups", "17.2.2", &|s| {
        s.more = u32::MAX as i64 - s.groups.len() as i64
    });
    add("sequence-index-goes-on", "17.2.2", &|s| s.tails[0] = vec![0]);
    add("sequence-index-short", "17.2.2", &|s| s.short[0] = 1);
    add("sequence-index-without-units", "17.2.2", &|s| s.short[0] = usize::MAX);
    add("sequence-units-in-space", "17.2.2", &|s| s.units = 1);
    add("sequence-units-unknown", "17.2.2", &|s| s.units = 2);
    add("sequence-of-no-tick-per-second", "17.2.2", &|s| s.rate[0] = 0);
    add("sequence-of-frames-of-no-tick", "17.2.2", &|s| s.rate[1] = 0);
    add("sequence-ancillary-chunk-before-the-index", "3.1.1", &|s| {
        let mut chunk = Chunk::new(200, 9, 9, 9, b"later");
        chunk.sum = 1;
        s.chunks.insert(0, chunk);
    });
    add("sequence-ancillary-chunk-behind-the-index", "17.2.3", &|s| {
        s.chunks.push(Chunk::new(200, 9, 9, 9, b"later"))
    });
}

fn entries(add: &mut Add) {
    add("group-of-no-frame", "17.2.2", &|s| s.groups[0].count = varint(0));
    add("group-of-65537-frames", "17.2.2", &|s| {
        s.groups[0].count = varint(65_537)
    });
    add("group-of-a-frame-more", "17.3.1", &|s| s.groups[0].count = varint(4));
    add("group-frames-not-shortest", "1.4.2", &|s| {
        s.groups[0].count = vec![0x83, 0]
    });
    add("group-gap-of-2-to-the-32", "1.4.2", &|s| s.groups[1].gap = 1 << 32);
    add("group-of-no-tick", "17.3.3", &|s| s.groups[0].ticks = 0);
    add("group-that-ends-when-its-last-frame-starts", "17.3.3", &|s| {
        s.groups[0].ticks = s.groups[0].frames.iter().map(|frame| frame.step).sum()
    });
    add("group-longer-than-it-is", "17.2.3", &|s| s.groups[0].longer = 1);
    add("last-group-longer-than-the-sequence", "17.2.3", &|s| {
        s.last().longer = 1
    });
    add("last-group-of-4-gib", "17.2.3", &|s| {
        let length = s.last().bytes().len() as u64;
        s.last().longer = u64::from(u32::MAX) - length;
    });
    add("group-of-no-byte", "17.2.3", &|s| {
        let length = s.last().bytes().len() as u64;
        s.last().longer = length.wrapping_neg();
    });
}

fn groups(add: &mut Add) {
    add("group-of-another-hash", "17.2.3", &|s| s.groups[0].hash = 1 << 63);
    add("group-changed", "17.2.3", &|s| {
        let group = &mut s.groups[1];
        let before = xxh3_64(&group.bytes());
        let part = &mut group.frames[2].levels[2].parts[2];
        let last = part.len() - 1;
        part[last] ^= 1;
        group.hash = before ^ xxh3_64(&group.bytes());
    });
    add("groups-that-are-exchanged", "17.2.3", &|s| {
        let [a, b] = [0, 1].map(|group: usize| xxh3_64(&s.groups[group].bytes()));
        s.groups.swap(0, 1);
        s.groups[0].hash = a ^ b;
        s.groups[1].hash = a ^ b;
    });
    add("groups-that-overlap", "17.3.4", &|s| {
        // The first one has the start of the second, which is no more than that.
        let start = s.groups[1].bytes()[..20].to_vec();
        s.groups[0].tails[1] = start;
        let whole = s.groups[1].bytes();
        s.groups[1].longer = 20u64.wrapping_neg();
        s.groups[1].hash = xxh3_64(&whole) ^ xxh3_64(&whole[20..]);
    });
    add("sequence-without-its-groups", "17.2.3", &|s| {
        s.short[1] = s.groups.iter().map(|group| group.bytes().len()).sum()
    });
    add("sequence-cut-in-its-first-group", "17.2.3", &|s| {
        s.short[1] = s.groups[1..].iter().map(|group| group.bytes().len()).sum::<usize>() + 40
    });
    add("sequence-cut-by-a-byte", "17.2.3", &|s| s.short[1] = 1);
    add("sequence-goes-on", "17.1.1", &|s| s.tails[1] = vec![0]);
    add("sequence-with-a-group-more", "17.1.1", &|s| {
        s.tails[1] = s.groups[0].bytes()
    });
}

fn tables(add: &mut Add) {
    add("group-of-nothing", "17.3.1", &|s| s.groups[0].short[1] = usize::MAX);
    add("group-cut-in-the-head-of-its-table", "17.3.1", &|s| {
        s.groups[0].short[1] = s.groups[0].bytes().len() - 4
    });
    add("group-cut-in-its-table", "17.3.1", &|s| {
        s.groups[0].short[1] = s.groups[0].bytes().len() - 30
    });
    add("frame-table-checksum", "3.1.1", &|s| s.groups[0].table.sum = 1);
    add("frame-table-of-type-1", "3.1.2", &|s| s.groups[0].table.kind = 1);
    add("frame-table-is-an-index", "17.3.1", &|s| s.groups[0].table.kind = 10);
    add("frame-table-of-level-1", "17.3.1", &|s| s.groups[0].table.level = 1);
    add("frame-table-of-slice-1", "17.3.1", &|s| {
        s.groups[0].table.slice = varint(1)
    });
    add("frame-table-of-one-frame-more", "17.3.1", &|s| s.groups[0].more = 1);
    add("frame-table-of-one-frame-less", "17.3.1", &|s| s.groups[0].more = -1);
    add("frame-table-goes-on", "17.3.2", &|s| s.groups[0].tails[0] = vec![0]);
    add("frame-table-short", "17.3.2", &|s| s.groups[0].short[0] = 1);
    add("group-goes-on", "17.3.4", &|s| s.groups[0].tails[1] = vec![0]);
    add("group-short", "17.3.4", &|s| s.groups[0].short[1] = 1);
}

fn frame_entries(add: &mut Add) {
    add("frame-of-kind-2", "17.3.2", &|s| s.frame(1).kind = 2);
    add("frame-at-the-time-of-the-one-before", "17.3.2", &|s| {
        s.frame(1).step = 0
    });
    add("first-frame-late", "17.3.2", &|s| s.frame(0).step = 1);
    add("frame-times-of-2-to-the-32", "17.3.2", &|s| {
        s.frame(1).step = u32::MAX.into();
        s.frame(2).step = u32::MAX.into();
    });
    add("frame-without-points", "17.3.2", &|s| s.frame(1).points = 0);
    add("frame-without-voxels", "17.3.2", &|s| s.frame(1).levels[0].voxels = 0);
    add("frame-with-fewer-points-than-voxels", "17.3.2", &|s| {
        s.frame(1).points = s.frame(1).levels[2].voxels - 1
    });
    add("frame-with-more-children-than-eight", "17.3.2", &|s| {
        s.frame(1).levels[1].voxels = 8 * s.frame(1).levels[0].voxels + 1
    });
    add("frame-with-more-points-than-the-sequence", "17.1.2", &|s| {
        s.frame(1).points += 500
    });
    add("frame-predicted-from-none", "17.3.3", &|s| {
        s.groups[0].frames[0] = s.groups[0].frames[1].clone();
        s.frame(0).step = 0;
    });
    add("frame-with-a-section-too-long", "17.3.4", &|s| {
        s.frame(2).levels[2].longer[2] = 1
    });
    add("frame-with-a-section-too-short", "17.3.4", &|s| {
        s.frame(2).levels[2].longer[1] = -1
    });
    add("frame-with-motion-too-long", "17.3.4", &|s| {
        s.frame(1).levels[0].longer[0] = 1
    });
    add("frame-with-sections-of-4-gib", "17.3.4", &|s| {
        s.frame(1)
            .levels
            .iter_mut()
            .for_each(|level| level.longer[2] = 0xffff_0000)
    });
    add("frame-with-the-border-of-its-sections-moved", "2.1.2", &|s| {
        s.frame(1).levels[1].longer = [0, 1, -1]
    });
}

fn frames(add: &mut Add) {
    add("whole-frame-with-a-chunk-changed", "3.1.1", &|s| {
        *s.frame(0).levels[2].parts[2].last_mut().expect("colours") ^= 1
    });
    add("predicted-frame-with-a-chunk-changed", "3.1.1", &|s| {
        *s.frame(1).levels[2].parts[1].last_mut().expect("geometry") ^= 1
    });
    add("frame-with-a-chunk-of-an-index", "3.1.2", &|s| {
        Chunk::new(10, 4, 0, 0, &[]).write(true, &mut s.frame(1).levels[2].parts[1])
    });
    add("frame-with-a-chunk-too-many", "3.2.1", &|s| {
        Chunk::new(1, 4, 1, 1, &[0; 4]).write(true, &mut s.frame(1).levels[2].parts[1])
    });
    add("frame-without-the-geometry-of-a-level", "3.2.3", &|s| {
        s.frame(2).levels[2].parts[1].clear()
    });
    add("frame-without-the-colours-of-a-level", "3.3.2", &|s| {
        s.frame(2).levels[2].parts[2].clear()
    });
    add("frame-without-the-one-that-it-is-predicted-from", "4.2.3", &|s| {
        let step = s.groups[0].frames.remove(1).step;
        s.frame(1).step += step;
        s.groups[0].count = varint(2);
    });
    add("frame-with-another-vector", "5.4.3", &|s| {
        with_blocks(s, |blocks| blocks.vectors[0][1] -= 1)
    });
    add("frame-with-other-modes-of-occupancies", "4.2.3", &|s| {
        with_blocks(s, |blocks| blocks.modes[3][0].geometry = Mode::Intra)
    });
    add("frame-with-other-modes-of-colours", "5.10.1", &|s| {
        with_blocks(s, |blocks| blocks.modes[3][0].colours = Mode::Intra)
    });
    add("frame-of-one-voxel-less-than-its-level", "3.2.4", &|s| {
        s.frame(1).levels[2].voxels -= 1
    });
}

/// Changes what the second frame says of its block.
fn with_blocks(sequence: &mut Sequence, change: impl Fn(&mut Blocks)) {
    let parts = [0, 1, 2].map(|level| sequence.motion(level).clone());
    let (head, rest) = Head::parse(&parts[0], 2, 4).expect("a head");
    let blocks = head.blocks(2, &[0], &[rest, &parts[1], &parts[2]]);
    let mut blocks = blocks.expect("motion of one block");
    change(&mut blocks);
    let parts = head
        .write(2, [&[0], &[]], [&blocks, &Blocks::default()])
        .expect("motion of one block");
    for (level, part) in parts.into_iter().enumerate() {
        *sequence.motion(level) = part;
    }
}

fn motion(add: &mut Add) {
    add("motion-of-no-byte", "17.5.1", &|s| s.motion(0).clear());
    add("motion-of-9-bytes", "17.5.1", &|s| s.motion(0).truncate(9));
    add("motion-of-blocks-below-the-first-level", "17.5.1", &|s| {
        s.motion(0)[0] = 3
    });
    add("motion-of-blocks-of-level-255", "17.5.1", &|s| s.motion(0)[0] = 255);
    add("motion-in-voxels-above-the-last-level", "17.5.1", &|s| {
        s.motion(0)[1] = 3
    });
    add("motion-in-voxels-of-level-22", "17.5.1", &|s| s.motion(0)[1] = 22);
    add("motion-with-a-reference-above-the-blocks", "17.5.1", &|s| {
        s.motion(0)[0] = 1;
        s.motion(0)[2] = 0;
    });
    add("motion-with-a-reference-below-the-last-level", "17.5.1", &|s| {
        s.motion(0)[2] = 5
    });
    add("motion-of-mode-3", "17.5.1", &|s| s.motion(0)[3] = 0x13);
    add("motion-of-mode-3-of-colours", "17.5.1", &|s| s.motion(0)[3] = 0x31);
    add("vector-of-the-root-longer-than-the-cube", "17.5.3", &|s| {
        s.motion(0)[4..6].copy_from_slice(&17i16.to_le_bytes())
    });
    add("vector-of-the-root-of-minus-32768", "17.5.3", &|s| {
        s.motion(0)[8..10].copy_from_slice(&i16::MIN.to_le_bytes())
    });
    add("vector-of-a-block-longer-than-the-cube", "17.5.3", &|s| {
        let head = Head::parse(s.motion(0), 2, 4).expect("a head").0;
        let blocks = Blocks {
            vectors: vec![[0, -17, 0]],
            modes: vec![vec![Modes::default()]; 4],
        };
        *s.motion(0) = head
            .write(2, [&[0], &[]], [&blocks, &Blocks::default()])
            .expect("motion")
            .swap_remove(0);
    });
    add("vector-with-an-escape-of-17-bits", "17.5.3", &|s| {
        // All decisions are 1.
        s.motion(0).truncate(10);
        s.motion(0).extend([0xff, 0xff, 0xff, 0xff, 0, 0, 0, 0xff]);
    });
}

fn words(add: &mut Add) {
    add("motion-with-an-invalid-quantile", "5.4.2", &|s| {
        s.motion(0).truncate(10);
        s.motion(0).extend([0xff; 8]);
    });
    add("motion-of-half-a-word", "5.4.3", &|s| s.motion(0).push(0));
    add("motion-goes-on", "5.4.3", &|s| s.motion(0).extend([0; 12]));
    add("motion-of-a-finer-level-of-half-a-word", "5.4.3", &|s| {
        s.motion(1).push(0)
    });
    add("motion-of-a-finer-level-goes-on", "5.4.3", &|s| {
        s.motion(2).extend([0; 12])
    });
}

fn divided(add: &mut Add) {
    add("motion-of-parts-below-the-first-level", "17.5.1", &|s| {
        s.motion(0)[0] = 0x84
    });
    add("coarse-colours-of-blocks-without-parts", "17.5.1", &|s| {
        s.motion(0)[0] = 0x42
    });
    add("coarse-colours-of-parts-below-the-first-level", "17.5.1", &|s| {
        s.motion(0)[0] = 0xc3
    });
    add("coarse-colours-of-parts-of-the-reference-level", "17.5.1", &|s| {
        s.motion(0)[0] = 0xc2;
        s.motion(0)[2] = 3;
    });
    add("motion-of-parts-goes-on", "5.4.3", &|s| s.motion(0).extend([0; 12]));
    add("motion-of-parts-of-no-word", "17.5.3", &|s| {
        s.motion(0).truncate(10);
        s.motion(0).extend([0xff, 0xff, 0xff, 0xff, 0, 0, 0, 0xff]);
    });
}

/// The lattice follows the head of 10 bytes: its level, the least weight of voxels, the length of its words.
fn warped(add: &mut Add) {
    add("warped-frame-whose-coarse-colours-move", "17.5.1", &|s| {
        s.motion(0)[0] |= 0x40
    });
    add("smooth-frame-whose-coarse-colours-move", "17.5.1", &|s| {
        s.motion(0)[0] |= 0xc0
    });
    add("warped-frame-with-another-reference", "17.5.1", &|s| {
        s.motion(0)[2] -= 1
    });
    add("warped-frame-with-a-vector", "17.5.1", &|s| s.motion(0)[6] = 1);
    add("lattice-that-is-not-there", "17.10.1", &|s| s.motion(0).truncate(10));
    add("lattice-of-the-level-above-the-finest", "17.10.1", &|s| {
        s.motion(0)[10] = 5
    });
    add("lattice-of-level-255", "17.10.1", &|s| s.motion(0)[10] = 255);
    add("lattice-without-a-least-weight", "17.10.1", &|s| {
        s.motion(0).truncate(11)
    });
    add("lattice-whose-voxels-are-not-near", "17.10.1", &|s| {
        s.motion(0)[11] = 39
    });
    add("lattice-without-a-length", "17.10.1", &|s| s.motion(0).truncate(12));
    add("lattice-longer-than-the-motion", "17.10.1", &|s| {
        s.motion(0).splice(12..13, [0xff, 0xff, 0x7f]);
    });
    add("lattice-with-a-length-not-shortest", "1.4.2", &|s| {
        s.motion(0).splice(12..13, [0x80, 0x80, 0]);
    });
    add("lattice-of-a-byte-more", "5.4.3", &|s| s.motion(0)[12] += 1);
    add("lattice-of-other-words", "17.5.3", &|s| {
        // All decisions are 1.
        s.motion(0).truncate(10);
        s.motion(0).extend([2, 40, 8, 0xff, 0xff, 0xff, 0xff, 0, 0, 0, 0xff]);
    });
    add("motion-of-a-warped-frame-goes-on", "5.4.3", &|s| {
        s.motion(0).extend([0; 12])
    });
}

/// Vectors of parts that are out of range.
fn parts(bytes: &[u8]) -> Vec<Kind> {
    let whole = Sequence::of(bytes);
    let reader = SequenceReader::new(bytes, &Limits::unlimited()).expect("a sequence");
    let frame = SequenceDecoder::new(Decoder::new().with_level(4)).frame(&reader, 1);
    let frame = frame.expect("a frame");
    let voxels = frame.points().expect("level 4").voxels.keys();
    let nodes = |down: u32| {
        let mut keys: Vec<u64> = voxels.iter().map(|key| key >> down).collect();
        keys.dedup();
        keys
    };
    let (blocks, parts) = (nodes(6), nodes(3));
    let keys: [&[u64]; 2] = [&blocks, &parts];
    let mut sequence = whole.clone();
    let sections = [0, 1, 2].map(|level| sequence.motion(level).clone());
    let (head, rest) = Head::parse(&sections[0], 4, 6).expect("a head");
    let sections = [rest, &sections[1], &sections[2]];
    let own = head.blocks(4, keys[0], &sections).expect("motion of blocks");
    let mut divided = head.parts(4, keys, &sections).expect("motion of parts");
    divided.vectors[0] = [0, 65, 0];
    for (level, part) in head
        .write(4, keys, [&own, &divided])
        .expect("motion")
        .into_iter()
        .enumerate()
    {
        *sequence.motion(level) = part;
    }
    vec![Kind {
        name: "motion-of-a-part-longer-than-the-cube",
        stream: PARTS,
        clause: "17.5.3",
        tries: vec![sequence.bytes()],
    }]
}

/// All blocks come from one place. Which one has enough voxels is found by trial.
fn crowded(bytes: &[u8]) -> Vec<Kind> {
    let whole = Sequence::of(bytes);
    let reader = SequenceReader::new(bytes, &Limits::unlimited()).expect("a sequence");
    let frame = SequenceDecoder::new(Decoder::new().with_level(3)).frame(&reader, 1);
    let frame = frame.expect("a frame");
    let keys = frame.points().expect("level 3").voxels.keys();
    let mut blocks: Vec<u64> = keys.iter().map(|key| key >> 3).collect();
    blocks.dedup();
    let place = |block: u64| b2p::geometry::morton::decode(block).map(|x| 16 * x as i16);
    let from = |source: &u64| {
        let mut sequence = whole.clone();
        let (head, _) = Head::parse(sequence.motion(0), 3, 6).expect("a head");
        let vector = |block: &u64| [0, 1, 2].map(|axis| place(*block)[axis] - place(*source)[axis]);
        let own = Blocks {
            vectors: blocks.iter().map(vector).collect(),
            modes: vec![vec![Modes::default(); blocks.len()]; 4],
        };
        let parts = head
            .write(3, [&blocks, &[]], [&own, &Blocks::default()])
            .expect("motion");
        for (level, part) in parts.into_iter().enumerate() {
            *sequence.motion(level) = part;
        }
        sequence.bytes()
    };
    vec![Kind {
        name: "blocks-that-all-come-from-one-place",
        stream: MANY,
        clause: "17.8.2",
        tries: blocks.iter().map(from).collect(),
    }]
}
