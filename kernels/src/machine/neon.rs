//! NEON as every AArch64 processor has it: blocks of four rows by one panel, or by half of one.

use std::arch::aarch64::*;
use std::arch::asm;

use crate::f16;

use crate::ceiling;
use crate::convert::{Halves, MAX};
use crate::machine::half;
use crate::rows::PANEL;
use crate::tile::{Arithmetic, Block, Machine, columns};
use crate::winograd::Registers;

/// # Safety
/// The processor must have NEON; the rest as [`columns`].
pub(crate) unsafe fn run(arithmetic: Arithmetic, block: &Block, whole: usize) {
    // SAFETY: the caller's promise for one panel, or half of it.
    unsafe {
        match (arithmetic, whole) {
            (Arithmetic::Float, 0) => wide::<Float, 4, 2, 1>(block),
            (Arithmetic::Float, _) => wide::<Float, 4, 4, 1>(block),
            (Arithmetic::Integer, 0) => wide::<Integer, 4, 1, 1>(block),
            (Arithmetic::Integer, _) => wide::<Integer, 4, 2, 1>(block),
            (Arithmetic::Half, _) => half::run(block),
            (Arithmetic::Brain, _) => unreachable!("NEON has no bf16"),
        }
    }
}

/// # Safety
/// As [`run`].
#[target_feature(enable = "neon")]
unsafe fn wide<M: Machine, const R: usize, const V: usize, const P: usize>(block: &Block) {
    // SAFETY: the caller's promise.
    unsafe { columns::<M, R, V, P>(block) }
}

/// # Safety
/// As [`run`].
pub(crate) unsafe fn spin(arithmetic: Arithmetic, rounds: usize) -> usize {
    // SAFETY: the caller's promise.
    unsafe {
        match arithmetic {
            Arithmetic::Float => spinning::<Float>(rounds),
            Arithmetic::Integer => spinning::<Integer>(rounds),
            Arithmetic::Half => half::spin(rounds),
            Arithmetic::Brain => unreachable!("NEON has no bf16"),
        }
    }
}

/// # Safety
/// As [`run`].
#[target_feature(enable = "neon")]
unsafe fn spinning<M: Machine>(rounds: usize) -> usize {
    // SAFETY: the caller's promise.
    unsafe { ceiling::rounds::<M>(rounds) }
}

/// f32.
struct Float;

// SAFETY: reads and writes `LANES` words, `factor` one.
unsafe impl Machine for Float {
    type Sum = float32x4_t;
    type Weight = float32x4_t;
    type Factor = f32;
    const LANES: usize = 4;

    #[inline(always)]
    unsafe fn zero() -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { vdupq_n_f32(0.0) }
    }

    #[inline(always)]
    unsafe fn load(at: *const u32) -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { vld1q_f32(at.cast()) }
    }

    #[inline(always)]
    unsafe fn store(at: *mut u32, sum: Self::Sum) {
        // SAFETY: the caller's promise.
        unsafe { vst1q_f32(at.cast(), sum) }
    }

    #[inline(always)]
    unsafe fn weight(at: *const u32) -> Self::Weight {
        // SAFETY: the caller's promise.
        unsafe { vld1q_f32(at.cast()) }
    }

    #[inline(always)]
    unsafe fn factor(at: *const u32) -> f32 {
        // SAFETY: the caller's promise.
        unsafe { at.cast::<f32>().read_unaligned() }
    }

    #[inline(always)]
    unsafe fn add(a: Self::Sum, b: Self::Sum) -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { vaddq_f32(a, b) }
    }

    #[inline(always)]
    unsafe fn mul_add(sum: Self::Sum, weight: Self::Weight, factor: f32) -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { vfmaq_n_f32(sum, weight, factor) }
    }
}

/// Pairs of i16: first and second values apart, for the instruction multiplies like by like.
struct Integer;

// SAFETY: reads and writes `LANES` words, `factor` one.
unsafe impl Machine for Integer {
    type Sum = [int32x4_t; 2];
    type Weight = int16x8x2_t;
    type Factor = int16x4_t;
    const LANES: usize = 8;

    #[inline(always)]
    unsafe fn zero() -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { [vdupq_n_s32(0); 2] }
    }

    #[inline(always)]
    unsafe fn load(at: *const u32) -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { [vld1q_s32(at.cast()), vld1q_s32(at.add(4).cast())] }
    }

    #[inline(always)]
    unsafe fn store(at: *mut u32, sum: Self::Sum) {
        // SAFETY: the caller's promise.
        unsafe {
            vst1q_s32(at.cast(), sum[0]);
            vst1q_s32(at.add(4).cast(), sum[1]);
        }
    }

    #[inline(always)]
    unsafe fn weight(at: *const u32) -> Self::Weight {
        // SAFETY: the caller's promise.
        unsafe { vld2q_s16(at.cast()) }
    }

    #[inline(always)]
    unsafe fn factor(at: *const u32) -> int16x4_t {
        // SAFETY: the caller's promise.
        unsafe { vreinterpret_s16_u32(vdup_n_u32(at.read_unaligned())) }
    }

    #[inline(always)]
    unsafe fn add(a: Self::Sum, b: Self::Sum) -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { [vaddq_s32(a[0], b[0]), vaddq_s32(a[1], b[1])] }
    }

    #[inline(always)]
    unsafe fn mul_add(sum: Self::Sum, weight: Self::Weight, factor: int16x4_t) -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe {
            let low = vmlal_lane_s16::<0>(sum[0], vget_low_s16(weight.0), factor);
            let high = vmlal_high_lane_s16::<0>(sum[1], weight.0, factor);
            [
                vmlal_lane_s16::<1>(low, vget_low_s16(weight.1), factor),
                vmlal_high_lane_s16::<1>(high, weight.1, factor),
            ]
        }
    }
}

/// Eight f16 as f32.
#[target_feature(enable = "neon")]
#[inline]
pub(crate) fn widened(narrow: uint16x8_t) -> [float32x4_t; 2] {
    let (low, high);
    // SAFETY: instructions between registers, which any NEON has.
    unsafe {
        asm!(
            "fcvtl {low:v}.4s, {narrow:v}.4h",
            "fcvtl2 {high:v}.4s, {narrow:v}.8h",
            low = out(vreg) low, high = lateout(vreg) high, narrow = in(vreg) narrow,
            options(pure, nomem, nostack, preserves_flags),
        );
    }
    [low, high]
}

pub(crate) struct Convert;

// SAFETY: NEON, as its module says.
unsafe impl Halves for Convert {
    #[inline(always)]
    unsafe fn widen(from: &[f16; PANEL], to: &mut [f32; PANEL]) {
        for half in [0, 8] {
            // SAFETY: eight values are read and written from `half` on.
            unsafe {
                let [low, high] = widened(vld1q_u16(from.as_ptr().add(half).cast()));
                vst1q_f32(to.as_mut_ptr().add(half), low);
                vst1q_f32(to.as_mut_ptr().add(half + 4), high);
            }
        }
    }

    #[inline(always)]
    unsafe fn narrow(from: &[f32; PANEL], to: &mut [f16; PANEL]) {
        for half in [0, 8] {
            // SAFETY: eight values are read and written from `half` on; the instructions convert between two registers.
            unsafe {
                // Of a NaN and a number, the instruction gives the number.
                let within = |at| {
                    let value = vmaxnmq_f32(vld1q_f32(at), vdupq_n_f32(-MAX));
                    vminnmq_f32(value, vdupq_n_f32(MAX))
                };
                let low = within(from.as_ptr().add(half));
                let high = within(from.as_ptr().add(half + 4));
                let narrow: uint16x8_t;
                asm!(
                    "fcvtn {narrow:v}.4h, {low:v}.4s",
                    "fcvtn2 {narrow:v}.8h, {high:v}.4s",
                    low = in(vreg) low, high = in(vreg) high, narrow = out(vreg) narrow,
                    options(pure, nomem, nostack, preserves_flags),
                );
                vst1q_u16(to.as_mut_ptr().add(half).cast(), narrow);
            }
        }
    }
}

// SAFETY: reads and writes 16 bytes, wherever they are.
unsafe impl Registers for Convert {
    type Register = int16x8_t;
    type Narrow = Self;
    const BYTES: usize = 16;

    #[inline(always)]
    unsafe fn read(at: *const u8) -> int16x8_t {
        // SAFETY: the caller's promise.
        unsafe { vld1q_s16(at.cast()) }
    }

    #[inline(always)]
    unsafe fn write(at: *mut u8, register: int16x8_t) {
        // SAFETY: the caller's promise.
        unsafe { vst1q_s16(at.cast(), register) }
    }

    #[inline(always)]
    unsafe fn add16(a: int16x8_t, b: int16x8_t) -> int16x8_t {
        // SAFETY: the caller's promise.
        unsafe { vaddq_s16(a, b) }
    }

    #[inline(always)]
    unsafe fn sub16(a: int16x8_t, b: int16x8_t) -> int16x8_t {
        // SAFETY: the caller's promise.
        unsafe { vsubq_s16(a, b) }
    }

    #[inline(always)]
    unsafe fn add32(a: int16x8_t, b: int16x8_t) -> int16x8_t {
        // SAFETY: the caller's promise.
        unsafe { vreinterpretq_s16_s32(vaddq_s32(vreinterpretq_s32_s16(a), vreinterpretq_s32_s16(b))) }
    }

    #[inline(always)]
    unsafe fn sub32(a: int16x8_t, b: int16x8_t) -> int16x8_t {
        // SAFETY: the caller's promise.
        unsafe { vreinterpretq_s16_s32(vsubq_s32(vreinterpretq_s32_s16(a), vreinterpretq_s32_s16(b))) }
    }

    #[inline(always)]
    unsafe fn eighth(a: int16x8_t) -> int16x8_t {
        // SAFETY: the caller's promise.
        unsafe { vreinterpretq_s16_s32(vshrq_n_s32::<3>(vreinterpretq_s32_s16(a))) }
    }
}
