//! The arithmetic kernels of `b2p`, and the one place that maps files into memory.
//!
//! Every `unsafe` block of the project lives here, each with its reason. Nothing here knows of streams, levels or Gaussians.
//!
//! A sparse convolution is one loop ([`ExactConv`] in integers, [`FloatConv`] in floats): for every output row, the rows its
//! [`Taps`] name are multiplied by that tap's weights and added up, in groups of rows with like neighbours ([`Plan`]) whose sums stay in the
//! registers, or matrix tiles, of the [`Isa`] while the taps go by. All of them give the same bits: integers wrap,
//! products of two f16 are exact in f32, fused or not, and each sum is added up in the same order. Only [`Precision::Bf16`],
//! [`Precision::Fastest`] and [`Precision::Half`] depend on the machine.

#[cfg(all(target_arch = "x86", not(target_feature = "sse2")))]
compile_error!("x87 arithmetic does not round to f32 after every step: build for a target with SSE2");

mod convert;
mod double;
mod exact;
mod family;
mod finish;
mod float;
mod machine;
mod map;
mod memory;
mod norms;
mod plan;
mod rows;
mod simd;
#[cfg(feature = "startup")]
mod startup;
mod taps;
mod tile;
mod winograd;

pub mod butterflies;
pub mod ceiling;
pub mod coefficients;
pub mod hidden;
pub mod mixing;
pub mod reference;
pub mod smooth;
pub mod splat;

pub use ::half::f16;
pub use convert::{to_f16, to_f32};
pub use double::add_products;
pub use exact::{ExactConv, LIMIT, Requantise};
pub use family::{copy_row, window};
pub use float::{FloatConv, FloatOut, Precision, Scale};
pub use map::{MappedFile, map_file};
pub use memory::{Zeros, give_back, zeros};
pub use plan::Plan;
pub use rows::Output;
pub use simd::{Isa, Scalar, Simd as Instructions, UnknownIsa, Work};
#[cfg(feature = "startup")]
pub use startup::stdout_was_closed;
pub use taps::{ABSENT, Taps};
