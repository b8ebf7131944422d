//! From Gaussians to ellipses on the picture.
//!
//! A Gaussian with axes `R·S` is seen as the image of its centre and the 2×2 covariance `M·Mᵀ + 0.3·I`, where `M = J·W·R·S` and `J`
//! is the derivative of the pinhole projection at the centre (EWA splatting; 0.3 px² is the pixel's own blur). The covariance is
//! never formed and inverted, which loses a long thin ellipse to cancellation in single precision; `ellipse.rs` has the formulas.
//!
//! [`project`] is the sole gate of visibility: its conditions are phrased so that NaN fails them, and everything after it may
//! assume finite numbers, a depth beyond the near plane, and at least one pixel.

mod camera;
mod ellipse;

use rayon::prelude::*;

pub use camera::Camera;
pub use ellipse::{Bounds, Ellipse};

use crate::error::Result;
use crate::gaussians::Gaussians;

/// Variance that every ellipse is widened by, in px².
pub const BLUR: f32 = 0.3;
/// The least opacity that is drawn.
pub const ALPHA_FLOOR: f32 = 1.0 / 255.0;
/// Standard deviations above this many cube-frame units are drawn as this: thousands of cubes, constant over any picture.
pub const MAX_SCALE: f32 = 1e4;

/// Gaussians that one task projects.
const BLOCK: usize = 4096;

/// The visible Gaussians of a picture, in the order of the input; one array for each later step.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Ellipses {
    /// Distance along the viewing direction, for the order of drawing. Positive and finite.
    pub depth: Vec<f32>,
    /// The pixels that may be touched, for the tiles.
    pub bounds: Vec<Bounds>,
    /// Shape and colour, for the pixels.
    pub shape: Vec<Ellipse>,
}

impl Ellipses {
    /// Bytes per ellipse.
    pub const BYTES: u64 = (size_of::<f32>() + size_of::<Bounds>() + size_of::<Ellipse>()) as u64;

    /// How many.
    pub fn len(&self) -> usize {
        self.depth.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.depth.is_empty()
    }

    fn resize(&mut self, count: usize) {
        self.depth.resize(count, 0.0);
        self.bounds.resize(count, Bounds::default());
        self.shape.resize(count, Ellipse::default());
    }
}

/// How many Gaussians are not drawn, by the first reason that applies.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Dropped {
    /// A parameter is NaN or infinite.
    pub not_finite: u64,
    /// The rotation is the zero quaternion.
    pub no_rotation: u64,
    /// The opacity is below [`ALPHA_FLOOR`].
    pub too_faint: u64,
    /// The centre is not beyond the near plane. A Gaussian that only reaches over it is dropped as well, never mirrored.
    pub behind: u64,
    /// No pixel within reach.
    pub outside: u64,
}

impl Dropped {
    /// All of them.
    pub fn total(&self) -> u64 {
        self.not_finite + self.no_rotation + self.too_faint + self.behind + self.outside
    }

    fn add(&mut self, other: Dropped) {
        self.not_finite += other.not_finite;
        self.no_rotation += other.no_rotation;
        self.too_faint += other.too_faint;
        self.behind += other.behind;
        self.outside += other.outside;
    }

    fn count(&mut self, reason: ellipse::Invisible) {
        match reason {
            ellipse::Invisible::NotFinite => self.not_finite += 1,
            ellipse::Invisible::NoRotation => self.no_rotation += 1,
            ellipse::Invisible::TooFaint => self.too_faint += 1,
            ellipse::Invisible::Behind => self.behind += 1,
            ellipse::Invisible::Outside => self.outside += 1,
        }
    }
}

/// Projects into `ellipses`, whose memory is reused; counts what is not visible.
///
/// # Errors
/// [`crate::Error::Usage`] if the camera is none ([`Camera::check`]) or the arrays of `gaussians` differ in length.
pub fn project(gaussians: &Gaussians, camera: &Camera, ellipses: &mut Ellipses) -> Result<Dropped> {
    camera.check()?;
    gaussians.check_lengths()?;
    let view = ellipse::View::new(camera);
    ellipses.resize(gaussians.len());

    // Each block gathers its visible ellipses at its start …
    let blocks: Vec<(usize, Dropped)> = ellipses
        .depth
        .par_chunks_mut(BLOCK)
        .zip(ellipses.bounds.par_chunks_mut(BLOCK))
        .zip(ellipses.shape.par_chunks_mut(BLOCK))
        .enumerate()
        .map(|(block, ((depth, bounds), shape))| {
            let first = block * BLOCK;
            let (mut kept, mut dropped) = (0, Dropped::default());
            for i in first..first + depth.len() {
                match view.see(gaussians, i) {
                    Ok(seen) => {
                        (depth[kept], bounds[kept], shape[kept]) = seen;
                        kept += 1;
                    }
                    Err(reason) => dropped.count(reason),
                }
            }
            (kept, dropped)
        })
        .collect();

    // … and the gaps are closed.
    let (mut visible, mut dropped) = (0, Dropped::default());
    for (block, (kept, lost)) in blocks.into_iter().enumerate() {
        let from = block * BLOCK;
        if from != visible {
            ellipses.depth.copy_within(from..from + kept, visible);
            ellipses.bounds.copy_within(from..from + kept, visible);
            ellipses.shape.copy_within(from..from + kept, visible);
        }
        visible += kept;
        dropped.add(lost);
    }
    ellipses.resize(visible);
    Ok(dropped)
}
