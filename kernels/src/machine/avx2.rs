//! AVX2 with FMA and F16C: blocks of six rows by one panel, or twelve by half of one.

use std::arch::x86_64::*;

use crate::f16;

use crate::ceiling;
use crate::convert::{Halves, MAX};
use crate::machine::machine;
use crate::rows::PANEL;
use crate::tile::{Arithmetic, Block, Machine, columns};

/// # Safety
/// The processor must have AVX2, FMA and F16C; the rest as [`columns`].
pub(crate) unsafe fn run(arithmetic: Arithmetic, block: &Block, whole: usize) -> usize {
    // SAFETY: the caller's promise for one panel, or half of it.
    unsafe {
        match (arithmetic, whole) {
            (Arithmetic::Float, 0) => wide::<Float, 12, 1>(block),
            (Arithmetic::Float, _) => wide::<Float, 6, 2>(block),
            (Arithmetic::Integer, 0) => wide::<Integer, 12, 1>(block),
            (Arithmetic::Integer, _) => wide::<Integer, 6, 2>(block),
            (Arithmetic::Brain, _) => unreachable!("AVX2 has no bf16"),
        }
    }
    1
}

/// # Safety
/// As [`run`].
#[target_feature(enable = "avx2,fma,f16c,bmi1,bmi2,popcnt,lzcnt")]
unsafe fn wide<M: Machine, const R: usize, const V: usize>(block: &Block) {
    // SAFETY: the caller's promise.
    unsafe { columns::<M, R, V>(block) }
}

/// # Safety
/// As [`run`].
pub(crate) unsafe fn spin(arithmetic: Arithmetic, rounds: usize) -> usize {
    // SAFETY: the caller's promise.
    unsafe {
        match arithmetic {
            Arithmetic::Float => spinning::<Float>(rounds),
            Arithmetic::Integer => spinning::<Integer>(rounds),
            Arithmetic::Brain => unreachable!("AVX2 has no bf16"),
        }
    }
}

/// # Safety
/// As [`run`].
#[target_feature(enable = "avx2,fma,f16c,bmi1,bmi2,popcnt,lzcnt")]
unsafe fn spinning<M: Machine>(rounds: usize) -> usize {
    // SAFETY: the caller's promise.
    unsafe { ceiling::rounds::<M>(rounds) }
}

machine!(
    /// f32.
    Float: __m256, __m256, 8,
    [_mm256_setzero_ps, _mm256_load_ps, _mm256_store_ps, _mm256_load_ps, spread8_f32],
    |sum, weight, factor| _mm256_fmadd_ps(weight, factor, sum)
);

machine!(
    /// Pairs of i16.
    Integer: __m256i, __m256i, 8,
    [_mm256_setzero_si256, _mm256_load_si256, _mm256_store_si256, _mm256_load_si256, spread8],
    |sum, weight, factor| _mm256_add_epi32(sum, _mm256_madd_epi16(weight, factor))
);

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

pub(crate) struct Convert;

// SAFETY: F16C and AVX, as its module says.
unsafe impl Halves for Convert {
    #[inline(always)]
    unsafe fn widen(from: &[f16; PANEL], to: &mut [f32; PANEL]) {
        // SAFETY: the arrays hold sixteen values each.
        unsafe {
            for half in [0, 8] {
                let wide = _mm256_cvtph_ps(_mm_loadu_si128(from.as_ptr().add(half).cast()));
                _mm256_storeu_ps(to.as_mut_ptr().add(half), wide);
            }
        }
    }

    #[inline(always)]
    unsafe fn narrow(from: &[f32; PANEL], to: &mut [f16; PANEL]) {
        // SAFETY: the arrays hold sixteen values each.
        unsafe {
            for half in [0, 8] {
                let wide = _mm256_loadu_ps(from.as_ptr().add(half));
                // Of a NaN and a number, the instruction gives the second.
                let wide = _mm256_max_ps(wide, _mm256_set1_ps(-MAX));
                let wide = _mm256_min_ps(wide, _mm256_set1_ps(MAX));
                let narrow = _mm256_cvtps_ph::<_MM_FROUND_TO_NEAREST_INT>(wide);
                _mm_storeu_si128(to.as_mut_ptr().add(half).cast(), narrow);
            }
        }
    }
}
