//! What networks of both versions are made of: sparse convolutions over a level, the memory that they run in, and the
//! files that hold their weights.

pub(crate) mod activations;
mod precision;
mod run;
mod safetensors;
mod stored;
mod tensors;

pub use precision::Precision;
pub(crate) use run::{Conv, Inception, Pool, ResBlock, apply, apply_f32, apply_onto, apply_part, concat, reals};
pub(crate) use safetensors::{Dtype, File};
pub(crate) use stored::{Spec, Stored};
#[cfg(test)]
pub(crate) use tensors::Element;
pub(crate) use tensors::{Tensors, malformed, missing};
