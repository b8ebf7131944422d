//! Sums in double precision: what other precisions are measured against, with the vectors that the machine has.

use crate::simd::{Isa, Simd, dispatch};

/// Adds to each sum `o` the products `input[c] · weights[c][o]`, one input after the other: the same bits on any
/// instruction set.
///
/// # Panics
/// If there are no sums, or not a weight for each of them and each input.
pub fn add_products(isa: Isa, input: &[f64], weights: &[f64], sums: &mut [f64]) {
    assert_eq!(weights.len(), input.len() * sums.len(), "[input][output]");
    dispatch!(isa, fn products(input: &[f64], weights: &[f64], sums: &mut [f64]));
}

/// Sums that stay in registers.
const BLOCK: usize = 32;

#[inline(always)]
fn products<S: Simd>(_: S, input: &[f64], weights: &[f64], sums: &mut [f64]) {
    let add = |x: f64, weights: &[f64], sums: &mut [f64]| {
        for (sum, w) in sums.iter_mut().zip(weights) {
            *sum += x * w;
        }
    };
    let outputs = sums.len();
    for (block, sums) in sums.chunks_mut(BLOCK).enumerate() {
        let weights = weights.chunks_exact(outputs);
        let weights = weights.map(|weights| &weights[block * BLOCK..]);
        if let Some(sums) = sums.first_chunk_mut::<BLOCK>() {
            let mut kept = *sums;
            for (x, weights) in input.iter().zip(weights) {
                add(*x, &weights[..BLOCK], &mut kept);
            }
            *sums = kept;
        } else {
            for (x, weights) in input.iter().zip(weights) {
                add(*x, weights, sums);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_are_added_up_in_their_order_on_any_instruction_set() {
        let value = |i: usize| (i * 7919 % 1009) as f64 / 3.0 - 150.0;
        for [inputs, outputs] in [[1, 1], [7, 14], [64, 64], [5, 40]] {
            let input: Vec<f64> = (0..inputs).map(value).collect();
            let weights: Vec<f64> = (0..inputs * outputs).map(|i| value(i + 1)).collect();
            let plain = |o: usize| {
                let terms = input.iter().enumerate();
                terms.fold(0.5, |sum, (c, x)| sum + x * weights[c * outputs + o])
            };
            let expected: Vec<f64> = (0..outputs).map(plain).collect();
            for isa in Isa::available() {
                let mut sums = vec![0.5; outputs];
                add_products(isa, &input, &weights, &mut sums);
                assert_eq!(sums, expected, "{isa}");
            }
        }
    }
}
