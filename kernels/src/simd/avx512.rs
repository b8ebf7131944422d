//! AVX-512 with VNNI: sixteen lanes.

use std::arch::x86_64::*;

use bytemuck::must_cast;
use half::f16;

use super::avx2::Avx2;
#[cfg(feature = "close")]
use super::avx2::{F32x8, I32x8};
#[cfg(feature = "close")]
use super::macros::vectorize;
use super::macros::{define_set, five, four, methods, operators, three};
use super::vector::{
    EXP2_ABOVE, F16_MAX, F32Vector, F64Vector, I16Vector, I32Vector, MaskVector, Simd, first, first_mut, polynomial,
    sealed,
};

define_set! { $ with_avx512, is_x86_feature_detected,
    /// Proof of AVX-512 F, BW, CD, DQ, VL and VNNI, and of AVX2.
    pub struct Avx512 = "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl", "avx512vnni";
    extends avx2::Avx2, with_avx2;
}

impl sealed::Sealed for Avx512 {}

impl Simd for Avx512 {
    const LANES: usize = 16;
    type F32 = F32x16;
    type F64 = F64x16;
    type I32 = I32x16;
    type I16 = I16x32;
    type Mask = Mask16;
    type Narrow = Avx2;

    #[inline(always)]
    fn narrow(self) -> Avx2 {
        self.base()
    }
}

/// Sixteen f32.
#[derive(Clone, Copy)]
pub struct F32x16(__m512);

/// Sixteen f64.
#[derive(Clone, Copy)]
pub struct F64x16(__m512d, __m512d);

/// Sixteen i32.
#[derive(Clone, Copy)]
pub struct I32x16(__m512i);

/// Thirty-two i16.
#[derive(Clone, Copy)]
pub struct I16x32(__m512i);

/// Sixteen truth values.
#[derive(Clone, Copy)]
pub struct Mask16(__mmask16);

operators!(F32x16: Add::add = _mm512_add_ps, Sub::sub = _mm512_sub_ps, Mul::mul = _mm512_mul_ps, Div::div = _mm512_div_ps);
operators!(
    I32x16: Add::add = _mm512_add_epi32, Sub::sub = _mm512_sub_epi32, Mul::mul = _mm512_mullo_epi32,
    BitAnd::bitand = _mm512_and_si512, BitOr::bitor = _mm512_or_si512,
);
operators!(I16x32: Add::add = _mm512_add_epi16, Sub::sub = _mm512_sub_epi16);

methods! { with_avx512 F32x16: F32Vector<Avx512> {
    fn splat(_simd: Avx512, x: f32) -> Self {
        F32x16(_mm512_set1_ps(x))
    }

    fn load(_simd: Avx512, from: &[f32]) -> Self {
        F32x16(must_cast(*first::<f32, 16>(from)))
    }

    fn store(self, to: &mut [f32]) {
        *first_mut::<f32, 16>(to) = must_cast(self.0);
    }

    fn load_f16(_simd: Avx512, from: &[f16]) -> Self {
        F32x16(_mm512_cvtph_ps(must_cast(*first::<f16, 16>(from))))
    }

    fn store_f16(self, to: &mut [f16]) {
        // Of a NaN and a number, the instruction gives the second.
        let value = _mm512_max_ps(self.0, _mm512_set1_ps(-F16_MAX));
        let value = _mm512_min_ps(value, _mm512_set1_ps(F16_MAX));
        *first_mut::<f16, 16>(to) = must_cast(_mm512_cvtps_ph::<_MM_FROUND_TO_NEAREST_INT>(value));
    }

    fn load_deinterleaved3(_simd: Avx512, from: &[[f32; 3]]) -> [Self; 3] {
        let [a, b, c]: [__m512; 3] = must_cast(*first::<_, 16>(from));
        // Lane `i` of vector `k` is float `3i + k`. Of the first two loads an index picks any; the third's are put in
        // after.
        static INDEX: [[[i32; 16]; 2]; 3] = {
            let mut index = [[[0; 16]; 2]; 3];
            let mut at = 0;
            while at < 48 {
                let (k, i) = (at % 3, at / 3);
                index[k][0][i] = if at < 32 { at as i32 } else { 0 };
                index[k][1][i] = if at < 32 { i as i32 } else { at as i32 - 16 };
                at += 1;
            }
            index
        };
        three!(k => {
            let ab = _mm512_permutex2var_ps(a, must_cast(INDEX[k][0]), b);
            F32x16(_mm512_permutex2var_ps(ab, must_cast(INDEX[k][1]), c))
        })
    }

    fn load_deinterleaved4(_simd: Avx512, from: &[[f32; 4]]) -> [Self; 4] {
        // Element `4i + j` is quarter `j` of load `i`; transposed within quarters, lane `4j + i` holds it.
        static ORDER: [i32; 16] = [0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15];
        let columns = transpose4(must_cast(*first::<_, 16>(from)));
        four!(k => F32x16(_mm512_permutexvar_ps(must_cast(ORDER), columns[k])))
    }

    fn load_records(_simd: Avx512, records: &[&[f32; 16]]) -> [Self; 16] {
        let records: &[&[f32; 16]; 16] = first(records);
        // Quarter `j` of `rows[q][i]` is quarter `q` of record `4j + i`; transposed, vector `k` of them is field `4q +
        // k`, in order but for the lanes: lane `4j + i`.
        let mut rows = [[_mm512_setzero_ps(); 4]; 4];
        for i in 0..4 {
            let [a, b, c, d]: [__m512; 4] = four!(j => must_cast(*records[4 * j + i]));
            let ab_low = _mm512_shuffle_f32x4::<0b01_00_01_00>(a, b);
            let ab_high = _mm512_shuffle_f32x4::<0b11_10_11_10>(a, b);
            let cd_low = _mm512_shuffle_f32x4::<0b01_00_01_00>(c, d);
            let cd_high = _mm512_shuffle_f32x4::<0b11_10_11_10>(c, d);
            rows[0][i] = _mm512_shuffle_f32x4::<0b10_00_10_00>(ab_low, cd_low);
            rows[1][i] = _mm512_shuffle_f32x4::<0b11_01_11_01>(ab_low, cd_low);
            rows[2][i] = _mm512_shuffle_f32x4::<0b10_00_10_00>(ab_high, cd_high);
            rows[3][i] = _mm512_shuffle_f32x4::<0b11_01_11_01>(ab_high, cd_high);
        }
        let mut fields = [F32x16(_mm512_setzero_ps()); 16];
        for q in 0..4 {
            let columns = transpose4(rows[q]);
            for k in 0..4 {
                fields[4 * q + k] = F32x16(columns[k]);
            }
        }
        fields
    }

    fn store_records(fields: &[Self; 16], which: u32, to: &mut [[f32; 16]]) -> usize {
        let quarters: [[__m512; 4]; 4] = four!(q => transpose4(four!(k => fields[4 * q + k].0)));
        // Record `4j + i` is quarter `j` of row `i` of each.
        let mut records = [_mm512_setzero_ps(); 16];
        for i in 0..4 {
            let [a, b, c, d] = four!(q => quarters[q][i]);
            let ab_even = _mm512_shuffle_f32x4::<0b10_00_10_00>(a, b);
            let ab_odd = _mm512_shuffle_f32x4::<0b11_01_11_01>(a, b);
            let cd_even = _mm512_shuffle_f32x4::<0b10_00_10_00>(c, d);
            let cd_odd = _mm512_shuffle_f32x4::<0b11_01_11_01>(c, d);
            records[i] = _mm512_shuffle_f32x4::<0b10_00_10_00>(ab_even, cd_even);
            records[8 + i] = _mm512_shuffle_f32x4::<0b11_01_11_01>(ab_even, cd_even);
            records[4 + i] = _mm512_shuffle_f32x4::<0b10_00_10_00>(ab_odd, cd_odd);
            records[12 + i] = _mm512_shuffle_f32x4::<0b11_01_11_01>(ab_odd, cd_odd);
        }
        let mut kept = 0;
        for (lane, record) in records.into_iter().enumerate() {
            if which >> lane & 1 == 1 {
                to[kept] = must_cast(record);
                kept += 1;
            }
        }
        kept
    }

    fn mul_add(self, factor: Self, term: Self) -> Self {
        F32x16(_mm512_fmadd_ps(self.0, factor.0, term.0))
    }

    fn neg_mul_add(self, factor: Self, term: Self) -> Self {
        F32x16(_mm512_fnmadd_ps(self.0, factor.0, term.0))
    }

    fn sqrt(self) -> Self {
        F32x16(_mm512_sqrt_ps(self.0))
    }

    fn abs(self) -> Self {
        F32x16(_mm512_abs_ps(self.0))
    }

    fn min(self, other: Self) -> Self {
        F32x16(_mm512_min_ps(self.0, other.0))
    }

    fn max(self, other: Self) -> Self {
        F32x16(_mm512_max_ps(self.0, other.0))
    }

    fn ceil(self) -> Self {
        F32x16(_mm512_roundscale_ps::<{ _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC }>(self.0))
    }

    fn floor(self) -> Self {
        F32x16(_mm512_roundscale_ps::<{ _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC }>(self.0))
    }

    fn lt(self, other: Self) -> Mask16 {
        Mask16(_mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, other.0))
    }

    fn le(self, other: Self) -> Mask16 {
        Mask16(_mm512_cmp_ps_mask::<_CMP_LE_OQ>(self.0, other.0))
    }

    fn ordered(self, other: Self) -> Mask16 {
        Mask16(_mm512_cmp_ps_mask::<_CMP_ORD_Q>(self.0, other.0))
    }

    fn select(mask: Mask16, yes: Self, no: Self) -> Self {
        F32x16(_mm512_mask_blend_ps(mask.0, no.0, yes.0))
    }

    fn keep(self, mask: Mask16) -> Self {
        F32x16(_mm512_maskz_mov_ps(mask.0, self.0))
    }

    fn exp2(self) -> Self {
        // What is beyond the integer below; scaling takes that integer by itself.
        let f = _mm512_reduce_ps::<{ _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC }>(self.0);
        let p = polynomial::<Avx512>(F32x16(f), five!(i => F32x16(_mm512_set1_ps(EXP2_ABOVE[i]))));
        F32x16(_mm512_scalef_ps(p.0, self.0))
    }

    fn split_exponent(self) -> (Self, Self) {
        let mantissa = _mm512_getmant_ps::<_MM_MANT_NORM_1_2, _MM_MANT_SIGN_SRC>(self.0);
        (F32x16(mantissa), F32x16(_mm512_getexp_ps(self.0)))
    }

    fn round_to_i32(self) -> I32x16 {
        I32x16(_mm512_cvtps_epi32(self.0))
    }

    fn truncate_to_i32(self) -> I32x16 {
        I32x16(_mm512_cvttps_epi32(self.0))
    }

    fn to_bits(self) -> I32x16 {
        I32x16(_mm512_castps_si512(self.0))
    }

    fn compress(self, which: u32) -> Self {
        F32x16(_mm512_maskz_compress_ps(which as u16, self.0))
    }
}}

methods! { with_avx512 F64x16: F64Vector<Avx512> {
    fn splat(_simd: Avx512, x: f64) -> Self {
        F64x16(_mm512_set1_pd(x), _mm512_set1_pd(x))
    }

    fn from_f32(x: F32x16) -> Self {
        F64x16(
            _mm512_cvtps_pd(_mm512_castps512_ps256(x.0)),
            _mm512_cvtps_pd(_mm512_extractf32x8_ps::<1>(x.0)),
        )
    }

    fn to_f32(self) -> F32x16 {
        let low = _mm512_castps256_ps512(_mm512_cvtpd_ps(self.0));
        F32x16(_mm512_insertf32x8::<1>(low, _mm512_cvtpd_ps(self.1)))
    }

    fn mul_add(self, factor: Self, term: Self) -> Self {
        F64x16(_mm512_fmadd_pd(self.0, factor.0, term.0), _mm512_fmadd_pd(self.1, factor.1, term.1))
    }

    fn min(self, other: Self) -> Self {
        F64x16(_mm512_min_pd(self.0, other.0), _mm512_min_pd(self.1, other.1))
    }

    fn max(self, other: Self) -> Self {
        F64x16(_mm512_max_pd(self.0, other.0), _mm512_max_pd(self.1, other.1))
    }

    fn lt(self, other: Self) -> Mask16 {
        let low = _mm512_cmp_pd_mask::<_CMP_LT_OQ>(self.0, other.0);
        let high = _mm512_cmp_pd_mask::<_CMP_LT_OQ>(self.1, other.1);
        Mask16(u16::from(low) | u16::from(high) << 8)
    }
}}

methods! { with_avx512 F64x16: std::ops::Mul {
    type Output = Self;

    fn mul(self, other: Self) -> Self {
        F64x16(_mm512_mul_pd(self.0, other.0), _mm512_mul_pd(self.1, other.1))
    }
}}

methods! { with_avx512 F64x16: std::ops::Div {
    type Output = Self;

    fn div(self, other: Self) -> Self {
        F64x16(_mm512_div_pd(self.0, other.0), _mm512_div_pd(self.1, other.1))
    }
}}

methods! { with_avx512 I32x16: I32Vector<Avx512> {
    fn splat(_simd: Avx512, x: i32) -> Self {
        I32x16(_mm512_set1_epi32(x))
    }

    fn load(_simd: Avx512, from: &[i32]) -> Self {
        I32x16(must_cast(*first::<i32, 16>(from)))
    }

    fn store(self, to: &mut [i32]) {
        *first_mut::<i32, 16>(to) = must_cast(self.0);
    }

    fn load_i16(_simd: Avx512, from: &[i16]) -> Self {
        I32x16(_mm512_cvtepi16_epi32(must_cast(*first::<i16, 16>(from))))
    }

    fn store_i16(self, to: &mut [i16]) {
        *first_mut::<i16, 16>(to) = must_cast(_mm512_cvtsepi32_epi16(self.0));
    }

    fn min(self, other: Self) -> Self {
        I32x16(_mm512_min_epi32(self.0, other.0))
    }

    fn max(self, other: Self) -> Self {
        I32x16(_mm512_max_epi32(self.0, other.0))
    }

    fn min_unsigned(self, other: Self) -> Self {
        I32x16(_mm512_min_epu32(self.0, other.0))
    }

    fn abs(self) -> Self {
        I32x16(_mm512_abs_epi32(self.0))
    }

    fn shl(self, count: u32) -> Self {
        I32x16(_mm512_sll_epi32(self.0, _mm_cvtsi32_si128(count as i32)))
    }

    fn shr(self, count: u32) -> Self {
        I32x16(_mm512_sra_epi32(self.0, _mm_cvtsi32_si128(count as i32)))
    }

    fn shr_unsigned(self, count: u32) -> Self {
        I32x16(_mm512_srl_epi32(self.0, _mm_cvtsi32_si128(count as i32)))
    }

    fn shr_each(self, count: Self) -> Self {
        I32x16(_mm512_srav_epi32(self.0, count.0))
    }

    fn eq(self, other: Self) -> Mask16 {
        Mask16(_mm512_cmpeq_epi32_mask(self.0, other.0))
    }

    fn lt(self, other: Self) -> Mask16 {
        Mask16(_mm512_cmplt_epi32_mask(self.0, other.0))
    }

    fn select(mask: Mask16, yes: Self, no: Self) -> Self {
        I32x16(_mm512_mask_blend_epi32(mask.0, no.0, yes.0))
    }

    fn keep(self, mask: Mask16) -> Self {
        I32x16(_mm512_maskz_mov_epi32(mask.0, self.0))
    }

    fn sum(self) -> i32 {
        _mm512_reduce_add_epi32(self.0)
    }

    fn dot_pairs(self, a: I16x32, b: I16x32) -> Self {
        I32x16(_mm512_dpwssd_epi32(self.0, a.0, b.0))
    }

    fn to_f32(self) -> F32x16 {
        F32x16(_mm512_cvtepi32_ps(self.0))
    }

    fn as_f32(self) -> F32x16 {
        F32x16(_mm512_castsi512_ps(self.0))
    }

    fn as_i16(self) -> I16x32 {
        I16x32(self.0)
    }
}}

methods! { with_avx512 I16x32: I16Vector<Avx512> {
    fn splat(_simd: Avx512, x: i16) -> Self {
        I16x32(_mm512_set1_epi16(x))
    }

    fn load(_simd: Avx512, from: &[i16]) -> Self {
        I16x32(must_cast(*first::<i16, 32>(from)))
    }

    fn store(self, to: &mut [i16]) {
        *first_mut::<i16, 32>(to) = must_cast(self.0);
    }

    fn load_i8(_simd: Avx512, from: &[i8]) -> Self {
        I16x32(_mm512_cvtepi8_epi16(must_cast(*first::<i8, 32>(from))))
    }

    fn saturating_add(self, other: Self) -> Self {
        I16x32(_mm512_adds_epi16(self.0, other.0))
    }

    fn min(self, other: Self) -> Self {
        I16x32(_mm512_min_epi16(self.0, other.0))
    }

    fn max(self, other: Self) -> Self {
        I16x32(_mm512_max_epi16(self.0, other.0))
    }

    fn mul_high(self, other: Self) -> Self {
        I16x32(_mm512_mulhi_epi16(self.0, other.0))
    }

    fn shr(self, count: u32) -> Self {
        I16x32(_mm512_sra_epi16(self.0, _mm_cvtsi32_si128(count as i32)))
    }

    fn as_i32(self) -> I32x16 {
        I32x16(self.0)
    }
}}

impl MaskVector for Mask16 {
    #[inline(always)]
    fn and(self, other: Self) -> Self {
        Mask16(self.0 & other.0)
    }

    #[inline(always)]
    fn bits(self) -> u32 {
        self.0.into()
    }
}

with_avx512! {
    /// Within each quarter of 128 bits: vector `k` of the result holds element `k` of each of the four.
    #[inline]
    fn transpose4([a, b, c, d]: [__m512; 4]) -> [__m512; 4] {
        let [ab_low, ab_high] = [_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b)];
        let [cd_low, cd_high] = [_mm512_unpacklo_ps(c, d), _mm512_unpackhi_ps(c, d)];
        [
            _mm512_shuffle_ps::<0b01_00_01_00>(ab_low, cd_low),
            _mm512_shuffle_ps::<0b11_10_11_10>(ab_low, cd_low),
            _mm512_shuffle_ps::<0b01_00_01_00>(ab_high, cd_high),
            _mm512_shuffle_ps::<0b11_10_11_10>(ab_high, cd_high),
        ]
    }
}

define_set! { $ with_bf16, is_x86_feature_detected,
    /// Proof of AVX512_BF16 and AVX-512.
    pub(crate) struct Bf16 = "avx512bf16";
    extends avx512::Avx512, with_avx512;
}

#[cfg(feature = "close")]
vectorize! { with_bf16 Bf16, base: Avx512 }

#[cfg(feature = "close")]
impl Bf16 {
    /// Rows of f16 as pairs of bf16, rounded to even: row `i` of `to` is row `rows[i]` of `input`, of `cin` values
    /// each. An odd row's last pair has a zero.
    ///
    /// # Panics
    /// If the input lacks a row.
    pub fn round_rows(self, input: &[f16], rows: &[u32], cin: usize, to: &mut [u32]) {
        // SAFETY: the token proves the features.
        unsafe { round_rows(input, rows, cin, to) }
    }

    /// Up to 32 f16 as pairs of bf16, rounded to even, and zeros after them.
    #[inline(always)]
    pub fn round(self, from: &[f16]) -> [u32; 16] {
        // SAFETY: the token proves the features.
        unsafe { round_f16(from) }
    }
}

#[cfg(feature = "close")]
with_bf16! {
    fn round_rows(input: &[f16], rows: &[u32], cin: usize, to: &mut [u32]) {
        for (to, &row) in to.chunks_exact_mut(cin.div_ceil(2)).zip(rows) {
            let from = &input[row as usize * cin..][..cin];
            for (to, from) in to.chunks_mut(16).zip(from.chunks(32)) {
                let here = u16::MAX >> (16 - to.len());
                // SAFETY: only the words of `to` are written.
                unsafe { _mm512_mask_storeu_epi32(to.as_mut_ptr().cast(), here, must_cast(round_f16(from))) };
            }
        }
    }
}

#[cfg(feature = "close")]
with_bf16! {
    /// Up to 32 f16 as pairs of bf16, and zeros after them.
    #[inline]
    fn round_f16(from: &[f16]) -> [u32; 16] {
        let here = u32::MAX >> 32usize.saturating_sub(from.len());
        // SAFETY: of 32 values only those of `from` are read.
        let halves = unsafe { _mm512_maskz_loadu_epi16(here, from.as_ptr().cast()) };
        let low = _mm512_cvtph_ps(_mm512_castsi512_si256(halves));
        let high = _mm512_cvtph_ps(_mm512_extracti64x4_epi64::<1>(halves));
        must_cast(_mm512_cvtne2ps_pbh(high, low))
    }
}

/// Vectors of pairs of bf16, as the bits of i32.
#[cfg(feature = "close")]
pub(crate) trait Bf16Vectors: Simd {
    /// `sum + a₀·b₀ + a₁·b₁`.
    fn dot_bf16(bf16: Bf16, sum: Self::F32, a: Self::I32, b: Self::I32) -> Self::F32;
}

#[cfg(feature = "close")]
impl Bf16Vectors for Avx512 {
    #[inline(always)]
    fn dot_bf16(_: Bf16, sum: F32x16, a: I32x16, b: I32x16) -> F32x16 {
        // SAFETY: the token proves the features.
        F32x16(unsafe { _mm512_dpbf16_ps(sum.0, must_cast(a.0), must_cast(b.0)) })
    }
}

#[cfg(feature = "close")]
impl Bf16Vectors for Avx2 {
    #[inline(always)]
    fn dot_bf16(_: Bf16, sum: F32x8, a: I32x8, b: I32x8) -> F32x8 {
        // SAFETY: the token proves the features.
        F32x8(unsafe { _mm256_dpbf16_ps(sum.0, must_cast(a.0), must_cast(b.0)) })
    }
}
