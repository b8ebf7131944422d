//! Plain Rust: what every machine has.

use crate::ceiling;
use crate::rows::PANEL;
use crate::tile::{Arithmetic, Block, Machine, columns};

/// # Safety
/// As [`columns`].
pub(crate) unsafe fn run(arithmetic: Arithmetic, block: &Block, _whole: usize) {
    // SAFETY: the caller's promise for one panel; plain Rust needs no instructions of its own.
    unsafe {
        match arithmetic {
            Arithmetic::Float => columns::<Float, 2, 1, 1>(block),
            Arithmetic::Integer => columns::<Integer, 2, 1, 1>(block),
            _ => unreachable!("plain Rust has neither bf16 nor f16"),
        }
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
            _ => unreachable!("plain Rust has neither bf16 nor f16"),
        }
    }
}

/// # Safety
/// As [`run`].
#[inline(never)]
unsafe fn spinning<M: Machine>(rounds: usize) -> usize {
    // SAFETY: the caller's promise.
    unsafe { ceiling::rounds::<M>(rounds) }
}

struct Float;

// SAFETY: reads and writes `LANES` words, `factor` one.
unsafe impl Machine for Float {
    type Sum = [f32; PANEL];
    type Weight = [f32; PANEL];
    type Factor = f32;
    const LANES: usize = PANEL;

    #[inline(always)]
    unsafe fn zero() -> Self::Sum {
        [0.0; PANEL]
    }

    #[inline(always)]
    unsafe fn load(at: *const u32) -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { at.cast::<Self::Sum>().read() }
    }

    #[inline(always)]
    unsafe fn store(at: *mut u32, sum: Self::Sum) {
        // SAFETY: the caller's promise.
        unsafe { at.cast::<Self::Sum>().write(sum) }
    }

    #[inline(always)]
    unsafe fn weight(at: *const u32) -> Self::Weight {
        // SAFETY: the caller's promise.
        unsafe { at.cast::<Self::Weight>().read() }
    }

    #[inline(always)]
    unsafe fn factor(at: *const u32) -> f32 {
        // SAFETY: the caller's promise.
        unsafe { at.cast::<f32>().read_unaligned() }
    }

    #[inline(always)]
    unsafe fn add(a: Self::Sum, b: Self::Sum) -> Self::Sum {
        std::array::from_fn(|j| a[j] + b[j])
    }

    #[inline(always)]
    unsafe fn mul_add(mut sum: Self::Sum, weight: Self::Weight, factor: f32) -> Self::Sum {
        for j in 0..PANEL {
            sum[j] += weight[j] * factor;
        }
        sum
    }
}

struct Integer;

// SAFETY: reads and writes `LANES` words, `factor` one.
unsafe impl Machine for Integer {
    type Sum = [[i32; PANEL / 2]; 2];
    type Weight = [[i16; PANEL]; 2];
    // The pair repeated: like this, compilers see the pairwise product of most machines.
    type Factor = [i16; PANEL];
    const LANES: usize = PANEL;

    #[inline(always)]
    unsafe fn zero() -> Self::Sum {
        [[0; PANEL / 2]; 2]
    }

    #[inline(always)]
    unsafe fn load(at: *const u32) -> Self::Sum {
        // SAFETY: the caller's promise.
        unsafe { at.cast::<Self::Sum>().read() }
    }

    #[inline(always)]
    unsafe fn store(at: *mut u32, sum: Self::Sum) {
        // SAFETY: the caller's promise.
        unsafe { at.cast::<Self::Sum>().write(sum) }
    }

    #[inline(always)]
    unsafe fn weight(at: *const u32) -> Self::Weight {
        // SAFETY: the caller's promise.
        unsafe { at.cast::<Self::Weight>().read() }
    }

    #[inline(always)]
    unsafe fn factor(at: *const u32) -> [i16; PANEL] {
        // SAFETY: the caller's promise.
        let pair = unsafe { at.cast::<[i16; 2]>().read_unaligned() };
        std::array::from_fn(|j| pair[j % 2])
    }

    #[inline(always)]
    unsafe fn add(a: Self::Sum, b: Self::Sum) -> Self::Sum {
        std::array::from_fn(|i| std::array::from_fn(|j| a[i][j].wrapping_add(b[i][j])))
    }

    #[inline(always)]
    unsafe fn mul_add(mut sum: Self::Sum, weight: Self::Weight, factor: [i16; PANEL]) -> Self::Sum {
        for (sum, weight) in sum.iter_mut().zip(&weight) {
            let mut dots = [0; PANEL / 2];
            for (j, dot) in dots.iter_mut().enumerate() {
                let even = i32::from(weight[2 * j]) * i32::from(factor[2 * j]);
                let odd = i32::from(weight[2 * j + 1]) * i32::from(factor[2 * j + 1]);
                *dot = even.wrapping_add(odd);
            }
            for (sum, dot) in sum.iter_mut().zip(dots) {
                *sum = sum.wrapping_add(dot);
            }
        }
        sum
    }
}
