mod axes;
mod colours;
mod feed;
mod headers;
mod transform;
mod units;

use super::chunk::{Chunk, ChunkKind, Form};
use super::*;
use crate::error::{Error, Result};
use crate::{Limits, Placement};
use proptest::prelude::*;

fn header() -> Header {
    Header {
        optional_flags: 0x8000_0001,
        bits: 5,
        base: 2,
        top: 4,
        points: 25,
        placement: Placement {
            origin: [1.5, -2.0, 1e-3],
            voxel_size: 0.25,
        },
        format: Format::Learned {
            model: *b"0123456789abcdef",
        },
        slice_voxels: 4,
        voxels: vec![3, 10, 20],
        sections: vec![],
    }
}

/// Bytes of a chunk of version 2 before its payload.
const CHUNK_HEADER: usize = 16;

const HASHES: [u64; 3] = [11, u64::MAX, 0x0123_4567_89ab_cdef];

fn writer(header: Header) -> Result<Writer> {
    let mut writer = Writer::new(header)?;
    writer.geometry(1, &[(2, b"one")])?;
    writer.geometry(2, &[(3, b"second")])?;
    writer.features(2, HASHES[0], &[b"latents 2"])?;
    writer.geometry(3, &[(10, b"")])?;
    writer.features(3, HASHES[1], &[b"a", b"b", b"c"])?;
    writer.geometry(4, &[(8, b"x"), (8, b"y"), (4, b"z")])?;
    writer.features(4, HASHES[2], &["", "v", "w", "x", "yz"])?;
    Ok(writer)
}

fn sample() -> Vec<u8> {
    writer(header()).unwrap().finish().unwrap()
}

fn parse(bytes: &[u8]) -> Result<Stream<'_>> {
    Stream::parse(bytes, &Limits::default())
}

/// Puts the header's right checksum after its fields.
fn seal_header(bytes: &mut [u8]) {
    let end = 84 + 12 * 3;
    let sum = crc32c::crc32c(&bytes[..end]);
    bytes[end..end + 4].copy_from_slice(&sum.to_le_bytes());
}

/// The same for every chunk, as far as their lengths lead.
fn seal_chunks(bytes: &mut [u8], mut at: usize) {
    while let Some(head) = bytes.get(at..at + CHUNK_HEADER) {
        let length = u32::from_le_bytes(head[8..12].try_into().unwrap()) as usize;
        let Some(payload) = bytes.get(at + CHUNK_HEADER..at + CHUNK_HEADER + length) else {
            return;
        };
        let sum = crc32c::crc32c_append(crc32c::crc32c(&head[..12]), payload);
        bytes[at + 12..at + CHUNK_HEADER].copy_from_slice(&sum.to_le_bytes());
        at += CHUNK_HEADER + length;
    }
}

#[test]
fn a_stream_is_intact_if_it_ends_where_one_of_its_levels_ends() {
    for bytes in [sample(), transform::sample()] {
        let header = parse(&bytes).unwrap().header().clone();
        let ends: Vec<u64> = (2..=4).map(|level| header.prefix_bytes(level).unwrap()).collect();
        for length in header.bytes()..=bytes.len() {
            let intact = parse(&bytes[..length]).unwrap().intact();
            assert_eq!(intact.is_ok(), ends.contains(&(length as u64)), "{length} bytes");
        }
        assert!(parse(&[&bytes[..], b"x"].concat()).unwrap().intact().is_err());
    }
}

#[test]
fn reading_inverts_writing() {
    let bytes = sample();
    let stream = parse(&bytes).unwrap().require(4).unwrap();
    assert!(stream.damage().is_none());
    let read = Header {
        sections: vec![],
        ..stream.header().clone()
    };
    assert_eq!(read, header());
    let counts = |slices: &[Slice]| slices.iter().map(|s| s.voxels).collect::<Vec<_>>();
    let codes = |slices: &[Slice]| {
        let text = |s: &Slice| String::from_utf8(s.bytes.to_vec()).unwrap();
        slices.iter().map(text).collect::<Vec<_>>()
    };
    let [base, middle, top] = stream.levels() else {
        panic!("three levels")
    };
    assert_eq!((base.level, base.voxels, base.latent_hash), (2, 3, HASHES[0]));
    assert_eq!(base.geometry.len(), 2);
    assert_eq!((base.geometry[0].level, base.geometry[1].level), (1, 2));
    assert_eq!(codes(&base.geometry[0].slices), ["one"]);
    assert_eq!(codes(&base.geometry[1].slices), ["second"]);
    assert_eq!(codes(&base.features), ["latents 2"]);
    assert_eq!(codes(&middle.features), ["a", "b", "c"]);
    assert_eq!(counts(&middle.features), [4, 4, 2]);
    assert_eq!(counts(&top.geometry[0].slices), [8, 8, 4]);
    assert_eq!(codes(&top.geometry[0].slices), ["x", "y", "z"]);
    assert_eq!(codes(&top.features), ["", "v", "w", "x", "yz"]);
    assert_eq!(top.latent_hash, HASHES[2]);
    for level in stream.levels() {
        for slice in level.features.iter().chain(&level.geometry[0].slices) {
            assert_eq!(&bytes[slice.offset..][..slice.bytes.len()], slice.bytes);
        }
    }
}

#[test]
fn the_first_bytes_match_the_specification() {
    let bytes = sample();
    assert_eq!(&bytes[..8], b"\x89B2P\r\n\x1a\n");
    assert_eq!(bytes[8..24], [2, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 128, 5, 2, 4, 0]);
    assert_eq!(bytes[24..32], 25u64.to_le_bytes());
    assert_eq!(bytes[56..64], 0.25f64.to_le_bytes());
    assert_eq!(bytes[64..84], *b"0123456789abcdef\x04\0\0\0");
    assert_eq!(bytes[84..96], [3, 0, 0, 0, 10, 0, 0, 0, 20, 0, 0, 0]);
    // Level 2: two chunks of geometry, one of features with the hash.
    assert_eq!(bytes[96..104], [16 + 3 + 16 + 6, 0, 0, 0, 16 + 8 + 9, 0, 0, 0]);
    assert_eq!(bytes[124..136], [1, 1, 0, 0, 2, 0, 0, 0, 3, 0, 0, 0]);
    assert_eq!(&bytes[140..143], b"one");
}

#[test]
fn a_prefix_has_exactly_its_complete_levels() {
    let bytes = sample();
    let whole = parse(&bytes).unwrap();
    let ends: Vec<usize> = (2..=4)
        .map(|level| whole.header().prefix_bytes(level).unwrap() as usize)
        .collect();
    assert_eq!(ends[2], bytes.len());
    for length in 0..bytes.len() {
        let prefix = parse(&bytes[..length]);
        if length < whole.header().bytes() {
            assert!(matches!(prefix, Err(Error::Truncated { .. })), "{length}");
            continue;
        }
        let prefix = prefix.unwrap();
        let count = ends.iter().filter(|&&end| end <= length).count();
        assert_eq!(prefix.levels(), &whole.levels()[..count]);
        assert!(matches!(prefix.damage(), Some(Error::Truncated { .. })));
        assert_eq!(prefix.deepest(), [None, Some(2), Some(3)][count]);
        let deeper = 2 + count as u8;
        assert!(matches!(prefix.require(deeper), Err(Error::Truncated { .. })));
    }
    for level in 2..=4 {
        let prefix = parse(&bytes[..ends[usize::from(level) - 2]]).unwrap();
        assert!(prefix.require(level).is_ok());
    }
}

#[test]
fn every_flipped_bit_is_detected_and_earlier_levels_survive() {
    let bytes = sample();
    let whole = parse(&bytes).unwrap();
    let end = |level: &Level| whole.header().prefix_bytes(level.level).unwrap() as usize;
    for bit in 0..8 * bytes.len() {
        let mut damaged = bytes.clone();
        damaged[bit / 8] ^= 1 << (bit % 8);
        let result = parse(&damaged);
        if bit / 8 < whole.header().bytes() {
            assert!(result.is_err(), "bit {bit} of the header");
            continue;
        }
        let stream = result.unwrap();
        let count = whole.levels().iter().filter(|l| end(l) <= bit / 8).count();
        assert_eq!(stream.levels(), &whole.levels()[..count], "bit {bit}");
        assert!(stream.damage().is_some(), "bit {bit}");
        assert!(stream.require(4).is_err());
    }
}

#[test]
fn bytes_after_the_last_section_are_reported() {
    let bytes = [&sample()[..], b"!"].concat();
    let stream = parse(&bytes).unwrap();
    assert_eq!(stream.deepest(), Some(4));
    assert!(
        stream
            .damage()
            .unwrap()
            .to_string()
            .contains("bytes after the last section")
    );
}

#[test]
fn errors_state_the_offset_and_the_field() {
    let bytes = sample();
    let mut damaged = bytes.clone();
    damaged[130] ^= 4;
    let error = parse(&damaged).unwrap().require(2).unwrap_err().to_string();
    assert!(
        error.starts_with("bitstream: checksum of a chunk of stated type 1, level 1, slice 0 at byte 124"),
        "{error}"
    );
    let error = parse(&bytes).unwrap().require(7).unwrap_err().to_string();
    assert_eq!(error, "the stream has the levels 2 to 4, not 7");
    let error = parse(b"ply\nformat ascii 1.0\n").unwrap_err().to_string();
    assert!(error.contains("byte 0: magic is"), "{error}");
    let header = parse(&bytes).unwrap().header().clone();
    assert!(header.check_model(b"0123456789abcdef").is_ok());
    let error = header.check_model(&[0xab; 16]).unwrap_err().to_string();
    assert!(error.contains("3031323334") && error.contains("abababab"), "{error}");
    let stream = parse(&bytes).unwrap();
    assert!(stream.levels()[0].check_latents(11).is_ok());
    assert!(matches!(
        stream.levels()[0].check_latents(12),
        Err(Error::DeterminismMismatch { level: 2, .. })
    ));
}

#[test]
fn limits_are_checked_before_allocation() {
    let bytes = sample();
    let limited = |limits| Stream::parse(&bytes, &limits).map(|_| ());
    let points = Limits {
        max_points: 24,
        ..Limits::default()
    };
    let depth = Limits {
        max_depth: 4,
        ..Limits::default()
    };
    for limits in [points, depth] {
        assert!(matches!(limited(limits), Err(Error::LimitExceeded { .. })));
    }
}

#[test]
fn invalid_headers_are_neither_written_nor_read() {
    type Change = fn(&mut Header);
    let forbidden: [(usize, u8, Change); 9] = [
        (20, 4, |h| h.bits = 4),
        (20, 22, |h| h.bits = 22),
        (21, 1, |h| h.base = 1),
        (21, 5, |h| h.base = 5),
        (24, 19, |h| h.points = 19),
        (24, 161, |h| h.points = 161),
        (80, 0, |h| h.slice_voxels = 0),
        (84, 65, |h| h.voxels[0] = 65),
        (88, 25, |h| h.voxels[1] = 25),
    ];
    for (offset, value, change) in forbidden {
        let mut header = header();
        change(&mut header);
        assert!(Writer::new(header).is_err(), "{offset} = {value}");
        let mut bytes = sample();
        bytes[offset] = value;
        seal_header(&mut bytes);
        assert!(parse(&bytes).is_err(), "{offset} = {value}");
    }
    for (slice, valid) in [
        (MAX_SLICE_VOXELS, true),
        (MAX_SLICE_VOXELS + 1, false),
        (u32::MAX, false),
    ] {
        let mut header = header();
        header.slice_voxels = slice;
        assert_eq!(Writer::new(header).is_ok(), valid, "slices of {slice}");
        let mut bytes = sample();
        bytes[80..84].copy_from_slice(&slice.to_le_bytes());
        seal_header(&mut bytes);
        assert_eq!(
            Header::parse(&bytes, &Limits::default()).is_ok(),
            valid,
            "slices of {slice}"
        );
    }
    for (slice, valid) in [(MAX_COLOUR_SLICE, true), (MAX_COLOUR_SLICE + 1, false), (0, false)] {
        let mut header = header();
        header.format = Format::Transform { colour_slice: slice };
        assert_eq!(Writer::new(header).is_ok(), valid, "slices of {slice}");
    }
    let mut bytes = sample();
    bytes[32..40].copy_from_slice(&f64::NAN.to_le_bytes());
    seal_header(&mut bytes);
    assert!(parse(&bytes).is_err());
}

#[test]
fn unknown_critical_parts_are_refused_and_optional_ones_ignored() {
    let refused = |offset: usize, value: u8| {
        let mut bytes = sample();
        bytes[offset] = value;
        seal_header(&mut bytes);
        matches!(parse(&bytes), Err(Error::Unsupported { .. }))
    };
    assert!(refused(8, 1), "an earlier major version");
    assert!(refused(8, 4), "a later major version");
    assert!(!refused(10, 9), "minor version");
    assert!(refused(15, 0x80), "critical flag");
    assert!(!refused(16, 0xff), "optional flag");

    let mut bytes = sample();
    bytes[124] = 5;
    seal_chunks(&mut bytes, 124);
    let error = parse(&bytes).unwrap().require(2).unwrap_err();
    assert!(matches!(error, Error::Unsupported { .. }), "{error}");

    // An ancillary chunk before, among and after the base level's geometry chunks.
    let bytes = sample();
    let whole = parse(&bytes).unwrap();
    for at in [124, 124 + 19, 124 + 19 + 22] {
        let mut extra = Vec::new();
        let chunk = Chunk {
            kind: ChunkKind::Ancillary(200),
            level: 99,
            slice: 0,
            count: 0,
            payload: b"a note",
            offset: 0,
            payload_at: 0,
        };
        chunk.write(Form::Fixed, &[], &mut extra).unwrap();
        let mut longer = [&bytes[..at], &extra, &bytes[at..]].concat();
        longer[96] += extra.len() as u8;
        seal_header(&mut longer);
        let stream = parse(&longer).unwrap();
        assert!(stream.damage().is_none(), "{:?}", stream.damage());
        assert_eq!(stream.levels()[1].latent_hash, whole.levels()[1].latent_hash);
    }
}

#[test]
fn chunks_out_of_order_or_with_impossible_counts_are_damage() {
    // Offset, value, and what the message tells; the checksum is right every time.
    for (offset, value, message) in [
        (
            125,
            2,
            "chunk is geometry of level 2, slice 0, expected geometry chunk of level 1, slice 0",
        ),
        (126, 1, "chunk is geometry of level 1, slice 1"),
        (128, 9, "is 9, expected 1 to 8"),
        (128, 0, "is 0, expected 1 to 8"),
        (128, 4, "voxel count of level 1 is 4, expected at most 3"),
        (124 + 19 + 4, 2, "voxel count of level 2 is 2, expected 3"),
        (124 + 19, 2, "chunk is feature of level 2"),
        (124 + 41 + 4, 2, "is 2, expected 3 to 3"),
        (124 + 41 + 8, 7, "expected 8 or more"),
    ] {
        let mut bytes = sample();
        bytes[offset] = value;
        seal_chunks(&mut bytes, 124);
        let error = parse(&bytes).unwrap().require(2).unwrap_err().to_string();
        assert!(error.contains(message), "{offset} = {value}: {error}");
    }
    // Sections that end between other chunks than their level's.
    for (from, to, by) in [(96, 100, 22), (100, 96, 33)] {
        let mut bytes = sample();
        bytes[from] -= by;
        bytes[to] += by;
        seal_header(&mut bytes);
        assert!(parse(&bytes).unwrap().require(2).is_err());
    }
}

#[test]
fn the_writer_refuses_invalid_levels() {
    let unfinished = Writer::new(header()).unwrap();
    assert!(unfinished.finish().is_err());
    let mut wrong = Writer::new(header()).unwrap();
    assert!(matches!(wrong.geometry(5, &[(1, b"")]), Err(Error::Usage(_))));
    assert!(matches!(wrong.features(3, 0, &[b""]), Err(Error::Usage(_))));
    wrong.geometry(2, &[(3, b"")]).unwrap();
    assert!(wrong.finish().is_err());
}

#[test]
fn a_stream_may_start_at_the_root() {
    let header = Header {
        bits: 1,
        base: 0,
        top: 0,
        points: 8,
        voxels: vec![1],
        ..header()
    };
    let mut writer = Writer::new(header).unwrap();
    writer.features(0, 5, &[b"root"]).unwrap();
    let bytes = writer.finish().unwrap();
    let stream = parse(&bytes).unwrap().require(0).unwrap();
    assert!(stream.levels()[0].geometry.is_empty());
    assert_eq!(stream.levels()[0].features[0].bytes, b"root");
}

proptest! {
    #[test]
    fn damage_with_valid_checksums_never_panics(
        edits in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
        small in any::<bool>(),
    ) {
        let mut bytes = sample();
        for (at, value) in edits {
            let at = at.index(bytes.len());
            bytes[at] = if small { value % 16 } else { value };
        }
        seal_header(&mut bytes);
        seal_chunks(&mut bytes, 124);
        if let Ok(stream) = parse(&bytes) {
            prop_assert!(stream.damage().is_some() || stream.deepest() == Some(stream.header().top));
        }
    }

    #[test]
    fn arbitrary_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let _ = parse(&bytes);
        let _ = parse(&[&sample()[..124], &bytes].concat());
    }
}
