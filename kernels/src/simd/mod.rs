//! The SIMD vocabulary: instruction sets, tokens that prove them, and vectors.
//!
//! - [`Isa`] names an instruction set of this machine. It is chosen once, at run time.
//! - A **token** ([`Scalar`], `Avx2`, `Avx512`, `Neon`) is a value without size that exists only where the processor has that
//!   instruction set. It implements [`Simd`], which names the vector types of the set.
//! - A vector is made from a token or from other vectors, so owning one proves the instruction set too. All operations are safe.
//! - [`Isa::run`], or the macro `dispatch!` in this crate, turns an [`Isa`] into a token: it calls a body that is generic over
//!   [`Simd`], in a function compiled with the features of the set.
//!
//! What a body calls must be inlined into it (`#[inline(always)]`). A function that is not inlined is compiled for the baseline of
//! the target, and every vector operation in it becomes a call.
//!
//! **Bits.** Integer operations give the same bits in every set. So do the floating-point operations of IEEE 754: `+`, `-`, `*`, `/`,
//! `sqrt`, conversions, rounding and comparisons. Three operations depend on the set, by their last bits: [`F32Vector::mul_add`],
//! [`F32Vector::neg_mul_add`] and [`F32Vector::exp2`], and [`F64Vector::mul_add`].
//!
//! To add an instruction set, write its file and add its arm to [`Isa`] and `dispatch!`.

#[cfg(target_arch = "x86_64")]
pub(crate) mod avx2;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx512;
pub(crate) mod dispatch;
mod isa;
#[cfg(target_arch = "aarch64")]
pub(crate) mod neon;
mod scalar;
#[cfg(test)]
mod tests;

use std::fmt::Debug;
use std::ops::{Add, BitAnd, BitOr, Div, Mul, Sub};

use crate::f16;

#[cfg(target_arch = "x86_64")]
pub use avx2::Avx2;
#[cfg(target_arch = "x86_64")]
pub use avx512::Avx512;
pub use dispatch::Work;
pub(crate) use dispatch::dispatch;
#[cfg(target_arch = "x86_64")]
pub(crate) use isa::Amx;
pub(crate) use isa::Level;
pub use isa::{Isa, UnknownIsa};
#[cfg(target_arch = "aarch64")]
pub use neon::Neon;
pub use scalar::Scalar;

/// Proof that the processor has an instruction set, and the vector types of that set.
///
/// All vectors have [`Simd::LANES`] lanes, except those of i16, which have twice as many.
pub trait Simd: Copy + Debug + Send + Sync + 'static + sealed::Sealed {
    /// Lanes of 32 bits: 4, 8 or 16.
    const LANES: usize;
    /// A vector of f32.
    type F32: F32Vector<Self>;
    /// A vector of f64.
    type F64: F64Vector<Self>;
    /// A vector of i32.
    type I32: I32Vector<Self>;
    /// A vector of i16, with twice as many lanes.
    type I16: I16Vector<Self>;
    /// One truth value per lane.
    type Mask: MaskVector;
    /// An instruction set that this one includes, with at most 8 lanes.
    type Narrow: Simd<Narrow = Self::Narrow>;

    /// The proof of [`Simd::Narrow`].
    fn narrow(self) -> Self::Narrow;

    /// Runs `work` in a function that is compiled with the features of this set.
    fn vectorize<W: Work>(self, work: W) -> W::Output;
}

pub(crate) mod sealed {
    /// Tokens can only be defined in this crate.
    pub trait Sealed {}
}

/// A vector of f32, all operations lane by lane.
///
/// `min` and `max` are those of x86: the second argument if either is NaN. Comparisons with NaN are false.
pub trait F32Vector<S: Simd>:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self>
{
    /// `x` in all lanes.
    fn splat(simd: S, x: f32) -> Self;
    /// The first [`Simd::LANES`] values of `from`.
    ///
    /// # Panics
    /// If there are fewer.
    fn load(simd: S, from: &[f32]) -> Self;
    /// Writes the first [`Simd::LANES`] values of `to`.
    ///
    /// # Panics
    /// If there are fewer.
    fn store(self, to: &mut [f32]);
    /// As [`F32Vector::load`], from f16: exact.
    fn load_f16(simd: S, from: &[f16]) -> Self;
    /// As [`F32Vector::store`], rounded to the nearest f16, ties to even. Values beyond ±65504 become ±65504, and NaN −65504.
    fn store_f16(self, to: &mut [f16]);
    /// Vector `k` of the result holds component `k` of the first elements of `from`.
    ///
    /// # Panics
    /// If there are fewer than [`Simd::LANES`].
    fn load_deinterleaved3(simd: S, from: &[[f32; 3]]) -> [Self; 3];
    /// As [`F32Vector::load_deinterleaved3`], of four components.
    fn load_deinterleaved4(simd: S, from: &[[f32; 4]]) -> [Self; 4];
    /// Vector `k` of the result holds field `k` of the first records.
    ///
    /// # Panics
    /// If there are fewer than [`Simd::LANES`].
    fn load_records(simd: S, records: &[&[f32; 16]]) -> [Self; 16];
    /// For every lane whose bit is set in `which`, in order, writes what the 16 vectors hold in it to the next record of `to`. The
    /// result is the number of records written.
    ///
    /// # Panics
    /// If `to` is shorter.
    fn store_records(fields: &[Self; 16], which: u32, to: &mut [[f32; 16]]) -> usize;
    /// `self·factor + term`, in one rounding where the set has that (not [`Scalar`]).
    fn mul_add(self, factor: Self, term: Self) -> Self;
    /// `term − self·factor`, likewise.
    fn neg_mul_add(self, factor: Self, term: Self) -> Self;
    /// The square root, correctly rounded.
    fn sqrt(self) -> Self;
    /// The magnitude.
    fn abs(self) -> Self;
    /// The lesser; `other` if either is NaN.
    fn min(self, other: Self) -> Self;
    /// The greater; `other` if either is NaN.
    fn max(self, other: Self) -> Self;
    /// The least integer that is no less; for magnitudes up to 2²².
    fn ceil(self) -> Self;
    /// The greatest integer that is no more; for magnitudes up to 2²².
    fn floor(self) -> Self;
    /// `self < other`.
    fn lt(self, other: Self) -> S::Mask;
    /// `self ≤ other`.
    fn le(self, other: Self) -> S::Mask;
    /// Whether neither value is NaN.
    fn ordered(self, other: Self) -> S::Mask;
    /// `yes` where the mask holds, else `no`.
    fn select(mask: S::Mask, yes: Self, no: Self) -> Self;
    /// `self` where the mask holds, else 0.
    fn keep(self, mask: S::Mask) -> Self;
    /// An approximation of `2^x` for `−126 ≤ x ≤ 1`, with a relative error below 3.1·10⁻⁶, exact for integers; at most 2⁻¹²⁶ for any
    /// lesser x. Its last bits depend on the instruction set.
    fn exp2(self) -> Self;
    /// The mantissa in `[1, 2)` and the exponent of a positive normal number.
    fn split_exponent(self) -> (Self, Self);
    /// The nearest integer, ties to even; for magnitudes below 2³¹.
    fn round_to_i32(self) -> S::I32;
    /// The integer without the fraction; for magnitudes below 2³¹.
    fn truncate_to_i32(self) -> S::I32;
    /// The same bits as integers.
    fn to_bits(self) -> S::I32;
    /// The lanes whose bit is set in `which`, in order, in the first lanes. The other lanes are arbitrary.
    fn compress(self, which: u32) -> Self;
}

/// A vector of f64, with as many lanes as [`F32Vector`]. All operations are lane by lane.
pub trait F64Vector<S: Simd>: Copy + Mul<Output = Self> + Div<Output = Self> {
    /// `x` in all lanes.
    fn splat(simd: S, x: f64) -> Self;
    /// The same numbers, exactly.
    fn from_f32(x: S::F32) -> Self;
    /// Rounded to f32.
    fn to_f32(self) -> S::F32;
    /// `self·factor + term`, in one rounding where the set has that (not [`Scalar`]).
    fn mul_add(self, factor: Self, term: Self) -> Self;
    /// The lesser; `other` if either is NaN.
    fn min(self, other: Self) -> Self;
    /// The greater; `other` if either is NaN.
    fn max(self, other: Self) -> Self;
    /// `self < other`.
    fn lt(self, other: Self) -> S::Mask;
}

/// A vector of i32, all operations lane by lane. `+`, `-` and `*` wrap.
pub trait I32Vector<S: Simd>:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + BitAnd<Output = Self> + BitOr<Output = Self>
{
    /// `x` in all lanes.
    fn splat(simd: S, x: i32) -> Self;
    /// The first [`Simd::LANES`] values of `from`.
    ///
    /// # Panics
    /// If there are fewer.
    fn load(simd: S, from: &[i32]) -> Self;
    /// Writes the first [`Simd::LANES`] values of `to`.
    ///
    /// # Panics
    /// If there are fewer.
    fn store(self, to: &mut [i32]);
    /// As [`I32Vector::load`], from i16.
    fn load_i16(simd: S, from: &[i16]) -> Self;
    /// As [`I32Vector::store`], clamped to i16.
    fn store_i16(self, to: &mut [i16]);
    /// The lesser.
    fn min(self, other: Self) -> Self;
    /// The greater.
    fn max(self, other: Self) -> Self;
    /// The lesser of unsigned integers.
    fn min_unsigned(self, other: Self) -> Self;
    /// The magnitude; that of −2³¹ wraps.
    fn abs(self) -> Self;
    /// `self << count`, for a count below 32.
    fn shl(self, count: u32) -> Self;
    /// `self >> count` of signed integers, for a count below 32.
    fn shr(self, count: u32) -> Self;
    /// `self >> count` of unsigned integers, for a count below 32.
    fn shr_unsigned(self, count: u32) -> Self;
    /// `self >> count` of signed integers, each lane by its own count below 32.
    fn shr_each(self, count: Self) -> Self;
    /// `self == other`.
    fn eq(self, other: Self) -> S::Mask;
    /// `self < other`.
    fn lt(self, other: Self) -> S::Mask;
    /// `yes` where the mask holds, else `no`.
    fn select(mask: S::Mask, yes: Self, no: Self) -> Self;
    /// `self` where the mask holds, else 0.
    fn keep(self, mask: S::Mask) -> Self;
    /// The sum of all lanes, wrapping.
    fn sum(self) -> i32;
    /// `self + a₀·b₀ + a₁·b₁`, wrapping: a₀ and a₁ are the two i16 of a lane.
    fn dot_pairs(self, a: S::I16, b: S::I16) -> Self;
    /// As f32, rounded to the nearest, ties to even.
    fn to_f32(self) -> S::F32;
    /// The same bits as floats.
    fn as_f32(self) -> S::F32;
    /// The same bits as i16, in the order of memory.
    fn as_i16(self) -> S::I16;
}

/// A vector of i16, with twice as many lanes as [`I32Vector`]. All operations are lane by lane. `+` and `-` wrap.
pub trait I16Vector<S: Simd>: Copy + Add<Output = Self> + Sub<Output = Self> {
    /// `x` in all lanes.
    fn splat(simd: S, x: i16) -> Self;
    /// The first `2·LANES` values of `from`.
    ///
    /// # Panics
    /// If there are fewer.
    fn load(simd: S, from: &[i16]) -> Self;
    /// Writes the first `2·LANES` values of `to`.
    ///
    /// # Panics
    /// If there are fewer.
    fn store(self, to: &mut [i16]);
    /// As [`I16Vector::load`], from i8.
    fn load_i8(simd: S, from: &[i8]) -> Self;
    /// The sum, clamped to i16.
    fn saturating_add(self, other: Self) -> Self;
    /// The lesser.
    fn min(self, other: Self) -> Self;
    /// The greater.
    fn max(self, other: Self) -> Self;
    /// The upper 16 bits of the products.
    fn mul_high(self, other: Self) -> Self;
    /// `self >> count`, for a count below 16.
    fn shr(self, count: u32) -> Self;
    /// The same bits as i32, in the order of memory.
    fn as_i32(self) -> S::I32;
}

/// One truth value per lane.
pub trait MaskVector: Copy {
    /// Where both hold.
    fn and(self, other: Self) -> Self;
    /// Lane `i` in bit `i`.
    fn bits(self) -> u32;
}

/// The first `N` values.
#[inline(always)]
#[track_caller]
fn first<T, const N: usize>(from: &[T]) -> &[T; N] {
    from.first_chunk().expect("a vector's values")
}

/// The first `N` values.
#[inline(always)]
#[track_caller]
fn first_mut<T, const N: usize>(to: &mut [T]) -> &mut [T; N] {
    to.first_chunk_mut().expect("room for a vector's values")
}

/// The largest finite f16.
pub(crate) const F16_MAX: f32 = 65504.0;

/// The polynomial of degree 4 through (0, 1) that is nearest to `2^f` on `[−½, ½]`, in relative error; highest power first.
const EXP2: [f32; 5] = [9.582_853e-3, 5.590_642_6e-2, 2.402_41e-1, 6.931_242e-1, 1.0];
/// As [`EXP2`], on `[0, 1]`.
#[cfg(target_arch = "x86_64")]
const EXP2_ABOVE: [f32; 5] = [1.342_679_7e-2, 5.224_229_4e-2, 2.412_802_9e-1, 6.930_448_4e-1, 1.0];
/// The least exponent of a normal number.
pub(crate) const LEAST_EXPONENT: f32 = -126.0;
/// Adding this to a small float leaves its nearest integer in the low bits: `1.5·2²³`.
const ROUND: f32 = 12_582_912.0;

/// The polynomial by Horner's rule, the highest coefficient first.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
#[inline(always)]
fn polynomial<S: Simd>(simd: S, x: S::F32, coefficients: &[f32; 5]) -> S::F32 {
    let mut p = S::F32::splat(simd, coefficients[0]);
    for c in &coefficients[1..] {
        p = p.mul_add(x, S::F32::splat(simd, *c));
    }
    p
}

/// Asks for a row to be brought into the cache, if the processor can be asked.
#[inline(always)]
pub(crate) fn prefetch<T>(row: &[T]) {
    #[cfg(target_arch = "x86_64")]
    for line in (0..size_of_val(row)).step_by(64) {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: SSE is part of the baseline. A prefetch reads nothing, and its address may be any.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(row.as_ptr().cast::<i8>().wrapping_add(line)) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = row;
}

/// `[$e; 3]` with `$i` counting. Arrays' own `map` and `from_fn` are calls that the compiler does not always inline into code for
/// an instruction set above the baseline; so are closures.
macro_rules! three {
    ($i:ident => $e:expr) => {
        [
            {
                let $i = 0;
                $e
            },
            {
                let $i = 1;
                $e
            },
            {
                let $i = 2;
                $e
            },
        ]
    };
}
pub(crate) use three;

/// As [`three`].
macro_rules! four {
    ($i:ident => $e:expr) => {
        [
            {
                let $i = 0;
                $e
            },
            {
                let $i = 1;
                $e
            },
            {
                let $i = 2;
                $e
            },
            {
                let $i = 3;
                $e
            },
        ]
    };
}
pub(crate) use four;
