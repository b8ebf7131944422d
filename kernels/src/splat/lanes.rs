//! Several floats side by side.
//!
//! [`Lanes`] is what the splat kernels are written in. `plain.rs` has the portable ones, the reference of the others; `avx2.rs` and
//! `avx512.rs` have those of x86, `neon.rs` those of AArch64. A kernel is one generic body, inlined into one function per instruction set ([`by_level`]).

use super::Ellipse;

/// A vector of `f32`, all operations lane by lane.
///
/// The least and the greatest are those of x86: the second argument if either is NaN. Comparisons with NaN are false.
pub(super) trait Lanes: Copy {
    /// How many lanes: a power of two, at most 16.
    const COUNT: usize;
    /// One truth per lane.
    type Mask: Mask;
    /// As many `f64`.
    type Double: Double<Lanes = Self, Mask = Self::Mask>;

    fn splat(x: f32) -> Self;
    /// The first floats of `from`.
    ///
    /// # Panics
    /// If they are fewer than [`Lanes::COUNT`].
    fn load(from: &[f32]) -> Self;
    /// Into the first floats of `to`.
    ///
    /// # Panics
    /// If they are fewer than [`Lanes::COUNT`].
    fn store(self, to: &mut [f32]);
    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn mul(self, other: Self) -> Self;
    fn div(self, other: Self) -> Self;
    /// `self·factor + term`, in one rounding where the machine has that.
    fn mul_add(self, factor: Self, term: Self) -> Self;
    /// `term − self·factor`.
    fn neg_mul_add(self, factor: Self, term: Self) -> Self;
    fn sqrt(self) -> Self;
    fn abs(self) -> Self;
    fn min(self, other: Self) -> Self;
    fn max(self, other: Self) -> Self;
    /// The least integer that is no less; for magnitudes up to 2²².
    fn ceil(self) -> Self;
    /// The greatest integer that is no more; for magnitudes up to 2²².
    fn floor(self) -> Self;
    fn lt(self, other: Self) -> Self::Mask;
    fn le(self, other: Self) -> Self::Mask;
    /// `yes` where the mask holds.
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self;
    /// `self` where the mask holds, else 0.
    fn keep(self, mask: Self::Mask) -> Self;
    /// `2^x` for `−126 ≤ x ≤ 1`, with a relative error below [`EXP2_ERROR`], exact for integers; at most 2⁻¹²⁶ for any less.
    fn exp2(self) -> Self;
    /// Whole numbers from 0 to 2²⁴, as the bits of unsigned integers.
    fn to_integer(self) -> Self;
    /// The bits of two integers' sum.
    fn add_integer(self, other: Self) -> Self;
    /// The lanes whose bit is set in `which`, in order, in the first lanes.
    fn compress(self, which: u32) -> Self;
    /// Component `k` of element `i` in lane `i` of vector `k`.
    ///
    /// # Panics
    /// If `from` has fewer elements than [`Lanes::COUNT`].
    fn deal3(from: &[[f32; 3]]) -> [Self; 3];
    /// As [`Lanes::deal3`], of four components.
    fn deal4(from: &[[f32; 4]]) -> [Self; 4];
    /// For every lane whose bit is set in `which`, in order, what the 16 vectors hold in it, into the next record of `to`.
    ///
    /// # Panics
    /// If `to` is shorter than the highest of the lanes.
    fn collect(fields: &[Self; 16], which: u32, to: &mut [Ellipse]) -> usize;
    /// Unsigned integers up to 2²⁴, as floats.
    fn to_float(self) -> Self;
    /// Field `k` of the ellipse that the lower half of key `i` numbers, in lane `i` of vector `k`. Where there are fewer keys than
    /// lanes, those of the last.
    ///
    /// # Panics
    /// If there is no key, or no such ellipse.
    fn gather(all: &[Ellipse], keys: &[u64]) -> [Self; 16];
    /// The mantissa, in `[1, 2)`, and the exponent, of a positive normal number.
    fn split(self) -> (Self, Self);
}

/// A vector of truths.
pub(super) trait Mask: Copy {
    fn and(self, other: Self) -> Self;
    /// Lane `i` in bit `i`.
    fn bits(self) -> u32;
}

/// A vector of `f64`, as wide as its [`Lanes`].
pub(super) trait Double: Copy {
    type Lanes;
    type Mask;
    fn splat(x: f64) -> Self;
    fn from_lanes(lanes: Self::Lanes) -> Self;
    /// Rounded to `f32`.
    fn to_lanes(self) -> Self::Lanes;
    fn mul(self, other: Self) -> Self;
    fn div(self, other: Self) -> Self;
    fn mul_add(self, factor: Self, term: Self) -> Self;
    fn min(self, other: Self) -> Self;
    fn max(self, other: Self) -> Self;
    fn lt(self, other: Self) -> Self::Mask;
}

/// The lanes of an instruction set.
pub(super) trait HasLanes: crate::simd::Simd {
    type Lanes: Lanes;
}

impl HasLanes for crate::simd::Scalar {
    type Lanes = super::plain::Plain;
}

#[cfg(target_arch = "x86_64")]
impl HasLanes for crate::simd::Avx2 {
    type Lanes = super::avx2::Avx2;
}

#[cfg(target_arch = "x86_64")]
impl HasLanes for crate::simd::Avx512 {
    type Lanes = super::avx512::Avx512;
}

#[cfg(target_arch = "aarch64")]
impl HasLanes for crate::simd::Neon {
    type Lanes = super::neon::Neon;
}

/// The polynomial of degree 4 through (0, 1) that is nearest to `2^f` on `[−½, ½]`, in relative error; highest power first.
pub(super) const EXP2: [f32; 5] = [9.582_853e-3, 5.590_642_6e-2, 2.402_41e-1, 6.931_242e-1, 1.0];
/// As [`EXP2`], on `[0, 1]`.
#[cfg(target_arch = "x86_64")]
pub(super) const EXP2_ABOVE: [f32; 5] = [1.342_679_7e-2, 5.224_229_4e-2, 2.412_802_9e-1, 6.930_448_4e-1, 1.0];
/// Relative error of [`Lanes::exp2`].
#[cfg(test)]
pub(super) const EXP2_ERROR: f64 = 3.1e-6;
/// The least exponent of a normal number.
pub(super) const LEAST_POWER: f32 = -126.0;
/// Adding this to a small float leaves its nearest integer in the low bits: `1.5·2²³`.
pub(super) const ROUND: f32 = 12_582_912.0;

/// Calls `$body::<L>(args…)` with the lanes `L` of `$isa`, as compiled for it.
macro_rules! by_level {
    ($isa:expr, fn $body:ident $(<const $flag:ident: u8>)? ($($arg:ident: $ty:ty),* $(,)?) $(-> $out:ty)?) => {{
        #[inline(always)]
        fn call<S: $crate::splat::lanes::HasLanes $(, const $flag: u8)?>(_: S, $($arg: $ty),*) $(-> $out)? {
            $body::<S::Lanes $(, $flag)?>($($arg),*)
        }
        $crate::simd::dispatch!($isa, fn call $(<; const $flag: u8>)? ($($arg: $ty),*) $(-> $out)?)
    }};
}
pub(super) use by_level;

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
pub(super) use three;

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
pub(super) use four;

/// Runs instructions of the level that the surrounding type stands for.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! instructions {
    ($e:expr) => {
        // SAFETY: the types of a level are named only by `by_level`, in functions that run only where the processor has the level.
        // What is loaded or stored is a slice whose length is checked before.
        unsafe { $e }
    };
}
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
pub(super) use instructions;

/// Methods of two arguments that are one instruction each.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! binary {
    ($($name:ident: $instruction:ident),* $(,)?) => {
        $(#[inline(always)]
        fn $name(self, other: Self) -> Self {
            Self(instructions!($instruction(self.0, other.0)))
        })*
    };
}
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
pub(super) use binary;

/// By Horner's rule, the highest coefficient first.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
#[inline(always)]
pub(super) fn polynomial<L: Lanes>(x: L, coefficients: &[f32; 5]) -> L {
    let mut p = L::splat(coefficients[0]);
    for c in &coefficients[1..] {
        p = p.mul_add(x, L::splat(*c));
    }
    p
}

/// The ellipse that key `i` numbers, or the last key.
#[inline(always)]
pub(super) fn numbered(keys: &[u64], i: usize) -> usize {
    keys[i.min(keys.len() - 1)] as u32 as usize
}
