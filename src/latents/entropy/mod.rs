//! Latents as bytes: integer probabilities from tables, asymmetric numeral systems, independent slices.
//!
//! Part of the exact zone: integers only, so that every machine reads the same latents from the same bytes. The
//! probabilities are data of the model, never computed here.
//!
//! # Symbols
//! A level has K latents per voxel, or none if the model has none in its role: then it has no slices. They are coded
//! voxel by voxel in Morton order, the K latents of a voxel in turn. A latent `y` with the predicted mean `μ` (in
//! sixteenths) and the scale index `σ` is coded as `d = y − m` with `m = (μ + 8) >> 4`, under row `16·σ + (μ − 16·m +
//! 8)` of the table `cdf.gauss`. Where nothing is predicted, `d = y` under row `k` of `cdf.prior` for channel `k`.
//!
//! No level predicts the base level. With a model that has no layers `base.…`, all its latents are unpredicted. With
//! one that has, the voxels of a slice are coded in eight passes, one for each octant `x + 2y + 4z` of their parents,
//! in Morton order within a pass; and a voxel is predicted from those of its 26 neighbours that lie in the same slice
//! and were coded before ([`crate::latents::network::Model::pass_parameters`]), unless there are none. A level of role
//! 1 or 2 is coded likewise with a model that has layers `near.1.…` or `near.2.…`, which correct what the level below
//! predicts. If the model says `learning`, what such passes have coded corrects what is predicted of the next latents,
//! in a way that `learning` (`src/latents/entropy/learning.rs`) defines.
//!
//! A row has n entries, each a probability in units of 2⁻¹⁶, at least 1, together 65,536. Entry `i < n − 1` stands for
//! `d = low + i`; the last one for every other `d`, whose distance from the row then follows in equiprobable bits, each
//! an entry of ½:
//! 1. side: 1 if `d` lies above the row, 0 below. The distance is `e ≥ 1`.
//! 2. `k = ⌊log₂ e⌋` ones, then a zero. More than 20 ones are an error.
//! 3. the lowest `k` bits of `e`, highest first.
//!
//! # Slice bytes
//! One slice is one stack of a range asymmetric numeral system with a 64-bit state and 32-bit words. With `c` the sum
//! of the row's entries before entry `i`, and `p` entry `i` itself, decoding one entry from the state `s` is: find the
//! `i` with `c ≤ s mod 2¹⁶ < c + p`; replace `s` by `⌊s / 2¹⁶⌋·p + (s mod 2¹⁶) − c`; if that is below 2³², by `s·2³² +
//! word` with the next word. The bytes are the first state, little-endian, in as few bytes as hold it, then the words,
//! little-endian, in the order in which they are read. The state is at least 2³², so it takes 5 to 8 bytes: the number
//! in that range that leaves a multiple of four.
//!
//! After the last symbol all words must have been read, and the state must be [`END_STATE`]. That notices every cut
//! tried and all but 0.07 % of flipped bits; checksums are for the rest.

mod coding;
mod coefficients;
mod learning;
mod level;
mod nearby;
mod octants;
mod quantise;
mod rows;
mod slice;
mod tables;

pub use coding::Coding;
pub use coefficients::{SlicePart, decode_coefficients, encode_coefficients};
pub use level::{decode_level, encode_level, expect_no_latents, latent_hash};
pub use octants::{Predict, decode_passes, encode_passes};
pub use quantise::{Rounding, quantise, quantise_passes};
pub use slice::{Condition, END_STATE, UNPREDICTED, decode_slice, encode_slice};
pub use tables::{RawRows, Tables};

#[cfg(test)]
pub(crate) mod tests;
