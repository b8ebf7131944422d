//! The indices of sequences and scenes.

use super::*;
use crate::container::scene::{BlockEntry, Cube, most_level, parse_index, write_index};
use crate::container::sequence::{
    FrameEntry, FrameKind, FrameLevel, GroupEntry, Index, MAX_GROUP_FRAMES, parse_table, table_bytes,
};

/// What the units have in common: levels 2 to 4 of 6 bits.
fn common() -> Header {
    Header {
        optional_flags: 0,
        bits: 6,
        points: 60,
        format: Format::Transform { colour_slice: 3 },
        voxels: vec![9, 20, 40],
        sections: vec![Section::default(); 3],
        ..header()
    }
}

fn blocks() -> Vec<BlockEntry> {
    let block = |level, key, points, voxels: [u32; 3]| BlockEntry {
        cube: Cube { level, key },
        points,
        voxels: voxels.into(),
        offset: 0,
        bytes: 100 + points,
        hash: 77 << 40 | u64::from(points),
    };
    vec![
        block(1, 0, 10, [2, 4, 7]),
        block(2, 8, 9, [1, 4, 6]),
        block(2, 15, 11, [1, 2, 7]),
        block(1, 7, 30, [5, 10, 20]),
    ]
}

fn scene(blocks: &[BlockEntry]) -> Result<(Header, Vec<BlockEntry>)> {
    let bytes = write_index(&common(), blocks)?;
    let header = Header::parse_scene(&bytes, &Limits::default())?;
    let found = parse_index(&bytes, &header, &Limits::default())?;
    assert_eq!(found[0].offset, bytes.len() as u64);
    Ok((header, found))
}

#[test]
fn the_index_of_a_scene_is_read_as_it_was_written() {
    let (header, found) = scene(&blocks()).unwrap();
    assert_eq!((header.points, &header.voxels[..]), (60, &[9, 20, 40][..]));
    let mut offset = found[0].offset;
    for (found, written) in found.iter().zip(blocks()) {
        assert_eq!(*found, BlockEntry { offset, ..written });
        offset += u64::from(found.bytes);
        let level = found.cube.level;
        let own = found.header(&header);
        assert_eq!((own.bits, own.base, own.top), (6 - level, 2 - level, 4 - level));
        assert_eq!((own.points, &own.voxels), (found.points.into(), &found.voxels));
        assert_eq!(own.sections.len(), 3);
    }
}

#[test]
fn blocks_that_overlap_are_out_of_order_or_too_deep_are_not_written() {
    let changed = |change: &dyn Fn(&mut Vec<BlockEntry>)| {
        let mut all = blocks();
        change(&mut all);
        scene(&all).is_ok()
    };
    assert!(changed(&|_| ()));
    assert!(!changed(&|all| all.swap(1, 2)));
    assert!(!changed(&|all| all.clear()));
    assert!(!changed(&|all| all[1].cube.key = 7));
    assert!(!changed(&|all| all[2].cube.key = 8));
    assert!(!changed(&|all| all[3].cube.key = 1));
    assert!(!changed(&|all| all[3].cube.key = 8));
    assert!(!changed(&|all| all[2].cube = Cube { level: 3, key: 100 }));
    assert!(changed(&|all| all[3].cube.key = 2));
    let deepest = [(2, 6), (0, 6), (12, 6), (12, 20), (10, 11), (9, 9)].map(|(base, bits)| most_level(base, bits));
    assert_eq!(deepest, [2, 0, 5, 10, 10, 8]);
}

#[test]
fn sums_that_are_not_those_of_the_blocks_are_refused() {
    let bytes = write_index(&common(), &blocks()).unwrap();
    let header = Header::parse_scene(&bytes, &Limits::default()).unwrap();
    let with = |change: &dyn Fn(&mut Header)| {
        let mut other = header.clone();
        change(&mut other);
        let error = parse_index(&bytes, &other, &Limits::default()).err()?;
        assert_eq!(error.offset(), Some(header.bytes() as u64));
        error.clause()
    };
    assert_eq!(with(&|_| ()), None);
    assert_eq!(with(&|header| header.points += 1), Some("18.1.2"));
    for level in 0..3 {
        assert_eq!(with(&|header| header.voxels[level] += 1), Some("18.1.2"));
    }
}

#[test]
fn the_header_of_a_block_must_say_what_the_index_says() {
    let (common, blocks) = scene(&blocks()).unwrap();
    for mut entry in blocks {
        let header = entry.header(&common);
        let wrong = |entry: &BlockEntry, found: &Header| {
            let error = entry.check_header(found, &common).err()?;
            assert_eq!(error.offset(), Some(entry.offset));
            error.clause()
        };
        entry.bytes = header.prefix_bytes(header.top).unwrap() as u32;
        assert_eq!(wrong(&entry, &header), None);
        let more = |points| Header {
            points: header.points + points,
            ..header.clone()
        };
        assert_eq!(wrong(&entry, &more(1)), Some("18.3.1"));
        for bytes in [entry.bytes - 1, entry.bytes + 1] {
            let other = BlockEntry { bytes, ..entry.clone() };
            assert_eq!(wrong(&other, &header), Some("2.1.1"));
        }
    }
}

#[test]
fn the_bytes_of_a_block_must_have_the_hash_of_the_index() {
    let stream = super::transform::sample();
    let cube = Cube { level: 1, key: 3 };
    let entry = BlockEntry::of(cube, &stream).unwrap();
    assert_eq!((entry.cube, entry.points, entry.offset), (cube, 20, 0));
    assert_eq!(
        (entry.bytes as usize, &entry.voxels[..]),
        (stream.len(), &[3, 10, 20][..])
    );
    entry.check_hash(&stream).unwrap();
    let mut damaged = stream;
    damaged[200] ^= 1;
    assert_eq!(entry.check_hash(&damaged).unwrap_err().clause(), Some("18.2.4"));
}

#[test]
fn a_cube_has_the_keys_below_it() {
    let cube = Cube { level: 2, key: 5 };
    assert_eq!(
        [1, 2, 3, 4].map(|level| cube.keys(level)),
        [0..0, 5..6, 40..48, 320..384]
    );
}

/// Three groups, the last of which starts later.
fn index() -> Index {
    let group = |first, frames, start, ticks, offset, bytes| GroupEntry {
        first,
        frames,
        start,
        ticks,
        offset,
        bytes,
        hash: 99 << 50 | first,
    };
    Index {
        timescale: 30,
        duration: 1,
        groups: vec![
            group(0, 3, 5, 3, 0, 1000),
            group(3, 1, 8, 1, 1000, 20),
            group(4, 2, 19, 2, 1020, 300),
        ],
    }
}

fn sequence(index: &Index) -> Result<Index> {
    let mut bytes = common().write_sequence();
    index.write(&mut bytes)?;
    let mut found = Index::parse(&bytes, &common(), &Limits::default())?;
    for group in &mut found.groups {
        group.offset -= bytes.len() as u64;
    }
    Ok(found)
}

#[test]
fn the_index_of_a_sequence_is_read_as_it_was_written() {
    assert_eq!(sequence(&index()).unwrap(), index());
    assert_eq!(index().frames(), 6);
    let wrong = |change: &dyn Fn(&mut Index)| {
        let mut other = index();
        change(&mut other);
        sequence(&other).err().map(|error| error.clause())
    };
    assert_eq!(wrong(&|index| index.timescale = 0), Some(Some("17.2.2")));
    assert_eq!(wrong(&|index| index.duration = 0), Some(Some("17.2.2")));
    assert_eq!(wrong(&|index| index.groups.clear()), Some(Some("17.2.1")));
    assert_eq!(wrong(&|index| index.groups[1].frames = 0), Some(Some("17.2.2")));
    assert_eq!(
        wrong(&|index| index.groups[1].frames = MAX_GROUP_FRAMES + 1),
        Some(Some("17.2.2"))
    );
    assert_eq!(wrong(&|index| index.groups[1].start = 7), Some(None));
    let few = Limits {
        max_frames: 5,
        ..Limits::default()
    };
    let mut bytes = common().write_sequence();
    index().write(&mut bytes).unwrap();
    assert!(matches!(
        Index::parse(&bytes, &common(), &few),
        Err(Error::LimitExceeded { needed: 6, .. })
    ));
    let mut sections = common();
    sections.sections[1].colours = 1;
    assert_eq!(
        Index::parse(&bytes, &sections, &few).unwrap_err().clause(),
        Some("17.1.2")
    );
}

#[test]
fn a_fault_in_an_index_or_a_table_is_at_the_entry_that_has_it() {
    let mut index = index();
    index.groups[1].frames = 0;
    let mut bytes = common().write_sequence();
    index.write(&mut bytes).unwrap();
    let error = Index::parse(&bytes, &common(), &Limits::default()).unwrap_err();
    // Before the end are the entries of two groups, of 12 and 13 bytes.
    assert_eq!(error.offset(), Some(bytes.len() as u64 - 25));
    let mut frames = frames();
    frames[1].points = 61;
    let end = table_bytes(&frames).unwrap().len() as u64;
    // Those of two frames, of 15 and 12 bytes.
    assert_eq!(table(&frames, 0).unwrap_err().offset(), Some(end - 27));
}

fn frames() -> Vec<FrameEntry> {
    let level = |voxels, motion, geometry, colours| FrameLevel {
        voxels,
        motion,
        section: Section { geometry, colours },
    };
    let frame = |kind, ticks, points, levels: [FrameLevel; 3]| FrameEntry {
        kind,
        ticks,
        points,
        levels: levels.into(),
        offset: 0,
    };
    let whole = [level(8, 0, 3, 4), level(20, 0, 5, 6), level(39, 0, 7, 8)];
    let predicted = [level(9, 11, 3, 4), level(19, 2, 5, 6), level(40, 1, 7, 8)];
    vec![
        frame(FrameKind::Whole, 0, 50, whole),
        frame(FrameKind::Predicted, 2, 60, predicted),
        frame(FrameKind::Whole, 3, 40, whole),
    ]
}

/// The table of a group of so many bytes more than its frames have.
fn table(frames: &[FrameEntry], more: usize) -> Result<(usize, Vec<FrameEntry>)> {
    let mut group = table_bytes(frames)?;
    let start = group.len();
    let bytes: u64 = frames.iter().map(FrameEntry::bytes).sum();
    group.resize(start + bytes as usize + more, 0);
    let entry = GroupEntry::of(&group, 3, 0, 4)?;
    Ok((start, parse_table(&group, &entry, &common(), &Limits::default())?))
}

#[test]
fn the_table_of_a_group_is_read_as_it_was_written() {
    let (start, found) = table(&frames(), 0).unwrap();
    let mut offset = start as u64;
    for (found, written) in found.iter().zip(frames()) {
        assert_eq!(*found, FrameEntry { offset, ..written });
        offset += found.bytes();
    }
    assert_eq!(found.iter().map(FrameEntry::bytes).collect::<Vec<_>>(), [33, 47, 33]);
    assert_eq!([0, 1, 2].map(|level| found[1].prefix_bytes(level)), [18, 31, 47]);
}

#[test]
fn tables_that_do_not_fit_their_group_or_their_sequence_are_refused() {
    let wrong = |change: &dyn Fn(&mut Vec<FrameEntry>)| {
        let mut other = frames();
        change(&mut other);
        table(&other, 0).err().and_then(|error| error.clause())
    };
    assert_eq!(wrong(&|_| ()), None);
    assert_eq!(wrong(&|frames| frames.truncate(2)), Some("17.3.1"));
    assert_eq!(wrong(&|frames| frames[0].kind = FrameKind::Predicted), Some("17.3.3"));
    assert_eq!(wrong(&|frames| frames[1].ticks = 0), Some("17.3.2"));
    assert_eq!(wrong(&|frames| frames[0].ticks = 1), Some("17.3.2"));
    assert_eq!(wrong(&|frames| frames[2].ticks = 4), Some("17.3.3"));
    assert_eq!(wrong(&|frames| frames[1].points = 61), Some("17.1.2"));
    for level in 0..3 {
        assert_eq!(
            wrong(&|frames| frames[1].levels[level].voxels = [10, 21, 41][level]),
            Some("17.1.2")
        );
    }
    // As a stream of its own it could not be.
    assert_eq!(wrong(&|frames| frames[1].levels[0].voxels = 0), Some("17.3.2"));
    assert_eq!(table(&frames(), 1).unwrap_err().clause(), Some("17.3.4"));
}

#[test]
fn a_group_is_taken_if_its_hash_is_right_and_all_of_it_is_there() {
    let mut entry = GroupEntry::of(b"some bytes", 1, 0, 1).unwrap();
    entry.offset = 3;
    assert_eq!(
        entry.take(b"at some bytes then").unwrap(),
        b"at some bytes then"[3..13].as_ref()
    );
    assert_eq!(entry.take(b"at some butes then").unwrap_err().clause(), Some("17.2.3"));
    let cut = entry.take(b"at some byte").unwrap_err();
    assert!(
        matches!(
            cut,
            Error::Truncated {
                offset: 12,
                needed: 1,
                ..
            }
        ),
        "{cut:?}"
    );
}

#[test]
fn an_index_that_is_cut_says_how_many_bytes_it_lacks() {
    let mut bytes = common().write_sequence();
    let start = bytes.len();
    index().write(&mut bytes).unwrap();
    for length in start - 2..bytes.len() {
        match Index::parse(&bytes[..length], &common(), &Limits::default()) {
            Err(Error::Truncated {
                offset, needed, field, ..
            }) => {
                assert_eq!(field, "index of the sequence");
                assert!(offset <= length as u64 && needed >= 1 && length as u64 + needed <= bytes.len() as u64);
            }
            other => panic!("{length} bytes: {other:?}"),
        }
    }
}
