//! The geometry of a stream: exact, or at its finest level as it looks alike for fewer bits.

use std::sync::Arc;

use rayon::prelude::*;

use super::EncoderInput;
use crate::colour::Steps;
use crate::error::Result;
use crate::geometry::{KernelMap, Octree, codec};
use crate::log::Log;

/// How exactly the finest level's voxels are coded. Only a level above the cloud's own is optimised, and only of streams
/// with lossy colours.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum GeometryTarget {
    /// As they are.
    Exact,
    /// Rate–distortion optimised: voxels may move by one. λ follows from luma's quantisation step.
    Visual,
    /// The same with this λ, 0 to 100: the squared distance, in squared voxels, that a bit must save.
    Lambda(f32),
}

/// λ where luma's quantisation step is one 255th. The error of a colour that is moved, and the squared error that a bit
/// must save elsewhere, are both squares: λ grows with the squared step.
const LAMBDA: f32 = 4.2e-5;
/// The greatest λ that follows from a step. Greater ones roughen smooth surfaces: at 0.25 a statue lost 13 SSIMULACRA2.
const MOST_LAMBDA: f32 = 0.125;

impl GeometryTarget {
    /// λ in units of 1/256.
    pub(super) fn lambda(self, steps: Steps) -> u32 {
        let lambda = match self {
            _ if steps.is_lossless() => 0.0,
            GeometryTarget::Exact => 0.0,
            // Of quarter octaves, so that streams with the same step of luma share an octree.
            GeometryTarget::Visual => {
                let lambda = (LAMBDA * steps.luma_step().powi(2)).min(MOST_LAMBDA);
                ((4.0 * lambda.log2()).round() / 4.0).exp2()
            }
            GeometryTarget::Lambda(lambda) => lambda.clamp(0.0, 100.0),
        };
        (256.0 * lambda).round() as u32
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
    /// The octree whose level `top` is optimised with this λ, in units of 1/256; `None` for λ = 0, for the
    /// cloud's own level, and where the level belongs to the colour trunk.
    pub(super) fn shape(&self, top: u8, lambda: u32, log: &Log) -> Result<Option<Arc<Shape>>> {
        if lambda == 0 || top == self.cloud.voxels.depth() || top <= self.trunk_depth(top) {
            return Ok(None);
        }
        let count = self.octree.level(top).len();
        log.step("shape", count, "voxels", || {
            let points = self.points(top);
            let (level, slice) = (usize::from(top), self.options.slice_voxels as usize);
            let distortion = codec::Distortion {
                points: &points,
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

    /// For each voxel of a level above the cloud's own, which of its children hold points.
    fn points(&self, level: u8) -> Vec<u8> {
        let voxels = &self.cloud.voxels;
        let shift = 3 * (self.cloud.voxels.depth() - level);
        let mask = |key: &u64| {
            let inside = voxels.keys()[voxels.within(*key, shift)].iter();
            inside.fold(0, |mask, k| mask | 1 << (k >> (shift - 3) & 7))
        };
        self.octree.level(level).keys().par_iter().map(mask).collect()
    }
}

impl Shape {
    pub fn lambda(&self) -> u32 {
        self.lambda
    }
}
