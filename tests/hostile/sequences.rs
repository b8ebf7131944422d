//! Sequences: cut, damaged, and lying behind right checksums.

use b2p::cloud::ColouredVoxels;
use b2p::container::Header;
use b2p::container::sequence::{GroupEntry, Index, parse_table, table_bytes};
use b2p::geometry::{Voxels, morton};
use b2p::{Decoder, Error, Limits, Placement, SequenceDecoder, SequenceEncoder, SequenceReader};
use rayon::prelude::*;

use crate::common::Ball;

/// Voxels and colours of a frame, or why there are none.
type Frame = Result<(Vec<u64>, Vec<[u8; 3]>), Error>;

/// Four frames of a ball that moves, in two groups.
fn sequence() -> Vec<u8> {
    let cloud = |frame: u64| {
        let moved = |([x, y, z], colour): ([u32; 3], [u8; 3])| (morton::encode([x, y + frame as u32, z]), colour);
        let mut voxels: Vec<_> = Ball::new(5, 9.5).voxels().into_iter().map(moved).collect();
        voxels.sort_unstable();
        Ok(ColouredVoxels {
            voxels: Voxels::new(5, voxels.iter().map(|voxel| voxel.0).collect()),
            colours: voxels.iter().map(|voxel| voxel.1).collect(),
            placement: Placement::VOXEL_GRID,
        })
    };
    let encoder = SequenceEncoder::new().with_levels(3..=4).with_group(2);
    encoder.encode(4, cloud, |_| {}).expect("a ball can be coded")
}

/// Every frame that can be had.
fn frames(bytes: &[u8]) -> Result<Vec<Frame>, Error> {
    let sequence = SequenceReader::new(bytes, &Limits::default())?;
    let mut decoder = SequenceDecoder::new(Decoder::new());
    let decoded = decoder.frames(&sequence, 0..sequence.frames().min(8));
    let found = decoded.map(|frame| {
        let frame = frame?;
        let points = frame.points().expect("a level");
        Ok((points.voxels.keys().to_vec(), points.colours.to_vec()))
    });
    Ok(found.collect())
}

/// The index, and the first group.
fn parts(bytes: &[u8]) -> (Header, Index, Vec<u8>) {
    let header = Header::parse_sequence(bytes, &Limits::default()).expect("a header");
    let index = Index::parse(bytes, &header, &Limits::default()).expect("an index");
    let group = index.groups[0].take(bytes).expect("a group").to_vec();
    (header, index, group)
}

/// The sequence with another first group, of the right hash.
fn with_group(bytes: &[u8], group: &[u8]) -> Vec<u8> {
    let (header, mut index, _) = parts(bytes);
    let old = index.groups[0];
    let entry = GroupEntry::of(group, old.frames, old.start, old.ticks).expect("a short group");
    let rest = bytes[old.offset as usize + old.bytes as usize..].to_vec();
    index.groups[0] = entry;
    let mut changed = header.write_sequence();
    index.write(&mut changed).expect("an index");
    changed.extend(group);
    changed.extend(rest);
    changed
}

#[test]
fn every_cut_gives_the_frames_of_whole_groups_and_typed_errors() {
    let bytes = sequence();
    let whole = frames(&bytes).expect("a sequence");
    (0..bytes.len()).into_par_iter().for_each(|length| {
        let Ok(found) = frames(&bytes[..length]) else {
            return;
        };
        for (found, whole) in found.iter().zip(&whole) {
            if let Ok(found) = found {
                assert!(whole.as_ref().is_ok_and(|whole| whole == found), "{length} bytes");
            }
        }
        assert!(found.last().is_some_and(|last| last.is_err()), "{length} bytes");
    });
}

#[test]
fn every_flipped_bit_is_noticed_and_leaves_the_other_groups() {
    let bytes = sequence();
    let whole = frames(&bytes).expect("a sequence");
    let (_, index, _) = parts(&bytes);
    (0..8 * bytes.len()).into_par_iter().for_each(|bit| {
        let mut damaged = bytes.clone();
        damaged[bit / 8] ^= 1 << (bit % 8);
        let Ok(found) = frames(&damaged) else {
            assert!(bit / 8 < index.groups[0].offset as usize, "bit {bit}");
            return;
        };
        // The minor version and optional flags mean nothing, but the header's checksum holds them.
        let lost = found.iter().filter(|frame| frame.is_err()).count();
        assert_eq!(lost, 2, "bit {bit}");
        for (found, whole) in found.iter().zip(&whole).filter(|(found, _)| found.is_ok()) {
            assert!(found.as_ref().ok() == whole.as_ref().ok(), "bit {bit}");
        }
    });
}

#[test]
fn motion_that_is_changed_behind_the_hash_is_refused_or_decoded_within_the_limits() {
    let bytes = sequence();
    let (header, index, group) = parts(&bytes);
    let table = parse_table(&group, &index.groups[0], &header, &Limits::default()).expect("a table");
    let motion: u32 = table[1].levels.iter().map(|level| level.motion).sum();
    assert!(motion > 9);
    let start = table[1].offset as usize;
    (8 * start..8 * (start + table[1].levels[0].motion as usize))
        .into_par_iter()
        .for_each(|bit| {
            let mut changed = group.clone();
            changed[bit / 8] ^= 1 << (bit % 8);
            let found = frames(&with_group(&bytes, &changed)).expect("a sequence");
            assert!(found[0].is_ok(), "bit {bit}");
            assert!(found[2].is_ok() && found[3].is_ok(), "bit {bit}");
            // The hash of colours tells that another motion is not the one that was coded with.
            if let Err(error) = &found[1] {
                assert!(matches!(error, Error::Frame { frame: 1, .. }), "bit {bit}: {error}");
                assert!(error.clause().is_some(), "bit {bit}: {error} has no clause");
            }
        });
}

#[test]
fn motion_of_a_finer_level_that_is_damaged_leaves_the_coarser_levels() {
    let bytes = sequence();
    let (header, index, mut group) = parts(&bytes);
    let table = parse_table(&group, &index.groups[0], &header, &Limits::default()).expect("a table");
    // More words than are read.
    let (mut frames, at) = (table.clone(), table[1].offset + table[1].prefix_bytes(0));
    let motion = at as usize..at as usize + table[1].levels[1].motion as usize;
    let longer = [&group[motion.clone()], &[0; 12]].concat();
    frames[1].levels[1].motion += 12;
    group.splice(motion, longer);
    let content = &group[table[0].offset as usize..];
    let group = [&table_bytes(&frames).expect("a table"), content].concat();
    let bytes = with_group(&bytes, &group);
    let sequence = SequenceReader::new(&bytes[..], &Limits::default()).expect("a sequence");
    let at_level = |level| {
        let frame = SequenceDecoder::new(Decoder::new().with_level(level)).frame(&sequence, 1);
        frame.map(drop).map_err(|error| (error.clause(), error.offset()))
    };
    assert_eq!(at_level(3), Ok(()));
    let (.., motion, _) = &places(&bytes)[3];
    assert_eq!(at_level(4), Err((Some("5.4.3"), Some(motion.start))));
}

#[test]
fn a_fault_in_a_group_is_at_its_place_in_the_file() {
    let bytes = sequence();
    let (_, index, mut group) = parts(&bytes);
    group[9] ^= 1;
    let found = frames(&with_group(&bytes, &group)).expect("a sequence");
    match &found[0] {
        Err(Error::ChecksumMismatch { offset, .. }) => assert_eq!(*offset, index.groups[0].offset),
        other => panic!("{other:?}"),
    }
}

/// Where the motion and the sections of each level of each frame of the first group lie in the file, and which they are.
fn places(bytes: &[u8]) -> Vec<(u64, u8, std::ops::Range<u64>, std::ops::Range<u64>)> {
    let (header, index, group) = parts(bytes);
    let table = parse_table(&group, &index.groups[0], &header, &Limits::default()).expect("a table");
    let mut places = Vec::new();
    for (number, frame) in (0..).zip(&table) {
        let mut at = index.groups[0].offset + frame.offset;
        for (level, own) in (header.base..).zip(&frame.levels) {
            let sections = at + u64::from(own.motion);
            let end = sections + own.section.bytes();
            places.push((number, level, at..sections, sections..end));
            at = end;
        }
    }
    places
}

fn faults(bytes: &[u8]) -> Vec<Error> {
    let sequence = SequenceReader::new(bytes, &Limits::default()).expect("a sequence");
    SequenceDecoder::new(Decoder::new()).faults(&sequence)
}

#[test]
fn a_damaged_chunk_is_found_in_its_frame_and_level_though_the_hash_of_the_group_is_wrong() {
    let bytes = sequence();
    let sequence = SequenceReader::new(&bytes[..], &Limits::default()).expect("a sequence");
    let group = sequence.index().groups[0];
    assert!(faults(&bytes).is_empty());
    for (frame, level, motion, sections) in places(&bytes) {
        // The length and the checksum of each chunk are among its first bytes.
        for at in sections.clone().take(12).chain(sections.clone().skip(12).step_by(7)) {
            let mut damaged = bytes.clone();
            damaged[at as usize] ^= 16;
            let found = faults(&damaged);
            assert_eq!(
                (found[0].clause(), found[0].offset()),
                (Some("17.2.3"), Some(group.offset))
            );
            let Some(Error::Frame { frame: blamed, source }) = found.get(1) else {
                panic!("byte {at}: {found:?}");
            };
            // A length that is too great is noticed where the section ends.
            let place = match (**source).offset().expect("a place") {
                end if matches!(**source, Error::Truncated { .. }) => end - 1,
                start => start.min(at + 1),
            };
            assert_eq!(*blamed, frame, "byte {at}: {found:?}");
            assert!(sections.contains(&place), "byte {at}: {found:?}");
            let part = sequence.part_at(place).expect("a part of a frame");
            assert_eq!((part.frame, part.level, part.is_motion), (frame, level, false));
            let part = sequence.part_at(at).expect("a part of a frame");
            assert!(
                part.chunk.is_some_and(|chunk| chunk.section == level),
                "byte {at}: {part:?}"
            );
        }
        // It has no checksum of its own.
        for at in motion {
            let mut damaged = bytes.clone();
            damaged[at as usize] ^= 16;
            assert_eq!(faults(&damaged).len(), 1, "byte {at}");
            let part = sequence.part_at(at).expect("a part of a frame");
            assert_eq!((part.frame, part.level, part.is_motion), (frame, level, true));
            assert!(part.chunk.is_none());
        }
    }
    let first = places(&bytes)[0].3.start;
    assert!(
        [0, group.offset, first - 1, bytes.len() as u64]
            .iter()
            .all(|at| sequence.part_at(*at).is_none())
    );
}

#[test]
fn a_fault_behind_right_checksums_is_at_its_place_in_the_file() {
    let bytes = sequence();
    let (header, index, group) = parts(&bytes);
    let table = parse_table(&group, &index.groups[0], &header, &Limits::default()).expect("a table");
    for (frame, level) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
        let mut frames = table.clone();
        frames[frame].levels[level].voxels -= 1;
        let content = &group[table[0].offset as usize..];
        let changed = with_group(&bytes, &[&table_bytes(&frames).expect("a table"), content].concat());
        let found = faults(&changed);
        let Some(Error::Frame { frame: blamed, .. }) = found.first() else {
            panic!("{found:?}");
        };
        assert_eq!(*blamed, frame as u64);
        let place = found[0].offset().expect("a place");
        let all = places(&changed);
        let (.., sections) = &all[2 * frame + level];
        assert!(sections.contains(&place), "{found:?} in {all:?}");
        // The frame after it cannot be decoded, either: that is said once.
        assert_eq!(found.len(), 1, "{found:?}");
    }
}

#[test]
fn vectors_out_of_range_are_refused_and_name_the_clause() {
    let bytes = sequence();
    let (header, index, mut group) = parts(&bytes);
    let table = parse_table(&group, &index.groups[0], &header, &Limits::default()).expect("a table");
    let vector = table[1].offset as usize + 4;
    group[vector..vector + 2].copy_from_slice(&i16::MIN.to_le_bytes());
    let found = frames(&with_group(&bytes, &group)).expect("a sequence");
    let error = found[1].as_ref().expect_err("a vector out of range");
    assert_eq!(error.clause(), Some("17.5.3"), "{error}");
    let motion = index.groups[0].offset + table[1].offset;
    assert_eq!(error.offset(), Some(motion), "{error}");
    assert!(error.to_string().contains("frame 1: bitstream: at byte"), "{error}");
    assert!(error.to_string().contains("motion of level 3"), "{error}");
    assert!(found[2].is_ok());
}

#[test]
fn numbers_of_frames_that_are_not_there_are_refused_before_anything_is_reserved() {
    let bytes = sequence();
    let (header, index, _) = parts(&bytes);
    let parse = |index: &Index| {
        let mut changed = header.write_sequence();
        index.write(&mut changed).expect("an index");
        SequenceReader::new(changed, &Limits::default()).map(|sequence| sequence.frames())
    };
    let with_frames = |frames: u32| {
        let mut index = index.clone();
        index.groups[0].frames = frames;
        index
    };
    for frames in [0, 65_537, u32::MAX] {
        let error = parse(&with_frames(frames)).expect_err("frames out of range");
        assert_eq!(error.clause(), Some("17.2.2"), "{error}");
    }
    let mut many = index.clone();
    many.groups = vec![with_frames(65_536).groups[0]; 17];
    many.groups.iter_mut().for_each(|group| group.start = 0);
    many.groups.iter_mut().for_each(|group| group.ticks = 0);
    assert!(matches!(
        parse(&many),
        Err(Error::LimitExceeded {
            option: "max_frames",
            ..
        })
    ));
    // A table of other frames than the index states.
    let (_, _, group) = parts(&bytes);
    let entry = GroupEntry {
        frames: 3,
        ..index.groups[0]
    };
    let error = parse_table(&group, &entry, &header, &Limits::default()).expect_err("another number");
    assert_eq!(error.clause(), Some("17.3.1"), "{error}");
}
