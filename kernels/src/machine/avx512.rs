//! AVX-512 with VNNI: blocks of four rows by four panels, of eight by two, or by one or half of one, in two parts.

use std::arch::x86_64::*;

use crate::f16;

use crate::ceiling;
use crate::convert::{Halves, MAX};
use crate::exact::LIMIT;

use crate::machine::machine;
use crate::rows::{Lanes, PANEL};
use crate::simd::avx512::{with_avx512, with_bf16};
use crate::tile::{Arithmetic, Block, MIN_GROUP, Machine, WIDE, columns};
use crate::winograd::Registers;

/// # Safety
/// The processor must have AVX-512 F, BW, CD, DQ, VL and VNNI, and AVX512_BF16 for [`Arithmetic::Brain`]; the rest as
/// [`columns`].
pub(crate) unsafe fn run(arithmetic: Arithmetic, block: &Block, whole: usize) {
    // SAFETY: the caller's promise for as many panels as each call multiplies.
    unsafe {
        match (arithmetic, whole) {
            (Arithmetic::Float, 0) => wide::<HalfFloat, 8, 1, 1>(block),
            (Arithmetic::Float, 1) => wide::<Float, 8, 1, 1>(block),
            (Arithmetic::Float, ..WIDE) => wide::<Float, 8, 2, 1>(block),
            (Arithmetic::Float, _) => wide::<Float, MIN_GROUP, WIDE, 1>(block),
            (Arithmetic::Integer, 0) => wide::<HalfInteger, 8, 1, 2>(block),
            (Arithmetic::Integer, 1) => wide::<Integer, 8, 1, 2>(block),
            (Arithmetic::Integer, ..WIDE) => wide::<Integer, 8, 2, 1>(block),
            (Arithmetic::Integer, _) => wide::<Integer, MIN_GROUP, WIDE, 1>(block),
            (Arithmetic::Brain, 0) => wide_brain::<HalfBrain, 8, 1, 1>(block),
            (Arithmetic::Brain, 1) => wide_brain::<Brain, 8, 1, 1>(block),
            (Arithmetic::Brain, ..WIDE) => wide_brain::<Brain, 8, 2, 1>(block),
            (Arithmetic::Brain, _) => wide_brain::<Brain, MIN_GROUP, WIDE, 1>(block),
        }
    }
}

with_avx512! {
    /// # Safety
    /// As [`run`].
    unsafe fn wide<M: Machine, const R: usize, const V: usize, const P: usize>(block: &Block) {
        // SAFETY: the caller's promise.
        unsafe { columns::<M, R, V, P>(block) }
    }
}

with_bf16! {
    /// # Safety
    /// As [`run`] for bf16.
    unsafe fn wide_brain<M: Machine, const R: usize, const V: usize, const P: usize>(block: &Block) {
        // SAFETY: the caller's promise.
        unsafe { columns::<M, R, V, P>(block) }
    }
}

/// # Safety
/// As [`run`].
pub(crate) unsafe fn spin(arithmetic: Arithmetic, rounds: usize) -> usize {
    // SAFETY: the caller's promise.
    unsafe {
        match arithmetic {
            Arithmetic::Float => spinning::<Float>(rounds),
            Arithmetic::Integer => spinning::<Integer>(rounds),
            Arithmetic::Brain => spinning_brain(rounds),
        }
    }
}

with_avx512! {
    /// # Safety
    /// As [`run`].
    unsafe fn spinning<M: Machine>(rounds: usize) -> usize {
        // SAFETY: the caller's promise.
        unsafe { ceiling::rounds::<M>(rounds) }
    }
}

with_bf16! {
    /// # Safety
    /// As [`run`] for bf16.
    unsafe fn spinning_brain(rounds: usize) -> usize {
        // SAFETY: the caller's promise.
        unsafe { ceiling::rounds::<Brain>(rounds) }
    }
}

machine!(
    /// f32.
    Float: __m512, __m512, 16,
    [_mm512_setzero_ps, _mm512_load_ps, _mm512_store_ps, _mm512_load_ps, spread16_f32, _mm512_add_ps],
    |sum, weight, factor| _mm512_fmadd_ps(weight, factor, sum)
);

machine!(
    /// f32, half a panel.
    HalfFloat: __m256, __m256, 8,
    [_mm256_setzero_ps, _mm256_load_ps, _mm256_store_ps, _mm256_load_ps, spread8_f32, _mm256_add_ps],
    |sum, weight, factor| _mm256_fmadd_ps(weight, factor, sum)
);

machine!(
    /// Pairs of i16.
    Integer: __m512i, __m512i, 16,
    [_mm512_setzero_si512, _mm512_load_si512, _mm512_store_si512, _mm512_load_si512, spread16, _mm512_add_epi32],
    |sum, weight, factor| _mm512_dpwssd_epi32(sum, weight, factor)
);

machine!(
    /// Pairs of i16, half a panel.
    HalfInteger: __m256i, __m256i, 8,
    [_mm256_setzero_si256, _mm256_load_si256, _mm256_store_si256, _mm256_load_si256, spread8, _mm256_add_epi32],
    |sum, weight, factor| _mm256_dpwssd_epi32(sum, weight, factor)
);

machine!(
    /// Pairs of bf16; needs AVX512_BF16.
    Brain: __m512, __m512i, 16,
    [_mm512_setzero_ps, _mm512_load_ps, _mm512_store_ps, _mm512_load_si512, spread16, _mm512_add_ps],
    // SAFETY: the types are 512 bits of anything.
    |sum, weight, factor| _mm512_dpbf16_ps(sum, std::mem::transmute::<__m512i, __m512bh>(weight), std::mem::transmute::<__m512i, __m512bh>(factor))
);

machine!(
    /// Pairs of bf16, half a panel; needs AVX512_BF16.
    HalfBrain: __m256, __m256i, 8,
    [_mm256_setzero_ps, _mm256_load_ps, _mm256_store_ps, _mm256_load_si256, spread8, _mm256_add_ps],
    // SAFETY: the types are 256 bits of anything.
    |sum, weight, factor| _mm256_dpbf16_ps(sum, std::mem::transmute::<__m256i, __m256bh>(weight), std::mem::transmute::<__m256i, __m256bh>(factor))
);

/// # Safety
/// `at` must be readable.
#[target_feature(enable = "avx512f")]
#[inline]
unsafe fn spread16(at: *const i32) -> __m512i {
    // SAFETY: the caller's promise.
    _mm512_set1_epi32(unsafe { at.read_unaligned() })
}

/// # Safety
/// `at` must be readable.
#[target_feature(enable = "avx512f")]
#[inline]
unsafe fn spread16_f32(at: *const f32) -> __m512 {
    // SAFETY: the caller's promise.
    _mm512_set1_ps(unsafe { at.read_unaligned() })
}

/// # Safety
/// `at` must be readable.
#[target_feature(enable = "avx2")]
#[inline]
unsafe fn spread8(at: *const i32) -> __m256i {
    // SAFETY: the caller's promise.
    _mm256_set1_epi32(unsafe { at.read_unaligned() })
}

/// # Safety
/// `at` must be readable.
#[target_feature(enable = "avx2")]
#[inline]
unsafe fn spread8_f32(at: *const f32) -> __m256 {
    // SAFETY: the caller's promise.
    _mm256_set1_ps(unsafe { at.read_unaligned() })
}

with_bf16! {
    /// Rows of f16 as pairs of bf16, rounded to even; an odd row's last pair has a zero.
    ///
    /// # Safety
    /// The processor must also have AVX512_BF16.
    pub(crate) unsafe fn to_brain(input: &[f16], rows: &[u32], cin: usize, to: &mut [u32]) {
        let words = cin.div_ceil(2);
        for (to, &row) in to.chunks_exact_mut(words).zip(rows) {
            let from = &input[row as usize * cin..][..cin];
            for (to, from) in to.chunks_mut(PANEL).zip(from.chunks(2 * PANEL)) {
                let (here, there) = (u32::MAX >> (32 - from.len()), u16::MAX >> (PANEL - to.len()));
                // SAFETY: only the values that are there are read, and only the words that are there written. The types are 512 bits
                // of anything.
                unsafe {
                    let halves = _mm512_maskz_loadu_epi16(here, from.as_ptr().cast());
                    let low = _mm512_cvtph_ps(_mm512_castsi512_si256(halves));
                    let high = _mm512_cvtph_ps(_mm512_extracti64x4_epi64::<1>(halves));
                    let pairs = _mm512_cvtne2ps_pbh(high, low);
                    let pairs = std::mem::transmute::<__m512bh, __m512i>(pairs);
                    _mm512_mask_storeu_epi32(to.as_mut_ptr().cast(), there, pairs);
                }
            }
        }
    }
}

pub(crate) struct Convert;

// SAFETY: AVX-512 F, as its module says.
unsafe impl Halves for Convert {
    #[inline(always)]
    unsafe fn widen(from: &[f16; PANEL], to: &mut [f32; PANEL]) {
        // SAFETY: the arrays hold sixteen values each.
        unsafe {
            let wide = _mm512_cvtph_ps(_mm256_loadu_si256(from.as_ptr().cast()));
            _mm512_storeu_ps(to.as_mut_ptr(), wide);
        }
    }

    #[inline(always)]
    unsafe fn narrow(from: &[f32; PANEL], to: &mut [f16; PANEL]) {
        // SAFETY: the arrays hold sixteen values each.
        unsafe {
            // Of a NaN and a number, the instruction gives the second.
            let wide = _mm512_max_ps(_mm512_loadu_ps(from.as_ptr()), _mm512_set1_ps(-MAX));
            let wide = _mm512_min_ps(wide, _mm512_set1_ps(MAX));
            let narrow = _mm512_cvtps_ph::<_MM_FROUND_TO_NEAREST_INT>(wide);
            _mm256_storeu_si256(to.as_mut_ptr().cast(), narrow);
        }
    }

    #[inline(always)]
    unsafe fn shift(sums: &Lanes, bias: &[i32; PANEL], shift: &[u32; PANEL]) -> [i16; PANEL] {
        // SAFETY: all are sixteen values of 32 bits; the types of the result are the same bits.
        unsafe {
            let sum = _mm512_load_si512(std::ptr::from_ref(sums).cast());
            let sum = _mm512_add_epi32(sum, _mm512_loadu_si512(bias.as_ptr().cast()));
            let sum = _mm512_srav_epi32(sum, _mm512_loadu_si512(shift.as_ptr().cast()));
            let limit = i32::from(LIMIT);
            let sum = _mm512_max_epi32(sum, _mm512_set1_epi32(-limit));
            let sum = _mm512_min_epi32(sum, _mm512_set1_epi32(limit));
            std::mem::transmute(_mm512_cvtepi32_epi16(sum))
        }
    }

    #[inline(always)]
    unsafe fn round(sums: &Lanes, factor: &[f32; PANEL], bias: &[f32; PANEL]) -> [i16; PANEL] {
        // SAFETY: all are sixteen values of 32 bits; the types of the result are the same bits.
        unsafe {
            let sum = _mm512_load_si512(std::ptr::from_ref(sums).cast());
            let value = _mm512_mul_ps(_mm512_cvtepi32_ps(sum), _mm512_loadu_ps(factor.as_ptr()));
            let value = _mm512_add_ps(value, _mm512_loadu_ps(bias.as_ptr()));
            let number = _mm512_cmp_ps_mask::<_CMP_ORD_Q>(value, value);
            let value = _mm512_maskz_mov_ps(number, value);
            let limit = f32::from(LIMIT);
            let value = _mm512_max_ps(value, _mm512_set1_ps(-limit));
            let value = _mm512_min_ps(value, _mm512_set1_ps(limit));
            std::mem::transmute(_mm512_cvtepi32_epi16(_mm512_cvtps_epi32(value)))
        }
    }

    #[inline(always)]
    unsafe fn settle(q: [i16; PANEL], residual: Option<&[i16; PANEL]>, floor: i16) -> [i16; PANEL] {
        // SAFETY: AVX2, which any processor with AVX-512 has.
        unsafe { super::avx2::Convert::settle(q, residual, floor) }
    }
}

// SAFETY: reads and writes 64 bytes, wherever they are.
unsafe impl Registers for Convert {
    type Register = __m512i;
    type Narrow = super::avx2::Convert;
    const BYTES: usize = 64;

    #[inline(always)]
    unsafe fn read(at: *const u8) -> __m512i {
        // SAFETY: the caller's promise.
        unsafe { _mm512_loadu_si512(at.cast()) }
    }

    #[inline(always)]
    unsafe fn write(at: *mut u8, register: __m512i) {
        // SAFETY: the caller's promise.
        unsafe { _mm512_storeu_si512(at.cast(), register) }
    }

    #[inline(always)]
    unsafe fn add16(a: __m512i, b: __m512i) -> __m512i {
        // SAFETY: the caller's promise.
        unsafe { _mm512_add_epi16(a, b) }
    }

    #[inline(always)]
    unsafe fn sub16(a: __m512i, b: __m512i) -> __m512i {
        // SAFETY: the caller's promise.
        unsafe { _mm512_sub_epi16(a, b) }
    }

    #[inline(always)]
    unsafe fn add32(a: __m512i, b: __m512i) -> __m512i {
        // SAFETY: the caller's promise.
        unsafe { _mm512_add_epi32(a, b) }
    }

    #[inline(always)]
    unsafe fn sub32(a: __m512i, b: __m512i) -> __m512i {
        // SAFETY: the caller's promise.
        unsafe { _mm512_sub_epi32(a, b) }
    }

    #[inline(always)]
    unsafe fn eighth(a: __m512i) -> __m512i {
        // SAFETY: the caller's promise.
        unsafe { _mm512_srai_epi32::<3>(a) }
    }
}
