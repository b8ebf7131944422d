//! AVX2 with FMA and F16C: eight lanes.

use std::arch::x86_64::*;

use bytemuck::must_cast;
use half::f16;

use super::macros::{define_set, five, four, methods, operators, vectorize};
use super::vector::{
    EXP2, F16_MAX, F32Vector, F64Vector, I16Vector, I32Vector, LEAST_EXPONENT, MaskVector, ROUND, Simd, first,
    first_mut, polynomial, sealed,
};

define_set! { $ with_avx2, is_x86_feature_detected,
    /// Proof of AVX2, and of what all processors with AVX2 have besides.
    pub struct Avx2 = "avx2", "fma", "f16c", "bmi1", "bmi2", "popcnt", "lzcnt";
}

define_set! { $ with_avx_vnni, is_x86_feature_detected,
    /// Proof of AVX-VNNI and AVX2.
    ///
    /// Vectors are those of [`Avx2`]: the compiler makes one instruction of [`I32Vector::dot_pairs`] by itself.
    pub(crate) struct AvxVnni = "avxvnni";
    extends avx2::Avx2, with_avx2;
}

impl sealed::Sealed for Avx2 {}

impl Simd for Avx2 {
    const LANES: usize = 8;
    type F32 = F32x8;
    type F64 = F64x8;
    type I32 = I32x8;
    type I16 = I16x16;
    type Mask = Mask8;
    type Narrow = Self;

    #[inline(always)]
    fn narrow(self) -> Self {
        self
    }
}

vectorize! { with_avx_vnni AvxVnni, base: Avx2 }

/// Eight f32.
#[derive(Clone, Copy)]
pub struct F32x8(pub(super) __m256);

/// Eight f64.
#[derive(Clone, Copy)]
pub struct F64x8(__m256d, __m256d);

/// Eight i32.
#[derive(Clone, Copy)]
pub struct I32x8(pub(super) __m256i);

/// Sixteen i16.
#[derive(Clone, Copy)]
pub struct I16x16(__m256i);

/// Eight truth values, all bits of each lane equal.
#[derive(Clone, Copy)]
pub struct Mask8(__m256);

operators!(F32x8: Add::add = _mm256_add_ps, Sub::sub = _mm256_sub_ps, Mul::mul = _mm256_mul_ps, Div::div = _mm256_div_ps);
operators!(
    I32x8: Add::add = _mm256_add_epi32, Sub::sub = _mm256_sub_epi32, Mul::mul = _mm256_mullo_epi32,
    BitAnd::bitand = _mm256_and_si256, BitOr::bitor = _mm256_or_si256,
);
operators!(I16x16: Add::add = _mm256_add_epi16, Sub::sub = _mm256_sub_epi16);

methods! { with_avx2 F32x8: F32Vector<Avx2> {
    fn splat(_simd: Avx2, x: f32) -> Self {
        F32x8(_mm256_set1_ps(x))
    }

    fn load(_simd: Avx2, from: &[f32]) -> Self {
        F32x8(must_cast(*first::<f32, 8>(from)))
    }

    fn store(self, to: &mut [f32]) {
        *first_mut::<f32, 8>(to) = must_cast(self.0);
    }

    fn load_f16(_simd: Avx2, from: &[f16]) -> Self {
        F32x8(_mm256_cvtph_ps(must_cast(*first::<f16, 8>(from))))
    }

    fn store_f16(self, to: &mut [f16]) {
        // Of a NaN and a number, the instruction gives the second.
        let value = _mm256_max_ps(self.0, _mm256_set1_ps(-F16_MAX));
        let value = _mm256_min_ps(value, _mm256_set1_ps(F16_MAX));
        *first_mut::<f16, 8>(to) = must_cast(_mm256_cvtps_ph::<_MM_FROUND_TO_NEAREST_INT>(value));
    }

    fn load_deinterleaved3(_simd: Avx2, from: &[[f32; 3]]) -> [Self; 3] {
        let [a, b, c]: [__m256; 3] = must_cast(*first::<_, 8>(from));
        // Lane `i` of vector `k` is float `3i + k`: in each of the three loads, what belongs to the vector is put in
        // its place.
        macro_rules! vector {
            ($index:expr, $from_b:literal, $from_c:literal) => {{
                let index = must_cast($index);
                let [a, b, c] = [
                    _mm256_permutevar8x32_ps(a, index),
                    _mm256_permutevar8x32_ps(b, index),
                    _mm256_permutevar8x32_ps(c, index),
                ];
                let ab = _mm256_blend_ps::<$from_b>(a, b);
                F32x8(_mm256_blend_ps::<$from_c>(ab, c))
            }};
        }
        [
            vector!([0, 3, 6, 1, 4, 7, 2, 5], 0b0011_1000, 0b1100_0000),
            vector!([1, 4, 7, 2, 5, 0, 3, 6], 0b0001_1000, 0b1110_0000),
            vector!([2, 5, 0, 3, 6, 1, 4, 7], 0b0001_1100, 0b1110_0000),
        ]
    }

    fn load_deinterleaved4(_simd: Avx2, from: &[[f32; 4]]) -> [Self; 4] {
        let quads: [__m128; 8] = must_cast(*first::<_, 8>(from));
        transpose4(four!(i => _mm256_set_m128(quads[i + 4], quads[i])))
    }

    fn load_records(_simd: Avx2, records: &[&[f32; 16]]) -> [Self; 16] {
        let records: &[&[f32; 16]; 8] = first(records);
        let mut fields = [F32x8(_mm256_setzero_ps()); 16];
        for q in 0..4 {
            let rows = four!(i => {
                let [low, high] = [records[i], records[i + 4]];
                _mm256_set_m128(
                    must_cast(*first::<f32, 4>(&high[4 * q..])),
                    must_cast(*first::<f32, 4>(&low[4 * q..])),
                )
            });
            let columns = transpose4(rows);
            for k in 0..4 {
                fields[4 * q + k] = columns[k];
            }
        }
        fields
    }

    fn store_records(fields: &[Self; 16], which: u32, to: &mut [[f32; 16]]) -> usize {
        let quarters: [[F32x8; 4]; 4] = four!(q => transpose4(four!(k => fields[4 * q + k].0)));
        let mut kept = 0;
        for lane in 0..8 {
            if which >> lane & 1 == 0 {
                continue;
            }
            let record = &mut to[kept];
            for q in 0..4 {
                let row = quarters[q][lane % 4].0;
                let half = if lane < 4 { _mm256_castps256_ps128(row) } else { _mm256_extractf128_ps::<1>(row) };
                *first_mut::<f32, 4>(&mut record[4 * q..]) = must_cast(half);
            }
            kept += 1;
        }
        kept
    }

    fn mul_add(self, factor: Self, term: Self) -> Self {
        F32x8(_mm256_fmadd_ps(self.0, factor.0, term.0))
    }

    fn neg_mul_add(self, factor: Self, term: Self) -> Self {
        F32x8(_mm256_fnmadd_ps(self.0, factor.0, term.0))
    }

    fn sqrt(self) -> Self {
        F32x8(_mm256_sqrt_ps(self.0))
    }

    fn abs(self) -> Self {
        F32x8(_mm256_andnot_ps(_mm256_set1_ps(-0.0), self.0))
    }

    fn min(self, other: Self) -> Self {
        F32x8(_mm256_min_ps(self.0, other.0))
    }

    fn max(self, other: Self) -> Self {
        F32x8(_mm256_max_ps(self.0, other.0))
    }

    fn ceil(self) -> Self {
        F32x8(_mm256_ceil_ps(self.0))
    }

    fn floor(self) -> Self {
        F32x8(_mm256_floor_ps(self.0))
    }

    fn lt(self, other: Self) -> Mask8 {
        Mask8(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0))
    }

    fn le(self, other: Self) -> Mask8 {
        Mask8(_mm256_cmp_ps::<_CMP_LE_OQ>(self.0, other.0))
    }

    fn ordered(self, other: Self) -> Mask8 {
        Mask8(_mm256_cmp_ps::<_CMP_ORD_Q>(self.0, other.0))
    }

    fn select(mask: Mask8, yes: Self, no: Self) -> Self {
        F32x8(_mm256_blendv_ps(no.0, yes.0, mask.0))
    }

    fn keep(self, mask: Mask8) -> Self {
        F32x8(_mm256_and_ps(mask.0, self.0))
    }

    fn exp2(self) -> Self {
        let round = F32x8(_mm256_set1_ps(ROUND));
        let x = F32x8(_mm256_max_ps(self.0, _mm256_set1_ps(LEAST_EXPONENT)));
        let shifted = x + round;
        let p = polynomial::<Avx2>(x - (shifted - round), five!(i => F32x8(_mm256_set1_ps(EXP2[i]))));
        let exponent = _mm256_slli_epi32::<23>(_mm256_castps_si256(shifted.0));
        F32x8(_mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(p.0), exponent)))
    }

    fn split_exponent(self) -> (Self, Self) {
        let mantissa = _mm256_and_ps(self.0, _mm256_castsi256_ps(_mm256_set1_epi32(0x007f_ffff)));
        let exponent = _mm256_srli_epi32::<23>(_mm256_castps_si256(self.0));
        let exponent = _mm256_sub_epi32(exponent, _mm256_set1_epi32(127));
        (F32x8(_mm256_or_ps(mantissa, _mm256_set1_ps(1.0))), F32x8(_mm256_cvtepi32_ps(exponent)))
    }

    fn round_to_i32(self) -> I32x8 {
        I32x8(_mm256_cvtps_epi32(self.0))
    }

    fn truncate_to_i32(self) -> I32x8 {
        I32x8(_mm256_cvttps_epi32(self.0))
    }

    fn to_bits(self) -> I32x8 {
        I32x8(_mm256_castps_si256(self.0))
    }

    fn compress(self, which: u32) -> Self {
        let order = must_cast([FIRST[which as usize % FIRST.len()], 0]);
        F32x8(_mm256_permutevar8x32_ps(self.0, _mm256_cvtepu8_epi32(order)))
    }
}}

methods! { with_avx2 F64x8: F64Vector<Avx2> {
    fn splat(_simd: Avx2, x: f64) -> Self {
        F64x8(_mm256_set1_pd(x), _mm256_set1_pd(x))
    }

    fn from_f32(x: F32x8) -> Self {
        F64x8(
            _mm256_cvtps_pd(_mm256_castps256_ps128(x.0)),
            _mm256_cvtps_pd(_mm256_extractf128_ps::<1>(x.0)),
        )
    }

    fn to_f32(self) -> F32x8 {
        F32x8(_mm256_set_m128(_mm256_cvtpd_ps(self.1), _mm256_cvtpd_ps(self.0)))
    }

    fn mul_add(self, factor: Self, term: Self) -> Self {
        F64x8(_mm256_fmadd_pd(self.0, factor.0, term.0), _mm256_fmadd_pd(self.1, factor.1, term.1))
    }

    fn min(self, other: Self) -> Self {
        F64x8(_mm256_min_pd(self.0, other.0), _mm256_min_pd(self.1, other.1))
    }

    fn max(self, other: Self) -> Self {
        F64x8(_mm256_max_pd(self.0, other.0), _mm256_max_pd(self.1, other.1))
    }

    fn lt(self, other: Self) -> Mask8 {
        let low = _mm256_cmp_pd::<_CMP_LT_OQ>(self.0, other.0);
        let high = _mm256_cmp_pd::<_CMP_LT_OQ>(self.1, other.1);
        // Each truth value is 64 equal bits: of its two halves either will do.
        let halves = _mm256_shuffle_ps::<0b10_00_10_00>(_mm256_castpd_ps(low), _mm256_castpd_ps(high));
        Mask8(_mm256_castpd_ps(_mm256_permute4x64_pd::<0b11_01_10_00>(_mm256_castps_pd(halves))))
    }
}}

methods! { with_avx2 F64x8: std::ops::Mul {
    type Output = Self;

    fn mul(self, other: Self) -> Self {
        F64x8(_mm256_mul_pd(self.0, other.0), _mm256_mul_pd(self.1, other.1))
    }
}}

methods! { with_avx2 F64x8: std::ops::Div {
    type Output = Self;

    fn div(self, other: Self) -> Self {
        F64x8(_mm256_div_pd(self.0, other.0), _mm256_div_pd(self.1, other.1))
    }
}}

methods! { with_avx2 I32x8: I32Vector<Avx2> {
    fn splat(_simd: Avx2, x: i32) -> Self {
        I32x8(_mm256_set1_epi32(x))
    }

    fn load(_simd: Avx2, from: &[i32]) -> Self {
        I32x8(must_cast(*first::<i32, 8>(from)))
    }

    fn store(self, to: &mut [i32]) {
        *first_mut::<i32, 8>(to) = must_cast(self.0);
    }

    fn load_i16(_simd: Avx2, from: &[i16]) -> Self {
        I32x8(_mm256_cvtepi16_epi32(must_cast(*first::<i16, 8>(from))))
    }

    fn store_i16(self, to: &mut [i16]) {
        // Packing works within halves of 128 bits.
        let packed = _mm256_packs_epi32(self.0, self.0);
        let packed = _mm256_permute4x64_epi64::<0b11_01_10_00>(packed);
        *first_mut::<i16, 8>(to) = must_cast(_mm256_castsi256_si128(packed));
    }

    fn min(self, other: Self) -> Self {
        I32x8(_mm256_min_epi32(self.0, other.0))
    }

    fn max(self, other: Self) -> Self {
        I32x8(_mm256_max_epi32(self.0, other.0))
    }

    fn min_unsigned(self, other: Self) -> Self {
        I32x8(_mm256_min_epu32(self.0, other.0))
    }

    fn abs(self) -> Self {
        I32x8(_mm256_abs_epi32(self.0))
    }

    fn shl(self, count: u32) -> Self {
        I32x8(_mm256_sll_epi32(self.0, _mm_cvtsi32_si128(count as i32)))
    }

    fn shr(self, count: u32) -> Self {
        I32x8(_mm256_sra_epi32(self.0, _mm_cvtsi32_si128(count as i32)))
    }

    fn shr_unsigned(self, count: u32) -> Self {
        I32x8(_mm256_srl_epi32(self.0, _mm_cvtsi32_si128(count as i32)))
    }

    fn shr_each(self, count: Self) -> Self {
        I32x8(_mm256_srav_epi32(self.0, count.0))
    }

    fn eq(self, other: Self) -> Mask8 {
        Mask8(_mm256_castsi256_ps(_mm256_cmpeq_epi32(self.0, other.0)))
    }

    fn lt(self, other: Self) -> Mask8 {
        Mask8(_mm256_castsi256_ps(_mm256_cmpgt_epi32(other.0, self.0)))
    }

    fn select(mask: Mask8, yes: Self, no: Self) -> Self {
        I32x8(_mm256_blendv_epi8(no.0, yes.0, _mm256_castps_si256(mask.0)))
    }

    fn keep(self, mask: Mask8) -> Self {
        I32x8(_mm256_and_si256(_mm256_castps_si256(mask.0), self.0))
    }

    fn sum(self) -> i32 {
        let sum = _mm_add_epi32(_mm256_castsi256_si128(self.0), _mm256_extracti128_si256::<1>(self.0));
        let sum = _mm_add_epi32(sum, _mm_shuffle_epi32::<0b1110>(sum));
        let sum = _mm_add_epi32(sum, _mm_shuffle_epi32::<0b01>(sum));
        _mm_cvtsi128_si32(sum)
    }

    fn dot_pairs(self, a: I16x16, b: I16x16) -> Self {
        I32x8(_mm256_add_epi32(self.0, _mm256_madd_epi16(a.0, b.0)))
    }

    fn to_f32(self) -> F32x8 {
        F32x8(_mm256_cvtepi32_ps(self.0))
    }

    fn as_f32(self) -> F32x8 {
        F32x8(_mm256_castsi256_ps(self.0))
    }

    fn as_i16(self) -> I16x16 {
        I16x16(self.0)
    }
}}

methods! { with_avx2 I16x16: I16Vector<Avx2> {
    fn splat(_simd: Avx2, x: i16) -> Self {
        I16x16(_mm256_set1_epi16(x))
    }

    fn load(_simd: Avx2, from: &[i16]) -> Self {
        I16x16(must_cast(*first::<i16, 16>(from)))
    }

    fn store(self, to: &mut [i16]) {
        *first_mut::<i16, 16>(to) = must_cast(self.0);
    }

    fn load_i8(_simd: Avx2, from: &[i8]) -> Self {
        I16x16(_mm256_cvtepi8_epi16(must_cast(*first::<i8, 16>(from))))
    }

    fn saturating_add(self, other: Self) -> Self {
        I16x16(_mm256_adds_epi16(self.0, other.0))
    }

    fn min(self, other: Self) -> Self {
        I16x16(_mm256_min_epi16(self.0, other.0))
    }

    fn max(self, other: Self) -> Self {
        I16x16(_mm256_max_epi16(self.0, other.0))
    }

    fn mul_high(self, other: Self) -> Self {
        I16x16(_mm256_mulhi_epi16(self.0, other.0))
    }

    fn shr(self, count: u32) -> Self {
        I16x16(_mm256_sra_epi16(self.0, _mm_cvtsi32_si128(count as i32)))
    }

    fn as_i32(self) -> I32x8 {
        I32x8(self.0)
    }
}}

methods! { with_avx2 Mask8: MaskVector {
    fn and(self, other: Self) -> Self {
        Mask8(_mm256_and_ps(self.0, other.0))
    }

    fn bits(self) -> u32 {
        _mm256_movemask_ps(self.0) as u32
    }
}}

with_avx2! {
    /// Within each half of 128 bits: vector `k` of the result holds element `k` of each of the four.
    #[inline]
    fn transpose4([a, b, c, d]: [__m256; 4]) -> [F32x8; 4] {
        let [ab_low, ab_high] = [_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b)];
        let [cd_low, cd_high] = [_mm256_unpacklo_ps(c, d), _mm256_unpackhi_ps(c, d)];
        [
            F32x8(_mm256_shuffle_ps::<0b01_00_01_00>(ab_low, cd_low)),
            F32x8(_mm256_shuffle_ps::<0b11_10_11_10>(ab_low, cd_low)),
            F32x8(_mm256_shuffle_ps::<0b01_00_01_00>(ab_high, cd_high)),
            F32x8(_mm256_shuffle_ps::<0b11_10_11_10>(ab_high, cd_high)),
        ]
    }
}

/// For each mask of eight lanes, the lanes that it holds, in order, one byte each.
pub(crate) static FIRST: [u64; 256] = {
    let mut first = [0; 256];
    let mut mask = 0;
    while mask < 256 {
        let (mut lane, mut kept) = (0, 0);
        while lane < 8 {
            if mask >> lane & 1 == 1 {
                first[mask] |= lane << (8 * kept);
                kept += 1;
            }
            lane += 1;
        }
        mask += 1;
    }
    first
};
