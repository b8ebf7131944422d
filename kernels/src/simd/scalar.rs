//! Portable Rust, four lanes at a time: what every processor of the target has, and the reference of the other sets.

use std::ops::{Add, BitAnd, BitOr, Div, Mul, Sub};

use half::f16;

use super::macros::{four, three};
use super::vector::{
    EXP2, F16_MAX, F32Vector, F64Vector, I16Vector, I32Vector, LEAST_EXPONENT, MaskVector, ROUND, Simd, first,
    first_mut, sealed,
};

/// What every processor of the target has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Scalar(());

impl Scalar {
    /// The token: there is nothing to prove.
    pub const TOKEN: Scalar = Scalar(());

    /// The token, as the other sets give theirs.
    pub(crate) fn new() -> Option<Self> {
        Some(Self::TOKEN)
    }
}

impl sealed::Sealed for Scalar {}

impl Simd for Scalar {
    const LANES: usize = 4;
    type F32 = F32x4;
    type F64 = F64x4;
    type I32 = I32x4;
    type I16 = I16x8;
    type Mask = Mask4;
    type Narrow = Self;

    #[inline(always)]
    fn narrow(self) -> Self {
        self
    }
}

/// Compiles a function as it is, apart from what calls it.
macro_rules! with_scalar {
    ($($item:tt)*) => {
        #[inline(never)]
        $($item)*
    };
}
pub(crate) use with_scalar;

/// Four f32.
#[derive(Clone, Copy)]
#[repr(align(16))]
pub struct F32x4([f32; 4]);

/// Four f64.
#[derive(Clone, Copy)]
pub struct F64x4([f64; 4]);

/// Four i32.
#[derive(Clone, Copy)]
#[repr(align(16))]
pub struct I32x4([i32; 4]);

/// Eight i16.
#[derive(Clone, Copy)]
#[repr(align(16))]
pub struct I16x8([i16; 8]);

/// Four truth values.
#[derive(Clone, Copy)]
pub struct Mask4([bool; 4]);

/// `[$e; 8]` with `$i` counting.
macro_rules! eight {
    ($i:ident => $e:expr) => {{
        let mut all = [Default::default(); 8];
        let mut $i = 0;
        while $i < 8 {
            all[$i] = $e;
            $i += 1;
        }
        all
    }};
}

/// Operators that apply `$f` to each lane.
macro_rules! lanewise {
    ($vector:ident, $lanes:ident: $($operator:ident::$name:ident = $f:expr),* $(,)?) => {
        $(impl $operator for $vector {
            type Output = Self;

            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                $vector($lanes!(i => $f(self.0[i], other.0[i])))
            }
        })*
    };
}

lanewise!(F32x4, four: Add::add = |a, b| a + b, Sub::sub = |a, b| a - b, Mul::mul = |a, b| a * b, Div::div = |a, b| a / b);
lanewise!(F64x4, four: Mul::mul = |a, b| a * b, Div::div = |a, b| a / b);
lanewise!(
    I32x4, four: Add::add = i32::wrapping_add, Sub::sub = i32::wrapping_sub, Mul::mul = i32::wrapping_mul,
    BitAnd::bitand = |a, b| a & b, BitOr::bitor = |a, b| a | b,
);
lanewise!(I16x8, eight: Add::add = i16::wrapping_add, Sub::sub = i16::wrapping_sub);

impl F32x4 {
    #[inline(always)]
    fn each(self, f: impl Fn(f32) -> f32) -> Self {
        F32x4(four!(i => f(self.0[i])))
    }

    #[inline(always)]
    fn both(self, other: Self, f: impl Fn(f32, f32) -> f32) -> Self {
        F32x4(four!(i => f(self.0[i], other.0[i])))
    }

    #[inline(always)]
    fn compare(self, other: Self, f: impl Fn(f32, f32) -> bool) -> Mask4 {
        Mask4(four!(i => f(self.0[i], other.0[i])))
    }
}

impl F32Vector<Scalar> for F32x4 {
    #[inline(always)]
    fn splat(_: Scalar, x: f32) -> Self {
        F32x4([x; 4])
    }

    #[inline(always)]
    fn load(_: Scalar, from: &[f32]) -> Self {
        F32x4(*first(from))
    }

    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        *first_mut(to) = self.0;
    }

    #[inline(always)]
    fn load_f16(_: Scalar, from: &[f16]) -> Self {
        let from: &[f16; 4] = first(from);
        F32x4(four!(i => widen(from[i])))
    }

    #[inline(always)]
    fn store_f16(self, to: &mut [f16]) {
        *first_mut(to) = four!(i => narrow(self.0[i]));
    }

    #[inline(always)]
    fn load_deinterleaved3(_: Scalar, from: &[[f32; 3]]) -> [Self; 3] {
        let from: &[_; 4] = first(from);
        three!(k => F32x4(four!(i => from[i][k])))
    }

    #[inline(always)]
    fn load_deinterleaved4(_: Scalar, from: &[[f32; 4]]) -> [Self; 4] {
        let from: &[_; 4] = first(from);
        four!(k => F32x4(four!(i => from[i][k])))
    }

    #[inline(always)]
    fn load_records(_: Scalar, records: &[&[f32; 16]]) -> [Self; 16] {
        let records: &[_; 4] = first(records);
        let mut fields = [F32x4([0.0; 4]); 16];
        for (k, field) in fields.iter_mut().enumerate() {
            *field = F32x4(four!(i => records[i][k]));
        }
        fields
    }

    #[inline(always)]
    fn store_records(fields: &[Self; 16], which: u32, to: &mut [[f32; 16]]) -> usize {
        let mut kept = 0;
        for lane in (0..4).filter(|lane| which >> lane & 1 == 1) {
            to[kept] = std::array::from_fn(|k| fields[k].0[lane]);
            kept += 1;
        }
        kept
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        self * factor + term
    }

    #[inline(always)]
    fn neg_mul_add(self, factor: Self, term: Self) -> Self {
        term - self * factor
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        self.each(f32::sqrt)
    }

    #[inline(always)]
    fn abs(self) -> Self {
        self.each(f32::abs)
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.both(other, |a, b| if a < b { a } else { b })
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.both(other, |a, b| if a > b { a } else { b })
    }

    // By hand: without SSE 4.1 `ceil` and `floor` are calls.
    #[inline(always)]
    fn ceil(self) -> Self {
        self.each(|x| {
            let whole = x as i32 as f32;
            if whole < x { whole + 1.0 } else { whole }
        })
    }

    #[inline(always)]
    fn floor(self) -> Self {
        self.each(|x| {
            let whole = x as i32 as f32;
            if whole > x { whole - 1.0 } else { whole }
        })
    }

    #[inline(always)]
    fn lt(self, other: Self) -> Mask4 {
        self.compare(other, |a, b| a < b)
    }

    #[inline(always)]
    fn le(self, other: Self) -> Mask4 {
        self.compare(other, |a, b| a <= b)
    }

    #[inline(always)]
    fn ordered(self, other: Self) -> Mask4 {
        self.compare(other, |a, b| !a.is_nan() & !b.is_nan())
    }

    #[inline(always)]
    fn select(mask: Mask4, yes: Self, no: Self) -> Self {
        F32x4(four!(i => if mask.0[i] { yes.0[i] } else { no.0[i] }))
    }

    #[inline(always)]
    fn keep(self, mask: Mask4) -> Self {
        Self::select(mask, self, F32x4([0.0; 4]))
    }

    #[inline(always)]
    fn exp2(self) -> Self {
        self.each(|x| {
            let x = if x > LEAST_EXPONENT { x } else { LEAST_EXPONENT };
            let shifted = x + ROUND;
            let f = x - (shifted - ROUND);
            let [a, b, c, d, e] = EXP2;
            let p = (((a * f + b) * f + c) * f + d) * f + e;
            f32::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 23))
        })
    }

    #[inline(always)]
    fn split_exponent(self) -> (Self, Self) {
        let one = 1.0f32.to_bits();
        let mantissa = self.each(|x| f32::from_bits(x.to_bits() & 0x007f_ffff | one));
        let exponent = self.each(|x| ((x.to_bits() >> 23) as i32 - 127) as f32);
        (mantissa, exponent)
    }

    #[inline(always)]
    fn round_to_i32(self) -> I32x4 {
        I32x4(four!(i => self.0[i].round_ties_even() as i32))
    }

    #[inline(always)]
    fn truncate_to_i32(self) -> I32x4 {
        I32x4(four!(i => self.0[i] as i32))
    }

    #[inline(always)]
    fn to_bits(self) -> I32x4 {
        I32x4(four!(i => self.0[i].to_bits() as i32))
    }

    #[inline(always)]
    fn compress(self, which: u32) -> Self {
        // Each lane is written where the next kept lane will be: no branch.
        let (mut first, mut kept) = ([0.0; 4], 0);
        for lane in 0..4 {
            first[kept % 4] = self.0[lane];
            kept += (which >> lane) as usize & 1;
        }
        F32x4(first)
    }
}

impl F64Vector<Scalar> for F64x4 {
    #[inline(always)]
    fn splat(_: Scalar, x: f64) -> Self {
        F64x4([x; 4])
    }

    #[inline(always)]
    fn from_f32(x: F32x4) -> Self {
        F64x4(four!(i => f64::from(x.0[i])))
    }

    #[inline(always)]
    fn to_f32(self) -> F32x4 {
        F32x4(four!(i => self.0[i] as f32))
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        F64x4(four!(i => self.0[i] * factor.0[i] + term.0[i]))
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        F64x4(four!(i => if self.0[i] < other.0[i] { self.0[i] } else { other.0[i] }))
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        F64x4(four!(i => if self.0[i] > other.0[i] { self.0[i] } else { other.0[i] }))
    }

    #[inline(always)]
    fn lt(self, other: Self) -> Mask4 {
        Mask4(four!(i => self.0[i] < other.0[i]))
    }
}

impl I32x4 {
    #[inline(always)]
    fn each(self, f: impl Fn(i32) -> i32) -> Self {
        I32x4(four!(i => f(self.0[i])))
    }

    #[inline(always)]
    fn both(self, other: Self, f: impl Fn(i32, i32) -> i32) -> Self {
        I32x4(four!(i => f(self.0[i], other.0[i])))
    }
}

impl I32Vector<Scalar> for I32x4 {
    #[inline(always)]
    fn splat(_: Scalar, x: i32) -> Self {
        I32x4([x; 4])
    }

    #[inline(always)]
    fn load(_: Scalar, from: &[i32]) -> Self {
        I32x4(*first(from))
    }

    #[inline(always)]
    fn store(self, to: &mut [i32]) {
        *first_mut(to) = self.0;
    }

    #[inline(always)]
    fn load_i16(_: Scalar, from: &[i16]) -> Self {
        let from: &[i16; 4] = first(from);
        I32x4(four!(i => from[i].into()))
    }

    #[inline(always)]
    fn store_i16(self, to: &mut [i16]) {
        *first_mut(to) = four!(i => self.0[i].clamp(i16::MIN.into(), i16::MAX.into()) as i16);
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.both(other, Ord::min)
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.both(other, Ord::max)
    }

    #[inline(always)]
    fn min_unsigned(self, other: Self) -> Self {
        self.both(other, |a, b| (a as u32).min(b as u32) as i32)
    }

    #[inline(always)]
    fn abs(self) -> Self {
        self.each(i32::wrapping_abs)
    }

    #[inline(always)]
    fn shl(self, count: u32) -> Self {
        self.each(|a| a.wrapping_shl(count))
    }

    #[inline(always)]
    fn shr(self, count: u32) -> Self {
        self.each(|a| a.wrapping_shr(count))
    }

    #[inline(always)]
    fn shr_unsigned(self, count: u32) -> Self {
        self.each(|a| (a as u32).wrapping_shr(count) as i32)
    }

    #[inline(always)]
    fn shr_each(self, count: Self) -> Self {
        self.both(count, |a, count| a.wrapping_shr(count as u32))
    }

    #[inline(always)]
    fn eq(self, other: Self) -> Mask4 {
        Mask4(four!(i => self.0[i] == other.0[i]))
    }

    #[inline(always)]
    fn lt(self, other: Self) -> Mask4 {
        Mask4(four!(i => self.0[i] < other.0[i]))
    }

    #[inline(always)]
    fn select(mask: Mask4, yes: Self, no: Self) -> Self {
        I32x4(four!(i => if mask.0[i] { yes.0[i] } else { no.0[i] }))
    }

    #[inline(always)]
    fn keep(self, mask: Mask4) -> Self {
        Self::select(mask, self, I32x4([0; 4]))
    }

    #[inline(always)]
    fn sum(self) -> i32 {
        let [a, b, c, d] = self.0;
        a.wrapping_add(b).wrapping_add(c.wrapping_add(d))
    }

    #[inline(always)]
    fn dot_pairs(self, a: I16x8, b: I16x8) -> Self {
        self + dot_pairs(a, b)
    }

    #[inline(always)]
    fn to_f32(self) -> F32x4 {
        F32x4(four!(i => self.0[i] as f32))
    }

    #[inline(always)]
    fn as_f32(self) -> F32x4 {
        F32x4(four!(i => f32::from_bits(self.0[i] as u32)))
    }

    #[inline(always)]
    fn as_i16(self) -> I16x8 {
        I16x8(bytemuck::must_cast(self.0))
    }
}

/// `a₀·b₀ + a₁·b₁` in each lane.
#[cfg(not(all(target_arch = "x86_64", target_feature = "sse2")))]
#[inline(always)]
fn dot_pairs(a: I16x8, b: I16x8) -> I32x4 {
    let product = |i: usize| i32::from(a.0[i]) * i32::from(b.0[i]);
    I32x4(four!(i => product(2 * i).wrapping_add(product(2 * i + 1))))
}

/// `a₀·b₀ + a₁·b₁` in each lane: compilers do not always find the instruction by themselves.
#[cfg(all(target_arch = "x86_64", target_feature = "sse2"))]
#[inline(always)]
fn dot_pairs(a: I16x8, b: I16x8) -> I32x4 {
    use bytemuck::must_cast;
    // SAFETY: the target has SSE2.
    I32x4(must_cast(unsafe {
        std::arch::x86_64::_mm_madd_epi16(must_cast(a.0), must_cast(b.0))
    }))
}

impl I16x8 {
    #[inline(always)]
    fn both(self, other: Self, f: impl Fn(i16, i16) -> i16) -> Self {
        I16x8(eight!(i => f(self.0[i], other.0[i])))
    }
}

impl I16Vector<Scalar> for I16x8 {
    #[inline(always)]
    fn splat(_: Scalar, x: i16) -> Self {
        I16x8([x; 8])
    }

    #[inline(always)]
    fn load(_: Scalar, from: &[i16]) -> Self {
        I16x8(*first(from))
    }

    #[inline(always)]
    fn store(self, to: &mut [i16]) {
        *first_mut(to) = self.0;
    }

    #[inline(always)]
    fn load_i8(_: Scalar, from: &[i8]) -> Self {
        let from: &[i8; 8] = first(from);
        I16x8(eight!(i => from[i].into()))
    }

    #[inline(always)]
    fn saturating_add(self, other: Self) -> Self {
        self.both(other, i16::saturating_add)
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.both(other, Ord::min)
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.both(other, Ord::max)
    }

    #[inline(always)]
    fn mul_high(self, other: Self) -> Self {
        self.both(other, |a, b| ((i32::from(a) * i32::from(b)) >> 16) as i16)
    }

    #[inline(always)]
    fn shr(self, count: u32) -> Self {
        I16x8(eight!(i => self.0[i].wrapping_shr(count)))
    }

    #[inline(always)]
    fn as_i32(self) -> I32x4 {
        I32x4(bytemuck::must_cast(self.0))
    }
}

impl MaskVector for Mask4 {
    #[inline(always)]
    fn and(self, other: Self) -> Self {
        Mask4(four!(i => self.0[i] & other.0[i]))
    }

    #[inline(always)]
    fn bits(self) -> u32 {
        (0..4).map(|i| u32::from(self.0[i]) << i).sum()
    }
}

/// The difference of the exponent biases of f32 and f16, where an f32 has its exponent.
pub(super) const REBIAS: u32 = (127 - 15) << 23;
/// The f32 whose last mantissa bit weighs as much as the smallest f16.
pub(super) const DENORMAL: u32 = (127 - 15 + 23 - 10 + 1) << 23;

/// An f16 as f32, exactly.
#[inline(always)]
fn widen(from: f16) -> f32 {
    let bits = u32::from(from.to_bits());
    let magnitude = (bits & 0x7fff) << 13;
    let sign = (bits & 0x8000) << 16;
    let exponent = magnitude & (0x1f << 23);
    // Infinity and NaN keep the largest exponent: it moves up by the rest of the way.
    let normal = magnitude + REBIAS + if exponent == 0x1f << 23 { REBIAS } else { 0 };
    // A subnormal's mantissa is read as a normal number's, and the implied one taken off again.
    let subnormal = f32::from_bits(magnitude + REBIAS + (1 << 23)) - f32::from_bits(REBIAS + (1 << 23));
    let value = if exponent == 0 { subnormal.to_bits() } else { normal };
    f32::from_bits(value | sign)
}

/// The nearest f16, ties to even, within ±65504; −65504 for NaN.
#[inline(always)]
#[expect(
    clippy::manual_clamp,
    reason = "`max` gives the number of a number and NaN, `clamp` keeps NaN"
)]
fn narrow(from: f32) -> f16 {
    let value = from.max(-F16_MAX).min(F16_MAX);
    let sign = (value.to_bits() >> 16) & 0x8000;
    let bits = value.to_bits() & 0x7fff_ffff;
    // Adding half an even step less one rounds to nearest; the parity of the kept mantissa breaks ties to even.
    let normal = (bits - REBIAS.min(bits) + 0xfff + ((bits >> 13) & 1)) >> 13;
    // The floating-point adder rounds at the weight of the smallest f16.
    let subnormal = (f32::from_bits(bits) + f32::from_bits(DENORMAL))
        .to_bits()
        .wrapping_sub(DENORMAL);
    let magnitude = if bits < REBIAS + (1 << 23) { subnormal } else { normal };
    f16::from_bits((magnitude | sign) as u16)
}
