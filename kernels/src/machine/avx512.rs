//! AVX-512 with VNNI: blocks of six rows by four panels, eight by three, twelve by two, one or half of one.

use std::arch::x86_64::*;

use half::f16;

use crate::ceiling;
use crate::convert::{Halves, MAX};
use crate::rows::PANEL;
use crate::tile::{Arithmetic, Block, Machine, columns};

/// # Safety
/// The processor must have AVX-512 F, BW, CD, DQ, VL and VNNI; the rest as [`columns`].
pub(crate) unsafe fn run(arithmetic: Arithmetic, block: &Block, whole: usize) -> usize {
    // SAFETY: the caller's promise for as many panels as each call multiplies.
    unsafe {
        match arithmetic {
            Arithmetic::Float => panels::<Float, HalfFloat>(block, whole),
            Arithmetic::Integer => panels::<Integer, HalfInteger>(block, whole),
        }
    }
    whole.clamp(1, 4)
}

/// # Safety
/// As [`run`].
#[inline(always)]
unsafe fn panels<M: Machine, H: Machine>(block: &Block, whole: usize) {
    // SAFETY: the caller's promise.
    unsafe {
        match whole {
            0 => wide::<H, 12, 1>(block),
            1 => wide::<M, 12, 1>(block),
            2 => wide::<M, 12, 2>(block),
            3 => wide::<M, 8, 3>(block),
            _ => wide::<M, 6, 4>(block),
        }
    }
}

/// # Safety
/// As [`run`].
#[target_feature(
    enable = "avx2,fma,f16c,bmi1,bmi2,popcnt,lzcnt,avx512f,avx512bw,avx512cd,avx512dq,avx512vl,avx512vnni"
)]
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
        }
    }
}

/// # Safety
/// As [`run`].
#[target_feature(
    enable = "avx2,fma,f16c,bmi1,bmi2,popcnt,lzcnt,avx512f,avx512bw,avx512cd,avx512dq,avx512vl,avx512vnni"
)]
unsafe fn spinning<M: Machine>(rounds: usize) -> usize {
    // SAFETY: the caller's promise.
    unsafe { ceiling::rounds::<M>(rounds) }
}

struct Float;

// SAFETY: reads and writes `LANES` words, `factor` one.
unsafe impl Machine for Float {
    type Sum = __m512;
    type Weight = __m512;
    type Factor = __m512;
    const LANES: usize = 16;

    #[inline(always)]
    unsafe fn zero() -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { _mm512_setzero_ps() }
    }

    #[inline(always)]
    unsafe fn load(at: *const u32) -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { _mm512_load_ps(at.cast()) }
    }

    #[inline(always)]
    unsafe fn store(at: *mut u32, sum: Self::Sum) {
        // SAFETY: the caller's promise.
        unsafe { _mm512_store_ps(at.cast(), sum) }
    }

    #[inline(always)]
    unsafe fn weight(at: *const u32) -> Self::Weight {
        // SAFETY: the caller's promise.
        unsafe { _mm512_load_ps(at.cast()) }
    }

    #[inline(always)]
    unsafe fn factor(at: *const u32) -> Self::Factor {
        // SAFETY: the caller's promise.
        unsafe { _mm512_set1_ps(at.cast::<f32>().read_unaligned()) }
    }

    #[inline(always)]
    unsafe fn mul_add(sum: Self::Sum, weight: Self::Weight, factor: Self::Factor) -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { _mm512_fmadd_ps(weight, factor, sum) }
    }
}

struct HalfFloat;

// SAFETY: reads and writes `LANES` words, `factor` one.
unsafe impl Machine for HalfFloat {
    type Sum = __m256;
    type Weight = __m256;
    type Factor = __m256;
    const LANES: usize = 8;

    #[inline(always)]
    unsafe fn zero() -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { _mm256_setzero_ps() }
    }

    #[inline(always)]
    unsafe fn load(at: *const u32) -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { _mm256_load_ps(at.cast()) }
    }

    #[inline(always)]
    unsafe fn store(at: *mut u32, sum: Self::Sum) {
        // SAFETY: the caller's promise.
        unsafe { _mm256_store_ps(at.cast(), sum) }
    }

    #[inline(always)]
    unsafe fn weight(at: *const u32) -> Self::Weight {
        // SAFETY: the caller's promise.
        unsafe { _mm256_load_ps(at.cast()) }
    }

    #[inline(always)]
    unsafe fn factor(at: *const u32) -> Self::Factor {
        // SAFETY: the caller's promise.
        unsafe { _mm256_set1_ps(at.cast::<f32>().read_unaligned()) }
    }

    #[inline(always)]
    unsafe fn mul_add(sum: Self::Sum, weight: Self::Weight, factor: Self::Factor) -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { _mm256_fmadd_ps(weight, factor, sum) }
    }
}

struct Integer;

// SAFETY: reads and writes `LANES` words, `factor` one.
unsafe impl Machine for Integer {
    type Sum = __m512i;
    type Weight = __m512i;
    type Factor = __m512i;
    const LANES: usize = 16;

    #[inline(always)]
    unsafe fn zero() -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { _mm512_setzero_si512() }
    }

    #[inline(always)]
    unsafe fn load(at: *const u32) -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { _mm512_load_si512(at.cast()) }
    }

    #[inline(always)]
    unsafe fn store(at: *mut u32, sum: Self::Sum) {
        // SAFETY: the caller's promise.
        unsafe { _mm512_store_si512(at.cast(), sum) }
    }

    #[inline(always)]
    unsafe fn weight(at: *const u32) -> Self::Weight {
        // SAFETY: the caller's promise.
        unsafe { _mm512_load_si512(at.cast()) }
    }

    #[inline(always)]
    unsafe fn factor(at: *const u32) -> Self::Factor {
        // SAFETY: the caller's promise.
        unsafe { _mm512_set1_epi32(at.cast::<i32>().read_unaligned()) }
    }

    #[inline(always)]
    unsafe fn mul_add(sum: Self::Sum, weight: Self::Weight, factor: Self::Factor) -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { _mm512_dpwssd_epi32(sum, weight, factor) }
    }
}

struct HalfInteger;

// SAFETY: reads and writes `LANES` words, `factor` one.
unsafe impl Machine for HalfInteger {
    type Sum = __m256i;
    type Weight = __m256i;
    type Factor = __m256i;
    const LANES: usize = 8;

    #[inline(always)]
    unsafe fn zero() -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { _mm256_setzero_si256() }
    }

    #[inline(always)]
    unsafe fn load(at: *const u32) -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { _mm256_load_si256(at.cast()) }
    }

    #[inline(always)]
    unsafe fn store(at: *mut u32, sum: Self::Sum) {
        // SAFETY: the caller's promise.
        unsafe { _mm256_store_si256(at.cast(), sum) }
    }

    #[inline(always)]
    unsafe fn weight(at: *const u32) -> Self::Weight {
        // SAFETY: the caller's promise.
        unsafe { _mm256_load_si256(at.cast()) }
    }

    #[inline(always)]
    unsafe fn factor(at: *const u32) -> Self::Factor {
        // SAFETY: the caller's promise.
        unsafe { _mm256_set1_epi32(at.cast::<i32>().read_unaligned()) }
    }

    #[inline(always)]
    unsafe fn mul_add(sum: Self::Sum, weight: Self::Weight, factor: Self::Factor) -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { _mm256_dpwssd_epi32(sum, weight, factor) }
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
}
