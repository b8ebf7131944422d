//! All that decides a bit of a stream, in integers and in floats whose order of operations is written down:
//! convolution, minimal filtering, requantisation, prediction of occupancies, the colour filter and the residual.
//!
//! Nothing here may name `close`: without the feature of that name it does not exist.

#[cfg(target_arch = "x86_64")]
pub(crate) mod amx;
pub mod butterflies;
pub mod coefficients;
pub(crate) mod conv;
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
mod digits;
#[cfg(target_arch = "aarch64")]
pub(crate) mod dot;
pub(crate) mod double;
mod epilogue;
pub mod hidden;
pub mod jacobi;
mod kernel;
pub mod mixing;
#[cfg(target_arch = "aarch64")]
mod neon;
pub(crate) mod norms;
pub(crate) mod peak;
pub(crate) mod reference;
pub(crate) mod requantise;
pub mod scatter;
pub mod smooth;
mod winograd;
