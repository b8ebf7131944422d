//! The geometry of a stream: exact, or at its finest level as it looks alike for fewer bits.

use std::borrow::Cow;
use std::sync::Arc;

use rayon::prelude::*;

use super::EncoderInput;
use crate::cloud::ColouredVoxels;
use crate::colour::Steps;
use crate::error::Result;
use crate::geometry::{Octree, SiblingMap, codec};
use crate::log::Log;

/// How exactly the finest level's voxels are coded, in streams with lossy colours.
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

/// How many times as great λ is two levels above the cloud's own and further up: people lost 0.2 dB with all of it.
const COARSE: f32 = 0.5;

/// How many times as great λ is in predicted frames: steps of 34 gain as much from the greatest λ as steps of 68.
const PREDICTED: f32 = 2.5;

/// λ of the cloud's own level in steps of one 255th, and the greatest. Much of what is coded there is noise of rounding,
/// without which pictures are better (`docs/measurements.md`, "Lossy geometry").
const OWN_LAMBDA: f32 = 1.0 / 80.0;
const MOST_OWN_LAMBDA: f32 = 0.5;

impl GeometryTarget {
    /// λ in units of 1/256, so many levels `above` the cloud's own, in a frame that is coded by itself or `predicted`.
    pub(super) fn lambda(self, steps: Steps, above: u8, predicted: bool) -> u32 {
        let step = steps.luma_step();
        let lambda = match self {
            _ if steps.is_lossless() => 0.0,
            GeometryTarget::Exact => 0.0,
            // Of quarter octaves, so that streams with the same step of luma share an octree.
            GeometryTarget::Visual => {
                let lambda = match above {
                    0 => (OWN_LAMBDA * step).min(MOST_OWN_LAMBDA),
                    _ if predicted => (PREDICTED * LAMBDA * step.powi(2)).min(MOST_LAMBDA),
                    1 => (LAMBDA * step.powi(2)).min(MOST_LAMBDA),
                    _ => COARSE * (LAMBDA * step.powi(2)).min(MOST_LAMBDA),
                };
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
    /// The code of the finest level.
    pub geometry: Vec<(u32, Vec<u8>)>,
}

impl EncoderInput<'_> {
    /// λ of streams with the last level `top` and these steps, in units of 1/256. A sparse cloud keeps its own voxels: few
    /// of them have the neighbours that tell noise from shape, and heads take what is left for a closed surface.
    pub(super) fn lambda(&self, top: u8, steps: Steps) -> u32 {
        let above = self.cloud.voxels.depth() - top;
        match self.options.geometry {
            GeometryTarget::Visual if above == 0 && self.sparse => 0,
            geometry => geometry.lambda(steps, above, false),
        }
    }

    /// The octree whose level `top` is optimised with this λ, in units of 1/256; `None` for λ = 0, and where the level
    /// belongs to the colour trunk.
    pub(super) fn shape(&self, top: u8, lambda: u32, log: &Log) -> Result<Option<Arc<Shape>>> {
        if lambda == 0 || top <= self.trunk_depth(top) {
            return Ok(None);
        }
        let count = self.octree.level(top).len();
        log.step("shape", count, "voxels", || {
            let points = points_in_children(self.cloud, &self.octree, top);
            let (level, slice) = (usize::from(top), self.options.slice_voxels as usize);
            let distortion = codec::Distortion {
                points: &points,
                lambda,
                shown: None,
            };
            let above = self.maps[level - 1].table();
            let (masks, geometry) = codec::optimise_level(self.isa, &self.octree, &above, top, slice, distortion, None);
            let mut octree = self.octree.truncated(top - 1);
            octree.grow(masks)?;
            Ok(Some(Arc::new(Shape {
                lambda,
                octree,
                geometry,
            })))
        })
    }

    /// The map of the level `top` of streams of this shape.
    pub(super) fn finest_map(&self, top: u8, shape: Option<&Shape>) -> Cow<'_, SiblingMap> {
        match shape {
            // Several shapes are kept while a rate is looked for, and maps are by far the largest part of them.
            Some(shape) => Cow::Owned(shape.octree.child_siblings(top - 1, &self.maps[usize::from(top) - 1])),
            None => Cow::Borrowed(&self.maps[usize::from(top)]),
        }
    }
}

/// For each voxel of a level of `octree`, which of its children hold points of the cloud. Nothing is known of voxels of
/// the cloud's own level and of those that hold none of its points: any child may.
pub(super) fn points_in_children(cloud: &ColouredVoxels, octree: &Octree, level: u8) -> Vec<u8> {
    let keys = octree.level(level).keys();
    if level == cloud.voxels.depth() {
        return vec![u8::MAX; keys.len()];
    }
    let any = |mask| if mask == 0 { u8::MAX } else { mask };
    keys.par_iter()
        .map(|key| any(points_within(cloud, *key, level)))
        .collect()
}

/// Which children of a voxel of a level above the cloud's own one hold points of the cloud.
pub(super) fn points_within(cloud: &ColouredVoxels, key: u64, level: u8) -> u8 {
    let voxels = &cloud.voxels;
    let shift = 3 * (voxels.depth() - level);
    let inside = voxels.keys()[voxels.within(key, shift)].iter();
    inside.fold(0, |mask, k| mask | 1 << (k >> (shift - 3) & 7))
}

impl Shape {
    pub fn lambda(&self) -> u32 {
        self.lambda
    }
}
