//! Streams that arrive in pieces.

use std::iter::repeat;

use b2p::latents::LatentDecoder;
use b2p::log::Log;
use b2p::{Cancel, Error, Limits};

use crate::common::small_stream;
use crate::{decoded, ends, model, pushed};

/// The stream as it is, and in every way in which it may not be: cut, damaged, continued, no stream at all.
fn variants(bytes: &[u8]) -> Vec<Vec<u8>> {
    let mut variants = vec![
        bytes.to_vec(),
        [bytes, b"more"].concat(),
        b"ply\nformat ascii 1.0\n".to_vec(),
        b"p".to_vec(),
        Vec::new(),
    ];
    variants.extend(ends(bytes).iter().map(|(_, end)| bytes[..*end].to_vec()));
    let step = bytes.len() / 40;
    for at in (0..bytes.len()).step_by(step) {
        variants.push(bytes[..at].to_vec());
        let mut damaged = bytes.to_vec();
        damaged[at] ^= 0x40;
        variants.push(damaged);
    }
    variants
}

#[test]
fn result_and_error_are_those_of_the_whole_however_the_bytes_are_cut() {
    let model = model();
    let bytes = small_stream(&model);
    let mut random = 1u64;
    for stream in variants(&bytes) {
        for level in [None, Some(2), Some(3), Some(1), Some(9)] {
            let whole = decoded(&model, &stream, level);
            for size in [1, 7, 100] {
                let (_, pieces) = pushed(&model, &stream, level, repeat(size));
                assert_eq!(pieces, whole, "pieces of {size}, level {level:?}");
            }
            let splits = std::iter::from_fn(|| {
                random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                Some((random >> 33) as usize % 300)
            });
            let (_, pieces) = pushed(&model, &stream, level, splits);
            assert_eq!(pieces, whole, "random pieces, level {level:?}");
        }
    }
}

#[test]
fn every_level_is_given_with_its_last_byte() {
    let model = model();
    let bytes = small_stream(&model);
    let (levels, result) = pushed(&model, &bytes, None, repeat(1));
    assert_eq!(levels, ends(&bytes));
    assert!(result.is_ok());
    let (levels, _) = pushed(&model, &bytes, Some(2), repeat(1));
    assert_eq!(levels, ends(&bytes)[..2], "no level after the one asked for");
}

#[test]
fn what_was_reached_before_the_damage_stays_usable() {
    let model = model();
    let mut bytes = small_stream(&model);
    let coarser = decoded(&model, &bytes, Some(2)).unwrap();
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    let (mut decoding, log) = (LatentDecoder::new(&model).start(None), Log::default());
    decoding.push(&bytes);
    assert!(!decoding.is_drawable());
    assert_eq!(decoding.advance(&log).unwrap(), Some(1));
    assert!(matches!(decoding.gaussians(&log), Err(Error::Unsupported { .. })));
    assert_eq!(decoding.advance(&log).unwrap(), Some(2));
    let error = decoding.advance(&log).unwrap_err();
    assert!(matches!(error, Error::ChecksumMismatch { .. }), "{error}");
    assert_eq!((decoding.level(), decoding.is_drawable()), (Some(2), true));
    assert_eq!(decoding.gaussians(&log).unwrap(), coarser);
    assert_eq!(decoding.exact().unwrap().octree.depth(), 2);
    assert!(matches!(decoding.finish(&log), Err(Error::Usage(_))));
}

#[test]
fn a_longer_prefix_never_loses_points() {
    let model = model();
    let bytes = small_stream(&model);
    let mut before = 0;
    for length in 0..=bytes.len() {
        let (mut decoding, log) = (LatentDecoder::new(&model).start(None), Log::default());
        decoding.push(&bytes[..length]);
        while decoding.advance(&log).unwrap().is_some() {}
        let points = decoding
            .exact()
            .map_or(0, |exact| exact.octree.level(exact.octree.depth()).len());
        assert!(points >= before, "{length} bytes");
        before = points;
    }
    assert!(before > 0);
}

#[test]
fn limits_are_held_against_the_header_before_anything_else_comes() {
    let model = model();
    let bytes = small_stream(&model);
    let limits = Limits::default().with_max_bytes(1 << 12);
    let decoder = LatentDecoder::new(&model).with_limits(limits);
    let mut decoding = decoder.start(None);
    decoding.push(&bytes[..124]);
    let error = decoding.advance(&Log::default()).unwrap_err();
    assert!(matches!(error, Error::LimitExceeded { .. }), "{error}");
}

#[test]
fn a_thrown_switch_stops_decoding_and_leaves_what_was_reached() {
    let model = model();
    let bytes = small_stream(&model);
    let cancel = Cancel::default();
    let decoder = LatentDecoder::new(&model).with_cancel(cancel.clone());
    for step in ["geometry", "probabilities", "features"] {
        let cancel = Cancel::default();
        let decoder = decoder.clone().with_cancel(cancel.clone());
        let listener = move |name: &str| {
            if name == format!("{step} of level 3") {
                cancel.cancel();
            }
        };
        let log = Log::with_listener(listener);
        let mut decoding = decoder.start(None);
        decoding.push(&bytes);
        let stopped = decoding.finish(&log);
        // Nothing follows the last level's features but the Gaussians.
        let stopped = match step {
            "features" => stopped.and_then(|()| decoding.gaussians(&log).map(|_| ())),
            _ => {
                assert_eq!(decoding.level(), Some(2));
                stopped
            }
        };
        assert!(matches!(stopped, Err(Error::Cancelled)), "{step}: {stopped:?}");
    }
    cancel.cancel();
    let stopped = decoder.decode(&bytes, None, &Log::default());
    assert!(matches!(stopped, Err(Error::Cancelled)));
}
