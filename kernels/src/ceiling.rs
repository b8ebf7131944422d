//! What one core can do at best, to judge the kernels by: loops of their own multiply-adds that wait for nothing.
//!
//! Each function measures for about 10 ms and gives the best rate that it saw, in 10⁹ multiply-adds per second. For plain Rust
//! (`scalar`) it tells what the compiler makes of such a loop, which is no bound.
//! Numbers are of many different bits, as a layer's are: with zeros alone AMX came out 1 % faster.

use std::hint::black_box;
use std::time::{Duration, Instant};

#[cfg(target_arch = "x86_64")]
use crate::machine::amx;
use crate::rows::{Lanes, PANEL};
use crate::simd::Isa;
use crate::tile::{Arithmetic, Machine, spin};

/// f32 multiply-adds: the bound of [`crate::FloatConv`].
pub fn f32(isa: Isa) -> f64 {
    measure(isa, Arithmetic::Float)
}

/// i16 by i16, summed in i32: the bound of [`crate::ExactConv`]. With tiles, a third of the products of bytes that they can do: three
/// make one of what a layer multiplies.
pub fn i16(isa: Isa) -> f64 {
    #[cfg(target_arch = "x86_64")]
    if isa.has_tiles() {
        return best(|| amx::spin(isa, ROUNDS)) / 3.0;
    }
    #[cfg(target_arch = "aarch64")]
    if isa.dot().is_some() {
        return best(|| crate::machine::dot::spin(isa, ROUNDS));
    }
    measure(isa, Arithmetic::Integer)
}

/// bf16 by bf16, summed in f32: the bound of [`crate::Precision::Bf16`]. Where that falls back to f32, so does this.
pub fn bf16(isa: Isa) -> f64 {
    #[cfg(target_arch = "x86_64")]
    if isa.has_tiles() {
        return best(|| amx::spin_brain(isa, ROUNDS));
    }
    match isa.has_bf16() {
        true => measure(isa, Arithmetic::Brain),
        false => f32(isa),
    }
}

/// f16 by f16, summed in f16: the bound of [`crate::Precision::Half`], whose sums in f32 come on top. Where that falls back to f32, so does this.
pub fn half(isa: Isa) -> f64 {
    #[cfg(target_arch = "aarch64")]
    if isa.has_half() {
        return measure(isa, Arithmetic::Half);
    }
    f32(isa)
}

/// Rounds of one batch, some 50 µs of them.
const ROUNDS: usize = 1 << 14;

fn measure(isa: Isa, arithmetic: Arithmetic) -> f64 {
    best(|| spin(isa, arithmetic, ROUNDS))
}

/// The best rate of `spin`, which gives the number of its products.
fn best(spin: impl Fn() -> usize) -> f64 {
    let begin = Instant::now();
    let mut best: f64 = 0.0;
    while begin.elapsed() < Duration::from_millis(10) {
        let start = Instant::now();
        let products = spin();
        best = best.max(products as f64 / start.elapsed().as_secs_f64() / 1e9);
    }
    best
}

/// Words that are numbers of either sign around 1 as f32, as two bf16 and as two f16, and large ones as two i16: many of their bits differ.
pub(crate) fn some_words<const N: usize>() -> [Lanes; N] {
    let mut state = 1u32;
    [(); N].map(|()| {
        Lanes([(); PANEL].map(|()| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let bits = state ^ (state >> 16);
            0x3f00_3f00 | (bits & 0x80ff_80ff)
        }))
    })
}

/// Multiplies `rounds` times five factors by two vectors of weights, in registers but for the factors, and gives the number of words
/// multiplied.
///
/// # Safety
/// The processor must have `M`'s instructions.
#[inline(always)]
pub(crate) unsafe fn rounds<M: Machine>(rounds: usize) -> usize {
    const ROWS: usize = 5;
    let words: [Lanes; 2] = some_words();
    let mut sink = Lanes::default();
    let from: *const u32 = black_box(&words).as_ptr().cast();
    // SAFETY: `from` holds 32 words, `sink` 16, and no vector has more than 16 lanes.
    unsafe {
        let weights = [M::weight(from), M::weight(from.add(16))];
        let mut sums = [[M::zero(); 2]; ROWS];
        for _ in 0..rounds {
            // Factors come from the cache, or else the compiler would multiply once and for all.
            let from = black_box(from);
            for (r, sums) in sums.iter_mut().enumerate() {
                let factor = M::factor(from.add(r));
                for (sum, &weight) in sums.iter_mut().zip(&weights) {
                    *sum = M::mul_add(*sum, weight, factor);
                }
            }
        }
        for sum in sums.as_flattened() {
            M::store(sink.0.as_mut_ptr(), *sum);
            black_box(&sink);
        }
    }
    rounds * ROWS * 2 * M::LANES
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_instruction_set_has_a_ceiling() {
        for isa in Isa::available() {
            for rate in [f32(isa), i16(isa), bf16(isa), half(isa)] {
                assert!(rate.is_finite() && rate > 0.0, "{isa}: {rate}");
            }
        }
    }
}
