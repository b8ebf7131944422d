//! Stream to Gaussians: drives the stages, holds no algorithm.
//!
//! [`Decoder`] decodes streams of either version. [`Decoding`] takes one as its bytes arrive and decodes each level as
//! soon as it is complete. [`Decoder::decode`], which takes a whole stream, is the same with all bytes at once: result
//! and error are the same however the bytes are cut, and the error is that of the first fault in the order of the
//! stream. What only version 2 needs, down to latents and features, is in `latents`.

mod check;
mod drawing;
mod memory;
mod reached;
mod stream;
mod streaming;
mod transform;

pub use check::{Checked, Fault};
#[cfg(feature = "encoder")]
pub(crate) use drawing::Advice;
pub(crate) use drawing::{LevelVoxels, Part};
pub use stream::{Decoder, Points};
pub use streaming::Decoding;
#[cfg(feature = "encoder")]
pub(crate) use transform::colour_hash;
