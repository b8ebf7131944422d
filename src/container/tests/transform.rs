//! Version 3.

use super::*;
use crate::axes::{Axes, Up};
use crate::container::axes::AXES;
use crate::container::chunk::{Chunks, HEAD_MAP};
use crate::container::reader::put_varint;

const HASHES: [u64; 3] = [7, u64::MAX, 0x0123_4567_89ab_cdef];

fn header() -> Header {
    Header {
        format: Format::Transform { colour_slice: 3 },
        bits: 4,
        points: 20,
        slice_voxels: 2,
        ..super::header()
    }
}

/// Levels 2 to 4 of 3, 10 and 20 voxels: level 1 has 2.
fn writer() -> Result<Writer> {
    let mut writer = Writer::new(header())?;
    writer.geometry_trunk(&[(2, "one"), (3, "second")])?;
    writer.colour_trunk(1, 2, HASHES[0], b"trunk")?;
    writer.colours(2, None, &[(2, "two")])?;
    writer.post_filter(2, b"filter")?;
    writer.geometry(3, &[(6, "a"), (4, "b")])?;
    writer.colours(3, Some(HASHES[1]), &[(3, "")])?;
    let five: Vec<_> = [4, 4, 4, 4, 4].map(|count| (count, "x")).into();
    writer.geometry(4, &five)?;
    let four = [(3, "p"), (3, "q"), (3, "r"), (1, "s")];
    writer.colours(4, Some(HASHES[2]), &four)?;
    writer.post_filter(4, b"")?;
    Ok(writer)
}

pub(super) fn sample() -> Vec<u8> {
    writer().unwrap().finish().unwrap()
}

/// A chunk of version 3.
fn chunk(kind: u8, level: u8, numbers: [u32; 2], payload: &[u8]) -> Vec<u8> {
    let mut bytes = vec![kind, level];
    for number in [numbers[0], numbers[1], payload.len() as u32] {
        put_varint(&mut bytes, number);
    }
    let sum = crc32c::crc32c_append(crc32c::crc32c(&bytes), payload);
    bytes.extend(sum.to_le_bytes());
    bytes.extend(payload);
    bytes
}

/// A stream with this header whose sections, two a level, hold these chunks.
fn stream(header: Header, sections: &[Vec<Vec<u8>>]) -> Vec<u8> {
    let sections: Vec<Vec<u8>> = sections.iter().map(|chunks| chunks.concat()).collect();
    let lengths = sections.chunks(2).map(|pair| Section {
        geometry: pair[0].len() as u32,
        colours: pair[1].len() as u32,
    });
    let header = Header {
        sections: lengths.collect(),
        ..header
    };
    [vec![header.write()], sections].concat().concat()
}

/// The sections of the sample's base level.
fn base() -> [Vec<Vec<u8>>; 2] {
    let hash = HASHES[0].to_le_bytes();
    [
        vec![chunk(5, 2, [0, 3], b"\x02\x03one\x03\x06second")],
        vec![
            chunk(6, 1, [0, 2], &[&hash[..], b"trunk"].concat()),
            chunk(7, 2, [0, 2], b"two"),
            chunk(8, 2, [0, 3], b"filter"),
        ],
    ]
}

fn only_base() -> Header {
    Header {
        top: 2,
        voxels: vec![3],
        ..header()
    }
}

#[test]
fn reading_inverts_writing() {
    let bytes = sample();
    let stream = parse(&bytes).unwrap();
    assert!(stream.damage().is_none(), "{:?}", stream.damage());
    let [base, middle, top] = stream.levels() else {
        panic!("three levels")
    };
    let geometry = |level: &Level| -> Vec<(u8, Vec<u32>)> {
        let counts = |part: &Geometry| part.slices.iter().map(|s| s.voxels).collect();
        let parts = level.geometry.iter();
        parts.map(|part| (part.level, counts(part))).collect()
    };
    assert_eq!(geometry(base), [(1, vec![2]), (2, vec![3])]);
    assert_eq!(geometry(middle), [(3, vec![6, 4])]);
    let colours = [base, middle, top].map(|level| level.colours.as_ref().unwrap());
    assert_eq!(colours.map(|colours| colours.hash), HASHES);
    let trunk = colours[0].trunk.unwrap();
    assert_eq!((trunk.level, trunk.slice.bytes), (1, &b"trunk"[..]));
    assert!(colours[1].trunk.is_none() && colours[1].filter.is_none());
    assert_eq!(colours[0].filter.unwrap().bytes, b"filter");
    let slices = &colours[2].levels[0].slices;
    let found: Vec<_> = slices.iter().map(|s| (s.voxels, s.bytes)).collect();
    assert_eq!(found[2..], [(3, &b"r"[..]), (1, &b"s"[..])]);
    for slice in slices.iter().chain(&base.geometry[1].slices) {
        let there = &bytes[slice.offset..slice.offset + slice.bytes.len()];
        assert_eq!(there, slice.bytes, "offsets lead to the code");
    }
}

#[test]
fn the_bytes_match_the_specification() {
    let [geometry, colours] = base();
    let mut writer = Writer::new(only_base()).unwrap();
    writer.geometry_trunk(&[(2, "one"), (3, "second")]).unwrap();
    writer.colour_trunk(1, 2, HASHES[0], b"trunk").unwrap();
    writer.colours(2, None, &[(2, "two")]).unwrap();
    writer.post_filter(2, b"filter").unwrap();
    let bytes = writer.finish().unwrap();
    assert_eq!(bytes, stream(only_base(), &[geometry, colours]));
    assert_eq!(bytes[8..12], [3, 0, 0, 0], "version");
    assert_eq!(bytes[64..72], [2, 0, 0, 0, 3, 0, 0, 0], "slice sizes");
    assert_eq!(bytes[72..76], [3, 0, 0, 0], "voxels of the base level");
    assert_eq!(only_base().bytes(), 72 + 12 + 4);
}

#[test]
fn all_levels_from_the_root_to_the_finest_can_be_coded() {
    let header = Header {
        bits: 1,
        base: 0,
        top: 1,
        points: 8,
        voxels: vec![1, 8],
        ..header()
    };
    let mut writer = Writer::new(header).unwrap();
    writer.geometry_trunk(&[] as &[(u32, &str)]).unwrap();
    writer.colour_trunk(0, 1, 1, b"root").unwrap();
    writer.geometry(1, &[(8, "all")]).unwrap();
    writer.colours(1, Some(2), &[(1, "c")]).unwrap();
    let bytes = writer.finish().unwrap();
    let stream = parse(&bytes).unwrap();
    assert_eq!(stream.levels().len(), 2);
    assert!(stream.levels()[0].geometry.is_empty());
}

#[test]
fn invalid_headers_are_refused() {
    let refused = |header: Header, field: &str| {
        let error = Writer::new(header).unwrap_err().to_string();
        assert!(error.contains(field), "{error}");
    };
    refused(Header { bits: 3, ..header() }, "bit depth");
    let slices = |colour_slice| Header {
        format: Format::Transform { colour_slice },
        ..header()
    };
    refused(slices(0), "slice size of the colours");
    refused(slices(65_537), "slice size of the colours");
    let geometry = Header {
        slice_voxels: 16_385,
        ..header()
    };
    refused(geometry, "slice size");
}

#[test]
fn invalid_chunks_are_damage() {
    let message = |section: usize, chunks: Vec<Vec<u8>>, words: &str| {
        let mut sections = base();
        sections[section] = chunks;
        let bytes = stream(only_base(), &sections);
        let error = parse(&bytes).unwrap().require(2).unwrap_err().to_string();
        assert!(error.contains(words), "{error} should tell of {words}");
    };
    let [geometry, colours] = base();
    let trunk = |level, count, payload: &[u8]| vec![chunk(5, level, [0, count], payload)];
    message(0, vec![], "end of the section");
    message(0, trunk(3, 3, b""), "geometry trunk chunk of a level from 1 to 2");
    message(0, trunk(2, 4, b"\x02\x03one\x03\x06second"), "voxel count");
    message(0, trunk(2, 3, b"\x02\x03one\x03\x06second!"), "bytes after");
    message(
        0,
        trunk(2, 3, b"\x02\x03one\x03\x07second"),
        "payload of the geometry trunk",
    );
    message(0, trunk(2, 3, b"\x02\x03one"), "payload of the geometry trunk");
    message(0, trunk(2, 3, b"\x00\x03one\x03\x06second"), "voxel count of level 1");
    message(0, trunk(2, 3, b"\x09\x03one\x03\x06second"), "voxel count of level 1");
    message(0, trunk(2, 3, b"\x03\x03one\x03\x06second"), "parents of level 2");
    message(0, vec![geometry[0].clone(), geometry[0].clone()], "section's last");

    message(1, vec![], "end of the section");
    message(1, colours[1..].to_vec(), "colour trunk chunk of a level from 0 to 2");
    message(1, vec![chunk(6, 1, [0, 2], b"short")], "first colour chunk");
    let hash = [0; 8];
    message(1, vec![chunk(6, 1, [0, 3], &hash)], "colour trunk");
    message(1, vec![chunk(6, 1, [1, 2], &hash)], "slice 0");
    let after = |chunk: Vec<u8>| vec![colours[0].clone(), chunk];
    message(1, after(colours[2].clone()), "colour chunk of level 2, slice 0");
    message(1, after(chunk(7, 2, [0, 3], b"two")), "voxel count of the colour chunk");
    message(
        1,
        after(chunk(7, 2, [1, 2], b"two")),
        "colour chunk of level 2, slice 0",
    );
    let filter = vec![colours[0].clone(), colours[1].clone(), chunk(8, 2, [0, 4], b"")];
    message(1, filter, "voxel count of the colour filter chunk");
    for kind in [0, 2, 3, 4, 9, 127] {
        message(1, after(chunk(kind, 2, [0, 2], b"two")), "type");
    }
}

#[test]
fn varints_have_their_shortest_form() {
    let [geometry, mut colours] = base();
    // The same slice in two bytes.
    let long = [7, 2, 0x80, 0, 2, 3];
    let sum = crc32c::crc32c_append(crc32c::crc32c(&long), b"two");
    colours[1] = [&long[..], &sum.to_le_bytes(), b"two"].concat();
    let bytes = stream(only_base(), &[geometry, colours]);
    let error = parse(&bytes).unwrap().require(2).unwrap_err().to_string();
    assert!(error.contains("chunk slice"), "{error}");
    for (bytes, number) in [
        (&[0][..], Some(0)),
        (&[0x7f], Some(127)),
        (&[0x80, 1], Some(128)),
        (&[0xff, 0xff, 0xff, 0xff, 0x0f], Some(u32::MAX)),
        (&[0xff, 0xff, 0xff, 0xff, 0x1f], None),
        (&[0xff, 0xff, 0xff, 0xff, 0xff, 1], None),
        (&[0x80, 0], None),
        (&[0x80], None),
    ] {
        let read = Reader::new(bytes, 0).varint("number").ok();
        assert_eq!(read, number, "{bytes:02x?}");
        if let Some(number) = number {
            let mut written = Vec::new();
            put_varint(&mut written, number);
            assert_eq!(written, bytes);
        }
    }
}

#[test]
fn every_flipped_bit_is_detected_and_earlier_levels_survive() {
    let bytes = sample();
    let whole = parse(&bytes).unwrap();
    for bit in 0..8 * bytes.len() {
        let mut flipped = bytes.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        let Ok(stream) = parse(&flipped) else {
            continue;
        };
        assert!(stream.damage().is_some(), "bit {bit}");
        let levels = stream.levels().len();
        assert_eq!(stream.levels(), &whole.levels()[..levels], "bit {bit}");
    }
}

#[test]
fn ancillary_chunks_are_skipped() {
    let [mut geometry, mut colours] = base();
    let note = chunk(200, 99, [9, 9], b"a note");
    geometry.insert(0, note.clone());
    geometry.push(note.clone());
    colours.insert(1, note);
    let bytes = stream(only_base(), &[geometry, colours]);
    let stream = parse(&bytes).unwrap();
    assert!(stream.damage().is_none(), "{:?}", stream.damage());
}

proptest! {
    #[test]
    fn damage_with_valid_checksums_never_panics(
        at in 0usize..1000,
        value in any::<u8>(),
        cut in 0usize..1000,
    ) {
        let [geometry, colours] = base();
        let mut sections = [geometry, colours];
        let which = at % 2;
        let count = sections[which].len();
        let chosen = &mut sections[which][at / 2 % count];
        let place = at / 7 % chosen.len();
        chosen[place] = value;
        let bytes = stream(only_base(), &sections);
        let length = bytes.len() - cut % 20;
        if let Ok(stream) = parse(&bytes[..length]) {
            prop_assert!(stream.levels().len() <= 1);
        }
    }
}

#[test]
fn the_first_head_map_of_a_level_counts() {
    let map = |level, payload: &[u8]| chunk(HEAD_MAP, level, [0, 0], payload);
    let bytes = [
        chunk(200, 4, [0, 0], b"?"),
        map(3, b"three"),
        map(4, b"four"),
        map(4, b"more"),
    ]
    .concat();
    let found = |bytes: &[u8], level| {
        let chunks = Chunks::new(Form::Short, bytes, 0..bytes.len());
        chunks.head_map(level).map(|chunk| chunk.payload.to_vec())
    };
    assert_eq!(found(&bytes, 3), Some(b"three".to_vec()));
    assert_eq!(found(&bytes, 4), Some(b"four".to_vec()));
    assert_eq!(found(&bytes, 5), None);
    // Nothing is known of what follows a damaged chunk.
    let mut damaged = bytes;
    damaged[0] ^= 1;
    assert_eq!(found(&damaged, 4), None);
}

#[test]
fn a_scan_lists_all_chunks_and_mends_damaged_ones_that_are_skipped() {
    let [mut geometry, colours] = base();
    let skipped = geometry.concat().len();
    geometry.push(chunk(200, 2, [0, 0], b"skipped"));
    let bytes = stream(only_base(), &[geometry, colours]);
    let header = Header::parse(&bytes, &Limits::default()).unwrap();
    let scan = Scan::new(&bytes, &header);
    assert!(scan.faults.is_empty() && scan.bytes == bytes);
    let first = header.bytes();
    let chunk_at = first + skipped;
    let kinds: Vec<u8> = scan.chunks.iter().map(|chunk| bytes[chunk.start]).collect();
    assert_eq!(kinds, [5, 200, 6, 7, 8]);
    assert_eq!((scan.chunks[0].start, scan.chunks[1].start), (first, chunk_at));
    assert!(scan.chunks.windows(2).all(|pair| pair[0].end == pair[1].start));
    assert_eq!(scan.chunks.last().map(|chunk| chunk.end), Some(bytes.len()));
    assert!(scan.chunks.iter().all(|chunk| chunk.section == 2 && chunk.slice == 0));
    assert_eq!(
        scan.chunks.iter().map(|chunk| chunk.level).collect::<Vec<_>>(),
        [2, 2, 1, 2, 2]
    );
    let notes: Vec<_> = scan.notes.iter().map(|note| (note.clause, note.offset)).collect();
    assert_eq!(notes, [("1.6.2", chunk_at)]);
    // A decoder skips it, damaged or not.
    let mut damaged = bytes.clone();
    let end = scan.chunks[1].end;
    damaged[end - 1] ^= 1;
    let scan = Scan::new(&damaged, &header);
    assert_eq!(scan.chunks.len(), 4);
    let [(2, error)] = &scan.faults[..] else {
        panic!("{:?}", scan.faults)
    };
    assert_eq!((error.clause(), error.offset()), (Some("3.1.1"), Some(chunk_at as u64)));
    assert!(parse(&damaged).unwrap().damage().is_some());
    let mended = parse(&scan.bytes).unwrap();
    assert!(mended.damage().is_none() && scan.bytes[end - 1] == damaged[end - 1]);
    // What decoders need is not mended.
    let mut damaged = bytes.clone();
    damaged[bytes.len() - 1] ^= 1;
    let scan = Scan::new(&damaged, &header);
    assert!(scan.faults.len() == 1 && scan.bytes == damaged);
    // Of a section that is cut the chunks that are whole are listed, and the cut is not reported here.
    let scan = Scan::new(&bytes[..bytes.len() - 1], &header);
    assert!(scan.faults.is_empty() && scan.chunks.len() == 4);
    // A length that leads out of its section is a fault of the section.
    let mut longer = bytes.clone();
    longer[chunk_at + 4] = 100;
    let scan = Scan::new(&longer, &header);
    assert!(scan.faults.len() == 1 && scan.chunks.len() == 4, "{scan:?}");
}

#[test]
fn a_scan_notes_axes_and_head_maps_that_have_no_effect() {
    let [geometry, colours] = base();
    let axes = Axes {
        up: Some(Up::Z),
        ..Axes::default()
    };
    let of = |payload: &[u8], points| chunk(AXES, 2, [0, points], payload);
    let map = |level| chunk(HEAD_MAP, level, [0, 0], b"map");
    let notes = |geometry: &[Vec<u8>], behind: &[Vec<u8>], above: &[Vec<u8>]| {
        let sections = [[geometry, behind].concat(), [&colours[..], above].concat()];
        let bytes = stream(only_base(), &sections);
        let header = Header::parse(&bytes, &Limits::default()).unwrap();
        assert!(parse(&bytes).unwrap().damage().is_none());
        let scan = Scan::new(&bytes, &header);
        assert!(scan.faults.is_empty());
        let chunk_of = |at: usize| scan.chunks.iter().position(|chunk| chunk.start == at);
        let notes = scan.notes.iter();
        notes
            .map(|note| (note.clause, chunk_of(note.offset).unwrap()))
            .collect::<Vec<_>>()
    };
    let good = of(&axes.to_bytes(), 0);
    // The first axes of a form that is known count, and those of the base level's geometry alone.
    assert_eq!(notes(&geometry, std::slice::from_ref(&good), &[]), []);
    assert_eq!(notes(&geometry, &[good.clone(), good.clone()], &[]), [("3.4.2", 2)]);
    assert_eq!(notes(&geometry, &[of(b"?", 0), good.clone()], &[]), [("3.4.2", 1)]);
    assert_eq!(notes(&geometry, &[], std::slice::from_ref(&good)), [("3.4.2", 4)]);
    assert_eq!(notes(&geometry, &[of(b"", 7), good], &[]), []);
    assert_eq!(notes(&geometry, &[of(b"", 0)], &[]), [("3.4.2", 1)]);
    // So does the first head map of the level, among its colours.
    assert_eq!(notes(&geometry, &[], &[map(2)]), []);
    assert_eq!(notes(&geometry, &[], &[map(2), map(2)]), [("7.5.1", 5)]);
    assert_eq!(notes(&geometry, &[], &[map(3), map(2)]), [("7.5.1", 4)]);
    assert_eq!(notes(&geometry, &[map(2)], &[map(2)]), [("7.5.1", 1)]);
}

#[test]
fn no_more_than_a_thousand_damaged_chunks_are_listed() {
    let [mut geometry, colours] = base();
    let good = chunk(200, 2, [0, 0], b"x");
    let mut damaged = good.clone();
    *damaged.last_mut().unwrap() ^= 1;
    geometry.extend(vec![[damaged, good].concat(); 1005]);
    let bytes = stream(only_base(), &[geometry, colours]);
    let header = Header::parse(&bytes, &Limits::default()).unwrap();
    assert_eq!(Scan::new(&bytes, &header).faults.len(), 1000);
}
