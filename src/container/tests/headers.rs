//! Which files begin like what, and fields at the ends of their ranges.

use super::*;
use crate::container::version;

fn of_version_3() -> Header {
    Header {
        format: Format::Transform { colour_slice: 3 },
        sections: vec![Section::default(); 3],
        ..header()
    }
}

fn of_version_2() -> Header {
    Header {
        sections: vec![Section::default(); 3],
        ..header()
    }
}

#[test]
fn the_first_bytes_tell_the_version_and_what_a_file_holds() {
    assert_eq!(version(&of_version_2().write()), Some(2));
    assert_eq!(version(&of_version_3().write()), Some(3));
    assert_eq!(version(&[&MAGIC[..], &[1, 2]].concat()), Some(0x201));
    assert_eq!(version(&[&MAGIC[..], &[1]].concat()), None);
    assert_eq!(version(&[1; 20]), None);
    let kinds = |bytes: &[u8]| [Header::is_of_sequence(bytes), Header::is_of_scene(bytes)];
    let frame = of_version_3();
    assert_eq!(kinds(&frame.write()), [false, false]);
    assert_eq!(kinds(&frame.write_sequence()), [true, false]);
    assert_eq!(kinds(&frame.write_scene()), [false, true]);
    assert_eq!(kinds(&frame.write_scene()[..15]), [false, false]);
    assert_eq!(kinds(&of_version_2().write_sequence()), [false, false]);
}

#[test]
fn a_file_of_another_kind_is_refused_with_the_names_of_both() {
    let (frame, limits) = (of_version_3(), Limits::default());
    let [one, sequence, scene] = ["a single frame", "a sequence of frames", "a scene of blocks"];
    let all = [
        (frame.write(), one),
        (frame.write_sequence(), sequence),
        (frame.write_scene(), scene),
    ];
    for (bytes, found) in all {
        let parsed = [
            (Header::parse(&bytes, &limits), one),
            (Header::parse_sequence(&bytes, &limits), sequence),
            (Header::parse_scene(&bytes, &limits), scene),
        ];
        for (parsed, expected) in parsed {
            match parsed {
                Ok(header) => assert!(found == expected && header == frame, "{found}"),
                Err(error) => {
                    let text = format!("it is {found}, where {expected} is expected");
                    assert!(found != expected && error.to_string().ends_with(&text), "{error}");
                }
            }
        }
    }
}

#[test]
fn the_checksum_of_a_header_follows_its_last_field() {
    for header in [of_version_2(), of_version_3()] {
        let bytes = header.write();
        let at = Header::checksum_at(&bytes).unwrap();
        assert_eq!(at + 4, bytes.len());
        assert_eq!(bytes[at..], crc32c::crc32c(&bytes[..at]).to_le_bytes());
        assert_eq!(Header::checksum_at(&bytes[..22]), None);
        let mut upside_down = bytes.clone();
        upside_down.swap(21, 22);
        assert_eq!(Header::checksum_at(&upside_down), None);
    }
}

#[test]
fn a_count_that_cannot_be_is_at_its_place_in_the_header() {
    for (header, start) in [(of_version_2(), 84), (of_version_3(), 72)] {
        for level in 0..3 {
            // More than eight times as many as the level above, or than there are places.
            let mut counts = header.clone();
            counts.voxels[level] = [65, 25, 81][level];
            let error = Header::parse(&counts.write(), &Limits::default()).unwrap_err();
            assert_eq!(error.offset(), Some(start + 4 * level as u64), "{error}");
            let field = format!("voxel count of level {}", 2 + level);
            assert!(error.to_string().contains(&field), "{error}");
            counts.voxels[level] -= 1;
            let later = Header::parse(&counts.write(), &Limits::default())
                .err()
                .and_then(|error| error.offset());
            assert_ne!(later, Some(start + 4 * level as u64));
        }
        for (points, is_possible) in [(19, false), (20, true), (20 * 8, true), (20 * 8 + 1, false)] {
            let counted = Header {
                points,
                ..header.clone()
            };
            assert_eq!(
                Header::parse(&counted.write(), &Limits::default()).is_ok(),
                is_possible,
                "{points}"
            );
        }
    }
}

#[test]
fn a_slice_size_that_cannot_be_is_at_its_place_in_the_header() {
    let fault = |bytes: &[u8], at: usize| {
        let mut bytes = bytes.to_vec();
        bytes[at..at + 4].copy_from_slice(&[0; 4]);
        let end = bytes.len() - 4;
        let sum = crc32c::crc32c(&bytes[..end]);
        bytes[end..].copy_from_slice(&sum.to_le_bytes());
        Header::parse(&bytes, &Limits::default()).unwrap_err()
    };
    let [version_2, version_3] = [of_version_2(), of_version_3()].map(|header| header.write());
    for (bytes, at, field) in [
        (&version_2, 80, "slice size"),
        (&version_3, 64, "slice size"),
        (&version_3, 68, "slice size of the colours"),
    ] {
        let error = fault(bytes, at);
        assert_eq!(error.offset(), Some(at as u64), "{error}");
        assert!(error.to_string().contains(field), "{error}");
    }
}

#[test]
fn levels_end_above_the_finest_in_version_2_and_at_it_in_version_3() {
    let deep = |header: Header, bits: u8, top: u8| {
        let header = Header {
            bits,
            base: top - 2,
            top,
            points: 20,
            ..header
        };
        Header::parse(&header.write(), &Limits::default())
            .map(drop)
            .map_err(|error| error.offset())
    };
    assert_eq!(deep(of_version_2(), 21, 20), Ok(()));
    assert_eq!(deep(of_version_2(), 21, 21), Err(Some(21)));
    assert_eq!(deep(of_version_2(), 20, 20), Err(Some(20)));
    assert_eq!(deep(of_version_3(), 21, 21), Ok(()));
    assert_eq!(deep(of_version_3(), 22, 22), Err(Some(21)));
    assert_eq!(deep(of_version_3(), 22, 21), Err(Some(20)));
    assert_eq!(deep(of_version_3(), 20, 21), Err(Some(20)));
    let four = |header: Header| Header {
        bits: 6,
        top: 5,
        points: 25,
        voxels: vec![3, 10, 20, 21],
        sections: vec![Section::default(); 4],
        ..header
    };
    assert!(Header::parse(&four(of_version_2()).write(), &Limits::default()).is_err());
    assert!(Header::parse(&four(of_version_3()).write(), &Limits::default()).is_ok());
}
