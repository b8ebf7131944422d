//! The lossless octree codec (`docs/format.md`, clause 4).
//!
//! A level is coded given the level above, as the occupancy of each parent: an 8-bit mask of its children. The parents,
//! in Morton order, are cut into slices of at most 16,384. Each slice is an entropy stream of its own, so the slices of
//! a level decode in any order and in parallel. Within a slice, each child is one binary decision, parent by parent and
//! octant by octant. Its probability comes from a small integer network (`network`), whose binary input features are
//!
//! - which of the parent's 26 neighbours are occupied,
//! - which children those neighbours have that precede the parent in the slice,
//! - which children the parent has in lower octants.
//!
//! The output layer of the network is backward-adaptive (`predictor`). Where the network is uncertain, a mixer combines
//! its prediction with those of five adaptive contexts (`contexts`, `mixer`). The decisions are coded by a binary
//! arithmetic coder (`coder`, `coding::probability`). If a parent has none of its first seven children, the
//! eighth is implied and not coded.
//!
//! # Exactness
//! All arithmetic is on integers. Encoder and decoder are bit-exact on every machine and with any number of threads.
//!
//! # Untrusted input
//! The caller states the expected number of voxels. A decoder fails as soon as a slice has more, or fewer at its end.
//! It allocates memory for the given parents and the expected voxels only.

mod coder;
mod contexts;
pub mod guide;
mod mixer;
mod neighbourhood;
pub mod network;
#[cfg(feature = "encoder")]
mod optimise;
mod predictor;

use super::{KernelMap, Octree};
use crate::cancel::Cancel;
use crate::container::Slice;
use crate::error::{Error, Result, Stage};
use b2p_kernels::{Instructions, Isa, Work};
use coder::{Decoder, Encoder};
use guide::Guide;
use neighbourhood::Neighbourhood;
#[cfg(feature = "encoder")]
pub use optimise::{Distortion, optimise_level};
use predictor::Predictor;
use rayon::prelude::*;
use std::ops::Range;

/// Ranges of parents that the slices cover, of at most `slice` parents each.
fn slices(parents: usize, slice: usize) -> impl ExactSizeIterator<Item = Range<usize>> {
    (0..parents.div_ceil(slice)).map(move |i| i * slice..parents.min((i + 1) * slice))
}

/// Encodes level `level` of `octree` in slices of `slice` parents. Returns the number of children and the entropy
/// stream of each slice. `map` is the 3³ kernel map of the level above. The result does not depend on `isa`.
///
/// # Panics
/// If `level` is 0 or deeper than the octree, `map` belongs to another level, or `slice` is 0.
pub fn encode_level(isa: Isa, octree: &Octree, map: &KernelMap, level: u8, slice: usize) -> Vec<(u32, Vec<u8>)> {
    encode_guided(isa, octree, map, level, slice, None)
}

/// [`encode_level`] with what a previous frame tells of the level.
///
/// # Panics
/// As [`encode_level`]; if the guide does not have one mode and window per parent, or has the mode `Skip` where the
/// window's children are not those of the parent.
pub fn encode_guided(
    isa: Isa,
    octree: &Octree,
    map: &KernelMap,
    level: u8,
    slice: usize,
    guide: Option<Guide<'_>>,
) -> Vec<(u32, Vec<u8>)> {
    let occupancy = octree.occupancy(level - 1);
    assert_eq!(map.len(), occupancy.len(), "one kernel map row per parent");
    let ranges: Vec<_> = slices(occupancy.len(), slice).collect();
    let encode = |parents: Range<usize>| {
        let masks = &occupancy[parents.clone()];
        let work = Encode {
            map,
            parents,
            masks,
            guide,
        };
        (count(masks) as u32, isa.run(work))
    };
    ranges.into_par_iter().map(encode).collect()
}

/// Decodes one slice of level `level`. Returns the occupancies of its parents `parents`. `map` is the 3³ kernel map of
/// the level above.
///
/// # Errors
/// [`Error::Truncated`] if the entropy stream ends early. [`Error::Malformed`] if it does not hold exactly
/// `slice.voxels` voxels, or has bytes after them.
///
/// # Panics
/// If `parents` exceeds the rows of `map`.
pub fn decode_slice(isa: Isa, level: u8, map: &KernelMap, parents: Range<usize>, slice: &Slice) -> Result<Vec<u8>> {
    decode_guided_slice(isa, level, map, parents, slice, None)
}

/// [`decode_slice`] with what a previous frame tells of the level.
fn decode_guided_slice(
    isa: Isa,
    level: u8,
    map: &KernelMap,
    parents: Range<usize>,
    slice: &Slice,
    guide: Option<Guide<'_>>,
) -> Result<Vec<u8>> {
    let masks = isa.run(Decode {
        level,
        map,
        parents: parents.clone(),
        slice,
        guide,
    })?;
    match count(&masks) {
        found if found == slice.voxels as usize => Ok(masks),
        found => {
            let expected = slice.voxels.to_string();
            Err(wrong_count(level, &parents, slice, found, expected))
        }
    }
}

/// Decodes the next level from its slices, of `slice` parents each, and adds it to `octree`. `map` is the 3³ kernel map
/// of the level that is the deepest before.
///
/// # Errors
/// Those of [`decode_masks`] and [`Octree::grow`]. The octree is then unchanged.
///
/// # Panics
/// If `map` belongs to another level, or `slice` is 0.
pub fn decode_level(
    isa: Isa,
    octree: &mut Octree,
    map: &KernelMap,
    encoded: &[Slice],
    slice: usize,
    cancel: &Cancel,
) -> Result<()> {
    let level = octree.depth() + 1;
    octree.grow(decode_masks(isa, level, map, encoded, slice, None, cancel)?)
}

/// Decodes the slices of `level`, of `slice` parents each. Returns the occupancies of all parents, as [`Octree::grow`]
/// takes them. `map` is the 3³ kernel map of the parents, `guide` what a previous frame tells of the level.
///
/// # Errors
/// Those of [`decode_slice`], [`Error::Malformed`] if the number of slices is wrong, and [`Error::Cancelled`].
///
/// # Panics
/// If `slice` is 0.
pub fn decode_masks(
    isa: Isa,
    level: u8,
    map: &KernelMap,
    encoded: &[Slice],
    slice: usize,
    guide: Option<Guide<'_>>,
    cancel: &Cancel,
) -> Result<Vec<u8>> {
    let ranges = slices(map.len(), slice);
    if encoded.len() != ranges.len() {
        return Err(Error::malformed(
            Stage::Geometry,
            format!("level {level}"),
            "number of slices",
            encoded.len(),
            ranges.len(),
        )
        .breaks("3.2.3"));
    }
    let tasks: Vec<_> = ranges.zip(encoded).collect();
    let decode = |(parents, slice): (Range<usize>, &Slice)| {
        cancel.check()?;
        decode_guided_slice(isa, level, map, parents, slice, guide)
    };
    // Collect all results first: the error returned is that of the first faulty slice, with any number of threads.
    let masks: Vec<Result<_>> = tasks.into_par_iter().map(decode).collect();
    let masks: Result<Vec<_>> = masks.into_iter().collect();
    Ok(masks?.concat())
}

/// Encodes the occupancies of one slice.
struct Encode<'a> {
    map: &'a KernelMap,
    parents: Range<usize>,
    masks: &'a [u8],
    guide: Option<Guide<'a>>,
}

impl Work for Encode<'_> {
    type Output = Vec<u8>;

    #[inline(always)]
    fn run<I: Instructions>(self, instructions: I) -> Vec<u8> {
        let Encode {
            map,
            parents,
            masks,
            guide,
        } = self;
        let mut predictor = Predictor::new(instructions, parents.len(), guide);
        let mut encoder = Encoder::new();
        let neighbourhoods = Neighbourhood::of_all(map, &parents);
        for ((parent, &mask), neighbourhood) in parents.clone().zip(masks).zip(neighbourhoods) {
            let skipped = guide.map_or(0, |guide| guide.skipped(parent));
            if skipped != 0 {
                assert_eq!(skipped, mask, "a skipped parent has the children of its window");
                continue;
            }
            let window = guide.and_then(|guide| guide.window(parent));
            let (row, first) = (map.row(parent), parents.start);
            predictor.code(&mut encoder, neighbourhood, row, first, masks, mask, window);
        }
        encoder.finish()
    }
}

/// Decodes the occupancies of one slice. Stops with an error as soon as they exceed its voxel count.
struct Decode<'a> {
    level: u8,
    map: &'a KernelMap,
    parents: Range<usize>,
    slice: &'a Slice<'a>,
    guide: Option<Guide<'a>>,
}

impl Work for Decode<'_> {
    type Output = Result<Vec<u8>>;

    #[inline(always)]
    fn run<I: Instructions>(self, instructions: I) -> Result<Vec<u8>> {
        let Decode {
            level,
            map,
            parents,
            slice,
            guide,
        } = self;
        let mut predictor = Predictor::new(instructions, parents.len(), guide);
        let mut decoder = Decoder::new(slice.bytes, slice.offset);
        let mut masks = Vec::with_capacity(parents.len());
        let mut found = 0;
        let neighbourhoods = Neighbourhood::of_all(map, &parents);
        for (parent, neighbourhood) in parents.clone().zip(neighbourhoods) {
            let (row, first) = (map.row(parent), parents.start);
            let mask = match guide.map_or(0, |guide| guide.skipped(parent)) {
                0 => {
                    let window = guide.and_then(|guide| guide.window(parent));
                    predictor.code(&mut decoder, neighbourhood, row, first, &masks, 0, window)
                }
                skipped => skipped,
            };
            decoder.check_not_past_end()?;
            masks.push(mask);
            found += mask.count_ones() as usize;
            let at_least = found + (parents.end - parent - 1);
            if at_least > slice.voxels as usize {
                let found = format!("at least {at_least}");
                let expected = format!("at most {}", slice.voxels);
                return Err(wrong_count(level, &parents, slice, found, expected));
            }
        }
        decoder.finish()?;
        Ok(masks)
    }
}

/// Number of children that `masks` have.
fn count(masks: &[u8]) -> usize {
    masks.iter().map(|mask| mask.count_ones() as usize).sum()
}

fn wrong_count(level: u8, parents: &Range<usize>, slice: &Slice, found: impl ToString, expected: String) -> Error {
    let at = format!("byte {}, level {level}, parents {parents:?}", slice.offset);
    Error::malformed(Stage::Geometry, at, "number of voxels", found, expected).breaks("4.1.3")
}

#[cfg(test)]
mod tests;
