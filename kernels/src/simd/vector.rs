//! What the vectors of every instruction set can do.

use std::fmt::Debug;
use std::ops::{Add, BitAnd, BitOr, Div, Mul, Sub};

use half::f16;

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
}

/// Work that is compiled once for every instruction set.
///
/// What it calls must be inlined into it (`#[inline(always)]`, closures): a function that is not is compiled for the
/// baseline of the target. Results are the same in all sets, as integers are everywhere, and floats whose order of
/// operations is written down.
pub trait Work {
    /// The result.
    type Output;

    /// Does the work with an instruction set; `#[inline(always)]` in implementations.
    fn run<S: Simd>(self, simd: S) -> Self::Output;
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
    /// As [`F32Vector::store`], rounded to the nearest f16, ties to even. Values beyond ±65504 become ±65504, and NaN
    /// −65504.
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
    /// For every lane whose bit is set in `which`, in order, writes what the 16 vectors hold in it to the next record
    /// of `to`. The result is the number of records written.
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
    /// An approximation of `2^x` for `−126 ≤ x ≤ 1`, with a relative error below 3.1·10⁻⁶, exact for integers; at most
    /// 2⁻¹²⁶ for any lesser x. Its last bits depend on the instruction set.
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
pub(super) fn first<T, const N: usize>(from: &[T]) -> &[T; N] {
    from.first_chunk().expect("a vector's values")
}

/// The first `N` values.
#[inline(always)]
#[track_caller]
pub(super) fn first_mut<T, const N: usize>(to: &mut [T]) -> &mut [T; N] {
    to.first_chunk_mut().expect("room for a vector's values")
}

/// The largest finite f16.
pub(crate) const F16_MAX: f32 = 65504.0;

/// The polynomial of degree 4 through (0, 1) that is nearest to `2^f` on `[−½, ½]`, in relative error; highest power
/// first.
pub(super) const EXP2: [f32; 5] = [9.582_853e-3, 5.590_642_6e-2, 2.402_41e-1, 6.931_242e-1, 1.0];
/// As [`EXP2`], on `[0, 1]`.
#[cfg(target_arch = "x86_64")]
pub(super) const EXP2_ABOVE: [f32; 5] = [1.342_679_7e-2, 5.224_229_4e-2, 2.412_802_9e-1, 6.930_448_4e-1, 1.0];
/// The least exponent of a normal number.
pub(crate) const LEAST_EXPONENT: f32 = -126.0;
/// Adding this to a small float leaves its nearest integer in the low bits: `1.5·2²³`.
pub(super) const ROUND: f32 = 12_582_912.0;

/// The polynomial by Horner's rule, the highest coefficient first.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64", target_feature = "simd128"))]
#[inline(always)]
pub(super) fn polynomial<S: Simd>(x: S::F32, coefficients: [S::F32; 5]) -> S::F32 {
    let mut p = coefficients[0];
    for c in &coefficients[1..] {
        p = p.mul_add(x, *c);
    }
    p
}

/// For each mask of four lanes, the bytes of the lanes that it holds, in order.
#[cfg(any(target_arch = "aarch64", target_feature = "simd128"))]
pub(super) static FIRST: [[u8; 16]; 16] = {
    let mut first = [[0; 16]; 16];
    let mut mask = 0;
    while mask < 16 {
        let (mut byte, mut kept) = (0, 0);
        while byte < 16 {
            if mask >> (byte / 4) & 1 == 1 {
                first[mask][kept] = byte as u8;
                kept += 1;
            }
            byte += 1;
        }
        mask += 1;
    }
    first
};
