//! The probability tables of a model.

use super::rows::{Row, Rows};
use crate::error::Result;

/// Scale indices: σ of index i is 0.11·(64 / 0.11)^(i / 63).
pub(super) const SCALES: usize = 64;
/// Fractions of a mean, in sixteenths.
const FRACTIONS: usize = 16;

/// One table as a model file holds it: rows of different length, end to end.
#[derive(Debug, Clone, Copy)]
pub struct RawRows<'a> {
    /// The tensor's name, for errors.
    pub name: &'a str,
    /// Probabilities in units of 2⁻¹⁶, minus 1.
    pub entries: &'a [u16],
    /// Row `r` is `entries[offsets[r]..offsets[r + 1]]`.
    pub offsets: &'a [u32],
    /// What the first entry of each row stands for.
    pub low: &'a [i16],
}

/// The tables of a model, found sound.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tables {
    gauss: Rows,
    prior: Rows,
    /// For every channel the scale that its prior is nearest to.
    prior_scales: Vec<u8>,
    learning: bool,
}

impl Tables {
    /// Checks and takes the tables `cdf.gauss` (1024 rows) and `cdf.prior` (one row per channel).
    ///
    /// # Errors
    /// [`crate::Error::Malformed`], naming table and row, unless offsets ascend from 0 to the number of entries, every
    /// row has at least two entries that sum to 65,536, and stands for values that `i16` holds.
    pub fn new(gauss: RawRows, prior: RawRows) -> Result<Self> {
        let gauss = Rows::new(gauss, Some(SCALES * FRACTIONS))?;
        let prior = Rows::new(prior, None)?;
        let peak = |sigma| gauss.row(sigma * FRACTIONS + FRACTIONS / 2).peak();
        let peaks: Vec<u32> = (0..SCALES).map(peak).collect();
        let scale = |channel| {
            let sure = prior.row(channel).peak();
            let scale = peaks.iter().position(|&peak| peak <= sure);
            scale.unwrap_or(SCALES - 1) as u8
        };
        let prior_scales = (0..prior.len()).map(scale).collect();
        Ok(Tables {
            gauss,
            prior,
            prior_scales,
            learning: false,
        })
    }

    /// The same tables, for passes that learn from what they have coded, or do not, as at first.
    pub fn with_learning(self, learning: bool) -> Self {
        Tables { learning, ..self }
    }

    /// Whether passes learn.
    pub(super) fn learning(&self) -> bool {
        self.learning
    }

    /// The scale index that a channel's latents start from where nothing predicts them but others nearby.
    pub(super) fn prior_scale(&self, channel: usize) -> u8 {
        self.prior_scales[channel]
    }

    /// K: latents per voxel.
    pub fn channels(&self) -> usize {
        self.prior.len()
    }

    /// The row of channel `channel` at the base level.
    pub(super) fn prior(&self, channel: usize) -> Row<'_> {
        self.prior.row(channel)
    }

    /// The row for a mean in sixteenths and a scale index, and the whole number its values count from.
    #[inline]
    pub(super) fn gauss(&self, mu: i16, sigma: u8) -> (Row<'_>, i32) {
        let mu = i32::from(mu);
        let whole = (mu + 8) >> 4;
        let fraction = (mu - 16 * whole + 8) as usize;
        let row = self.gauss.row(usize::from(sigma) * FRACTIONS + fraction);
        (row, whole)
    }
}
