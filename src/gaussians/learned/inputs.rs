//! Inputs of the network as integers: colours, their differences, occupancy and quantisation step are multiples of
//! 1/512.

use b2p_kernels::{LIMIT, zeros};
use rayon::prelude::*;

use super::LevelInput;
use super::load::INPUTS;
use crate::layers::activations::log2;

/// Scale of a parent's channels. All values are exact multiples, except the logarithm, which is rounded.
pub const PARENT_STEP: f32 = 1.0 / 512.0;
/// Scale of a child's channels in integers: twice as large, so that all differences of luma fit ±2047.
pub const CHILD_STEP: f32 = 1.0 / 256.0;
/// Maximum quantisation step. Larger ones are clamped.
const COARSEST: f32 = 65_536.0;
/// Minimum rows per task.
const BLOCK: usize = 1024;

/// A child's channel in units of [`CHILD_STEP`], clamped to ±[`LIMIT`].
pub fn within_limit(v: i32) -> i16 {
    let limit = i32::from(LIMIT);
    ((v + 1) >> 1).clamp(-limit, limit) as i16
}

/// A child's channel in units of [`PARENT_STEP`], exact: four times the largest difference is 4 · 2040.
pub fn fine(v: i32) -> i16 {
    v as i16
}

/// Where some children hang.
pub struct Links {
    /// Row of each child's parent.
    pub parents: Vec<u32>,
    /// Octant of each child in its parent.
    pub octants: Vec<u8>,
}

impl Links {
    /// Those of these voxels of the level, which mostly ascend.
    pub fn new(input: &LevelInput<'_>, voxels: &[u32]) -> Self {
        let keys = input.octree.level(input.level).keys();
        let first_child = input.octree.first_child(input.level - 1);
        let (mut parents, mut octants) = (zeros(voxels.len()), zeros(voxels.len()));
        let rows = parents.par_chunks_mut(BLOCK).zip(octants.par_chunks_mut(BLOCK));
        rows.zip(voxels.par_chunks(BLOCK))
            .for_each(|((parents, octants), voxels)| {
                let mut at = 0;
                for ((parent, octant), &voxel) in parents.iter_mut().zip(octants).zip(voxels) {
                    let is_here = |at: usize| {
                        first_child[at] <= voxel && first_child.get(at + 1).is_none_or(|&next| voxel < next)
                    };
                    let next = (at + 1).min(first_child.len() - 1);
                    at = match (is_here(at), is_here(next)) {
                        (true, _) => at,
                        (_, true) => next,
                        _ => first_child.partition_point(|&first| first <= voxel) - 1,
                    };
                    *parent = at as u32;
                    *octant = (keys[voxel as usize] & 7) as u8;
                }
            });
        Links { parents, octants }
    }
}

/// `[voxels, 12]`: channels of these voxels of the level above, in units of [`PARENT_STEP`].
pub fn parents(input: &LevelInput<'_>, voxels: &[u32]) -> Vec<i16> {
    let step = coarseness(input.luma_step);
    let occupancy = input.octree.occupancy(input.level - 1);
    let mut rows = zeros(voxels.len() * INPUTS[0]);
    let tasks = rows.par_chunks_exact_mut(INPUTS[0]).with_min_len(BLOCK);
    tasks.zip(voxels).for_each(|(row, &voxel)| {
        let (mask, colour) = (occupancy[voxel as usize], input.colours_above[voxel as usize]);
        for (octant, bit) in row[..8].iter_mut().enumerate() {
            *bit = i16::from(mask >> octant & 1) * 512;
        }
        for (to, value) in row[8..11].iter_mut().zip(luma_chroma(colour)) {
            *to = value as i16;
        }
        row[11] = step as i16;
    });
    rows
}

/// `[voxels, 7]`: channels of these voxels of the level, whose parents are known, each rounded by `of_child`.
pub fn children(input: &LevelInput<'_>, voxels: &[u32], parents: &[u32], of_child: fn(i32) -> i16) -> Vec<i16> {
    let step = of_child(coarseness(input.luma_step));
    let mut rows = zeros(voxels.len() * INPUTS[1]);
    let tasks = rows.par_chunks_exact_mut(INPUTS[1]).with_min_len(BLOCK);
    tasks
        .zip(voxels.par_iter().zip(parents))
        .for_each(|(row, (&voxel, &parent))| {
            let own = luma_chroma(input.colours[voxel as usize]);
            let above = luma_chroma(input.colours_above[parent as usize]);
            for channel in 0..3 {
                row[channel] = of_child(4 * (own[channel] - above[channel]));
                row[3 + channel] = of_child(own[channel]);
            }
            row[6] = step;
        });
    rows
}

/// y, co, cg in units of 1/512.
fn luma_chroma([r, g, b]: [u8; 3]) -> [i32; 3] {
    let [r, g, b] = [r, g, b].map(i32::from);
    [r + 2 * g + b - 512, 4 * (r - b), 4 * g - 2 * (r + b)]
}

/// `log2(step) / 4` in units of 1/512.
fn coarseness(step: f32) -> i32 {
    let step = if step.is_nan() { 1.0 } else { step.clamp(1.0, COARSEST) };
    ((log2(step) * 128.0 + 0.5) as i32).min(LIMIT.into())
}
