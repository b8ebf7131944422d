//! What differs from one instruction set to the next.

#[cfg(target_arch = "x86_64")]
pub(crate) mod amx;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx2;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx2_lists;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx512;
#[cfg(target_arch = "aarch64")]
pub(crate) mod dot;
#[cfg(target_arch = "aarch64")]
pub(crate) mod half;
#[cfg(target_arch = "aarch64")]
pub(crate) mod neon;
pub(crate) mod scalar;

use crate::rows::{Lanes, PANEL};

/// The largest magnitude of a number whose [`digits`], and their sum, are signed bytes.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
const REACH: i16 = 4095;

/// `(high, low)` with `x = 64·high + low`.
///
/// Three products of digits make one of numbers: `high·high`, `low·low`, and `(high + low)·(high + low)`, which contains them and the mixed
/// ones (Karatsuba). Added modulo 2³², as everywhere, sums are equal to the bit.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
fn digits(x: i16) -> (i8, i8) {
    let high = (x + 32) >> 6;
    (high as i8, (x - (high << 6)) as i8)
}

/// The same memory, as words.
pub(crate) fn words_mut(lanes: &mut [Lanes]) -> &mut [u32] {
    // SAFETY: `Lanes` is `repr(C)` and holds `PANEL` words and nothing else; 64 bytes are their size, so there is no padding.
    unsafe { std::slice::from_raw_parts_mut(lanes.as_mut_ptr().cast(), lanes.len() * PANEL) }
}

/// The same memory, as i16.
pub(crate) fn halves_mut(words: &mut [u32]) -> &mut [i16] {
    // SAFETY: two i16 take u32's size, need no more alignment, and have every bit pattern as a value.
    unsafe { std::slice::from_raw_parts_mut(words.as_mut_ptr().cast(), 2 * words.len()) }
}

/// The same memory, as f32.
pub(crate) fn floats_mut(words: &mut [u32]) -> &mut [f32] {
    // SAFETY: f32 has u32's size and alignment, and every word is a value of both.
    unsafe { std::slice::from_raw_parts_mut(words.as_mut_ptr().cast(), words.len()) }
}

/// A [`Machine`](crate::tile::Machine) of `$lanes` words: the intrinsics that make zeros, load, store, spread and add words, and
/// the multiplication.
#[cfg(target_arch = "x86_64")]
macro_rules! machine {
    (
        $(#[$doc:meta])* $name:ident: $sum:ty, $weight:ty, $lanes:literal,
        [$zero:expr, $load:expr, $store:expr, $weights:expr, $spread:expr, $add:expr],
        |$s:ident, $w:ident, $f:ident| $mul_add:expr
    ) => {
        $(#[$doc])*
        struct $name;

        // SAFETY: reads and writes `LANES` words, `factor` one.
        unsafe impl Machine for $name {
            type Sum = $sum;
            type Weight = $weight;
            type Factor = $weight;
            const LANES: usize = $lanes;

            #[inline(always)]
            unsafe fn zero() -> Self::Sum {
                // SAFETY: the caller's promise.
                unsafe { $zero() }
            }

            #[inline(always)]
            unsafe fn load(at: *const u32) -> Self::Sum {
                // SAFETY: the caller's promise.
                unsafe { $load(at.cast()) }
            }

            #[inline(always)]
            unsafe fn store(at: *mut u32, sum: Self::Sum) {
                // SAFETY: the caller's promise.
                unsafe { $store(at.cast(), sum) }
            }

            #[inline(always)]
            unsafe fn weight(at: *const u32) -> Self::Weight {
                // SAFETY: the caller's promise.
                unsafe { $weights(at.cast()) }
            }

            #[inline(always)]
            unsafe fn factor(at: *const u32) -> Self::Factor {
                // SAFETY: the caller's promise.
                unsafe { $spread(at.cast()) }
            }

            #[inline(always)]
            unsafe fn add(a: Self::Sum, b: Self::Sum) -> Self::Sum {
                // SAFETY: the caller's promise.
                unsafe { $add(a, b) }
            }

            #[inline(always)]
            unsafe fn mul_add($s: Self::Sum, $w: Self::Weight, $f: Self::Factor) -> Self::Sum {
                // SAFETY: the caller's promise.
                unsafe { $mul_add }
            }
        }
    };
}
#[cfg(target_arch = "x86_64")]
use machine;

/// Calls the unsafe `$body::<H, …>(args…)` as compiled for `$isa`, `H` being its conversions of f16.
macro_rules! with_halves {
    ($isa:expr, fn $body:ident <$($g:ident: $bound:path),*> ($($arg:ident: $ty:ty),* $(,)?)) => {{
        #[inline(always)]
        fn call<S: $crate::simd::Simd + $crate::convert::HasHalves, $($g: $bound),*> (_: S, $($arg: $ty),*) {
            // SAFETY: the token of these conversions.
            unsafe { $body::<S::Halves, $($g),*>($($arg),*) }
        }
        $crate::simd::dispatch!($isa, fn call<$($g: $bound),*>($($arg: $ty),*))
    }};
}
pub(crate) use with_halves;
