//! The arithmetic kernels of `b2p`, and the one place that maps files into memory.
//!
//! Every `unsafe` block of the project lives here, each with its reason. Nothing here knows of streams, levels or
//! Gaussians.
//!
//! A sparse convolution is one loop ([`ExactConv`] in integers, [`FloatConv`] in floats): for every output row, the
//! rows its [`Taps`] name are multiplied by that tap's weights and added up, in groups of rows with like neighbours
//! ([`Plan`]) whose sums stay in the registers, or matrix tiles, of the [`Isa`] while the taps go by. All of them give
//! the same bits: integers wrap, products of two f16 are exact in f32, fused or not, and each sum is added up in the
//! same order. Only [`Precision::Bf16`], [`Precision::Fastest`] and [`Precision::Half`] depend on the machine.

#[cfg(all(target_arch = "x86", not(target_feature = "sse2")))]
compile_error!("x87 arithmetic does not round to f32 after every step: build for a target with SSE2");

#[cfg(feature = "close")]
mod close;
mod exact;
mod map;
mod memory;
mod simd;
mod sparse;
#[cfg(feature = "startup")]
mod startup;

pub use ::half::f16;
#[cfg(feature = "close")]
pub use close::splat;
#[cfg(feature = "close")]
pub use close::{
    conv::{FloatConv, FloatOut, Precision, Scale},
    convert::{to_f16, to_f32},
};
pub use exact::conv::ExactConv;
pub use exact::double::add_products;
pub use exact::requantise::{LIMIT, Requantise};
pub use exact::{butterflies, coefficients, hidden, jacobi, mixing, scatter, smooth};
pub use map::{MappedFile, map_file};
pub use memory::{Zeros, give_back, keep_freed, zeros};
pub use simd::{Isa, Scalar, Simd, Simd as Instructions, UnknownIsa, Work};
pub use sparse::children::{copy_row, window};
pub use sparse::plan::Plan;
pub use sparse::rows::Output;
pub use sparse::taps::{ABSENT, MadeRows, Taps};
#[cfg(feature = "startup")]
pub use startup::stdout_was_closed;

/// Peak throughput of one core, to judge the kernels by.
///
/// Each function measures for about 10 ms and gives the best rate seen, in 10⁹ multiply-adds per second. For `scalar`
/// it tells what the compiler makes of such a loop, which is no bound.
pub mod peak {
    #[cfg(feature = "close")]
    pub use crate::close::peak::{bf16, f32, half};
    pub use crate::exact::peak::i16;
}

/// The convolutions as their definitions read: what the kernels are tested against.
pub mod reference {
    #[cfg(feature = "close")]
    pub use crate::close::reference::{Value, float};
    pub use crate::exact::reference::{exact, tap};
}
