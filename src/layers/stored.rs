//! Layers as the model file has them, in f16, and what they run as.

use b2p_kernels::f16;
use b2p_kernels::{ExactConv, FloatConv, LIMIT, Requantise, Scale};

/// One layer to be had.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Spec {
    pub name: String,
    /// Taps: 27 (3³), 8 (2³, or one per octant), 1 (linear).
    pub volume: usize,
    pub cin: usize,
    pub cout: usize,
    /// Whether it is geometry-invariant: divided by the norm of its active weights.
    pub invariant: bool,
}

/// A layer of the close zone.
pub(crate) struct Stored {
    pub spec: Spec,
    /// [taps, in, out], finite.
    pub weights: Vec<f16>,
    /// One per output channel.
    pub bias: Vec<f32>,
    /// Of a geometry-invariant layer, one per output channel.
    pub gain: Option<Vec<f32>>,
}

/// The largest weight of a layer that runs in integers, unless sums could overflow.
const WEIGHT: u64 = 2047;
/// Sums of squared weights stay below this, and those of products.
const SUM_LIMIT: u64 = 1 << 31;
/// Sums of products of 3³ kernels stay below this, with which all children of a voxel are computed at once
/// ([`ExactConv`]).
const SMALL_SUM_LIMIT: u64 = 1 << 28;

impl Stored {
    /// The layer in floats.
    pub fn float(&self) -> FloatConv {
        let Spec { volume, cin, cout, .. } = self.spec;
        let scale = match &self.gain {
            Some(gain) => Scale::Invariant(gain.clone()),
            None => Scale::Plain,
        };
        FloatConv::new(volume, cin, cout, &self.weights, self.bias.clone(), scale)
    }

    /// The layer in integers: its input is in steps of `from`, its output in steps of `to`. A channel's largest weight
    /// becomes 2047, or seven eighths of that and so on until no sum can be too large.
    pub fn integer(&self, from: f32, to: f32) -> ExactConv {
        let Spec { volume, cin, cout, .. } = self.spec;
        let real: Vec<f64> = self.weights.iter().map(|w| w.to_f64()).collect();
        let (mut peaks, mut totals) = (vec![0.0f64; cout], vec![0.0; cout]);
        for row in real.chunks_exact(cout) {
            for ((w, peak), total) in row.iter().zip(&mut peaks).zip(&mut totals) {
                *peak = peak.max(w.abs());
                *total += w.abs();
            }
        }
        let scale = |top: u64, peak: f64| if peak > 0.0 { top as f64 / peak } else { 0.0 };
        let limit = if volume == 27 { SMALL_SUM_LIMIT } else { SUM_LIMIT };
        // Rounding takes half a step off a weight at most, so that most tops are known to be too large.
        let lowered = |mut top: u64, o: usize| {
            let least = |top| totals[o] * scale(top, peaks[o]) - (volume * cin) as f64 / 2.0;
            while least(top) * f64::from(LIMIT) >= limit as f64 {
                top = top * 7 / 8;
            }
            top
        };
        let mut tops: Vec<u64> = (0..cout).map(|o| lowered(WEIGHT, o)).collect();
        let mut weights = vec![0i16; real.len()];
        loop {
            let scales = tops.iter().zip(&peaks);
            let scales: Vec<f64> = scales.map(|(&top, &peak)| scale(top, peak)).collect();
            let mut sums = vec![[0, 0]; cout];
            for (to, from) in weights.chunks_exact_mut(cout).zip(real.chunks_exact(cout)) {
                let channels = to.iter_mut().zip(from).zip(&scales).zip(&mut sums);
                for (((to, w), scale), [sum, squares]) in channels {
                    // In ±2047: the largest becomes the top.
                    *to = rounded(w * scale) as i16;
                    let q = u64::from(to.unsigned_abs());
                    *sum += q;
                    *squares += q * q;
                }
            }
            let overflows =
                |[sum, squares]: [u64; 2]| sum * u64::from(LIMIT.unsigned_abs()) >= limit || squares >= SUM_LIMIT;
            let over: Vec<usize> = (0..cout).filter(|&o| overflows(sums[o])).collect();
            if over.is_empty() {
                break;
            }
            for o in over {
                tops[o] = lowered(tops[o] * 7 / 8, o);
            }
        }
        let steps = tops.iter().zip(&peaks);
        let step = |(&top, peak)| if top > 0 { peak / top as f64 } else { 0.0 };
        let steps: Vec<f64> = steps.map(step).collect();
        let ratio = f64::from(from) / f64::from(to);
        let bias = self.bias.iter().map(|b| b / to).collect();
        let requantise = match &self.gain {
            Some(gain) => Requantise::Invariant {
                gain: gain.iter().map(|g| (f64::from(*g) * ratio) as f32).collect(),
                bias,
            },
            None => Requantise::Scale {
                scale: steps.iter().map(|step| (step * ratio) as f32).collect(),
                bias,
            },
        };
        ExactConv::new(volume, cin, cout, &weights, requantise)
    }
}

/// To the nearest integer, halves to even, of numbers below 2⁵¹; `f64::round_ties_even` is a call unless instructions
/// beyond the least are compiled for.
fn rounded(x: f64) -> f64 {
    const ONES: f64 = 1.5 * (1u64 << 52) as f64;
    x + ONES - ONES
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_rounded_to_the_nearest_and_halves_to_even() {
        for i in -10_000..10_000 {
            let x = f64::from(i) / 4.0;
            assert_eq!(rounded(x), x.round_ties_even());
        }
    }
}
