//! The same for streams of version 3: every cut, every flipped bit, lies behind right checksums, pieces of any size.

use std::iter::repeat;

use b2p::container::Header;
use b2p::encoder::transform::{Options, encode};
use b2p::log::Log;
use b2p::{Decoder, Decoding};
use b2p::{Error, Limits};
use rayon::prelude::*;

use crate::common::Ball;
use crate::ends;
use crate::seal::{chunks, seal};

/// Voxels and colours of a level.
type Found = (Vec<u64>, Vec<[u8; 3]>);

/// A stream of a few hundred bytes with all that version 3 has: trunks, levels of several slices, filters.
fn stream() -> Vec<u8> {
    let options = Options {
        levels: Some(2..=4),
        slice_voxels: 24,
        colour_slice: 40,
        ..Options::default()
    };
    let cloud = Ball::new(5, 9.5).cloud();
    let encoded = encode(&cloud, &options, &Log::default());
    encoded.expect("a ball can be coded").bytes
}

fn found(decoding: &Decoding) -> Option<Found> {
    let points = decoding.points()?;
    Some((points.voxels.keys().to_vec(), points.colours.to_vec()))
}

/// Pushes a stream in pieces: every level as it became whole with the bytes that had come by then, and the error that
/// ended it.
fn pushed(
    bytes: &[u8],
    level: Option<u8>,
    sizes: impl IntoIterator<Item = usize>,
) -> (Vec<(Found, usize)>, Option<String>) {
    let mut decoding = Decoder::new().with_level(level).start();
    let mut levels = Vec::new();
    let (mut sizes, mut at) = (sizes.into_iter(), 0);
    let result = (|| {
        loop {
            while decoding.advance()?.is_some() {
                levels.extend(found(&decoding).map(|found| (found, at)));
            }
            if at == bytes.len() {
                return decoding.finish();
            }
            let size = sizes.next().unwrap_or(usize::MAX).min(bytes.len() - at);
            decoding.push(&bytes[at..at + size]);
            at += size;
        }
    })();
    (levels, result.err().map(|error| format!("{error:?}")))
}

/// Every level that can be had of a stream, and the error that ended it.
fn levels(bytes: &[u8]) -> (Vec<Found>, Option<String>) {
    let (levels, error) = pushed(bytes, None, [usize::MAX]);
    (levels.into_iter().map(|(found, _)| found).collect(), error)
}

#[test]
fn every_cut_is_noticed_and_leaves_the_whole_levels_before_it() {
    let bytes = stream();
    let (whole, error) = levels(&bytes);
    assert_eq!((whole.len(), error), (3, None));
    let ends = ends(&bytes);
    (0..bytes.len()).into_par_iter().for_each(|length| {
        let count = ends.iter().filter(|(_, end)| *end <= length).count();
        let (found, error) = levels(&bytes[..length]);
        assert!(found == whole[..count], "{length} bytes");
        let at_an_end = ends.iter().any(|(_, end)| *end == length);
        assert_eq!(error.is_none(), at_an_end, "{length} bytes: {error:?}");
        for (level, end) in &ends {
            let asked = pushed(&bytes[..length], Some(*level), [usize::MAX]).1;
            assert_eq!(asked.is_none(), *end <= length, "level {level} of {length} bytes");
        }
    });
}

#[test]
fn every_flipped_bit_is_noticed_and_leaves_the_levels_before_it() {
    let bytes = stream();
    let (whole, _) = levels(&bytes);
    let ends = ends(&bytes);
    (0..8 * bytes.len()).into_par_iter().for_each(|bit| {
        let (at, mut damaged) = (bit / 8, bytes.clone());
        damaged[at] ^= 1 << (bit % 8);
        let before = ends.iter().filter(|(_, end)| *end <= at).count();
        let (found, error) = levels(&damaged);
        assert!(found == whole[..before], "bit {bit}");
        assert!(error.is_some(), "bit {bit} unnoticed");
    });
}

#[test]
fn levels_and_errors_are_those_of_the_whole_however_the_bytes_are_cut() {
    let bytes = stream();
    let mut variants = vec![
        bytes.clone(),
        [&bytes[..], b"more"].concat(),
        b"ply\nformat ascii 1.0\n".to_vec(),
        b"p".to_vec(),
        Vec::new(),
    ];
    for at in (0..bytes.len()).step_by(bytes.len() / 40) {
        variants.push(bytes[..at].to_vec());
        let mut damaged = bytes.clone();
        damaged[at] ^= 0x40;
        variants.push(damaged);
    }
    for stream in variants {
        for level in [None, Some(2), Some(3), Some(9)] {
            let only =
                |levels: Vec<(Found, usize)>| -> Vec<Found> { levels.into_iter().map(|(found, _)| found).collect() };
            let (whole, error) = pushed(&stream, level, [usize::MAX]);
            let whole = only(whole);
            for size in [1, 7, 100] {
                let (pieces, own) = pushed(&stream, level, repeat(size));
                assert_eq!(own, error, "pieces of {size}, level {level:?}");
                assert!(only(pieces) == whole, "pieces of {size}, level {level:?}");
            }
        }
    }
}

#[test]
fn every_level_is_given_with_its_last_byte() {
    let bytes = stream();
    let (levels, error) = pushed(&bytes, None, repeat(1));
    assert_eq!(error, None);
    let came: Vec<_> = levels.iter().map(|(_, at)| *at).collect();
    let expected: Vec<_> = ends(&bytes).into_iter().map(|(_, end)| end).collect();
    assert_eq!(came, expected);
}

#[test]
fn what_is_wrong_behind_right_checksums_is_refused_or_told_by_the_hash_and_the_levels_before_stay() {
    let bytes = stream();
    let (whole, _) = levels(&bytes);
    let ends = ends(&bytes);
    let first = chunks(&bytes)[0];
    (first..bytes.len()).into_par_iter().for_each(|at| {
        for bit in [0, 3, 6] {
            let mut changed = bytes.clone();
            changed[at] ^= 1 << bit;
            seal(&mut changed);
            let before = ends.iter().filter(|(_, end)| *end <= at).count();
            let (found, error) = levels(&changed);
            assert!(found.len() >= before && found[..before] == whole[..before]);
            // A filter may be changed without being noticed: the hash is of what it is run on.
            let same = found.len() == whole.len() && error.is_none();
            let voxels = |levels: &[Found]| levels.iter().map(|l| l.0.clone()).collect::<Vec<_>>();
            assert!(!same || voxels(&found) == voxels(&whole), "byte {at}");
        }
    });
}

#[test]
fn limits_are_held_against_the_header_before_anything_else_comes() {
    let bytes = stream();
    let header = Header::parse(&bytes, &Limits::default()).unwrap();
    for limits in [
        Limits::default().with_max_bytes(1 << 12),
        Limits::default().with_max_points(20),
        Limits::default().with_max_depth(3),
    ] {
        let mut decoding = Decoder::new().with_limits(limits).start();
        decoding.push(&bytes[..header.bytes()]);
        let error = decoding.advance().unwrap_err();
        assert!(matches!(error, Error::LimitExceeded { .. }), "{error}");
        let again = decoding.advance().unwrap_err();
        assert!(matches!(again, Error::Usage(_)), "{again}");
    }
}

#[test]
fn what_was_reached_before_the_damage_stays_usable() {
    let mut bytes = stream();
    let (end, last) = (ends(&bytes)[1].1, bytes.len() - 1);
    let decoder = Decoder::new();
    let coarser = decoder.decode(&bytes[..end]).unwrap();
    bytes[last] ^= 1;
    let mut decoding = decoder.start();
    decoding.push(&bytes);
    assert!(!decoding.is_drawable());
    assert_eq!(decoding.advance().unwrap(), Some(2));
    assert_eq!(decoding.advance().unwrap(), Some(3));
    let error = decoding.advance().unwrap_err();
    assert!(matches!(error, Error::ChecksumMismatch { .. }), "{error}");
    assert_eq!((decoding.level(), decoding.is_drawable()), (Some(3), true));
    assert_eq!(decoding.gaussians().unwrap(), coarser);
    assert!(matches!(decoding.finish(), Err(Error::Usage(_))));
}
