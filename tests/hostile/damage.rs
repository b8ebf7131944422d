//! Every way to cut a small stream, and every way to change one bit or to lose one byte of it.

use b2p::latents::network::Model;
use b2p::latents::{Exact, LatentDecoder};
use b2p::log::Log;
use rayon::prelude::*;

use crate::common::small_stream;
use crate::{decoded, ends, model};

/// The exact zone of every level that can be had of a stream, and the error that ended it.
fn levels(model: &Model, bytes: &[u8]) -> (Vec<Exact>, Option<String>) {
    let mut decoding = LatentDecoder::new(model).start(None);
    let (mut levels, log) = (Vec::new(), Log::default());
    decoding.push(bytes);
    loop {
        match decoding.advance(&log) {
            Ok(Some(_)) => levels.extend(decoding.exact().cloned()),
            Ok(None) => {
                return (levels, decoding.finish(&log).err().map(|e| e.to_string()));
            }
            Err(error) => return (levels, Some(error.to_string())),
        }
    }
}

#[test]
fn every_cut_is_noticed_and_leaves_the_whole_levels_before_it() {
    let model = model();
    let bytes = small_stream(&model);
    let (whole, error) = levels(&model, &bytes);
    assert_eq!((whole.len(), error), (3, None));
    let ends = ends(&bytes);
    (0..bytes.len()).into_par_iter().for_each(|length| {
        let count = ends.iter().filter(|(_, end)| *end <= length).count();
        let (found, error) = levels(&model, &bytes[..length]);
        assert_eq!(found, whole[..count], "{length} bytes");
        let at_an_end = ends.iter().any(|(_, end)| *end == length);
        assert_eq!(error.is_none(), at_an_end, "{length} bytes: {error:?}");
        for (level, end) in &ends[1..] {
            let asked = decoded(&model, &bytes[..length], Some(*level));
            assert_eq!(asked.is_ok(), *end <= length, "level {level} of {length} bytes");
        }
    });
}

/// Decodes changed streams: each must be refused, after no more than the levels before the change, these as they should
/// be.
fn all_are_noticed(changes: impl Fn(u8) -> Vec<u8> + Sync) {
    let model = model();
    let bytes = small_stream(&model);
    let (whole, _) = levels(&model, &bytes);
    let ends = ends(&bytes);
    let tried: usize = (0..bytes.len())
        .into_par_iter()
        .map(|at| {
            let changes = changes(bytes[at]);
            for &change in &changes {
                let mut damaged = bytes.clone();
                damaged[at] = change;
                let before = ends.iter().filter(|(_, end)| *end <= at).count();
                let (found, error) = levels(&model, &damaged);
                assert_eq!(found, whole[..before], "byte {at} became {change:#04x}");
                assert!(error.is_some(), "byte {at} became {change:#04x} unnoticed");
            }
            changes.len()
        })
        .sum();
    println!("{tried} changes of a stream of {} bytes, all noticed", bytes.len());
}

#[test]
fn every_flipped_bit_is_noticed_and_leaves_the_levels_before_it() {
    all_are_noticed(|byte| (0..8).map(|bit| byte ^ 1 << bit).collect());
}

#[test]
fn every_byte_lost_to_zeros_or_ones_is_noticed() {
    all_are_noticed(|byte| [0, 255].into_iter().filter(|&lost| lost != byte).collect());
}
