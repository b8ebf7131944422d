//! The best scene of at most so many bits for each point.

use super::encoder::{Cut, Cuts, Grid, SceneEncoder, voxels_of};
use crate::cloud::ColouredVoxels;
use crate::encoder::transform::QualityTarget;
use crate::error::{Error, Result};
use crate::log::Log;

/// Blocks that are tried, spread over the scene.
const TRIED: usize = 4;
/// The coarsest step that a level is tried with, in eighths of an octave above half of a 255th: 64 255ths; 23 for the
/// level of the cloud's own voxels, whose geometry takes most.
const COARSEST: [i32; 2] = [56, 44];
/// Steps that are tried until all blocks fit.
const CORRECTIONS: usize = 8;

impl SceneEncoder {
    /// Codes a cloud as well as possible with at most so many bits for each point, the whole scene counted, and says in
    /// which steps and down to which level. All blocks have one quality. It is found on some blocks, and corrected if
    /// all together take more.
    ///
    /// # Errors
    /// [`Error::Usage`] if the bits are not a finite number above 0, [`Error::TooFewBits`] if the smallest scene has
    /// more, and those of [`SceneEncoder::encode`].
    pub fn encode_to_rate(&self, cloud: &ColouredVoxels, bits_per_point: f64) -> Result<(Vec<u8>, QualityTarget, u8)> {
        if !(bits_per_point.is_finite() && bits_per_point > 0.0) {
            let what = "a scene cannot have";
            return Err(Error::Usage(format!("{what} {bits_per_point} bits for each point")));
        }
        let grid = Grid::of(cloud);
        let levels = match &self.options.levels {
            Some(_) => self.levels(grid.bits)?,
            None => *self.levels(grid.bits)?.start()..=grid.bits,
        };
        let (mut least, points) = (f64::INFINITY, cloud.voxels.len() as f64);
        for top in levels.clone().rev() {
            let encoder = |at: i32| {
                let encoder = self.clone().with_levels(*levels.start().min(&top)..=top);
                encoder.with_quality(quality(at))
            };
            let tried = encoder(0).sample(cloud, &grid)?;
            let coarsest = COARSEST[usize::from(top == grid.bits && top > *levels.start())];
            let mut fits = |at: i32| -> Result<bool> {
                let used = encoder(at).trial(&tried, &grid)?;
                least = least.min(used);
                Ok(used <= bits_per_point)
            };
            if !fits(coarsest)? {
                continue;
            }
            let (mut finest, mut too_fine) = (coarsest, -1);
            while finest - too_fine > 1 {
                let middle = (finest + too_fine) / 2;
                match fits(middle)? {
                    true => finest = middle,
                    false => too_fine = middle,
                }
            }
            for at in (finest..=coarsest).take(CORRECTIONS) {
                let bytes = encoder(at).encode(cloud)?;
                let used = bytes.len() as f64 * 8.0 / points;
                least = least.min(used);
                if used <= bits_per_point {
                    return Ok((bytes, quality(at), top));
                }
            }
        }
        Err(Error::TooFewBits {
            asked: bits_per_point,
            least,
        })
    }

    /// Some blocks of a cloud.
    fn sample(&self, cloud: &ColouredVoxels, grid: &Grid) -> Result<Vec<Cut>> {
        let cutter = self.cutter(grid, &self.levels(grid.bits)?);
        let cuts = || Cuts::new(cutter.clone(), voxels_of(cloud));
        let count = cuts().count();
        let step = count.div_ceil(TRIED);
        // The first of a row would be at the border.
        cuts().skip(step / 2).step_by(step.max(1)).collect()
    }

    /// Bits that some blocks take for each of their points.
    fn trial(&self, blocks: &[Cut], grid: &Grid) -> Result<f64> {
        let levels = self.levels(grid.bits)?;
        let (mut bytes, mut points) = (0, 0);
        for (cube, voxels) in blocks {
            let coded = self.code(grid, &levels, *cube, voxels, false, &Log::off())?;
            bytes += coded.len() + ENTRY;
            points += voxels.len();
        }
        Ok(bytes as f64 * 8.0 / points.max(1) as f64)
    }
}

/// Bytes of a block in the index, more or less.
const ENTRY: usize = 32;

/// The quality at a place: eighths of an octave above a step of half of a 255th.
fn quality(at: i32) -> QualityTarget {
    QualityTarget::Step(0.5 * 2f32.powf(at as f32 / 8.0))
}
