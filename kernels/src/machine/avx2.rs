//! AVX2 with FMA and F16C, and AVX-VNNI beside: blocks of four rows by one panel, or by half of one.

use std::arch::x86_64::*;

use crate::f16;

use crate::ceiling;
use crate::convert::{Halves, MAX};
use crate::exact::LIMIT;
use crate::machine::machine;
use crate::rows::{Lanes, PANEL};
use crate::simd::avx2::{with_avx_vnni, with_avx2};
use crate::tile::{Arithmetic, Block, Machine, columns};
use crate::winograd::Registers;

/// # Safety
/// The processor must have AVX2, FMA and F16C; the rest as [`columns`].
pub(crate) unsafe fn run(arithmetic: Arithmetic, block: &Block, whole: usize) {
    // SAFETY: the caller's promise for one panel, or half of it.
    unsafe {
        match (arithmetic, whole) {
            (Arithmetic::Float, 0) => wide::<Float, 4, 1, 1>(block),
            (Arithmetic::Float, _) => wide::<Float, 4, 2, 1>(block),
            (Arithmetic::Integer, 0) => wide::<Integer, 4, 1, 1>(block),
            (Arithmetic::Integer, _) => wide::<Integer, 4, 2, 1>(block),
            (Arithmetic::Brain, _) => unreachable!("AVX2 has no bf16"),
        }
    }
}

/// # Safety
/// The processor must have AVX-VNNI, too; the rest as [`run`].
pub(crate) unsafe fn run_vnni(arithmetic: Arithmetic, block: &Block, whole: usize) {
    // SAFETY: the caller's promise for one panel, or half of it.
    unsafe {
        match (arithmetic, whole) {
            (Arithmetic::Integer, 0) => wide_vnni::<Vnni, 4, 1, 2>(block),
            (Arithmetic::Integer, _) => wide_vnni::<Vnni, 4, 2, 1>(block),
            _ => run(arithmetic, block, whole),
        }
    }
}

with_avx_vnni! {
    /// # Safety
    /// As [`run_vnni`].
    unsafe fn wide_vnni<M: Machine, const R: usize, const V: usize, const P: usize>(block: &Block) {
        // SAFETY: the caller's promise.
        unsafe { columns::<M, R, V, P>(block) }
    }
}

/// # Safety
/// As [`run_vnni`].
pub(crate) unsafe fn spin_vnni(arithmetic: Arithmetic, rounds: usize) -> usize {
    // SAFETY: the caller's promise.
    unsafe {
        match arithmetic {
            Arithmetic::Integer => spinning_vnni::<Vnni>(rounds),
            _ => spin(arithmetic, rounds),
        }
    }
}

with_avx_vnni! {
    /// # Safety
    /// As [`run_vnni`].
    unsafe fn spinning_vnni<M: Machine>(rounds: usize) -> usize {
        // SAFETY: the caller's promise.
        unsafe { ceiling::rounds::<M>(rounds) }
    }
}

with_avx2! {
    /// # Safety
    /// As [`run`].
    unsafe fn wide<M: Machine, const R: usize, const V: usize, const P: usize>(block: &Block) {
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
            Arithmetic::Brain => unreachable!("AVX2 has no bf16"),
        }
    }
}

with_avx2! {
    /// # Safety
    /// As [`run`].
    unsafe fn spinning<M: Machine>(rounds: usize) -> usize {
        // SAFETY: the caller's promise.
        unsafe { ceiling::rounds::<M>(rounds) }
    }
}

machine!(
    /// f32.
    Float: __m256, __m256, 8,
    [_mm256_setzero_ps, _mm256_load_ps, _mm256_store_ps, _mm256_load_ps, spread8_f32, _mm256_add_ps],
    |sum, weight, factor| _mm256_fmadd_ps(weight, factor, sum)
);

machine!(
    /// Pairs of i16.
    Integer: __m256i, __m256i, 8,
    [_mm256_setzero_si256, _mm256_load_si256, _mm256_store_si256, _mm256_load_si256, spread8, _mm256_add_epi32],
    |sum, weight, factor| _mm256_add_epi32(sum, _mm256_madd_epi16(weight, factor))
);

machine!(
    /// Pairs of i16, multiplied and added at once.
    Vnni: __m256i, __m256i, 8,
    [_mm256_setzero_si256, _mm256_load_si256, _mm256_store_si256, _mm256_load_si256, spread8, _mm256_add_epi32],
    |sum, weight, factor| _mm256_dpwssd_avx_epi32(sum, weight, factor)
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

    #[inline(always)]
    unsafe fn shift(sums: &Lanes, bias: &[i32; PANEL], shift: &[u32; PANEL]) -> [i16; PANEL] {
        let limit = i32::from(LIMIT);
        // SAFETY: all are sixteen values of 32 bits, read eight by eight.
        unsafe {
            let mut results = [_mm256_setzero_si256(); 2];
            for (half, result) in results.iter_mut().enumerate() {
                let bias = _mm256_loadu_si256(bias.as_ptr().add(8 * half).cast());
                let shift = _mm256_loadu_si256(shift.as_ptr().add(8 * half).cast());
                let sum = _mm256_load_si256(sums.0.as_ptr().add(8 * half).cast());
                let sum = _mm256_add_epi32(sum, bias);
                let sum = _mm256_srav_epi32(sum, shift);
                let sum = _mm256_max_epi32(sum, _mm256_set1_epi32(-limit));
                *result = _mm256_min_epi32(sum, _mm256_set1_epi32(limit));
            }
            join(results)
        }
    }

    #[inline(always)]
    unsafe fn round(sums: &Lanes, factor: &[f32; PANEL], bias: &[f32; PANEL]) -> [i16; PANEL] {
        let limit = f32::from(LIMIT);
        // SAFETY: all are sixteen values of 32 bits, read eight by eight.
        unsafe {
            let mut results = [_mm256_setzero_si256(); 2];
            for (half, result) in results.iter_mut().enumerate() {
                let sum = _mm256_load_si256(sums.0.as_ptr().add(8 * half).cast());
                let factor = _mm256_loadu_ps(factor.as_ptr().add(8 * half));
                let value = _mm256_mul_ps(_mm256_cvtepi32_ps(sum), factor);
                let value = _mm256_add_ps(value, _mm256_loadu_ps(bias.as_ptr().add(8 * half)));
                let value = _mm256_and_ps(value, _mm256_cmp_ps::<_CMP_ORD_Q>(value, value));
                let value = _mm256_max_ps(value, _mm256_set1_ps(-limit));
                *result = _mm256_cvtps_epi32(_mm256_min_ps(value, _mm256_set1_ps(limit)));
            }
            join(results)
        }
    }

    #[inline(always)]
    unsafe fn settle(q: [i16; PANEL], residual: Option<&[i16; PANEL]>, floor: i16) -> [i16; PANEL] {
        // SAFETY: the types are sixteen values of 16 bits.
        unsafe {
            let mut q = std::mem::transmute::<[i16; PANEL], __m256i>(q);
            if let Some(residual) = residual {
                // What is larger than this takes any result beyond the limit, and does not overflow.
                let most = i16::MAX - LIMIT;
                let x = _mm256_loadu_si256(residual.as_ptr().cast());
                let x = _mm256_max_epi16(x, _mm256_set1_epi16(-most));
                let x = _mm256_min_epi16(x, _mm256_set1_epi16(most));
                q = _mm256_min_epi16(_mm256_add_epi16(q, x), _mm256_set1_epi16(LIMIT));
            }
            std::mem::transmute(_mm256_max_epi16(q, _mm256_set1_epi16(floor)))
        }
    }
}

/// Two times eight small numbers as i16.
///
/// # Safety
/// The processor must have AVX2.
#[inline(always)]
unsafe fn join(halves: [__m256i; 2]) -> [i16; PANEL] {
    // SAFETY: the types of the result are the same bits.
    unsafe {
        let packed = _mm256_packs_epi32(halves[0], halves[1]);
        std::mem::transmute(_mm256_permute4x64_epi64::<0b11_01_10_00>(packed))
    }
}

// SAFETY: reads and writes 32 bytes, wherever they are.
unsafe impl Registers for Convert {
    type Register = __m256i;
    type Narrow = Self;
    const BYTES: usize = 32;

    #[inline(always)]
    unsafe fn read(at: *const u8) -> __m256i {
        // SAFETY: the caller's promise.
        unsafe { _mm256_loadu_si256(at.cast()) }
    }

    #[inline(always)]
    unsafe fn write(at: *mut u8, register: __m256i) {
        // SAFETY: the caller's promise.
        unsafe { _mm256_storeu_si256(at.cast(), register) }
    }

    #[inline(always)]
    unsafe fn add16(a: __m256i, b: __m256i) -> __m256i {
        // SAFETY: the caller's promise.
        unsafe { _mm256_add_epi16(a, b) }
    }

    #[inline(always)]
    unsafe fn sub16(a: __m256i, b: __m256i) -> __m256i {
        // SAFETY: the caller's promise.
        unsafe { _mm256_sub_epi16(a, b) }
    }

    #[inline(always)]
    unsafe fn add32(a: __m256i, b: __m256i) -> __m256i {
        // SAFETY: the caller's promise.
        unsafe { _mm256_add_epi32(a, b) }
    }

    #[inline(always)]
    unsafe fn sub32(a: __m256i, b: __m256i) -> __m256i {
        // SAFETY: the caller's promise.
        unsafe { _mm256_sub_epi32(a, b) }
    }

    #[inline(always)]
    unsafe fn eighth(a: __m256i) -> __m256i {
        // SAFETY: the caller's promise.
        unsafe { _mm256_srai_epi32::<3>(a) }
    }
}
