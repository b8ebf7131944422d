//! How exactly colours are coded, and the quantisation steps that it stands for.

use std::fmt;

use super::EncoderInput;
use crate::colour::{self, Steps};
use crate::error::{Error, Result};

/// How much coarser the step of a chroma is than that of luma, in indices of steps: about as much error in red, green
/// and blue comes of both.
const CHROMA: u8 = 8;
/// The coarsest index of chroma: Co's step is two indices greater.
pub(super) const MAX_CHROMA: u8 = Steps::MAX - 2;

/// By how many indices the steps of the two levels above the last are finer than squared error in voxels asks for: at
/// equal bits SSIMULACRA2 gains 0.4 points on average, and PSNR 0.02 dB (`docs/measurements.md`).
const FINER: u8 = 2;

/// How exactly colours are coded.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum QualityTarget {
    /// In quantisation steps; luma's of the finest level has this size in 255ths, ½ to 1000, chroma's (Cg's) twice
    /// that.
    Step(f32),
    /// The same with a size for each.
    Steps {
        /// Luma's.
        luma: f32,
        /// Chroma's, ½ to 1000, too.
        chroma: f32,
    },
    /// The mean colours of the finest level's voxels, each channel rounded to a whole 255th.
    Lossless,
}

impl fmt::Display for QualityTarget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            QualityTarget::Step(luma) => write!(f, "step {luma:.2}"),
            QualityTarget::Steps { luma, chroma } => write!(f, "step {luma:.2},{chroma:.2}"),
            QualityTarget::Lossless => f.write_str("exact colours"),
        }
    }
}

impl QualityTarget {
    /// The steps of the finest level.
    pub(super) fn steps(self) -> Result<Steps> {
        match self {
            QualityTarget::Lossless => Ok(Steps::LOSSLESS),
            QualityTarget::Step(step) => {
                let luma = nearest(step)?;
                Ok(steps_of(luma, luma))
            }
            QualityTarget::Steps { luma, chroma } => Ok(Steps {
                luma: nearest(luma)?,
                chroma: nearest(chroma)?.min(MAX_CHROMA),
            }),
        }
    }

    /// The same with `factor` times the steps, within their limits.
    pub fn scaled(self, factor: f32) -> Self {
        let scale = |step: f32| (step * factor).clamp(0.5, 1000.0);
        match self {
            QualityTarget::Lossless => QualityTarget::Lossless,
            QualityTarget::Step(step) => QualityTarget::Step(scale(step)),
            QualityTarget::Steps { luma, chroma } => QualityTarget::Steps {
                luma: scale(luma),
                chroma: scale(chroma),
            },
        }
    }

    /// What stands for these steps.
    pub(super) fn of(steps: Steps) -> Self {
        let size = |luma| Steps { luma, ..steps }.luma_step();
        match steps.is_lossless() {
            true => QualityTarget::Lossless,
            false => QualityTarget::Steps {
                luma: size(steps.luma),
                chroma: size(steps.chroma),
            },
        }
    }
}

/// The index of the step nearest to this size.
fn nearest(size: f32) -> Result<u8> {
    if !(0.5..=1000.0).contains(&size) {
        let what = "a quantisation step is 0.5 to 1000 255ths";
        return Err(Error::Usage(format!("{what}, not {size}")));
    }
    let off = |luma: &u8| {
        let steps = Steps { luma: *luma, chroma: 0 };
        (steps.luma_step() / size).ln().abs()
    };
    let nearest = (0..=Steps::MAX).min_by(|a, b| off(a).total_cmp(&off(b)));
    Ok(nearest.unwrap_or(Steps::MAX))
}

/// The steps that go with an index of luma's, and with one for chroma.
pub(super) fn steps_of(luma: u8, chroma: u8) -> Steps {
    Steps {
        luma,
        chroma: (chroma + CHROMA).min(MAX_CHROMA),
    }
}

impl EncoderInput<'_> {
    /// How levels are coded, if the last one, `top`, has these steps: the coarser a level, the smaller are its steps,
    /// for what it brings is seen at all levels that follow.
    pub(super) fn coding(&self, steps: Steps, top: u8, level: u8) -> colour::Options {
        let above = (level..top).fold(steps, |steps, _| steps.above());
        let mut steps = above.finer(FINER * (top - level).min(2));
        if self.grey && !steps.is_lossless() {
            steps.chroma = Steps::ABSENT;
        }
        let mut coding = colour::Options::new(steps);
        if !self.options.optimised {
            coding.lambda = 0.0;
        }
        coding
    }
}
