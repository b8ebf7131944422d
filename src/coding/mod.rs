//! Entropy coding of binary decisions: probabilities in integers, and a range coder.

pub(crate) mod ans;
pub(crate) mod binary;
pub(crate) mod probability;

/// Probabilities are in units of 2⁻¹⁶.
pub(crate) const ONE: u32 = 1 << 16;
