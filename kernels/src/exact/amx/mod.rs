//! AMX: tiles of 16 rows by 64 bytes, multiplied and summed in 32 bits.
//!
//! [`multiply()`] multiplies a plan's groups by tiles of weights; [`integers`], and `close` for bf16, cut numbers into
//! what tiles hold.

pub(crate) mod integers;
mod multiply;
mod pairing;
mod pairs;
pub(crate) mod peak;
mod tiles;
mod weights;

#[cfg(feature = "close")]
pub(crate) use multiply::{multiply, prepare};
#[cfg(feature = "close")]
pub(crate) use tiles::LINE;
#[cfg(feature = "close")]
pub(crate) use weights::Scheme;
pub(crate) use weights::{Buffers, Weights};
