//! Sparse convolution, as far as integers and floats have it in common: which input rows a tile of output rows reads,
//! and the register-blocked loop that multiplies them by weights.

pub(crate) mod accumulate;
pub(crate) mod children;
mod lists;
#[cfg(target_arch = "x86_64")]
mod lists_avx2;
pub(crate) mod microkernel;
pub(crate) mod peak;
pub(crate) mod plan;
mod planner;
pub(crate) mod rows;
pub(crate) mod scratch;
pub(crate) mod taps;
mod tile_taps;
