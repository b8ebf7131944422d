//! The geometry of a stream: exact, or at its finest level as it looks alike for fewer bits.

use std::sync::Arc;

use rayon::prelude::*;

use super::EncoderInput;
use crate::colour::Steps;
use crate::error::Result;
use crate::geometry::{KernelMap, Octree, codec};
use crate::log::Log;

/// How exactly the finest level's voxels are coded.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum GeometryTarget {
    /// As they are.
    Exact,
    /// Rate–distortion optimised: voxels may move by one. The number is the Lagrangian multiplier λ, 0 to 100: the
    /// squared distance, in squared voxels, that a bit must save.
    Visual(f32),
}

impl GeometryTarget {
    /// λ in units of 1/256; 0 for exact geometry, which lossless colours always have.
    pub(super) fn lambda(self, steps: Steps, _top: u8) -> u32 {
        match self {
            GeometryTarget::Visual(lambda) if !steps.is_lossless() => (256.0 * lambda.clamp(0.0, 100.0)) as u32,
            _ => 0,
        }
    }
}

/// An octree whose finest level was optimised.
pub(super) struct Shape {
    /// λ, in units of 1/256.
    lambda: u32,
    pub octree: Octree,
    /// The 3³ kernel map of the finest level.
    pub map: KernelMap,
    /// The code of the finest level.
    pub geometry: Vec<(u32, Vec<u8>)>,
}

impl EncoderInput<'_> {
    /// The octree whose level `top` is optimised with this λ, in units of 1/256; `None` for λ = 0, and where the level
    /// belongs to the colour trunk.
    pub(super) fn shape(&self, top: u8, lambda: u32, log: &Log) -> Result<Option<Arc<Shape>>> {
        if lambda == 0 || top <= self.trunk_depth(top) {
            return Ok(None);
        }
        let count = self.octree.level(top).len();
        log.step("shape", count, "voxels", || {
            let weights = self.weights(top);
            let (level, slice) = (usize::from(top), self.options.slice_voxels as usize);
            let distortion = codec::Distortion {
                weights: &weights,
                lambda,
            };
            let above = &self.maps[level - 1];
            let (masks, geometry) = codec::optimise_level(self.isa, &self.octree, above, top, slice, distortion);
            let mut octree = self.octree.truncated(top - 1);
            octree.grow(masks)?;
            let map = octree.child_map(top - 1, above);
            Ok(Some(Arc::new(Shape {
                lambda,
                octree,
                map,
                geometry,
            })))
        })
    }

    /// How much of the surface each voxel of a level holds: a patch of it has four of the voxels below.
    fn weights(&self, level: u8) -> Vec<u8> {
        let keys = self.cloud.voxels.keys();
        let depth = self.cloud.voxels.depth();
        if level == depth {
            return vec![codec::FULL; keys.len()];
        }
        let shift = 3 * (depth - level);
        let patch = 4usize.pow(u32::from(depth - level).min(4));
        let weight = |key: &u64| {
            let first = keys.partition_point(|k| k >> shift < *key);
            let inside = keys[first..].iter().take(patch).take_while(|k| *k >> shift == *key);
            (usize::from(codec::FULL) * inside.count() / patch).max(1) as u8
        };
        self.octree.level(level).keys().par_iter().map(weight).collect()
    }
}

impl Shape {
    pub fn lambda(&self) -> u32 {
        self.lambda
    }
}
