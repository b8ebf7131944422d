//! Codes the coefficients of a slice, node by node (`docs/format.md`, clause 5.7).

use std::ops::Range;

use b2p_kernels::Instructions;
use b2p_kernels::butterflies;

use super::model::{ChromaFromLuma, CoefficientContext, FEATURES, Model, SignContext};
use super::prediction::{Coded, EARLIER_FACES, FaceNeighbours};
use super::space::{Steps, Ycc, clamp};
use super::transform::{AXIS, FRACTIONS, JOINS, JOINS_OF, SCALE, Scale, UNSCALED, forward};
use crate::geometry::KernelMap;
use crate::geometry::codec::guide::Mode;

/// Reads coefficients from an entropy stream, or chooses and writes them.
pub(super) trait CoefficientCoder {
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

/// The nodes of a level, whose children's colours are coded.
#[derive(Clone, Copy)]
pub(super) struct Nodes<'a> {
    /// The 3³ kernel map of the nodes' level.
    pub map: &'a KernelMap,
    /// The 3³ kernel map of the children's level.
    pub children: &'a KernelMap,
    /// The occupancy of each node.
    pub masks: &'a [u8],
    /// The index of each node's first child.
    pub first_child: &'a [u32],
    /// The colour of each node.
    pub values: &'a [Ycc],
    /// The local coefficient energy of each node and channel: 16 times the mean magnitude, at most 255.
    pub energies: &'a [[u8; 3]],
    /// What a previous frame tells of the children.
    pub guide: Option<Guide<'a>>,
}

/// What a previous frame tells of the colours of a level (`docs/format.md`, clause 17.7).
#[derive(Debug, Clone, Copy)]
pub struct Guide<'a> {
    /// The mode of every node.
    pub modes: &'a [Mode],
    /// Y, Co and Cg of every child in the moved previous frame, and whether it is there. Of no meaning for children of
    /// nodes in [`Mode::Intra`].
    pub moved: &'a [Option<Ycc>],
}

/// Coding parameters of a slice.
#[derive(Debug, Clone, Copy)]
pub(super) struct Coding {
    pub steps: Steps,
    /// Factor of the predicted differences, in units of 1/256.
    pub gain: u8,
}

/// Colours and coefficient energies of a coded slice.
pub(super) struct CodedSlice {
    /// The colours of the nodes' children, in order.
    pub values: Vec<Ycc>,
    /// 16 times the mean magnitude of the coefficients of each node and channel, at most 255.
    pub energies: Vec<[u8; 3]>,
}

/// A node's coefficients, clamped to ±127: that of a slot and channel at `4·slot + channel`, then zeros.
type Block = [i8; 32];
/// Eight lanes: Y, Co, Cg and 0, twice.
type Lanes = [i32; 8];

/// Codes the colours of the children of the nodes `range`. An encoder passes the original colours of these children as
/// `truth`.
#[inline(always)]
pub(super) fn code<I: Instructions, S: CoefficientCoder>(
    simd: I,
    coder: &mut S,
    model: &mut Model,
    nodes: Nodes<'_>,
    range: Range<usize>,
    coding: Coding,
    truth: Option<&[Ycc]>,
) -> CodedSlice {
    let first = range.start;
    let base = nodes.first_child.get(first).map_or(0, |&child| child as usize);
    let count: usize = nodes.masks[range.clone()].iter().map(|m| m.count_ones() as usize).sum();
    let mut coded = Coded::new(base, count);
    let mut energies = vec![[0; 3]; range.len()];
    // The last one stays zero: it stands for blocks that are absent or in another slice.
    let mut blocks = vec![Block::default(); range.len() + 1];
    let scales = Scales::new(coding.steps);
    for node in range.clone() {
        let mask = nodes.masks[node];
        let mode = nodes.guide.map_or(Mode::Intra, |guide| guide.modes[node]);
        if mode == Mode::Skip {
            push_moved(&mut coded, nodes, node);
            continue;
        }
        if mask.is_power_of_two() {
            coded.push(nodes.values[node]);
            continue;
        }
        let row = nodes.map.row(node);
        let around = FaceNeighbours::new(nodes.map, nodes.masks, nodes.values, node);
        let joins = &JOINS_OF[usize::from(mask)];
        let fractions = &FRACTIONS[usize::from(mask)];
        let mut predicted = predict(nodes, node, &around, &coded);
        if mode == Mode::Inter {
            predict_moved(&mut predicted, nodes, node);
        }
        let target = truth.map(|truth| {
            let at = nodes.first_child[node] as usize - base;
            forward(mask, spread(mask, &truth[at..])).1
        });
        let (magnitudes, signs) = sum_blocks(EARLIER_FACES.map(|k| {
            let block = (row[k] as usize).wrapping_sub(first).min(range.len());
            &blocks[block]
        }));
        let mut block = NodeCoder {
            model,
            scales: &scales,
            joins,
            gain: if mode == Mode::Inter { 256 } else { coding.gain.into() },
            predicted: butterflies::forward(simd, &JOINS, fractions, predicted),
            gradient: around.gradient(),
            energy: nodes.energies[node].map(|energy| log_class(energy.into())),
            magnitudes,
            signs,
            own: Block::default(),
            sums: [0; 3],
            done: 0,
            children: mask.count_ones() as usize,
        };
        let differences = block.code(simd, coder, target.as_ref());
        let (own, sums, done) = (block.own, block.sums, block.done);
        blocks[node - first] = own;
        energies[node - first] = sums.map(|sum| (16 * sum / done.max(1)).min(255) as u8);
        let [y, co, cg] = nodes.values[node].map(i32::from);
        let mean = [y, co, cg, 0, 0, 0, 0, 0];
        let values = butterflies::inverse(simd, &JOINS, fractions, mean, &differences);
        let fraction = coding.steps.fraction();
        for octant in crate::geometry::ones(mask.into()) {
            let [y, co, cg, ..] = values[octant];
            coded.push([y, co, cg].map(|x| clamp(x, fraction)));
        }
    }
    CodedSlice {
        values: coded.into_values(),
        energies,
    }
}

/// For every slot and channel of three blocks the sum of `min(|q|, 2)`, and the signs (0 zero, 1 plus, 2 minus) as a
/// number in base 3.
#[inline(always)]
fn sum_blocks([a, b, c]: [&Block; 3]) -> ([u8; 32], [u8; 32]) {
    let (mut magnitudes, mut signs) = ([0; 32], [0; 32]);
    for i in 0..32 {
        let magnitude = |q: i8| (q.unsigned_abs()).min(2);
        let sign = |q: i8| u8::from(q > 0) + 2 * u8::from(q < 0);
        magnitudes[i] = magnitude(a[i]) + magnitude(b[i]) + magnitude(c[i]);
        signs[i] = 9 * sign(a[i]) + 3 * sign(b[i]) + sign(c[i]);
    }
    (magnitudes, signs)
}

/// Places the first values of `values` at the octants of `mask`, in order. Other octants are 0.
#[inline(always)]
pub(super) fn spread(mask: u8, values: &[Ycc]) -> [[i32; 3]; 8] {
    let mut by_octant = [[0; 3]; 8];
    for (octant, value) in crate::geometry::ones(mask.into()).zip(values) {
        by_octant[octant] = value.map(i32::from);
    }
    by_octant
}

/// Both predictions of a node's children, by octant, in four lanes each: `near`, which includes the children coded
/// before, then `far`, from the nodes of the level above alone (`docs/format.md`, 5.6.5).
#[inline(always)]
fn predict(nodes: Nodes<'_>, node: usize, around: &FaceNeighbours, coded: &Coded) -> [Lanes; 8] {
    let mut predicted = [[0; 8]; 8];
    let sums = around.sums();
    let first = nodes.first_child[node] as usize;
    for (child, octant) in (first..).zip(crate::geometry::ones(nodes.masks[node].into())) {
        let far = [0, 1, 2, 3].map(|lane| sums[lane][octant]);
        let near = coded.sums(nodes.children.row(child), far);
        let ([a, b, c], [d, e, f]) = (mean(near), mean(far));
        predicted[octant] = [a, b, c, 0, d, e, f, 0];
    }
    predicted
}

/// Gives the children of a skipped node the colours of the moved previous frame; those that are not there, the node's.
#[inline(always)]
fn push_moved(coded: &mut Coded, nodes: Nodes<'_>, node: usize) {
    let first = nodes.first_child[node] as usize;
    for child in first..first + nodes.masks[node].count_ones() as usize {
        let moved = nodes.guide.and_then(|guide| guide.moved[child]);
        coded.push(moved.unwrap_or(nodes.values[node]));
    }
}

/// The largest magnitude of a value.
const LARGEST: i32 = 256 << 6;

/// Replaces the near predictions of children that are in the moved previous frame by their colours there. The others
/// move by the mean of these changes.
#[inline(always)]
fn predict_moved(predicted: &mut [Lanes; 8], nodes: Nodes<'_>, node: usize) {
    let Some(guide) = nodes.guide else {
        return;
    };
    let first = nodes.first_child[node] as usize;
    let (mut shifts, mut count) = ([0i32; 3], 0);
    for (child, octant) in (first..).zip(crate::geometry::ones(nodes.masks[node].into())) {
        if let Some(moved) = guide.moved[child] {
            for t in 0..3 {
                shifts[t] += i32::from(moved[t]) - predicted[octant][t];
                predicted[octant][t] = moved[t].into();
            }
            count += 1;
        }
    }
    let shifts = shifts.map(|shift| shift / count.max(1));
    for (child, octant) in (first..).zip(crate::geometry::ones(nodes.masks[node].into())) {
        if guide.moved[child].is_none() {
            (0..3).for_each(|t| predicted[octant][t] = (predicted[octant][t] + shifts[t]).clamp(-LARGEST, LARGEST));
        }
    }
}

/// The mean from sums of weighted colours and of weights, which must be at least 2.
#[inline(always)]
fn mean([y, co, cg, weight]: [i32; 4]) -> [i32; 3] {
    let weight = weight.max(2) as u32;
    // ⌊2³² / weight⌋
    let inverse = i64::from(u32::MAX / weight + u32::from(weight.is_power_of_two()));
    [y, co, cg].map(|sum| ((i64::from(sum) * inverse + (1 << 31)) >> 32) as i32)
}

/// Quantisation steps of the channels, and their inverses.
struct Scales {
    units: [i32; 3],
    /// `⌊2³² / unit⌋` in lanes of Y, Co, Cg and 0, twice; 0 where the unit is 1, or 0 for a channel without
    /// coefficients.
    inverses: [u32; 8],
    /// All bits set in those lanes.
    units_of_one: [u32; 8],
    lossless: bool,
}

impl Scales {
    fn new(steps: Steps) -> Scales {
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

    #[inline(always)]
    fn scale(&self, [v, w]: [usize; 2]) -> Scale {
        if self.lossless { UNSCALED } else { SCALE[v][w] }
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
fn log_class(x: u32) -> i32 {
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
struct NodeCoder<'a> {
    model: &'a mut Model,
    /// Factor of the predicted differences, in units of 1/256.
    gain: i32,
    scales: &'a Scales,
    joins: &'a super::transform::Joins,
    /// Transforms of both predictions, by slot: four lanes of the one that includes children coded before, and four of
    /// the one from nodes of the level above alone.
    predicted: [Lanes; 7],
    gradient: [i32; 3],
    /// Class of the local coefficient energy by channel.
    energy: [i32; 3],
    /// [`sum_blocks`] of the face neighbours at z − 1, y − 1 and x − 1.
    magnitudes: [u8; 32],
    signs: [u8; 32],
    own: Block,
    /// Sum of the magnitudes coded so far, by channel.
    sums: [u32; 3],
    /// Number of slots coded so far.
    done: u32,
    children: usize,
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
    fn code<I: Instructions, S: CoefficientCoder>(
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
        let weights = self.joins.weights(slot);
        let scale = self.scales.scale(weights);
        let mut context = self.context(slot, weights);
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
    fn context(&self, slot: usize, [v, w]: [usize; 2]) -> CoefficientContext {
        let forward = SCALE[v][w].forward;
        CoefficientContext {
            slot,
            axis: AXIS[slot],
            children: self.children,
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

    #[test]
    fn means_are_those_of_the_format() {
        for weight in (2..40_000i64).step_by(3).chain((1..15).map(|bits| 1 << bits)) {
            for sum in [-weight * 16_384, -12_345, 0, 1, weight / 2, weight * 16_383] {
                let inverse = (1i64 << 32) / weight;
                let expected = ((sum * inverse + (1 << 31)) >> 32) as i32;
                assert_eq!(mean([sum as i32, 0, 0, weight as i32])[0], expected, "{sum} / {weight}");
            }
        }
    }
}
