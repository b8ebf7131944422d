//! Codes the coefficients of a slice, node by node (`docs/format.md`, clause 5.7).

use std::ops::Range;

use super::model::{ChromaFromLuma, CoefficientContext, Model, SignContext};
use super::prediction::{CHILD_WEIGHTS, EARLIER_FACES, NODE_WEIGHTS, SELF_AND_FACES, WeightedMean};
use super::space::{Steps, Ycc, clamp};
use super::transform::{AXIS, JOINS_OF, SCALE, Scale, UNSCALED, forward, inverse};
use crate::geometry::KernelMap;

/// Reads coefficients from an entropy stream, or chooses and writes them.
pub(super) trait CoefficientCoder {
    /// Codes one coefficient in the context `c` and returns it. `target` is the prediction residual, in units of
    /// values, for which an encoder chooses the coefficient; a decoder ignores it.
    fn coefficient(&mut self, model: &mut Model, c: &CoefficientContext, target: i32, quantiser: Quantiser) -> i32;
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

/// A node's coefficients by slot and channel, clamped to ±127.
type Block = [[i8; 3]; 7];

/// Codes the colours of the children of the nodes `range`. An encoder passes the original colours of these children as
/// `truth`.
#[inline(always)]
pub(super) fn code<S: CoefficientCoder>(
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
    let mut coded = CodedSlice {
        values: Vec::with_capacity(count),
        energies: vec![[0; 3]; range.len()],
    };
    let mut blocks = vec![Block::default(); range.len()];
    let scales = Scales::new(coding.steps);
    for node in range.clone() {
        let mask = nodes.masks[node];
        if mask.is_power_of_two() {
            coded.values.push(nodes.values[node]);
            continue;
        }
        let row = nodes.map.row(node);
        let (near, far) = predict(nodes, node, row, base, &coded.values);
        let target = truth.map(|truth| {
            let at = nodes.first_child[node] as usize - base;
            forward(mask, spread(mask, &truth[at..])).1
        });
        let mut block = NodeCoder {
            model,
            coding,
            scales: &scales,
            joins: &JOINS_OF[usize::from(mask)],
            near: forward(mask, near).1,
            far: forward(mask, far).1,
            gradient: gradient(nodes, node, row),
            energy: nodes.energies[node],
            neighbours: EARLIER_FACES.map(|k| {
                let neighbour = row[k] as usize;
                if neighbour != KernelMap::ABSENT as usize && neighbour >= first {
                    blocks[neighbour - first]
                } else {
                    Block::default()
                }
            }),
            own: Block::default(),
            sums: [0; 3],
            done: 0,
            children: mask.count_ones() as usize,
        };
        let differences = block.code(coder, target.as_ref());
        let (own, sums, done) = (block.own, block.sums, block.done);
        blocks[node - first] = own;
        coded.energies[node - first] = sums.map(|sum| (16 * sum / done.max(1)).min(255) as u8);
        let mean = nodes.values[node].map(i32::from);
        let values = inverse(mask, mean, &differences);
        let fraction = coding.steps.fraction();
        for octant in crate::geometry::ones(mask.into()) {
            coded.values.push(values[octant].map(|x| clamp(x, fraction)));
        }
    }
    coded
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

/// Both predictions of a node's children, by octant: `near` includes the children coded before, `far` only the nodes of
/// the level above (`docs/format.md`, 5.6.5).
#[inline(always)]
fn predict(nodes: Nodes<'_>, node: usize, row: &[u32], base: usize, coded: &[Ycc]) -> ([[i32; 3]; 8], [[i32; 3]; 8]) {
    let (mut near, mut far) = ([[0; 3]; 8], [[0; 3]; 8]);
    let around = SELF_AND_FACES.map(|k| row[k]);
    let own_first = nodes.first_child[node] as usize;
    for (child, octant) in (own_first..).zip(crate::geometry::ones(nodes.masks[node].into())) {
        let mut mean = WeightedMean::default();
        for (weights, &neighbour) in NODE_WEIGHTS.iter().zip(&around) {
            if neighbour != KernelMap::ABSENT {
                let neighbour = neighbour as usize;
                let weight = weights[usize::from(nodes.masks[neighbour])][octant];
                mean.add(nodes.values[neighbour], weight.into());
            }
        }
        far[octant] = mean.value();
        let mut more = mean;
        for (&touching, weight) in nodes.children.row(child).iter().zip(CHILD_WEIGHTS) {
            let place = (touching as usize).wrapping_sub(base);
            if place < own_first - base {
                more.add(coded[place], weight);
            }
        }
        near[octant] = more.value();
    }
    (near, far)
}

/// The mean absolute difference to the present face neighbours, by channel.
#[inline(always)]
fn gradient(nodes: Nodes<'_>, node: usize, row: &[u32]) -> [u32; 3] {
    let (mut sums, mut count) = ([0u32; 3], 0);
    let own = nodes.values[node];
    for k in &SELF_AND_FACES[1..] {
        if row[*k] != KernelMap::ABSENT {
            let neighbour = nodes.values[row[*k] as usize];
            for t in 0..3 {
                sums[t] += u32::from(own[t].abs_diff(neighbour[t]));
            }
            count += 1;
        }
    }
    sums.map(|sum| sum / count.max(1))
}

/// Quantisation steps of the channels, and their inverses.
struct Scales {
    units: [i32; 3],
    /// `2³² / unit`, rounded down.
    inverses: [u64; 3],
    lossless: bool,
}

impl Scales {
    fn new(steps: Steps) -> Scales {
        let units = steps.units();
        Scales {
            units,
            inverses: units.map(|unit| (1 << 32) / unit.max(1) as u64),
            lossless: steps.is_lossless(),
        }
    }

    #[inline(always)]
    fn scale(&self, [v, w]: [usize; 2]) -> Scale {
        if self.lossless { UNSCALED } else { SCALE[v][w] }
    }

    /// A difference in units of 1/16 of the channel's step, at most 4095.
    #[inline(always)]
    fn sixteenths(&self, channel: usize, difference: u32, scale: Scale) -> u32 {
        let scaled = (u64::from(difference) * scale.forward as u64) >> 8;
        ((scaled * self.inverses[channel]) >> 32).min(4095) as u32
    }
}

/// `8·log₂(2 + x) − 8` in eighths of an octave, linear within an octave: 0 to 88 for `x` from 0 to 4095.
#[inline(always)]
fn log_class(x: u32) -> i32 {
    let x = x + 2;
    let octave = x.ilog2();
    ((octave << 3 | (x << 3 >> octave) & 7) - 8) as i32
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
    coding: Coding,
    scales: &'a Scales,
    joins: &'a super::transform::Joins,
    /// Transform of the prediction that includes children coded before.
    near: [[i32; 3]; 7],
    /// Transform of the prediction from nodes of the level above alone.
    far: [[i32; 3]; 7],
    gradient: [u32; 3],
    energy: [u8; 3],
    /// The blocks of the face neighbours at z − 1, y − 1 and x − 1; zeros where absent or in another slice.
    neighbours: [Block; 3],
    own: Block,
    /// Sum of the magnitudes coded so far, by channel.
    sums: [u32; 3],
    /// Number of slots coded so far.
    done: u32,
    children: usize,
}

impl NodeCoder<'_> {
    /// Codes all coefficients and returns the decoded differences by slot and channel.
    #[inline(always)]
    fn code<S: CoefficientCoder>(&mut self, coder: &mut S, target: Option<&[[i32; 3]; 7]>) -> [[i32; 3]; 7] {
        let mut differences = [[0; 3]; 7];
        let joins = self.joins;
        for slot in joins.slots() {
            let target = target.map(|all| all[slot]);
            differences[slot] = self.code_slot(coder, slot, target.unwrap_or_default());
            self.done += 1;
        }
        differences
    }

    /// Codes the three channels of one slot.
    #[inline(always)]
    fn code_slot<S: CoefficientCoder>(&mut self, coder: &mut S, slot: usize, target: [i32; 3]) -> [i32; 3] {
        let weights = self.joins.weights(slot);
        let scale = self.scales.scale(weights);
        let mut context = self.context(slot, weights, scale);
        let predicted = self.near[slot];
        let magnitudes: [u32; 3] =
            std::array::from_fn(|t| self.scales.sixteenths(t, predicted[t].unsigned_abs(), scale));
        let mut differences = [0; 3];
        let mut luma = 0;
        for t in 0..3 {
            let mut expected = (predicted[t] * i32::from(self.coding.gain) + 128) >> 8;
            let unit = self.scales.units[t];
            if unit == 0 {
                differences[t] = expected;
                continue;
            }
            let cross_channel = if t > 0 {
                magnitudes[0]
            } else {
                magnitudes[1].max(magnitudes[2])
            };
            self.channel_context(&mut context, t, slot, scale, magnitudes[t], cross_channel);
            let from_luma = if t > 0 {
                predict_chroma(self.model.chroma_from_luma[t - 1], luma, self.scales.units[0])
            } else {
                0
            };
            expected += from_luma;
            let quantiser = Quantiser { scale, unit };
            let q = coder.coefficient(self.model, &context, target[t] - expected, quantiser);
            let decoded = quantiser.difference(q);
            differences[t] = (expected + decoded).clamp(-(1 << 16), 1 << 16);
            if t == 0 {
                luma = decoded;
            } else if luma != 0 {
                adapt_chroma(&mut self.model.chroma_from_luma[t - 1], luma, from_luma + decoded);
            }
            let magnitude = q.unsigned_abs().min(127);
            self.own[slot][t] = q.clamp(-127, 127) as i8;
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
    fn context(&self, slot: usize, [v, w]: [usize; 2], scale: Scale) -> CoefficientContext {
        let forward = if self.scales.lossless {
            super::transform::SCALE[v][w].forward
        } else {
            scale.forward
        };
        CoefficientContext {
            slot,
            axis: AXIS[slot],
            children: self.children,
            weight_class: usize::from(forward > 3000) + usize::from(forward > 3700) + usize::from(forward > 4200),
            ..CoefficientContext::default()
        }
    }

    /// Sets the part of the context that belongs to channel `t`.
    #[inline(always)]
    fn channel_context(
        &self,
        c: &mut CoefficientContext,
        t: usize,
        slot: usize,
        scale: Scale,
        magnitude: u32,
        cross_channel: u32,
    ) {
        let scales = self.scales;
        let (near, far) = (self.near[slot][t], self.far[slot][t]);
        let mut magnitudes = 0;
        let mut signs = 0;
        for block in &self.neighbours {
            let q = i32::from(block[slot][t]);
            magnitudes += q.abs().min(2) as usize;
            signs = 3 * signs + sign_class(q);
        }
        c.channel = t;
        c.neighbour_magnitudes = magnitudes;
        c.energy = log_class(self.energy[t].into());
        c.gradient = log_class(scales.sixteenths(t, self.gradient[t], scale));
        c.near = log_class(magnitude);
        c.far = log_class(scales.sixteenths(t, far.unsigned_abs(), scale));
        c.cross_channel = log_class(cross_channel);
        let first = self.done == 0;
        let block = if first {
            0
        } else {
            log_class(16 * self.sums[t] / self.done)
        };
        c.block = if first { 60 } else { block.min(55) };
        c.sign.near = signed_class(near < 0, magnitude);
        let shift = near - far;
        c.sign.shift = signed_class(shift < 0, scales.sixteenths(t, shift.unsigned_abs(), scale));
        c.sign.neighbours = signs;
        c.features = [
            c.energy - 24,
            c.gradient - 24,
            c.near - 24,
            block - 16,
            c.far - 24,
            c.cross_channel - 24,
            16 * c.luma as i32,
            16 * c.co as i32,
            8 * c.weight_class as i32 - 12,
            8 * magnitudes as i32,
            if first { 24 } else { 0 },
            32,
        ];
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
