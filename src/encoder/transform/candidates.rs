//! Ways to predict a frame, of which the best is coded.

use std::sync::Arc;

use b2p_kernels::Isa;

use super::choice::Weights;
use super::predicted::{Plan, Target};
use super::warp::{LATTICE_UNIT, Warp};
use super::{Motion, Options};
use crate::cloud::ColouredVoxels;
use crate::colour::{Steps, Truth};
use crate::error::Result;
use crate::geometry::Octree;
use crate::motion::moved::{self, REACH};
use crate::motion::{Head, Previous};

/// Levels from the blocks to the finest one: blocks have 16³ voxels, and parts 8³, if the base level is not above them.
const BLOCK_DEPTH: u8 = 4;
/// How much a warped frame may cost, in costs of blocks, if none of them moves and if all of them do. Costs count single
/// voxels, of which it displaces more; its surface is smoother, and the frames after it take fewer bits. But what stands
/// still is better copied.
const WORTH: [f32; 2] = [0.5, 1.7];

/// A frame and the one before it.
pub(super) struct Frame<'a> {
    pub cloud: &'a ColouredVoxels,
    pub octree: &'a Octree,
    pub truth: &'a Truth,
    pub previous: &'a Arc<Previous>,
    pub options: &'a Options,
    pub steps: Steps,
    pub base: u8,
    pub top: u8,
}

/// A way to predict a frame.
pub(super) struct Candidate {
    pub warp: Option<Warp>,
    pub target: Target,
    pub plan: Plan,
}

impl Frame<'_> {
    /// The better one of blocks that move and of a warped frame: the former suit what stands still or moves as a whole,
    /// and copy it exactly, the latter what turns and bends.
    pub fn best(&self) -> Result<Candidate> {
        let moved = || self.candidate(None);
        let motion = self.options.motion;
        if matches!(motion, Motion::Blocks | Motion::Parts) || self.options.scalable || self.steps.is_lossless() {
            return moved();
        }
        let warped = || {
            let isa = self.options.isa.unwrap_or_else(Isa::detect);
            let warp = Warp::new(isa, self.previous, self.octree, self.truth, self.top);
            warp.map(|warp| self.candidate(Some(warp))).transpose()
        };
        if motion == Motion::Warped {
            return warped()?.map_or_else(moved, Ok);
        }
        let (moved, warped) = rayon::join(moved, warped);
        let moved = moved?;
        let Some(warped) = warped? else {
            return Ok(moved);
        };
        let worth = WORTH[0] + (WORTH[1] - WORTH[0]) * moved.target.moving();
        let better = self.cost(&warped)? < worth * self.cost(&moved)?;
        Ok(if better { warped } else { moved })
    }

    /// Rate and distortion of a candidate, about, with the bits of its motion.
    fn cost(&self, candidate: &Candidate) -> Result<f32> {
        let Candidate { warp, target, plan } = candidate;
        let motion = plan.write(self.base, &target.keys(), warp.as_ref())?;
        let bits = 8 * motion.iter().map(Vec::len).sum::<usize>();
        Ok(target.cost + self.weights(true).lambda * bits as f32)
    }

    pub fn weights(&self, warped: bool) -> Weights {
        Weights::of_step(self.steps.luma_step(), self.top == self.cloud.voxels.depth(), warped)
    }

    fn candidate(&self, warp: Option<Warp>) -> Result<Candidate> {
        let Frame { options, base, top, .. } = *self;
        let divided = warp.is_none() && options.motion != Motion::Blocks && base > 0;
        // Blocks, or their parts, are nodes of the base level or of one above it.
        let block_level = (base - u8::from(divided)).min(top.saturating_sub(BLOCK_DEPTH));
        let part_level = block_level + u8::from(divided);
        let target = Target::new(self, warp.as_ref(), [block_level, part_level])?;
        let head = Head {
            block_level,
            divided,
            // They are rounded: exact colours of what stands still would differ from their means.
            moves_coarse: divided && block_level + 2 <= base && !self.steps.is_lossless(),
            warped: warp.is_some(),
            smooth: warp.is_some(),
            unit_level: if warp.is_some() { top + LATTICE_UNIT } else { top },
            reference_level: match warp {
                Some(_) => top,
                None => if options.scalable { base } else { top }.min(block_level + REACH),
            },
            root: target.root,
            vector: [0; 3],
        };
        let source = (self.previous, warp.as_ref().map(|warp| &warp.warped));
        let plan = match target.modes(source, head, base) {
            // Blocks that come from the same place may together have too many voxels.
            Err(error) if error.clause() == Some(moved::TOO_MANY) => {
                let head = Head {
                    reference_level: block_level,
                    moves_coarse: false,
                    ..head
                };
                target.modes(source, head, base)?
            }
            plan => plan?,
        };
        Ok(Candidate { warp, target, plan })
    }
}
