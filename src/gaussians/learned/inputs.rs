//! What the network reads, as integers: colours, their differences, occupancy and the quantisation step are multiples of 1/512.

use b2p_kernels::{LIMIT, zeros};
use rayon::prelude::*;

use super::LevelInput;
use super::load::INPUTS;
use crate::layers::activations::log2;

/// The real value of a parent channel's step, which holds every value exactly (the logarithm's rounded).
pub const PARENT_STEP: f32 = 1.0 / 512.0;
/// The real value of a child channel's step in integers: twice as large, so that differences up to the largest of luma fit ±2047.
pub const CHILD_STEP: f32 = 1.0 / 256.0;
/// The coarsest step that heads are told of.
const COARSEST: f32 = 65_536.0;
/// Rows that one task makes at least.
const BLOCK: usize = 1024;

/// Input channels of both levels, and how they hang together.
pub struct Channels {
    /// [parents, 12], in steps of [`PARENT_STEP`].
    pub parent: Vec<i16>,
    /// [children, 7].
    pub child: Vec<i16>,
    /// The parent of each child.
    pub parents: Vec<u32>,
    /// The place of each child in its parent.
    pub octants: Vec<u8>,
}

impl Channels {
    /// Children in steps of [`CHILD_STEP`] within ±[`LIMIT`].
    pub fn within_limit(input: &LevelInput<'_>) -> Self {
        let limit = i32::from(LIMIT);
        Channels::new(input, |v| ((v + 1) >> 1).clamp(-limit, limit) as i16)
    }

    /// Children in steps of [`PARENT_STEP`], exact.
    pub fn fine(input: &LevelInput<'_>) -> Self {
        // Four times the largest difference is 4 · 2040.
        Channels::new(input, |v| v as i16)
    }

    fn new(input: &LevelInput<'_>, of_child: impl Fn(i32) -> i16 + Sync) -> Self {
        let voxels = input.octree.level(input.level);
        let (parents, octants) = (voxels.parent_indices(), voxels.octants());
        let step = coarseness(input.luma_step);
        let occupancy = input.octree.occupancy(input.level - 1);
        let mut parent = zeros(occupancy.len() * INPUTS[0]);
        parent
            .par_chunks_exact_mut(INPUTS[0])
            .with_min_len(BLOCK)
            .zip(occupancy.par_iter().zip(input.colours_above))
            .for_each(|(row, (mask, &colour))| {
                for (octant, bit) in row[..8].iter_mut().enumerate() {
                    *bit = i16::from(mask >> octant & 1) * 512;
                }
                for (to, value) in row[8..11].iter_mut().zip(luma_chroma(colour)) {
                    *to = value as i16;
                }
                row[11] = step as i16;
            });
        let mut child = zeros(voxels.len() * INPUTS[1]);
        child
            .par_chunks_exact_mut(INPUTS[1])
            .with_min_len(BLOCK)
            .zip(parents.par_iter().zip(input.colours))
            .for_each(|(row, (&parent, &colour))| {
                let own = luma_chroma(colour);
                let above = luma_chroma(input.colours_above[parent as usize]);
                for channel in 0..3 {
                    row[channel] = of_child(4 * (own[channel] - above[channel]));
                    row[3 + channel] = of_child(own[channel]);
                }
                row[6] = of_child(step);
            });
        Channels {
            parent,
            child,
            parents,
            octants,
        }
    }
}

/// y, co, cg in 512ths.
fn luma_chroma([r, g, b]: [u8; 3]) -> [i32; 3] {
    let [r, g, b] = [r, g, b].map(i32::from);
    [r + 2 * g + b - 512, 4 * (r - b), 4 * g - 2 * (r + b)]
}

/// A quarter of the logarithm of the quantisation step, in 512ths.
fn coarseness(step: f32) -> i32 {
    let step = if step.is_nan() { 1.0 } else { step.clamp(1.0, COARSEST) };
    ((log2(step) * 128.0 + 0.5) as i32).min(LIMIT.into())
}
