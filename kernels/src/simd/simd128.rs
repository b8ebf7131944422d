//! WebAssembly's SIMD, for modules that are compiled with it: four lanes.
//!
//! A module cannot ask what its machine has, so there is nothing to detect. Floats are as those of [`super::scalar`] to
//! the bit: there is no multiplication with addition in one rounding.

use std::arch::wasm32::*;

use bytemuck::must_cast;
use half::f16;

use super::macros::{five, four, methods, operators};
use super::scalar::{DENORMAL, REBIAS};
use super::vector::{
    EXP2, F16_MAX, F32Vector, F64Vector, FIRST, I16Vector, I32Vector, LEAST_EXPONENT, MaskVector, ROUND, Simd, first,
    first_mut, polynomial, sealed,
};

/// What every machine has that runs a module with SIMD.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Simd128(());

impl Simd128 {
    /// The token: the module would not run without SIMD.
    pub(crate) fn new() -> Option<Self> {
        Some(Self(()))
    }
}

impl sealed::Sealed for Simd128 {}

impl Simd for Simd128 {
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

/// Compiles a function with SIMD.
macro_rules! with_simd128 {
    ($($item:tt)*) => {
        #[target_feature(enable = "simd128")]
        $($item)*
    };
}
pub(crate) use with_simd128;

/// Four f32.
#[derive(Clone, Copy)]
pub struct F32x4(v128);

/// Four f64.
#[derive(Clone, Copy)]
pub struct F64x4(v128, v128);

/// Four i32.
#[derive(Clone, Copy)]
pub struct I32x4(v128);

/// Eight i16.
#[derive(Clone, Copy)]
pub struct I16x8(v128);

/// Four truth values, all bits of each lane equal.
#[derive(Clone, Copy)]
pub struct Mask4(v128);

operators!(F32x4: Add::add = f32x4_add, Sub::sub = f32x4_sub, Mul::mul = f32x4_mul, Div::div = f32x4_div);
operators!(
    I32x4: Add::add = i32x4_add, Sub::sub = i32x4_sub, Mul::mul = i32x4_mul, BitAnd::bitand = v128_and,
    BitOr::bitor = v128_or,
);
operators!(I16x8: Add::add = i16x8_add, Sub::sub = i16x8_sub);

methods! { with_simd128 F32x4: F32Vector<Simd128> {
    fn splat(_simd: Simd128, x: f32) -> Self {
        F32x4(f32x4_splat(x))
    }

    fn load(_simd: Simd128, from: &[f32]) -> Self {
        F32x4(must_cast(*first::<f32, 4>(from)))
    }

    fn store(self, to: &mut [f32]) {
        *first_mut::<f32, 4>(to) = must_cast(self.0);
    }

    fn load_f16(_simd: Simd128, from: &[f16]) -> Self {
        F32x4(widen(u32x4_extend_low_u16x8(low_half(must_cast(*first::<f16, 4>(from))))))
    }

    fn store_f16(self, to: &mut [f16]) {
        let [half, _]: [u64; 2] = must_cast(u16x8_narrow_i32x4(narrow(self.0), u32x4_splat(0)));
        *first_mut::<f16, 4>(to) = must_cast(half);
    }

    fn load_deinterleaved3(_simd: Simd128, from: &[[f32; 3]]) -> [Self; 3] {
        let from: &[f32; 12] = first(first::<_, 4>(from).as_flattened());
        let [a, b, c]: [v128; 3] = must_cast(*from);
        [
            F32x4(i32x4_shuffle::<0, 1, 2, 5>(i32x4_shuffle::<0, 3, 6, 6>(a, b), c)),
            F32x4(i32x4_shuffle::<0, 1, 2, 6>(i32x4_shuffle::<1, 4, 7, 7>(a, b), c)),
            F32x4(i32x4_shuffle::<0, 1, 4, 7>(i32x4_shuffle::<2, 5, 5, 5>(a, b), c)),
        ]
    }

    fn load_deinterleaved4(_simd: Simd128, from: &[[f32; 4]]) -> [Self; 4] {
        let from: &[_; 4] = first(from);
        transpose4(four!(i => F32x4(must_cast(from[i]))))
    }

    fn load_records(_simd: Simd128, records: &[&[f32; 16]]) -> [Self; 16] {
        let records: &[&[f32; 16]; 4] = first(records);
        let mut fields = [F32x4(f32x4_splat(0.0)); 16];
        for q in 0..4 {
            let columns = transpose4(four!(i => F32x4(must_cast(*first::<f32, 4>(&records[i][4 * q..])))));
            for k in 0..4 {
                fields[4 * q + k] = columns[k];
            }
        }
        fields
    }

    fn store_records(fields: &[Self; 16], which: u32, to: &mut [[f32; 16]]) -> usize {
        let quarters: [[F32x4; 4]; 4] = four!(q => transpose4(four!(k => fields[4 * q + k])));
        let mut kept = 0;
        for lane in (0..4).filter(|lane| which >> lane & 1 == 1) {
            let record = &mut to[kept];
            for q in 0..4 {
                *first_mut::<f32, 4>(&mut record[4 * q..]) = must_cast(quarters[q][lane].0);
            }
            kept += 1;
        }
        kept
    }

    fn mul_add(self, factor: Self, term: Self) -> Self {
        F32x4(f32x4_add(f32x4_mul(self.0, factor.0), term.0))
    }

    fn neg_mul_add(self, factor: Self, term: Self) -> Self {
        F32x4(f32x4_sub(term.0, f32x4_mul(self.0, factor.0)))
    }

    fn sqrt(self) -> Self {
        F32x4(f32x4_sqrt(self.0))
    }

    fn abs(self) -> Self {
        F32x4(f32x4_abs(self.0))
    }

    fn min(self, other: Self) -> Self {
        // `pmin(a, b)` is `b < a ? b : a`.
        F32x4(f32x4_pmin(other.0, self.0))
    }

    fn max(self, other: Self) -> Self {
        // `pmax(a, b)` is `a < b ? b : a`.
        F32x4(f32x4_pmax(other.0, self.0))
    }

    fn ceil(self) -> Self {
        F32x4(f32x4_ceil(self.0))
    }

    fn floor(self) -> Self {
        F32x4(f32x4_floor(self.0))
    }

    fn lt(self, other: Self) -> Mask4 {
        Mask4(f32x4_lt(self.0, other.0))
    }

    fn le(self, other: Self) -> Mask4 {
        Mask4(f32x4_le(self.0, other.0))
    }

    fn ordered(self, other: Self) -> Mask4 {
        Mask4(v128_and(f32x4_eq(self.0, self.0), f32x4_eq(other.0, other.0)))
    }

    fn select(mask: Mask4, yes: Self, no: Self) -> Self {
        F32x4(v128_bitselect(yes.0, no.0, mask.0))
    }

    fn keep(self, mask: Mask4) -> Self {
        F32x4(v128_and(self.0, mask.0))
    }

    fn exp2(self) -> Self {
        let round = F32x4(f32x4_splat(ROUND));
        let x = F32x4(f32x4_pmax(f32x4_splat(LEAST_EXPONENT), self.0));
        let shifted = x + round;
        let p = polynomial::<Simd128>(x - (shifted - round), five!(i => F32x4(f32x4_splat(EXP2[i]))));
        F32x4(i32x4_add(p.0, i32x4_shl(shifted.0, 23)))
    }

    fn split_exponent(self) -> (Self, Self) {
        let mantissa = v128_or(v128_and(self.0, u32x4_splat(0x007f_ffff)), f32x4_splat(1.0));
        let exponent = i32x4_sub(u32x4_shr(self.0, 23), i32x4_splat(127));
        (F32x4(mantissa), F32x4(f32x4_convert_i32x4(exponent)))
    }

    fn round_to_i32(self) -> I32x4 {
        I32x4(i32x4_trunc_sat_f32x4(f32x4_nearest(self.0)))
    }

    fn truncate_to_i32(self) -> I32x4 {
        I32x4(i32x4_trunc_sat_f32x4(self.0))
    }

    fn to_bits(self) -> I32x4 {
        I32x4(self.0)
    }

    fn compress(self, which: u32) -> Self {
        F32x4(i8x16_swizzle(self.0, must_cast(FIRST[which as usize % FIRST.len()])))
    }
}}

methods! { with_simd128 F64x4: F64Vector<Simd128> {
    fn splat(_simd: Simd128, x: f64) -> Self {
        F64x4(f64x2_splat(x), f64x2_splat(x))
    }

    fn from_f32(x: F32x4) -> Self {
        let high = i64x2_shuffle::<1, 1>(x.0, x.0);
        F64x4(f64x2_promote_low_f32x4(x.0), f64x2_promote_low_f32x4(high))
    }

    fn to_f32(self) -> F32x4 {
        let (low, high) = (f32x4_demote_f64x2_zero(self.0), f32x4_demote_f64x2_zero(self.1));
        F32x4(i64x2_shuffle::<0, 2>(low, high))
    }

    fn mul_add(self, factor: Self, term: Self) -> Self {
        F64x4(
            f64x2_add(f64x2_mul(self.0, factor.0), term.0),
            f64x2_add(f64x2_mul(self.1, factor.1), term.1),
        )
    }

    fn min(self, other: Self) -> Self {
        F64x4(f64x2_pmin(other.0, self.0), f64x2_pmin(other.1, self.1))
    }

    fn max(self, other: Self) -> Self {
        F64x4(f64x2_pmax(other.0, self.0), f64x2_pmax(other.1, self.1))
    }

    fn lt(self, other: Self) -> Mask4 {
        let (low, high) = (f64x2_lt(self.0, other.0), f64x2_lt(self.1, other.1));
        Mask4(i32x4_shuffle::<0, 2, 4, 6>(low, high))
    }
}}

methods! { with_simd128 F64x4: std::ops::Mul {
    type Output = Self;

    fn mul(self, other: Self) -> Self {
        F64x4(f64x2_mul(self.0, other.0), f64x2_mul(self.1, other.1))
    }
}}

methods! { with_simd128 F64x4: std::ops::Div {
    type Output = Self;

    fn div(self, other: Self) -> Self {
        F64x4(f64x2_div(self.0, other.0), f64x2_div(self.1, other.1))
    }
}}

methods! { with_simd128 I32x4: I32Vector<Simd128> {
    fn splat(_simd: Simd128, x: i32) -> Self {
        I32x4(i32x4_splat(x))
    }

    fn load(_simd: Simd128, from: &[i32]) -> Self {
        I32x4(must_cast(*first::<i32, 4>(from)))
    }

    fn store(self, to: &mut [i32]) {
        *first_mut::<i32, 4>(to) = must_cast(self.0);
    }

    fn load_i16(_simd: Simd128, from: &[i16]) -> Self {
        I32x4(i32x4_extend_low_i16x8(low_half(must_cast(*first::<i16, 4>(from)))))
    }

    fn store_i16(self, to: &mut [i16]) {
        let [half, _]: [u64; 2] = must_cast(i16x8_narrow_i32x4(self.0, self.0));
        *first_mut::<i16, 4>(to) = must_cast(half);
    }

    fn min(self, other: Self) -> Self {
        I32x4(i32x4_min(self.0, other.0))
    }

    fn max(self, other: Self) -> Self {
        I32x4(i32x4_max(self.0, other.0))
    }

    fn min_unsigned(self, other: Self) -> Self {
        I32x4(u32x4_min(self.0, other.0))
    }

    fn abs(self) -> Self {
        I32x4(i32x4_abs(self.0))
    }

    fn shl(self, count: u32) -> Self {
        I32x4(i32x4_shl(self.0, count))
    }

    fn shr(self, count: u32) -> Self {
        I32x4(i32x4_shr(self.0, count))
    }

    fn shr_unsigned(self, count: u32) -> Self {
        I32x4(u32x4_shr(self.0, count))
    }

    fn shr_each(self, count: Self) -> Self {
        let (lanes, counts): ([i32; 4], [u32; 4]) = (must_cast(self.0), must_cast(count.0));
        I32x4(must_cast(four!(i => lanes[i].wrapping_shr(counts[i]))))
    }

    fn eq(self, other: Self) -> Mask4 {
        Mask4(i32x4_eq(self.0, other.0))
    }

    fn lt(self, other: Self) -> Mask4 {
        Mask4(i32x4_lt(self.0, other.0))
    }

    fn select(mask: Mask4, yes: Self, no: Self) -> Self {
        I32x4(v128_bitselect(yes.0, no.0, mask.0))
    }

    fn keep(self, mask: Mask4) -> Self {
        I32x4(v128_and(self.0, mask.0))
    }

    fn sum(self) -> i32 {
        let pairs = i32x4_add(self.0, i64x2_shuffle::<1, 0>(self.0, self.0));
        i32x4_extract_lane::<0>(pairs).wrapping_add(i32x4_extract_lane::<1>(pairs))
    }

    fn dot_pairs(self, a: I16x8, b: I16x8) -> Self {
        I32x4(i32x4_add(self.0, i32x4_dot_i16x8(a.0, b.0)))
    }

    fn to_f32(self) -> F32x4 {
        F32x4(f32x4_convert_i32x4(self.0))
    }

    fn as_f32(self) -> F32x4 {
        F32x4(self.0)
    }

    fn as_i16(self) -> I16x8 {
        I16x8(self.0)
    }
}}

methods! { with_simd128 I16x8: I16Vector<Simd128> {
    fn splat(_simd: Simd128, x: i16) -> Self {
        I16x8(i16x8_splat(x))
    }

    fn load(_simd: Simd128, from: &[i16]) -> Self {
        I16x8(must_cast(*first::<i16, 8>(from)))
    }

    fn store(self, to: &mut [i16]) {
        *first_mut::<i16, 8>(to) = must_cast(self.0);
    }

    fn load_i8(_simd: Simd128, from: &[i8]) -> Self {
        I16x8(i16x8_extend_low_i8x16(low_half(must_cast(*first::<i8, 8>(from)))))
    }

    fn saturating_add(self, other: Self) -> Self {
        I16x8(i16x8_add_sat(self.0, other.0))
    }

    fn min(self, other: Self) -> Self {
        I16x8(i16x8_min(self.0, other.0))
    }

    fn max(self, other: Self) -> Self {
        I16x8(i16x8_max(self.0, other.0))
    }

    fn mul_high(self, other: Self) -> Self {
        let low = i32x4_extmul_low_i16x8(self.0, other.0);
        let high = i32x4_extmul_high_i16x8(self.0, other.0);
        I16x8(i16x8_shuffle::<1, 3, 5, 7, 9, 11, 13, 15>(low, high))
    }

    fn shr(self, count: u32) -> Self {
        I16x8(i16x8_shr(self.0, count))
    }

    fn as_i32(self) -> I32x4 {
        I32x4(self.0)
    }
}}

methods! { with_simd128 Mask4: MaskVector {
    fn and(self, other: Self) -> Self {
        Mask4(v128_and(self.0, other.0))
    }

    fn bits(self) -> u32 {
        i32x4_bitmask(self.0).into()
    }
}}

with_simd128! {
    /// Vector `k` of the result holds element `k` of each of the four.
    #[inline]
    fn transpose4([a, b, c, d]: [F32x4; 4]) -> [F32x4; 4] {
        let ab_low = i32x4_shuffle::<0, 4, 1, 5>(a.0, b.0);
        let ab_high = i32x4_shuffle::<2, 6, 3, 7>(a.0, b.0);
        let cd_low = i32x4_shuffle::<0, 4, 1, 5>(c.0, d.0);
        let cd_high = i32x4_shuffle::<2, 6, 3, 7>(c.0, d.0);
        [
            F32x4(i64x2_shuffle::<0, 2>(ab_low, cd_low)),
            F32x4(i64x2_shuffle::<1, 3>(ab_low, cd_low)),
            F32x4(i64x2_shuffle::<0, 2>(ab_high, cd_high)),
            F32x4(i64x2_shuffle::<1, 3>(ab_high, cd_high)),
        ]
    }
}

with_simd128! {
    /// Eight bytes in the lower half of a vector.
    #[inline]
    fn low_half(bytes: u64) -> v128 {
        u64x2_replace_lane::<0>(u64x2_splat(0), bytes)
    }
}

with_simd128! {
    /// As the function of this name in [`super::scalar`], whose comments say why.
    #[inline]
    fn widen(bits: v128) -> v128 {
        let (most, rebias, implied) = (u32x4_splat(0x1f << 23), u32x4_splat(REBIAS), u32x4_splat(1 << 23));
        let magnitude = i32x4_shl(v128_and(bits, u32x4_splat(0x7fff)), 13);
        let sign = i32x4_shl(v128_and(bits, u32x4_splat(0x8000)), 16);
        let exponent = v128_and(magnitude, most);
        let rebased = i32x4_add(magnitude, rebias);
        let normal = i32x4_add(rebased, v128_and(i32x4_eq(exponent, most), rebias));
        let subnormal = f32x4_sub(i32x4_add(rebased, implied), i32x4_add(rebias, implied));
        let value = v128_bitselect(subnormal, normal, i32x4_eq(exponent, u32x4_splat(0)));
        v128_or(value, sign)
    }
}

with_simd128! {
    /// As the function of this name in [`super::scalar`], whose comments say why; in 32 bits.
    #[inline]
    fn narrow(from: v128) -> v128 {
        let (rebias, denormal) = (u32x4_splat(REBIAS), u32x4_splat(DENORMAL));
        // `pmax(a, b)` is `a < b ? b : a`: the bound if `from` is NaN.
        let value = f32x4_pmin(f32x4_splat(F16_MAX), f32x4_pmax(f32x4_splat(-F16_MAX), from));
        let sign = v128_and(u32x4_shr(value, 16), u32x4_splat(0x8000));
        let bits = v128_and(value, u32x4_splat(0x7fff_ffff));
        let even = i32x4_add(u32x4_splat(0xfff), v128_and(u32x4_shr(bits, 13), u32x4_splat(1)));
        let normal = u32x4_shr(i32x4_add(i32x4_sub(bits, u32x4_min(rebias, bits)), even), 13);
        let subnormal = i32x4_sub(f32x4_add(bits, denormal), denormal);
        let small = u32x4_lt(bits, i32x4_add(rebias, u32x4_splat(1 << 23)));
        v128_or(v128_bitselect(subnormal, normal, small), sign)
    }
}
