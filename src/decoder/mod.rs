//! Stream to Gaussians: drives the stages, holds no algorithm.
//!
//! [`StreamDecoder`] decodes streams of either version, [`StreamDecoding`] takes one as its bytes arrive and decodes each level as soon as it is
//! whole. [`StreamDecoder::decode`], which takes a whole stream, is the same with all bytes at once: result and error are the same however the
//! bytes are cut, and the error is that of the first fault in the order of the stream. What is of version 2 alone, down to
//! latents and features, is [`crate::latents`].

mod memory;
mod stream;
mod streaming;
mod transform;

pub use stream::{Points, StreamDecoder};
pub use streaming::StreamDecoding;
#[cfg(feature = "encoder")]
pub(crate) use transform::colour_hash;
