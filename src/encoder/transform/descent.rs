//! Colours refined by gradient descent through what is drawn of a stream.
//!
//! The cloud, and what a decoder makes of the stream, are drawn from many sides. A pixel mixes the colours of its Gaussians
//! linearly, so that the gradient of the squared differences takes the same shares back to them
//! ([`Renderer::gather`](crate::Renderer::gather)), and from there to voxels: the heads' own share in a Gaussian's colour
//! hardly depends on the voxel's. The gradient is divided by the sum of the shares, the diagonal of the normal equations
//! (Jacobi's method). Moved colours are coded again in each round, so that the next one sees what quantisation left.
//!
//! Shares also say how much is seen of a voxel, and by that its error counts in quantisation.

use std::sync::atomic::{AtomicI64, Ordering};

use rayon::prelude::*;

use super::reference::{Views, closed};
use super::refine::{Moves, difference, owner};
use super::surfel_size::with_heads;
use super::{Coded, EncoderInput};
use crate::colour::{Importance, Steps};
use crate::error::Result;
use crate::gaussians::Gaussians;
use crate::geometry::Voxels;
use crate::limits::Limits;
use crate::log::Log;
use crate::renderer::Image;

/// Pictures that are compared.
const VIEWS: usize = 10;
/// The golden angle, in degrees.
const TURN: f64 = 137.507_764;
/// Share of the difference that colours move by in all rounds together, and at most in one.
const SHARES: [f32; 2] = [1.6, 0.4];
/// Pixels that hold a colour where few show its voxel.
const INERTIA: f32 = 2.0;
/// Rounds that may bring nothing, one after the other.
const PATIENCE: usize = 2;
/// By how much steps are coarser that tell what a byte is worth: 3/8 of an octave.
const COARSER: u8 = 3;
/// Less covered pixels tell nothing of colours.
const COVERED: f32 = 0.05;
/// Sums of what pixels tell are in these parts of one, so that they do not depend on the order of pixels.
const PARTS: f32 = 1_048_576.0;

/// Pictures of the cloud, from all sides.
pub(super) struct Pictures {
    /// Premultiplied.
    views: Vec<Vec<[u8; 4]>>,
}

/// What pixels tell of the voxels.
struct Told {
    /// The squared error of all pictures.
    error: f64,
    /// Of red, green and blue, in 255ths, what each voxel should have more.
    missing: Vec<[f32; 3]>,
    /// How many pixels each voxel has, in [`PARTS`].
    seen: Vec<u64>,
}

/// Azimuth and elevation of the views, in degrees: on a spiral of equal steps in height.
fn directions() -> impl Iterator<Item = (f64, f64)> {
    (0..VIEWS).map(|i| {
        let height = 1.0 - (2 * i + 1) as f64 / VIEWS as f64;
        // A camera cannot look straight down.
        ((i as f64 * TURN) % 360.0, 0.9 * height.asin().to_degrees())
    })
}

impl EncoderInput<'_> {
    /// Moves colours further than `moves`, for which `coded` was coded, in at most so many rounds. Gives out what has the
    /// least error and bytes, where a byte is worth the error that coarser steps would bring for it.
    pub(super) fn descended(
        &self,
        coded: Coded,
        mut moves: Moves,
        steps: Steps,
        rounds: usize,
        log: &Log,
    ) -> Result<Coded> {
        if rounds == 0 {
            return Ok(coded);
        }
        let pictures = self.pictures(log)?;
        let (mut told, price) = log.step("compare from all sides", 2 * VIEWS, "pictures", || {
            let told = self.compare(pictures, &coded)?;
            let price = self.price(pictures, &coded, told.error, &moves, steps, log)?;
            Ok((told, price))
        })?;
        let cost = |told: &Told, coded: &Coded| told.error + price * coded.bytes.len() as f64;
        let share = (SHARES[0] / rounds as f32).min(SHARES[1]);
        let (mut least, mut best, mut vain) = (cost(&told, &coded), coded, 0);
        for round in 1..=rounds {
            let name = format!("compare from all sides, {round} of {rounds}");
            let (next, new) = log.step(name, VIEWS, "pictures", || {
                self.follow(&mut moves, &told, share);
                let next = self.moved(&best, &moves, Some(&told.seen), steps, log)?;
                let told = self.compare(pictures, &next)?;
                Ok((next, told))
            })?;
            told = new;
            if cost(&told, &next) < least {
                (least, best, vain) = (cost(&told, &next), next, 0);
            } else {
                vain += 1;
            }
            if vain == PATIENCE {
                break;
            }
        }
        Ok(best)
    }

    /// Codes the shape of `coded` once more, with moved colours. If known, errors count by how much is `seen` of a voxel.
    fn moved(&self, coded: &Coded, moves: &Moves, seen: Option<&[u64]>, steps: Steps, log: &Log) -> Result<Coded> {
        let Coded { top, shape, .. } = coded;
        let mut truth = self.moved_truth(*top, shape.as_deref(), moves);
        if let Some(seen) = seen {
            truth = truth.with_importance(Importance::new(self.octree(shape.as_deref()), *top, seen));
        }
        self.code_towards(&truth, *top, steps, shape.clone(), &log.quiet())
    }

    /// The squared error that a byte is worth: what coarser steps cost and save.
    fn price(
        &self,
        pictures: &Pictures,
        coded: &Coded,
        error: f64,
        moves: &Moves,
        steps: Steps,
        log: &Log,
    ) -> Result<f64> {
        let coarser = self.moved(coded, moves, None, steps.coarser(COARSER), log)?;
        let more = self.compare(pictures, &coarser)?.error - error;
        let saved = coded.bytes.len().saturating_sub(coarser.bytes.len());
        Ok(if saved > 0 { more.max(0.0) / saved as f64 } else { 0.0 })
    }

    /// Pictures of the cloud, which are drawn once.
    fn pictures(&self, log: &Log) -> Result<&Pictures> {
        if let Some(pictures) = self.pictures.get() {
            return Ok(pictures);
        }
        let drawn = log.step("draw the cloud from all sides", VIEWS, "pictures", || self.draw_all())?;
        Ok(self.pictures.get_or_init(|| drawn))
    }

    /// Draws the cloud: with the best heads, or if there are none or it is sparse, as surfels.
    fn draw_all(&self) -> Result<Pictures> {
        let heads = self.options.heads.as_ref().filter(|_| !self.sparse);
        let gaussians = heads.map(|heads| with_heads(self.isa, self.cloud, heads)).transpose()?;
        let gaussians = match gaussians.flatten() {
            Some(gaussians) => gaussians,
            None => closed(self.isa, self.cloud, self.sparse)?,
        };
        let byte = |x: f32| (255.0 * x).round() as u8;
        let mut views = self.views();
        let view = |direction| -> Result<_> {
            let image = views.large(&gaussians, direction)?;
            Ok(image.pixels.par_iter().map(|pixel| pixel.map(byte)).collect())
        };
        let views = directions().map(view).collect::<Result<_>>()?;
        Ok(Pictures { views })
    }

    /// What draws pictures as large as the cloud deserves, whatever the level.
    fn views(&self) -> Views {
        Views::of_level(self.isa, self.cloud.voxels.depth())
    }

    /// Compares what is drawn of a stream with pictures of the cloud.
    fn compare(&self, pictures: &Pictures, coded: &Coded) -> Result<Told> {
        let voxels = self.octree(coded.shape.as_deref()).level(coded.top);
        let gaussians = self.drawn(coded)?;
        let owners = owners(voxels, &gaussians);
        let sums: Vec<[AtomicI64; 4]> = (0..voxels.len()).map(|_| Default::default()).collect();
        let mut error = 0.0;
        let mut views = self.views();
        for (direction, truth) in directions().zip(&pictures.views) {
            let missing = missing(truth, &views.large(&gaussians, direction)?);
            error += squared_error(&missing);
            let camera = views.camera(direction, 2)?;
            let limits = Limits::unlimited();
            views
                .renderer
                .gather(&gaussians, &camera, &missing, &limits, |i, told| {
                    let Some(sums) = sums.get(owners[i] as usize) else {
                        return;
                    };
                    for (sum, told) in sums.iter().zip(told) {
                        sum.fetch_add((PARTS * told) as i64, Ordering::Relaxed);
                    }
                })?;
        }
        let sum = |sums: &[AtomicI64; 4], c: usize| sums[c].load(Ordering::Relaxed) as f32 / PARTS;
        let missing = |sums: &[AtomicI64; 4]| [0, 1, 2].map(|c| sum(sums, c) / (sum(sums, 3) + INERTIA));
        Ok(Told {
            error,
            missing: sums.par_iter().map(missing).collect(),
            seen: sums
                .par_iter()
                .map(|sums| sums[3].load(Ordering::Relaxed) as u64)
                .collect(),
        })
    }

    /// Adds to `moves` a share of what is missing.
    fn follow(&self, moves: &mut Moves, told: &Told, share: f32) {
        moves.follow(told.missing.par_iter().map(|missing| {
            let [y, co, cg] = difference(missing.map(|x| share * x));
            if self.grey { [y, 0.0, 0.0] } else { [y, co, cg] }
        }));
    }
}

/// The voxel that each Gaussian belongs to, [`u32::MAX`] for those far from all.
fn owners(voxels: &Voxels, gaussians: &Gaussians) -> Vec<u32> {
    let voxels_per_unit = (1u32 << voxels.depth()) as f32 / 2.0;
    let one_each = gaussians.len() == voxels.len();
    let of = |(i, position): (usize, &[f32; 3])| match one_each {
        true => i as u32,
        false => {
            let place = position.map(|x| (x + 1.0) * voxels_per_unit);
            owner(voxels, place).map_or(u32::MAX, |voxel| voxel as u32)
        }
    };
    gaussians.position.par_iter().enumerate().map(of).collect()
}

/// The difference in red, green and blue in 255ths of each pixel, as far as both pictures cover it, and 1.
fn missing(truth: &[[u8; 4]], seen: &Image) -> Vec<[f32; 4]> {
    let pairs = truth.par_iter().zip(&seen.pixels);
    let pixels = pairs.map(|(truth, seen)| {
        let [r, g, b, covered] = truth.map(f32::from);
        let both = (covered / 255.0).min(seen[3]);
        if both < COVERED {
            return [0.0, 0.0, 0.0, 1.0];
        }
        let [red, green, blue] =
            [(r, 0), (g, 1), (b, 2)].map(|(x, c)| 255.0 * both * (x / covered - seen[c] / seen[3]));
        [red, green, blue, 1.0]
    });
    pixels.collect()
}

/// The squared error of a picture.
fn squared_error(missing: &[[f32; 4]]) -> f64 {
    let squares = missing.iter().map(|[r, g, b, _]| r * r + g * g + b * b);
    squares.map(f64::from).sum()
}

#[cfg(test)]
mod tests;
