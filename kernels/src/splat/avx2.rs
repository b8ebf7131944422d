//! The lanes of AVX2.
//!
//! The methods are inlined into functions compiled for their instruction set, and called from nowhere else.

use std::arch::x86_64::*;

use super::Ellipse;
use super::lanes::{
    Double, EXP2, LEAST_POWER, Lanes, Mask, ROUND, binary, four, instructions, numbered, polynomial, three,
};

/// For each mask of eight lanes, the lanes that it holds, in order.
static FIRST: [[u8; 8]; 256] = {
    let mut first = [[0; 8]; 256];
    let mut mask = 0;
    while mask < 256 {
        let (mut lane, mut kept) = (0, 0);
        while lane < 8 {
            if mask >> lane & 1 == 1 {
                first[mask][kept] = lane as u8;
                kept += 1;
            }
            lane += 1;
        }
        mask += 1;
    }
    first
};

/// Eight floats.
#[derive(Clone, Copy)]
pub(super) struct Avx2(__m256);

#[derive(Clone, Copy)]
pub(super) struct Mask8(__m256);

#[derive(Clone, Copy)]
pub(super) struct Double8(__m256d, __m256d);

impl Lanes for Avx2 {
    const COUNT: usize = 8;
    type Mask = Mask8;
    type Double = Double8;

    binary! {
        add: _mm256_add_ps, sub: _mm256_sub_ps, mul: _mm256_mul_ps, div: _mm256_div_ps, min: _mm256_min_ps, max: _mm256_max_ps
    }

    #[inline(always)]
    fn splat(x: f32) -> Self {
        Avx2(instructions!(_mm256_set1_ps(x)))
    }

    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        let from = &from[..8];
        Avx2(instructions!(_mm256_loadu_ps(from.as_ptr())))
    }

    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        let to = &mut to[..8];
        instructions!(_mm256_storeu_ps(to.as_mut_ptr(), self.0));
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Avx2(instructions!(_mm256_fmadd_ps(self.0, factor.0, term.0)))
    }

    #[inline(always)]
    fn neg_mul_add(self, factor: Self, term: Self) -> Self {
        Avx2(instructions!(_mm256_fnmadd_ps(self.0, factor.0, term.0)))
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        Avx2(instructions!(_mm256_sqrt_ps(self.0)))
    }

    #[inline(always)]
    fn abs(self) -> Self {
        Avx2(instructions!(_mm256_andnot_ps(_mm256_set1_ps(-0.0), self.0)))
    }

    #[inline(always)]
    fn ceil(self) -> Self {
        Avx2(instructions!(_mm256_ceil_ps(self.0)))
    }

    #[inline(always)]
    fn floor(self) -> Self {
        Avx2(instructions!(_mm256_floor_ps(self.0)))
    }

    #[inline(always)]
    fn lt(self, other: Self) -> Mask8 {
        Mask8(instructions!(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0)))
    }

    #[inline(always)]
    fn le(self, other: Self) -> Mask8 {
        Mask8(instructions!(_mm256_cmp_ps::<_CMP_LE_OQ>(self.0, other.0)))
    }

    #[inline(always)]
    fn select(mask: Mask8, yes: Self, no: Self) -> Self {
        Avx2(instructions!(_mm256_blendv_ps(no.0, yes.0, mask.0)))
    }

    #[inline(always)]
    fn keep(self, mask: Mask8) -> Self {
        Avx2(instructions!(_mm256_and_ps(mask.0, self.0)))
    }

    #[inline(always)]
    fn exp2(self) -> Self {
        let x = self.max(Self::splat(LEAST_POWER));
        let shifted = x.add(Self::splat(ROUND));
        let f = x.sub(shifted.sub(Self::splat(ROUND)));
        let p = polynomial(f, &EXP2);
        Avx2(instructions!(_mm256_castsi256_ps(_mm256_add_epi32(
            _mm256_castps_si256(p.0),
            _mm256_slli_epi32::<23>(_mm256_castps_si256(shifted.0)),
        ))))
    }

    #[inline(always)]
    fn to_integer(self) -> Self {
        Avx2(instructions!(_mm256_castsi256_ps(_mm256_cvttps_epi32(self.0))))
    }

    #[inline(always)]
    fn add_integer(self, other: Self) -> Self {
        Avx2(instructions!(_mm256_castsi256_ps(_mm256_add_epi32(
            _mm256_castps_si256(self.0),
            _mm256_castps_si256(other.0)
        ))))
    }

    #[inline(always)]
    fn compress(self, which: u32) -> Self {
        let order = &FIRST[which as usize % FIRST.len()];
        Avx2(instructions!(_mm256_permutevar8x32_ps(
            self.0,
            _mm256_cvtepu8_epi32(_mm_loadl_epi64(order.as_ptr().cast()))
        )))
    }

    #[inline(always)]
    fn deal3(from: &[[f32; 3]]) -> [Self; 3] {
        let from = from[..8].as_flattened();
        let [a, b, c] = three!(i => Self::load(&from[8 * i..]).0);
        // Lane `i` of vector `k` is float `3i + k`: in each of the three loads, what belongs to the vector is put in its place.
        macro_rules! vector {
            ($index:tt, $from_b:literal, $from_c:literal) => {{
                let index = _mm256_loadu_si256((&raw const $index).cast());
                let [a, b, c] = [
                    _mm256_permutevar8x32_ps(a, index),
                    _mm256_permutevar8x32_ps(b, index),
                    _mm256_permutevar8x32_ps(c, index),
                ];
                let ab = _mm256_blend_ps::<$from_b>(a, b);
                Avx2(_mm256_blend_ps::<$from_c>(ab, c))
            }};
        }
        static INDEX: [[i32; 8]; 3] = [
            [0, 3, 6, 1, 4, 7, 2, 5],
            [1, 4, 7, 2, 5, 0, 3, 6],
            [2, 5, 0, 3, 6, 1, 4, 7],
        ];
        let [x, y, z] = &INDEX;
        instructions!([
            vector!((*x), 0b0011_1000, 0b1100_0000),
            vector!((*y), 0b0001_1000, 0b1110_0000),
            vector!((*z), 0b0001_1100, 0b1110_0000),
        ])
    }

    #[inline(always)]
    fn deal4(from: &[[f32; 4]]) -> [Self; 4] {
        let from = from[..8].as_flattened();
        let rows = four!(i => {
            let [low, high] = [&from[4 * i..][..4], &from[4 * i + 16..][..4]];
            instructions!(_mm256_set_m128(
                _mm_loadu_ps(high.as_ptr()),
                _mm_loadu_ps(low.as_ptr())
            ))
        });
        let [a, b, c, d] = turn4_256(rows);
        [Avx2(a), Avx2(b), Avx2(c), Avx2(d)]
    }

    #[inline(always)]
    fn collect(fields: &[Self; 16], which: u32, to: &mut [Ellipse]) -> usize {
        let quarters: [[__m256; 4]; 4] = four!(q => turn4_256(four!(k => fields[4 * q + k].0)));
        let mut kept = 0;
        for lane in 0..8 {
            if which >> lane & 1 == 0 {
                continue;
            }
            let record = to[kept].as_fields_mut();
            for (quarter, part) in quarters.iter().zip(record.chunks_exact_mut(4)) {
                let row = quarter[lane % 4];
                instructions!({
                    let half = if lane < 4 {
                        _mm256_castps256_ps128(row)
                    } else {
                        _mm256_extractf128_ps::<1>(row)
                    };
                    _mm_storeu_ps(part.as_mut_ptr(), half);
                });
            }
            kept += 1;
        }
        kept
    }

    #[inline(always)]
    fn to_float(self) -> Self {
        Avx2(instructions!(_mm256_cvtepi32_ps(_mm256_castps_si256(self.0))))
    }

    #[inline(always)]
    fn gather(all: &[Ellipse], keys: &[u64]) -> [Self; 16] {
        let mut fields = [Self::splat(0.0); 16];
        let low = four!(i => all[numbered(keys, i)].fields());
        let high = four!(i => all[numbered(keys, i + 4)].fields());
        for q in 0..4 {
            let rows = four!(i => instructions!(_mm256_set_m128(
                _mm_loadu_ps(high[i][4 * q..][..4].as_ptr()),
                _mm_loadu_ps(low[i][4 * q..][..4].as_ptr())
            )));
            let turned = turn4_256(rows);
            for k in 0..4 {
                fields[4 * q + k] = Avx2(turned[k]);
            }
        }
        fields
    }

    #[inline(always)]
    fn split(self) -> (Self, Self) {
        let bits = instructions!(_mm256_castps_si256(self.0));
        let mantissa = Avx2(instructions!(_mm256_or_ps(
            _mm256_and_ps(self.0, _mm256_castsi256_ps(_mm256_set1_epi32(0x007f_ffff))),
            _mm256_set1_ps(1.0),
        )));
        let exponent = Avx2(instructions!(_mm256_cvtepi32_ps(_mm256_sub_epi32(
            _mm256_srli_epi32::<23>(bits),
            _mm256_set1_epi32(127)
        ))));
        (mantissa, exponent)
    }
}

impl Mask for Mask8 {
    binary! { and: _mm256_and_ps }

    #[inline(always)]
    fn bits(self) -> u32 {
        instructions!(_mm256_movemask_ps(self.0)) as u32
    }
}

impl Double for Double8 {
    type Lanes = Avx2;
    type Mask = Mask8;

    #[inline(always)]
    fn splat(x: f64) -> Self {
        let x = instructions!(_mm256_set1_pd(x));
        Double8(x, x)
    }

    #[inline(always)]
    fn from_lanes(lanes: Avx2) -> Self {
        Double8(
            instructions!(_mm256_cvtps_pd(_mm256_castps256_ps128(lanes.0))),
            instructions!(_mm256_cvtps_pd(_mm256_extractf128_ps::<1>(lanes.0))),
        )
    }

    #[inline(always)]
    fn to_lanes(self) -> Avx2 {
        Avx2(instructions!(_mm256_set_m128(
            _mm256_cvtpd_ps(self.1),
            _mm256_cvtpd_ps(self.0)
        )))
    }

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Double8(
            instructions!(_mm256_mul_pd(self.0, other.0)),
            instructions!(_mm256_mul_pd(self.1, other.1)),
        )
    }

    #[inline(always)]
    fn div(self, other: Self) -> Self {
        Double8(
            instructions!(_mm256_div_pd(self.0, other.0)),
            instructions!(_mm256_div_pd(self.1, other.1)),
        )
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Double8(
            instructions!(_mm256_fmadd_pd(self.0, factor.0, term.0)),
            instructions!(_mm256_fmadd_pd(self.1, factor.1, term.1)),
        )
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Double8(
            instructions!(_mm256_min_pd(self.0, other.0)),
            instructions!(_mm256_min_pd(self.1, other.1)),
        )
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Double8(
            instructions!(_mm256_max_pd(self.0, other.0)),
            instructions!(_mm256_max_pd(self.1, other.1)),
        )
    }

    #[inline(always)]
    fn lt(self, other: Self) -> Mask8 {
        let low = instructions!(_mm256_cmp_pd::<_CMP_LT_OQ>(self.0, other.0));
        let high = instructions!(_mm256_cmp_pd::<_CMP_LT_OQ>(self.1, other.1));
        // Each truth is all ones or all zeros: of the two halves of its 64 bits either will do.
        let halves = instructions!(_mm256_shuffle_ps::<0b10_00_10_00>(
            _mm256_castpd_ps(low),
            _mm256_castpd_ps(high)
        ));
        Mask8(instructions!(_mm256_castpd_ps(_mm256_permute4x64_pd::<0b11_01_10_00>(
            _mm256_castps_pd(halves)
        ))))
    }
}

/// Within each quarter of 128 bits: vector `k` of the result holds element `k` of each of the four.
#[inline(always)]
fn turn4_256([a, b, c, d]: [__m256; 4]) -> [__m256; 4] {
    instructions!({
        let [ab_low, ab_high] = [_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b)];
        let [cd_low, cd_high] = [_mm256_unpacklo_ps(c, d), _mm256_unpackhi_ps(c, d)];
        [
            _mm256_shuffle_ps::<0b01_00_01_00>(ab_low, cd_low),
            _mm256_shuffle_ps::<0b11_10_11_10>(ab_low, cd_low),
            _mm256_shuffle_ps::<0b01_00_01_00>(ab_high, cd_high),
            _mm256_shuffle_ps::<0b11_10_11_10>(ab_high, cd_high),
        ]
    })
}
