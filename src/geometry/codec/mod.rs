//! The octree codec: lossless, level by level.
//!
//! A level is coded, given the level above, as the occupancy of each of the parents: which of their eight children are there. The
//! parents, in Morton order, are cut into slices of so many (16,384 in a stream); each slice is an entropy stream of its own, so the slices of a
//! level decode in any order and in parallel. Within a slice, parent after parent and child after child by ascending octant, each
//! child is one binary decision, whose probability comes from a small integer network (`network`) that sees
//!
//! - which of the parent's 26 neighbours are occupied,
//! - which children those neighbours have that come earlier in the slice,
//! - which children the parent itself has in the octants below,
//!
//! and whose output layer goes on learning as it codes (`predictor`). Where the network is in doubt, five tables of what the slice has shown in like
//! `surroundings` have their say (`mixer`): what a cloud repeats, it tells once. The decisions go through a binary arithmetic coder (`coder`,
//! `probability`). If a parent has none of its first seven children, the eighth is not coded: it must be there.
//!
//! # Exactness
//! Integers throughout: an encoder and a decoder anywhere, with any number of threads, agree on every bit. A stream is fully
//! determined by what it codes.
//!
//! # Hostile input
//! A decoder is told how many voxels to expect, and fails as soon as there are more, or in the end fewer. It reserves memory for the
//! parents it was given and the voxels it was told, no more.

mod coder;
mod mixer;
mod neighbourhood;
pub mod network;
mod predictor;
mod surroundings;

use super::{KernelMap, Octree};
use crate::cancel::Cancel;
use crate::container::Slice;
use crate::error::{Error, Result, Stage};
use b2p_kernels::{Instructions, Isa, Work};
use coder::{Decoder, Encoder};
use neighbourhood::Neighbourhood;
use predictor::Predictor;
use rayon::prelude::*;
use std::ops::Range;

/// The slices of so many parents: which parents each has, at most `slice`.
fn slices(parents: usize, slice: usize) -> impl ExactSizeIterator<Item = Range<usize>> {
    (0..parents.div_ceil(slice)).map(move |i| i * slice..parents.min((i + 1) * slice))
}

/// Codes level `level` of `octree` in slices of `slice` parents: for each the number of children, and the code. `map` is the 3³
/// kernel map of the level above; any `isa` gives the same.
///
/// # Panics
/// If `level` is 0 or deeper than the octree, `map` is another level's, or `slice` is 0.
pub fn encode_level(isa: Isa, octree: &Octree, map: &KernelMap, level: u8, slice: usize) -> Vec<(u32, Vec<u8>)> {
    let occupancy = octree.occupancy(level - 1);
    assert_eq!(map.len(), occupancy.len(), "one kernel map row per parent");
    let ranges: Vec<_> = slices(occupancy.len(), slice).collect();
    let encode = |parents: Range<usize>| {
        let masks = &occupancy[parents.clone()];
        let work = Encode { map, parents, masks };
        (count(masks) as u32, isa.run(work))
    };
    ranges.into_par_iter().map(encode).collect()
}

/// The occupancies of the parents `parents`, whose children are the slice's voxels of level `level`; `map` is the 3³ kernel map of
/// the level above.
///
/// # Errors
/// [`Error::Truncated`] if the code ends early, [`Error::Malformed`] if it does not hold exactly so many voxels or goes on after them.
///
/// # Panics
/// If `map` has not that many rows.
pub fn decode_slice(isa: Isa, level: u8, map: &KernelMap, parents: Range<usize>, slice: &Slice) -> Result<Vec<u8>> {
    let masks = isa.run(Decode {
        level,
        map,
        parents: parents.clone(),
        slice,
    })?;
    match count(&masks) {
        found if found == slice.voxels as usize => Ok(masks),
        found => {
            let expected = slice.voxels.to_string();
            Err(wrong_count(level, &parents, slice, found, expected))
        }
    }
}

/// Adds to `octree` the level that these slices hold, each of the children of `slice` parents. `map` is the 3³ kernel map of what is
/// now the deepest level.
///
/// # Errors
/// Those of [`decode_masks`] and [`Octree::grow`]. The octree is unchanged then.
///
/// # Panics
/// If `map` is another level's, or `slice` is 0.
pub fn decode_level(
    isa: Isa,
    octree: &mut Octree,
    map: &KernelMap,
    encoded: &[Slice],
    slice: usize,
    cancel: &Cancel,
) -> Result<()> {
    let level = octree.depth() + 1;
    octree.grow(decode_masks(isa, level, map, encoded, slice, cancel)?)
}

/// The occupancies of all parents of `level`, whose 3³ kernel map is `map`, from slices of the children of `slice` parents each: what
/// [`Octree::grow`] adds that level with.
///
/// # Errors
/// Those of [`decode_slice`], [`Error::Malformed`] if there are more or fewer slices than there should be, and [`Error::Cancelled`].
///
/// # Panics
/// If `slice` is 0.
pub fn decode_masks(
    isa: Isa,
    level: u8,
    map: &KernelMap,
    encoded: &[Slice],
    slice: usize,
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
        ));
    }
    let tasks: Vec<_> = ranges.zip(encoded).collect();
    let decode = |(parents, slice): (Range<usize>, &Slice)| {
        cancel.check()?;
        decode_slice(isa, level, map, parents, slice)
    };
    // All of them, so that the error is that of the first slice that has one.
    let masks: Vec<Result<_>> = tasks.into_par_iter().map(decode).collect();
    let masks: Result<Vec<_>> = masks.into_iter().collect();
    Ok(masks?.concat())
}

/// Codes the occupancies of one slice.
struct Encode<'a> {
    map: &'a KernelMap,
    parents: Range<usize>,
    masks: &'a [u8],
}

impl Work for Encode<'_> {
    type Output = Vec<u8>;

    #[inline(always)]
    fn run<I: Instructions>(self, instructions: I) -> Vec<u8> {
        let Encode { map, parents, masks } = self;
        let (mut predictor, mut encoder) = (Predictor::new(instructions, parents.len()), Encoder::new());
        let around = Neighbourhood::of_all(map, &parents);
        for ((here, &mask), around) in parents.clone().zip(masks).zip(around) {
            predictor.code(&mut encoder, around, map.row(here), parents.start, masks, mask);
        }
        encoder.finish()
    }
}

/// Decodes the occupancies of one slice, unless they come to more than its voxels.
struct Decode<'a> {
    level: u8,
    map: &'a KernelMap,
    parents: Range<usize>,
    slice: &'a Slice<'a>,
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
        } = self;
        let mut predictor = Predictor::new(instructions, parents.len());
        let mut decoder = Decoder::new(slice.bytes, slice.offset);
        let mut masks = Vec::with_capacity(parents.len());
        let mut found = 0;
        let around = Neighbourhood::of_all(map, &parents);
        for (here, around) in parents.clone().zip(around) {
            let (row, first) = (map.row(here), parents.start);
            let mask = predictor.code(&mut decoder, around, row, first, &masks, 0);
            decoder.check_not_past_end()?;
            masks.push(mask);
            found += mask.count_ones() as usize;
            let at_least = found + (parents.end - here - 1);
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

fn count(masks: &[u8]) -> usize {
    masks.iter().map(|mask| mask.count_ones() as usize).sum()
}

fn wrong_count(level: u8, parents: &Range<usize>, slice: &Slice, found: impl ToString, expected: String) -> Error {
    let at = format!("byte {}, level {level}, parents {parents:?}", slice.offset);
    Error::malformed(Stage::Geometry, at, "number of voxels", found, expected)
}

#[cfg(test)]
mod tests;
