//! The network: from latents to features and probabilities in integers, from features to raw Gaussians in floats.
//!
//! Modules and layers are those of the paper's appendix. In the exact zone (upsampling, entropy model PEM, reconstruction FR) all
//! arithmetic is that of [`b2p_kernels::ExactConv`], so encoder and decoder agree to the bit wherever they run. Gaussian generation GG
//! and the encoder's feature conversion FC and squeezing FS are floats.
//!
//! The levels of a stream have roles: 0 is the base level, 1 and 2 the levels above it.

mod model;
mod shape;
mod tensors;
mod untrained;

pub use model::{Model, RAW};
pub use shape::{HeadShape, ROLES, Shape, Upsample};
pub use untrained::untrained;
