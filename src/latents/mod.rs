//! What only streams of version 2 need: learned features, the entropy coder of their latents, and what corrects the
//! colours of their Gaussians.
//!
//! Nothing on the way of version 3 depends on it.

mod activate;
mod colour_filter;
mod decoder;
mod decoding;
pub mod entropy;
pub mod network;
mod residual;

pub use activate::activate;
pub use colour_filter::{ColourFilter, Groups, INPUTS as COLOUR_INPUTS, Surroundings};
pub use decoder::{Exact, LatentDecoder, LatentDecoder as Decoder};
pub(crate) use decoding::nothing_reached;
pub use decoding::{LatentDecoding, LatentDecoding as Decoding};
pub use residual::{BASIS as COLOUR_BASIS, ColourResidual, ResidualSteps, Steps};
