//! The convolution as its definition reads: a triple loop over f64. What the kernels are tested against.

use super::conv::Scale;
use crate::exact::reference::tap;
use crate::sparse::taps::Taps;
use ::half::f16;

/// A value, and how large the terms it was summed from are: what a bound on its rounding error scales with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Value {
    /// The result.
    pub value: f64,
    /// The sum of its terms' magnitudes.
    pub magnitude: f64,
}

/// `rows` rows of a float layer, before any rounding to f16.
pub fn float(
    [cin, cout]: [usize; 2],
    weights: &[f16],
    bias: &[f32],
    scale: &Scale,
    taps: &Taps<'_>,
    input: &[f16],
    rows: usize,
    residual: Option<&[f16]>,
    relu: bool,
) -> Vec<Value> {
    let mut out = Vec::with_capacity(rows * cout);
    for i in 0..rows {
        for o in 0..cout {
            let (mut sum, mut magnitude, mut energy) = (0f64, 0f64, 0f64);
            for k in 0..taps.volume() {
                let Some(row) = tap(taps, i, k) else { continue };
                for c in 0..cin {
                    let w = weights[(k * cin + c) * cout + o].to_f64();
                    let product = w * input[row * cin + c].to_f64();
                    sum += product;
                    magnitude += product.abs();
                    energy += w * w;
                }
            }
            if let Scale::Invariant(gain) = scale {
                let factor = f64::from(gain[o]) / (energy + 1e-8).sqrt();
                sum *= factor;
                magnitude *= factor.abs();
            }
            let extra = residual.map_or(0.0, |x| x[i * cout + o].to_f64());
            let value = sum + f64::from(bias[o]) + extra;
            out.push(Value {
                value: if relu { value.max(0.0) } else { value },
                magnitude: magnitude + f64::from(bias[o]).abs() + extra.abs(),
            });
        }
    }
    out
}
