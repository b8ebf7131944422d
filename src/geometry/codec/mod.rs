//! The octree, level by level, losslessly.
mod coder;
mod context;
mod mixer;

use rayon::prelude::*;

use super::{KernelMap, Octree};
use crate::error::{Error, Result, Stage};
use coder::{Coder, Decoder, Encoder};
use context::{Contexts, Window};
use mixer::Mixer;

/// Codes which children the voxels of `level − 1` have, in slices of `slice` voxels of that level: for each the number of children, and
/// the code. `map` is the 3³ kernel map of `level − 1`.
pub fn encode_level(
    octree: &Octree,
    map: &KernelMap,
    level: u8,
    slice: usize,
) -> Vec<(u32, Vec<u8>)> {
    let occupancy = octree.occupancy(level - 1);
    occupancy
        .par_chunks(slice)
        .enumerate()
        .map(|(i, part)| {
            let mut encoder = Encoder::new();
            let mut masks = part.to_vec();
            run(&mut encoder, map, i * slice, &mut masks, |_| true);
            let children = part.iter().map(|m| m.count_ones()).sum();
            (children, encoder.finish())
        })
        .collect()
}

/// Reads the next level of an octree from slices of (number of children, code).
pub fn decode_level(
    octree: &mut Octree,
    map: &KernelMap,
    slices: &[(u32, &[u8])],
    slice: usize,
) -> Result<()> {
    let parents = octree.level(octree.depth()).len();
    let level = octree.depth() + 1;
    let needed = parents.div_ceil(slice);
    if slices.len() != needed {
        return Err(Error::malformed(
            Stage::Geometry,
            format!("level {level}"),
            "number of slices",
            slices.len(),
            needed,
        ));
    }
    let mut occupancy = vec![0u8; parents];
    let results: Vec<Result<()>> = occupancy
        .par_chunks_mut(slice)
        .zip(slices)
        .enumerate()
        .map(|(i, (masks, &(children, bytes)))| {
            let at = format!("level {level}, slice {i}");
            let mut decoder = Decoder::new(bytes);
            run(&mut decoder, map, i * slice, masks, |d| !d.exhausted());
            decoder.finish(&at)?;
            let found: u32 = masks.iter().map(|m| m.count_ones()).sum();
            if found != children {
                return Err(Error::malformed(
                    Stage::Geometry,
                    at,
                    "number of children",
                    found,
                    children,
                ));
            }
            Ok(())
        })
        .collect();
    results.into_iter().collect::<Result<()>>()?;
    octree.grow(occupancy)
}

/// Codes the masks of the voxels from `first` on: reads them when encoding, fills them in when decoding. Stops when `go_on` says so.
fn run<C: Coder>(
    coder: &mut C,
    map: &KernelMap,
    first: usize,
    masks: &mut [u8],
    go_on: impl Fn(&C) -> bool,
) {
    let mut mixer = Mixer::new(Contexts::COUNT, Contexts::SETS);
    for i in 0..masks.len() {
        let window = Window::around(map.row(first + i), first, &masks[..i]);
        let given = masks[i];
        let mut mask = 0u8;
        for octant in 0..8 {
            if octant == 7 && mask == 0 {
                mask = 1 << 7;
                break;
            }
            let contexts = Contexts::of(&window, octant, mask);
            let wanted = given >> octant & 1 == 1;
            let bit = mixer.bit(&contexts.slots, contexts.set, |p| coder.code(wanted, p));
            mask |= u8::from(bit) << octant;
        }
        masks[i] = mask;
        if !go_on(coder) {
            return;
        }
    }
}
