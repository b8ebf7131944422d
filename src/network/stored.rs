//! Layers as the model file has them, in f16, and what they run as.

use b2p_kernels::f16;
use b2p_kernels::{ExactConv, FloatConv, LIMIT, Requantise, Scale};

use super::structure::Spec;

/// A layer of the close zone.
pub(super) struct Stored {
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
/// Sums of products of 3³ kernels stay below this, with which all children of a voxel are computed at once ([`ExactConv`]).
const SMALL_SUM_LIMIT: u64 = 1 << 28;

impl Stored {
    /// The layer in floats.
    pub fn float(&self) -> FloatConv {
        let Spec {
            volume, cin, cout, ..
        } = self.spec;
        let scale = match &self.gain {
            Some(gain) => Scale::Invariant(gain.clone()),
            None => Scale::Plain,
        };
        FloatConv::new(volume, cin, cout, &self.weights, self.bias.clone(), scale)
    }

    /// The layer in integers: its input is in steps of `from`, its output in steps of `to`. A channel's largest weight becomes 2047,
    /// or seven eighths of that and so on until no sum can be too large.
    pub fn integer(&self, from: f32, to: f32) -> ExactConv {
        let Spec {
            volume, cin, cout, ..
        } = self.spec;
        let mut weights = vec![0; self.weights.len()];
        let mut steps = vec![0.0; cout];
        for (o, step) in steps.iter_mut().enumerate() {
            let channel = self.weights[o..].iter().step_by(cout);
            let channel: Vec<f64> = channel.map(|w| w.to_f64()).collect();
            let peak = channel.iter().fold(0.0, |peak: f64, w| peak.max(w.abs()));
            let total: f64 = channel.iter().map(|w| w.abs()).sum();
            let scale = |top: u64| if peak > 0.0 { top as f64 / peak } else { 0.0 };
            let quantised = |top: u64| {
                let scale = scale(top);
                let steps = channel.iter().map(move |w| w * scale);
                steps.map(|w| w.round_ties_even() as i64)
            };
            let limit = if volume == 27 {
                SMALL_SUM_LIMIT
            } else {
                SUM_LIMIT
            };
            let overflows = |top: &u64| {
                // Rounding takes half a step off a weight at most, so that most tops are known to be too large.
                let least = total * scale(*top) - channel.len() as f64 / 2.0;
                if least * f64::from(LIMIT) >= limit as f64 {
                    return true;
                }
                let (sum, squares) = quantised(*top).fold((0, 0), |(sum, squares), q| {
                    let q = q.unsigned_abs();
                    (sum + q, squares + q * q)
                });
                sum * u64::from(LIMIT.unsigned_abs()) >= limit || squares >= SUM_LIMIT
            };
            let mut tops = std::iter::successors(Some(WEIGHT), |top| Some(top * 7 / 8));
            let top = tops.find(|top| !overflows(top)).unwrap_or(0);
            for (q, weight) in quantised(top).zip(weights[o..].iter_mut().step_by(cout)) {
                // In ±2047 by construction.
                *weight = q as i16;
            }
            *step = if top > 0 { peak / top as f64 } else { 0.0 };
        }
        let ratio = f64::from(from) / f64::from(to);
        let bias = self.bias.iter().map(|b| b / to).collect();
        let requantise = match &self.gain {
            Some(gain) => Requantise::Invariant {
                gain: gain
                    .iter()
                    .map(|g| (f64::from(*g) * ratio) as f32)
                    .collect(),
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
