//! What may differ between machines in its last bits: convolution in floats, conversions of f16, and splatting.

#[cfg(target_arch = "x86_64")]
mod amx;
#[cfg(target_arch = "x86_64")]
mod bf16;
pub(crate) mod conv;
pub(crate) mod convert;
#[cfg(target_arch = "aarch64")]
mod half;
mod kernel;
pub(crate) mod peak;
pub(crate) mod reference;
pub mod splat;
