//! Codes the coefficients of one node: their contexts, prediction and quantisation (`docs/format.md`, clauses 5.7.3 to
//! 5.7.5).

use b2p_kernels::Instructions;

use super::model::{ChromaFromLuma, CoefficientContext, FEATURES, Model, SignContext};
use super::space::Steps;
use super::transform::{AXIS, Joins, Scale, UNSCALED, Weighting};

/// Reads coefficients from an entropy stream, or chooses and writes them.
pub(super) trait CoefficientCoder {
    /// Called before the coefficients of a node.
    #[inline(always)]
    fn start(&mut self, _node: usize) {}

    /// Codes one coefficient in the context `c` and returns it. `target` is the prediction residual, in units of
    /// values, for which an encoder chooses the coefficient; a decoder ignores it.
    fn coefficient<I: Instructions>(
        &mut self,
        simd: I,
        model: &mut Model,
        c: &CoefficientContext,
        target: i32,
        quantiser: Quantiser,
    ) -> i32;
}

/// Dequantisation of a coefficient.
#[derive(Debug, Clone, Copy)]
pub(super) struct Quantiser {
    pub scale: Scale,
    /// The quantisation step, in units of values.
    pub unit: i32,
}

impl Quantiser {
    /// The dequantised difference, in units of values.
    #[inline(always)]
    pub fn difference(self, coefficient: i32) -> i32 {
        let product = i64::from(coefficient) * i64::from(self.unit) * i64::from(self.scale.inverse);
        ((product + (1 << 11)) >> 12).clamp(-(1 << 20), 1 << 20) as i32
    }
}

/// A node's coefficients, clamped to ±127: that of a slot and channel at `4·slot + channel`, then zeros.
pub(super) type Block = [i8; 32];
/// Eight lanes: Y, Co, Cg and 0, twice.
pub(super) type Lanes = [i32; 8];

/// Quantisation steps of the channels, and their inverses.
pub(super) struct Scales {
    units: [i32; 3],
    /// `⌊2³² / unit⌋` in lanes of Y, Co, Cg and 0, twice; 0 where the unit is 1, or 0 for a channel without
    /// coefficients.
    inverses: [u32; 8],
    /// All bits set in those lanes.
    units_of_one: [u32; 8],
    lossless: bool,
}

impl Scales {
    pub fn new(steps: Steps) -> Scales {
        let units = steps.units();
        let unit = |lane: usize| units.get(lane % 4).map_or(2, |unit| *unit as u64);
        let inverse = |lane| {
            if unit(lane) < 2 {
                0
            } else {
                ((1 << 32) / unit(lane)) as u32
            }
        };
        Scales {
            units,
            inverses: std::array::from_fn(inverse),
            units_of_one: std::array::from_fn(|lane| if unit(lane) < 2 { u32::MAX } else { 0 }),
            lossless: steps.is_lossless(),
        }
    }

    /// Differences in units of 1/16 of their channel's step, at most 4095, in lanes of Y, Co, Cg and 0, twice.
    #[inline(always)]
    fn sixteenths(&self, differences: Lanes, scale: Scale) -> [u32; 8] {
        let mut sixteenths = [0; 8];
        let forward = scale.forward as u32;
        for (lane, to) in sixteenths.iter_mut().enumerate() {
            let scaled = (differences[lane].unsigned_abs() * forward) >> 8;
            let steps = (u64::from(scaled) * u64::from(self.inverses[lane])) >> 32;
            *to = (steps as u32 + (scaled & self.units_of_one[lane])).min(4095);
        }
        sixteenths
    }
}

/// `8·log₂(2 + x) − 8` in eighths of an octave, linear within an octave: 0 to 88 for `x` from 0 to 4095. The upper bits
/// of a float are its exponent and mantissa.
#[inline(always)]
pub(super) fn log_class(x: u32) -> i32 {
    ((((x + 2) as i32 as f32).to_bits() >> 20) as i32) - (127 << 3) - 8
}

/// Class of a signed number of 16ths of a step: 4 near 0, 3 to 0 for negative, 5 to 8 for positive numbers.
#[inline(always)]
fn signed_class(negative: bool, sixteenths: u32) -> usize {
    let steps = usize::from(sixteenths >= 2)
        + usize::from(sixteenths >= 6)
        + usize::from(sixteenths >= 12)
        + usize::from(sixteenths >= 24);
    if negative { 4 - steps } else { 4 + steps }
}

/// 0 if `x` is 0, 1 if it is positive, 2 if negative.
#[inline(always)]
fn sign_class(x: i32) -> usize {
    usize::from(x > 0) + 2 * usize::from(x < 0)
}

/// Coder of the coefficients of one node.
pub(super) struct NodeCoder<'a> {
    pub model: &'a mut Model,
    /// Factor of the predicted differences, in units of 1/256.
    pub gain: i32,
    pub scales: &'a Scales,
    pub joins: &'a Joins,
    pub weighting: &'a Weighting,
    /// Transforms of both predictions, by slot: four lanes of the one that includes children coded before, and four of
    /// the one from nodes of the level above alone.
    pub predicted: [Lanes; 7],
    pub gradient: [i32; 3],
    /// Class of the local coefficient energy by channel.
    pub energy: [i32; 3],
    /// Magnitudes and signs of the face neighbours at z − 1, y − 1 and x − 1 (`block::sum_blocks`).
    pub magnitudes: [u8; 32],
    pub signs: [u8; 32],
    pub own: Block,
    /// Sum of the magnitudes coded so far, by channel.
    pub sums: [u32; 3],
    /// Number of slots coded so far.
    pub done: u32,
    pub children: usize,
    /// Levels from the children's to the stream's last, at most 3.
    pub height: usize,
}

/// What the contexts of a slot's channels are made of. Lanes are as in [`NodeCoder::predicted`].
struct SlotContext {
    /// Sixteenths of a step of both predictions, and their classes.
    predicted: [u32; 8],
    logs: [i32; 8],
    /// Classes of the shift from the far to the near prediction in lanes 0 to 2, and of the gradient in 4 to 6.
    shift: [u32; 8],
    gradient: [i32; 8],
}

impl NodeCoder<'_> {
    /// Codes all coefficients and returns the decoded differences by slot, in lanes of Y, Co and Cg.
    #[inline(always)]
    pub fn code<I: Instructions, S: CoefficientCoder>(
        &mut self,
        simd: I,
        coder: &mut S,
        target: Option<&[[i32; 3]; 7]>,
    ) -> [Lanes; 7] {
        let mut differences = [[0; 8]; 7];
        let joins = self.joins;
        for slot in joins.slots() {
            let target = target.map(|all| all[slot]);
            let [y, co, cg] = self.code_slot(simd, coder, slot, target.unwrap_or_default());
            differences[slot] = [y, co, cg, 0, 0, 0, 0, 0];
            self.done += 1;
        }
        differences
    }

    /// Codes the three channels of one slot.
    #[inline(always)]
    fn code_slot<I: Instructions, S: CoefficientCoder>(
        &mut self,
        simd: I,
        coder: &mut S,
        slot: usize,
        target: [i32; 3],
    ) -> [i32; 3] {
        let scale = if self.scales.lossless {
            UNSCALED
        } else {
            self.weighting.scales[slot]
        };
        let mut context = self.context(slot);
        let shared = self.slot_context(slot, scale);
        let mut differences = [0; 3];
        let mut luma = 0;
        for t in 0..3 {
            let mut expected = (self.predicted[slot][t] * self.gain + 128) >> 8;
            let unit = self.scales.units[t];
            if unit == 0 {
                differences[t] = expected;
                continue;
            }
            self.channel_context(&mut context, t, slot, &shared);
            let from_luma = if t > 0 {
                predict_chroma(self.model.chroma_from_luma[t - 1], luma, self.scales.units[0])
            } else {
                0
            };
            expected += from_luma;
            let quantiser = Quantiser { scale, unit };
            let q = coder.coefficient(simd, self.model, &context, target[t] - expected, quantiser);
            let decoded = quantiser.difference(q);
            differences[t] = (expected + decoded).clamp(-(1 << 16), 1 << 16);
            if t == 0 {
                luma = decoded;
            } else if luma != 0 {
                adapt_chroma(&mut self.model.chroma_from_luma[t - 1], luma, from_luma + decoded);
            }
            let magnitude = q.unsigned_abs().min(127);
            self.own[4 * slot + t] = q.clamp(-127, 127) as i8;
            self.sums[t] += magnitude;
            match t {
                0 => {
                    context.luma = magnitude.min(3) as usize;
                    context.sign.channels = sign_class(q);
                }
                1 => {
                    context.co = magnitude.min(3) as usize;
                    context.sign.channels += 3 * sign_class(q);
                }
                _ => (),
            }
        }
        differences
    }

    /// The part of the context that all channels of a slot share.
    #[inline(always)]
    fn context(&self, slot: usize) -> CoefficientContext {
        let forward = self.weighting.scales[slot].forward;
        CoefficientContext {
            slot,
            axis: AXIS[slot],
            children: self.children,
            height: self.height,
            weight_class: usize::from(forward > 3000) + usize::from(forward > 3700) + usize::from(forward > 4200),
            ..CoefficientContext::default()
        }
    }

    /// Scales what the contexts of a slot's channels depend on, all channels together.
    #[inline(always)]
    fn slot_context(&self, slot: usize, scale: Scale) -> SlotContext {
        let predicted = self.predicted[slot];
        let mut others = [0; 8];
        for t in 0..3 {
            others[t] = predicted[t] - predicted[4 + t];
            others[4 + t] = self.gradient[t];
        }
        let predicted = self.scales.sixteenths(predicted, scale);
        let others = self.scales.sixteenths(others, scale);
        let (mut logs, mut gradient) = ([0; 8], [0; 8]);
        for lane in 0..8 {
            logs[lane] = log_class(predicted[lane]);
            gradient[lane] = log_class(others[lane]);
        }
        SlotContext {
            predicted,
            logs,
            shift: others,
            gradient,
        }
    }

    /// Sets the part of the context that belongs to channel `t`.
    #[inline(always)]
    fn channel_context(&self, c: &mut CoefficientContext, t: usize, slot: usize, shared: &SlotContext) {
        /// `⌊2¹⁶ / n⌋ + 1`: sums of up to six magnitudes, times 16, are divided exactly.
        const INVERSES: [u32; 8] = [0, 65_536, 32_769, 21_846, 16_385, 13_108, 10_923, 9363];
        let [near, far] = [self.predicted[slot][t], self.predicted[slot][4 + t]];
        c.channel = t;
        c.neighbour_magnitudes = self.magnitudes[4 * slot + t].into();
        c.energy = self.energy[t];
        c.gradient = shared.gradient[4 + t];
        c.near = shared.logs[t];
        c.far = shared.logs[4 + t];
        c.cross_channel = if t > 0 {
            shared.logs[0]
        } else {
            shared.logs[1].max(shared.logs[2])
        };
        let first = self.done == 0;
        let mean = (16 * self.sums[t] * INVERSES[self.done as usize & 7]) >> 16;
        let block = log_class(mean);
        c.block = if first { 60 } else { block.min(55) };
        c.sign.near = signed_class(near < 0, shared.predicted[t]);
        c.sign.shift = signed_class(near < far, shared.shift[t]);
        c.sign.neighbours = self.signs[4 * slot + t].into();
        let features: [i32; FEATURES] = [
            c.energy - 24,
            c.gradient - 24,
            c.near - 24,
            if first { -16 } else { block - 16 },
            c.far - 24,
            c.cross_channel - 24,
            16 * c.luma as i32,
            16 * c.co as i32,
            8 * c.weight_class as i32 - 12,
            8 * c.neighbour_magnitudes as i32,
            if first { 24 } else { 0 },
            32,
        ];
        c.features[..FEATURES].copy_from_slice(&features);
    }
}

/// Prediction of a chroma difference from the dequantised luma residual `luma`; `unit` is luma's step
/// (`docs/format.md`, 5.7.5).
#[inline(always)]
fn predict_chroma(chroma_from_luma: ChromaFromLuma, luma: i32, unit: i32) -> i32 {
    if luma == 0 {
        return 0;
    }
    let square = chroma_from_luma.square + 64 * i64::from(unit) * i64::from(unit);
    let ratio = (chroma_from_luma.product * 256 / square).clamp(-512, 512) as i32;
    (ratio * luma + 128) >> 8
}

#[inline(always)]
fn adapt_chroma(chroma_from_luma: &mut ChromaFromLuma, luma: i32, chroma: i32) {
    let (luma, chroma) = (i64::from(luma), i64::from(chroma));
    chroma_from_luma.product += luma * chroma - (chroma_from_luma.product >> 11);
    chroma_from_luma.square += luma * luma - (chroma_from_luma.square >> 11);
}

impl Default for SignContext {
    fn default() -> Self {
        SignContext {
            near: 4,
            shift: 4,
            channels: 0,
            neighbours: 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithms_are_linear_within_an_octave() {
        for x in 0..=4095u32 {
            let octave = (x + 2).ilog2();
            let expected = ((octave << 3) | (((x + 2) << 3 >> octave) & 7)) as i32 - 8;
            assert_eq!(log_class(x), expected, "{x}");
        }
    }
}
