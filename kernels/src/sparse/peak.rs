//! Peak throughput of one core, to judge the kernels by: loops of multiply-adds that wait for nothing.
//!
//! Each measurement takes about 10 ms and gives the best rate seen, in 10⁹ multiply-adds per second. For
//! [`Scalar`](crate::Scalar) it tells what the compiler makes of such a loop, which is no bound. The numbers have many
//! different bits, as those of layers do: with zeros alone AMX came out 1 % faster.

use std::hint::black_box;
use std::time::{Duration, Instant};

use super::microkernel::Microkernel;
use super::rows::{PANEL, Words};

/// Rounds of one batch, some 50 µs of them.
pub(crate) const ROUNDS: usize = 1 << 14;

/// The best rate of `batch`, which gives the number of its products.
pub(crate) fn best(batch: impl Fn() -> usize) -> f64 {
    let begin = Instant::now();
    let mut best: f64 = 0.0;
    while begin.elapsed() < Duration::from_millis(10) {
        let start = Instant::now();
        let products = batch();
        best = best.max(products as f64 / start.elapsed().as_secs_f64() / 1e9);
    }
    best
}

/// Words that are numbers of either sign around 1 as f32, as two bf16 and as two f16, and large ones as two i16: many
/// of their bits differ.
pub(crate) fn some_words<const N: usize>() -> [Words; N] {
    let mut state = 1u32;
    [(); N].map(|()| {
        Words([(); PANEL].map(|()| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let bits = state ^ (state >> 16);
            0x3f00_3f00 | (bits & 0x80ff_80ff)
        }))
    })
}

/// Multiplies `rounds` times five factors by two vectors of weights, in registers but for the factors, and gives the
/// number of words multiplied.
#[inline(always)]
pub(crate) fn rounds<K: Microkernel>(kernel: K, rounds: usize) -> usize {
    const ROWS: usize = 5;
    let words: [Words; 2] = some_words();
    let mut sink = Words::default();
    let from = black_box(&words);
    let weights = [kernel.weight(&from[0].0), kernel.weight(&from[1].0)];
    let mut sums = [[kernel.zero(); 2]; ROWS];
    for _ in 0..rounds {
        // Factors come from the cache, or else the compiler would multiply once and for all.
        let from = black_box(from);
        for (r, sums) in sums.iter_mut().enumerate() {
            let factor = kernel.factor(from[0].0[r]);
            for (sum, &weight) in sums.iter_mut().zip(&weights) {
                *sum = kernel.add_product(*sum, weight, factor);
            }
        }
    }
    for sum in sums.as_flattened() {
        kernel.store(*sum, &mut sink.0);
        black_box(&sink);
    }
    rounds * ROWS * 2 * K::LANES
}
