//! Motion of blocks between frames.

use rayon::prelude::*;

use super::Truth;
use super::choice::{self, Weights};
use crate::colour::Ycc;
use crate::geometry::{Octree, morton};
use crate::motion::{Previous, predicted};

/// How far vectors are searched at the coarsest of three levels, in its voxels.
const REACH: i32 = 4;
/// Cost of a voxel that is not there in the previous frame; one that is costs less, by its colour.
const MISSING: f32 = 1.0;
/// The most that a difference of colours costs.
const OTHER_COLOUR: f32 = 0.7;
/// Difference of luma that costs the most, in units of colours.
const FAR_LUMA: f32 = 40.0 * 64.0;
/// The 3³ cells at the start of a window of 4³.
pub(super) const AROUND: u64 = 0x0777_0777_0777;
/// The cell in their middle.
pub(super) const CENTRE: u64 = 1 << 21;

/// A block of a frame.
#[derive(Debug, Clone)]
pub(super) struct Block {
    pub key: u64,
    pub vector: [i16; 3],
    /// Its voxels become those of the moved previous frame.
    pub keep: bool,
}

/// A voxel of the moved previous frame: its place, and its number there.
pub(super) type Moved = ([i32; 3], usize);

/// What is compared: a frame and the frame before.
pub(super) struct Search<'a> {
    pub octree: &'a Octree,
    pub truth: &'a Truth,
    pub previous: &'a Previous,
    /// The frame itself, found by position.
    pub current: &'a Previous,
    pub top: u8,
    pub block_level: u8,
}

impl Search<'_> {
    /// All blocks that have voxels in either frame, in the order of their keys, with vectors of least cost.
    pub fn blocks(&self, weights: Weights) -> Vec<Block> {
        let own = self.octree.level(self.block_level).keys();
        let mut keys = own.to_vec();
        if let Some(level) = self.previous.level(self.top) {
            keys.extend(level.blocks(self.top, self.block_level));
        }
        keys.sort_unstable();
        keys.dedup();
        let found: Vec<[i16; 3]> = own
            .par_iter()
            .map(|key| self.refined(*key, self.coarse(*key)))
            .collect();
        let tried: Vec<Vec<([i16; 3], f32)>> = own
            .par_iter()
            .enumerate()
            .map(|(i, key)| {
                let tried = candidates(own, &found, i).into_iter();
                tried
                    .map(|vector| (vector, choice::cost(self, *key, vector, weights)))
                    .collect()
            })
            .collect();
        let (mut coded, mut vectors) = (Vec::new(), Vec::new());
        let mut blocks: Vec<Block> = Vec::new();
        for key in keys {
            // Blocks of no voxels of either frame are not coded.
            coded.push(key);
            let (predicted, sure) = predicted(&coded, &vectors, [0; 3]);
            let cost = |(vector, cost): &([i16; 3], f32)| cost + weights.lambda * vector_bits(*vector, predicted, sure);
            let tried = own.binary_search(&key).map(|i| &tried[i]);
            let best = tried
                .ok()
                .and_then(|tried| tried.iter().min_by(|a, b| cost(a).total_cmp(&cost(b))));
            let vector = best.map_or(predicted, |best| best.0);
            vectors.push(vector);
            blocks.push(Block {
                key,
                vector,
                keep: false,
            });
        }
        blocks
    }

    /// The vector found at the coarsest level, in its voxels.
    fn coarse(&self, key: u64) -> [i32; 3] {
        let down = 2.min(self.top - self.block_level);
        let level = self.top - down;
        let mut best = (f32::INFINITY, [0; 3]);
        for z in -REACH..=REACH {
            for y in -REACH..=REACH {
                for x in -REACH..=REACH {
                    let length = (x.abs() + y.abs() + z.abs()) as f32;
                    let cost = self.cost(level, key, [x, y, z]) + 0.05 * length;
                    if cost < best.0 {
                        best = (cost, [x, y, z]);
                    }
                }
            }
        }
        best.1.map(|x| x << down)
    }

    /// The best vector near the one of the coarsest level, and near 0.
    fn refined(&self, key: u64, coarse: [i32; 3]) -> [i16; 3] {
        let mut best = (f32::INFINITY, [0; 3]);
        let mut consider = |vector: [i32; 3]| {
            let length: i32 = vector.iter().map(|x| x.abs()).sum();
            let cost = self.cost(self.top, key, vector) + 0.05 * length as f32;
            if cost < best.0 {
                best = (cost, vector);
            }
            best.1
        };
        consider([0; 3]);
        let mut centre = consider(coarse);
        for step in [2, 1, 1] {
            let around = centre;
            for i in 0..27 {
                let offset = [i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1];
                centre = consider([0, 1, 2].map(|axis| around[axis] + step * offset[axis]));
            }
        }
        centre.map(|x| x as i16)
    }

    /// How badly a vector in voxels of `level` predicts the block's voxels of that level.
    fn cost(&self, level: u8, key: u64, vector: [i32; 3]) -> f32 {
        let Some(previous) = self.previous.level(level) else {
            return 0.0;
        };
        let mut cost = 0.0;
        for i in self.voxels(level, key) {
            let at = self.octree.level(level).coordinate(i);
            let at = [0, 1, 2].map(|axis| at[axis] as i32 - vector[axis]);
            cost += match previous.index(at) {
                None => MISSING,
                Some(index) => {
                    let apart = luma_apart(self.truth.level(level)[i], previous.values[index]);
                    OTHER_COLOUR * (apart.abs() / FAR_LUMA).min(1.0)
                }
            };
        }
        cost
    }

    /// Numbers of the voxels of `level` in a block.
    pub fn voxels(&self, level: u8, key: u64) -> std::ops::Range<usize> {
        let (keys, down) = (self.octree.level(level).keys(), 3 * (level - self.block_level));
        let first = keys.partition_point(|k| k >> down < key);
        first..first + keys[first..].partition_point(|k| k >> down == key)
    }

    /// The voxels of level `top` that the previous frame has in a block, moved by `vector`.
    pub fn moved(&self, key: u64, vector: [i16; 3]) -> Vec<Moved> {
        let side = 1i32 << (self.top - self.block_level);
        let vector = vector.map(i32::from);
        let first = morton::decode(key).map(|x| x as i32 * side);
        let mut found = Vec::new();
        if let Some(previous) = self.previous.level(self.top) {
            previous.in_box([0, 1, 2].map(|axis| first[axis] - vector[axis]), side, |from, index| {
                found.push(([0, 1, 2].map(|axis| from[axis] + vector[axis]), index));
            });
        }
        found
    }
}

/// Vectors to try for block `i`: its own, those of the blocks around it, and 0.
fn candidates(keys: &[u64], found: &[[i16; 3]], i: usize) -> Vec<[i16; 3]> {
    let at = morton::decode(keys[i]).map(|x| x as i32);
    let mut tried = vec![found[i], [0; 3]];
    for k in 0..27 {
        let place = [at[0] + k % 3 - 1, at[1] + k / 3 % 3 - 1, at[2] + k / 9 - 1];
        if place.iter().all(|x| *x >= 0)
            && let Ok(i) = keys.binary_search(&morton::encode(place.map(|x| x as u32)))
            && !tried.contains(&found[i])
        {
            tried.push(found[i]);
        }
    }
    tried
}

/// Bits of a vector, about.
fn vector_bits(vector: [i16; 3], predicted: [i16; 3], sure: usize) -> f32 {
    if vector == predicted {
        return [1.0, 1.0, 0.4][sure];
    }
    let component = |axis: usize| {
        let apart = f32::from(vector[axis]) - f32::from(predicted[axis]);
        0.8 + 2.0 * (1.0 + apart.abs()).log2()
    };
    [1.0, 1.0, 2.0][sure] + component(0) + component(1) + component(2)
}

/// Difference of luma, and half of those of chroma.
fn luma_apart(a: Ycc, b: Ycc) -> f32 {
    let apart = |t: usize| f32::from(a[t]) - f32::from(b[t]);
    let chroma = (apart(1).abs() + apart(2).abs()) / 4.0;
    let luma = apart(0);
    if luma < 0.0 { luma - chroma } else { luma + chroma }
}
