//! The two ways of coding a level, as its encoder sees them.

use super::level::encode_level;
use super::octants::{Predict, encode_passes};
use super::quantise::{Rounding, quantise, quantise_passes};
use super::slice::Condition;
use super::tables::Tables;

/// What a level's latents are coded under.
#[derive(Clone, Copy)]
pub enum Coding<'a> {
    /// What is known beforehand: [`encode_level`].
    Known(Condition<'a>),
    /// What neighbours tell, too: [`encode_passes`] of voxels with these keys.
    Passes {
        /// The level's Morton keys, ascending.
        keys: &'a [u64],
        /// What predicts a pass.
        predict: &'a Predict<'a>,
    },
}

impl Coding<'_> {
    /// Rounds latents [voxels, K] that shall be coded so.
    ///
    /// # Panics
    /// As [`quantise`] and [`quantise_passes`].
    pub fn quantise(self, tables: &Tables, latents: &[f32], rounding: Rounding, slice_voxels: usize) -> Vec<i16> {
        match self {
            Coding::Known(condition) => quantise(tables, condition, latents, rounding),
            Coding::Passes { keys, predict } => quantise_passes(tables, keys, predict, latents, rounding, slice_voxels),
        }
    }

    /// Codes latents [voxels, K] in slices of so many voxels.
    ///
    /// # Panics
    /// As [`encode_level`] and [`encode_passes`].
    pub fn encode(self, tables: &Tables, latents: &[i16], slice_voxels: usize) -> Vec<Vec<u8>> {
        match self {
            Coding::Known(condition) => encode_level(tables, condition, latents, slice_voxels),
            Coding::Passes { keys, predict } => encode_passes(tables, keys, predict, latents, slice_voxels),
        }
    }
}
