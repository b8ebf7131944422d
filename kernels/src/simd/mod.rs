//! The SIMD vocabulary: instruction sets, tokens that prove them, and vectors.
//!
//! - [`Isa`] names an instruction set of this machine. It is chosen once, at run time.
//! - A **token** ([`Scalar`], `Avx2`, `Avx512`, `Neon`, `Simd128`) is a value without size that exists only where the
//!   processor has that instruction set. It implements [`Simd`], which names the vector types of the set.
//! - A vector is made from a token or from other vectors, so owning one proves the instruction set too. All operations
//!   are safe.
//! - [`Isa::run`], or the macro `dispatch!` in this crate, turns an [`Isa`] into a token: it calls a body that is
//!   generic over [`Simd`], in a function compiled with the features of the set.
//!
//! What a body calls must be inlined into it (`#[inline(always)]`). A function that is not inlined is compiled for the
//! baseline of the target, and every vector operation in it becomes a call.
//!
//! **Bits.** Integer operations give the same bits in every set. So do the floating-point operations of IEEE 754: `+`,
//! `-`, `*`, `/`, `sqrt`, conversions, rounding and comparisons. Three operations depend on the set, by their last
//! bits: [`F32Vector::mul_add`], [`F32Vector::neg_mul_add`] and [`F32Vector::exp2`], and [`F64Vector::mul_add`].
//!
//! To add an instruction set, write its file, and add its `mod` and its line of `instruction_sets!` below.

/// All instruction sets, plainest first, for a macro of this module that has an arm for each: where it exists, its
/// token, and the macro that compiles functions with its features.
macro_rules! instruction_sets {
    ($macro:ident $($arguments:tt)*) => {
        $crate::simd::$macro! {
            $($arguments)*
            [all()] scalar::Scalar, with_scalar;
            [target_arch = "x86_64"] avx2::Avx2, with_avx2;
            [target_arch = "x86_64"] avx512::Avx512, with_avx512;
            [target_arch = "aarch64"] neon::Neon, with_neon;
            [target_feature = "simd128"] simd128::Simd128, with_simd128;
        }
    };
}
pub(crate) use instruction_sets;

#[cfg(target_arch = "x86_64")]
pub(crate) mod amx;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx2;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx512;
pub(crate) mod dispatch;
mod isa;
pub(crate) mod macros;
#[cfg(target_arch = "aarch64")]
pub(crate) mod neon;
mod prefetch;
pub(crate) mod scalar;
#[cfg(target_feature = "simd128")]
pub(crate) mod simd128;
#[cfg(test)]
mod tests;
pub(crate) mod vector;

pub(crate) use dispatch::{dispatch, match_level};
pub use isa::{Isa, UnknownIsa};
pub(crate) use isa::{Level, define_level};
pub(crate) use macros::four;
#[cfg(feature = "close")]
pub(crate) use macros::three;
pub(crate) use prefetch::prefetch;
pub use scalar::Scalar;
#[cfg(all(test, feature = "close"))]
pub(crate) use vector::F16_MAX;
#[cfg(feature = "close")]
pub(crate) use vector::LEAST_EXPONENT;
pub use vector::{F32Vector, I16Vector, I32Vector, Simd, Work};
#[cfg(any(test, feature = "close"))]
pub use vector::{F64Vector, MaskVector};
