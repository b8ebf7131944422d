//! From sums to activations: what layers say, and its bounds.

/// The largest magnitude of an activation.
pub const LIMIT: i16 = 2047;

/// How sums become activations again.
#[derive(Debug, Clone)]
pub enum Requantise {
    /// `clamp((sum + bias) >> shift)`, all wrapping; the rounding constant is part of the bias.
    Shift {
        /// One per output channel.
        bias: Vec<i32>,
        /// One per output channel, at most 31.
        shift: Vec<u8>,
    },
    /// `clamp(round(sum · scale + bias))` in f32, halves to even.
    Scale {
        /// One per output channel.
        scale: Vec<f32>,
        /// One per output channel.
        bias: Vec<f32>,
    },
    /// `clamp(round(sum · (gain / √D) + bias))` in f32, halves to even, with
    /// `D = max(1, Σ weight²)` over the output channel's weights in the taps that read something.
    Invariant {
        /// One per output channel.
        gain: Vec<f32>,
        /// One per output channel.
        bias: Vec<f32>,
    },
}
