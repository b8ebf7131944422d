//! The lanes of AVX-512.
//!
//! The methods are inlined into functions compiled for their instruction set, and called from nowhere else.

use std::arch::x86_64::*;

use super::Ellipse;
use super::lanes::{Double, EXP2_ABOVE, Lanes, Mask, binary, four, instructions, numbered, polynomial, three};

/// Sixteen floats.
#[derive(Clone, Copy)]
pub(super) struct Avx512(__m512);

#[derive(Clone, Copy)]
pub(super) struct Mask16(__mmask16);

#[derive(Clone, Copy)]
pub(super) struct Double16(__m512d, __m512d);

impl Lanes for Avx512 {
    const COUNT: usize = 16;
    type Mask = Mask16;
    type Double = Double16;

    binary! {
        add: _mm512_add_ps, sub: _mm512_sub_ps, mul: _mm512_mul_ps, div: _mm512_div_ps, min: _mm512_min_ps, max: _mm512_max_ps
    }

    #[inline(always)]
    fn splat(x: f32) -> Self {
        Avx512(instructions!(_mm512_set1_ps(x)))
    }

    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        let from = &from[..16];
        Avx512(instructions!(_mm512_loadu_ps(from.as_ptr())))
    }

    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        let to = &mut to[..16];
        instructions!(_mm512_storeu_ps(to.as_mut_ptr(), self.0));
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Avx512(instructions!(_mm512_fmadd_ps(self.0, factor.0, term.0)))
    }

    #[inline(always)]
    fn neg_mul_add(self, factor: Self, term: Self) -> Self {
        Avx512(instructions!(_mm512_fnmadd_ps(self.0, factor.0, term.0)))
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        Avx512(instructions!(_mm512_sqrt_ps(self.0)))
    }

    #[inline(always)]
    fn abs(self) -> Self {
        Avx512(instructions!(_mm512_abs_ps(self.0)))
    }

    #[inline(always)]
    fn ceil(self) -> Self {
        Avx512(instructions!(_mm512_roundscale_ps::<
            { _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC },
        >(self.0)))
    }

    #[inline(always)]
    fn floor(self) -> Self {
        Avx512(instructions!(_mm512_roundscale_ps::<
            { _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC },
        >(self.0)))
    }

    #[inline(always)]
    fn lt(self, other: Self) -> Mask16 {
        Mask16(instructions!(_mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, other.0)))
    }

    #[inline(always)]
    fn le(self, other: Self) -> Mask16 {
        Mask16(instructions!(_mm512_cmp_ps_mask::<_CMP_LE_OQ>(self.0, other.0)))
    }

    #[inline(always)]
    fn select(mask: Mask16, yes: Self, no: Self) -> Self {
        Avx512(instructions!(_mm512_mask_blend_ps(mask.0, no.0, yes.0)))
    }

    #[inline(always)]
    fn keep(self, mask: Mask16) -> Self {
        Avx512(instructions!(_mm512_maskz_mov_ps(mask.0, self.0)))
    }

    #[inline(always)]
    fn exp2(self) -> Self {
        // What is beyond the integer below; scaling takes that integer by itself.
        let f = instructions!(_mm512_reduce_ps::<{ _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC }>(
            self.0
        ));
        let p = polynomial(Avx512(f), &EXP2_ABOVE);
        Avx512(instructions!(_mm512_scalef_ps(p.0, self.0)))
    }

    #[inline(always)]
    fn to_integer(self) -> Self {
        Avx512(instructions!(_mm512_castsi512_ps(_mm512_cvttps_epi32(self.0))))
    }

    #[inline(always)]
    fn add_integer(self, other: Self) -> Self {
        Avx512(instructions!(_mm512_castsi512_ps(_mm512_add_epi32(
            _mm512_castps_si512(self.0),
            _mm512_castps_si512(other.0)
        ))))
    }

    #[inline(always)]
    fn compress(self, which: u32) -> Self {
        Avx512(instructions!(_mm512_maskz_compress_ps(which as u16, self.0)))
    }

    #[inline(always)]
    fn deal3(from: &[[f32; 3]]) -> [Self; 3] {
        let from = from[..16].as_flattened();
        let [a, b, c] = three!(i => Self::load(&from[16 * i..]).0);
        // Lane `i` of vector `k` is float `3i + k`. Of the first two loads an index picks any; the third's are put in after.
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
        three!(k => instructions!({
            let first = _mm512_loadu_si512((&raw const INDEX[k][0]).cast());
            let then = _mm512_loadu_si512((&raw const INDEX[k][1]).cast());
            let ab = _mm512_permutex2var_ps(a, first, b);
            Avx512(_mm512_permutex2var_ps(ab, then, c))
        }))
    }

    #[inline(always)]
    fn deal4(from: &[[f32; 4]]) -> [Self; 4] {
        let from = from[..16].as_flattened();
        let rows = four!(i => Self::load(&from[16 * i..]).0);
        // Element `4i + j` is quarter `j` of load `i`; turned within quarters, lane `4j + i` holds it.
        static ORDER: [i32; 16] = [0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15];
        let turned = turn4_512(rows);
        four!(k => Avx512(instructions!(_mm512_permutexvar_ps(
            _mm512_loadu_si512((&raw const ORDER).cast()),
            turned[k]
        ))))
    }

    #[inline(always)]
    fn collect(fields: &[Self; 16], which: u32, to: &mut [Ellipse]) -> usize {
        let quarters: [[__m512; 4]; 4] = four!(q => turn4_512(four!(k => fields[4 * q + k].0)));
        // Record `4j + i` is quarter `j` of row `i` of each.
        let mut records = [instructions!(_mm512_setzero_ps()); 16];
        for i in 0..4 {
            let [a, b, c, d] = four!(q => quarters[q][i]);
            instructions!({
                let ab_even = _mm512_shuffle_f32x4::<0b10_00_10_00>(a, b);
                let ab_odd = _mm512_shuffle_f32x4::<0b11_01_11_01>(a, b);
                let cd_even = _mm512_shuffle_f32x4::<0b10_00_10_00>(c, d);
                let cd_odd = _mm512_shuffle_f32x4::<0b11_01_11_01>(c, d);
                records[i] = _mm512_shuffle_f32x4::<0b10_00_10_00>(ab_even, cd_even);
                records[8 + i] = _mm512_shuffle_f32x4::<0b11_01_11_01>(ab_even, cd_even);
                records[4 + i] = _mm512_shuffle_f32x4::<0b10_00_10_00>(ab_odd, cd_odd);
                records[12 + i] = _mm512_shuffle_f32x4::<0b11_01_11_01>(ab_odd, cd_odd);
            });
        }
        let mut kept = 0;
        for (lane, record) in records.into_iter().enumerate() {
            if which >> lane & 1 == 1 {
                Avx512(record).store(to[kept].as_fields_mut());
                kept += 1;
            }
        }
        kept
    }

    #[inline(always)]
    fn to_float(self) -> Self {
        Avx512(instructions!(_mm512_cvtepi32_ps(_mm512_castps_si512(self.0))))
    }

    #[inline(always)]
    fn gather(all: &[Ellipse], keys: &[u64]) -> [Self; 16] {
        // Quarter `j` of `rows[q][i]` is quarter `q` of record `4j + i`; turned, vector `k` of them is field `4q + k`, in order
        // but for the lanes: lane `4j + i`.
        let mut rows = [[instructions!(_mm512_setzero_ps()); 4]; 4];
        for i in 0..4 {
            let [a, b, c, d] = four!(j => Self::load(all[numbered(keys, 4 * j + i)].fields()).0);
            instructions!({
                let ab_low = _mm512_shuffle_f32x4::<0b01_00_01_00>(a, b);
                let ab_high = _mm512_shuffle_f32x4::<0b11_10_11_10>(a, b);
                let cd_low = _mm512_shuffle_f32x4::<0b01_00_01_00>(c, d);
                let cd_high = _mm512_shuffle_f32x4::<0b11_10_11_10>(c, d);
                rows[0][i] = _mm512_shuffle_f32x4::<0b10_00_10_00>(ab_low, cd_low);
                rows[1][i] = _mm512_shuffle_f32x4::<0b11_01_11_01>(ab_low, cd_low);
                rows[2][i] = _mm512_shuffle_f32x4::<0b10_00_10_00>(ab_high, cd_high);
                rows[3][i] = _mm512_shuffle_f32x4::<0b11_01_11_01>(ab_high, cd_high);
            });
        }
        let mut fields = [Self::splat(0.0); 16];
        for q in 0..4 {
            let turned = turn4_512(rows[q]);
            for k in 0..4 {
                fields[4 * q + k] = Avx512(turned[k]);
            }
        }
        fields
    }

    #[inline(always)]
    fn split(self) -> (Self, Self) {
        (
            Avx512(instructions!(
                _mm512_getmant_ps::<_MM_MANT_NORM_1_2, _MM_MANT_SIGN_SRC>(self.0)
            )),
            Avx512(instructions!(_mm512_getexp_ps(self.0))),
        )
    }
}

impl Mask for Mask16 {
    #[inline(always)]
    fn and(self, other: Self) -> Self {
        Mask16(self.0 & other.0)
    }

    #[inline(always)]
    fn bits(self) -> u32 {
        self.0.into()
    }
}

impl Double for Double16 {
    type Lanes = Avx512;
    type Mask = Mask16;

    #[inline(always)]
    fn splat(x: f64) -> Self {
        let x = instructions!(_mm512_set1_pd(x));
        Double16(x, x)
    }

    #[inline(always)]
    fn from_lanes(lanes: Avx512) -> Self {
        Double16(
            instructions!(_mm512_cvtps_pd(_mm512_castps512_ps256(lanes.0))),
            instructions!(_mm512_cvtps_pd(_mm512_extractf32x8_ps::<1>(lanes.0))),
        )
    }

    #[inline(always)]
    fn to_lanes(self) -> Avx512 {
        Avx512(instructions!(_mm512_insertf32x8::<1>(
            _mm512_castps256_ps512(_mm512_cvtpd_ps(self.0)),
            _mm512_cvtpd_ps(self.1)
        )))
    }

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Double16(
            instructions!(_mm512_mul_pd(self.0, other.0)),
            instructions!(_mm512_mul_pd(self.1, other.1)),
        )
    }

    #[inline(always)]
    fn div(self, other: Self) -> Self {
        Double16(
            instructions!(_mm512_div_pd(self.0, other.0)),
            instructions!(_mm512_div_pd(self.1, other.1)),
        )
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Double16(
            instructions!(_mm512_fmadd_pd(self.0, factor.0, term.0)),
            instructions!(_mm512_fmadd_pd(self.1, factor.1, term.1)),
        )
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Double16(
            instructions!(_mm512_min_pd(self.0, other.0)),
            instructions!(_mm512_min_pd(self.1, other.1)),
        )
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Double16(
            instructions!(_mm512_max_pd(self.0, other.0)),
            instructions!(_mm512_max_pd(self.1, other.1)),
        )
    }

    #[inline(always)]
    fn lt(self, other: Self) -> Mask16 {
        let low = instructions!(_mm512_cmp_pd_mask::<_CMP_LT_OQ>(self.0, other.0));
        let high = instructions!(_mm512_cmp_pd_mask::<_CMP_LT_OQ>(self.1, other.1));
        Mask16(u16::from(low) | u16::from(high) << 8)
    }
}

/// Within each quarter of 128 bits: vector `k` of the result holds element `k` of each of the four.
#[inline(always)]
fn turn4_512([a, b, c, d]: [__m512; 4]) -> [__m512; 4] {
    instructions!({
        let [ab_low, ab_high] = [_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b)];
        let [cd_low, cd_high] = [_mm512_unpacklo_ps(c, d), _mm512_unpackhi_ps(c, d)];
        [
            _mm512_shuffle_ps::<0b01_00_01_00>(ab_low, cd_low),
            _mm512_shuffle_ps::<0b11_10_11_10>(ab_low, cd_low),
            _mm512_shuffle_ps::<0b01_00_01_00>(ab_high, cd_high),
            _mm512_shuffle_ps::<0b11_10_11_10>(ab_high, cd_high),
        ]
    })
}
