//! The coefficients of a slice, node by node.

use std::ops::Range;

use super::model::{Circumstances, Cross, Model, SignCircumstances};
use super::prediction::{BEFORE, Mean, NEAR, TOUCHING_AT, WEIGHTS};
use super::space::{Steps, Ycc, clamp};
use super::transform::{AXIS, JOINS_OF, SCALE, Scale, UNSCALED, forward, inverse};
use crate::geometry::KernelMap;

/// Where coefficients come from, or go to.
pub(super) trait Source {
    /// The coefficient in these circumstances. An encoder chooses it for a difference of `wanted` that is left after prediction; a decoder reads it.
    fn coefficient(&mut self, model: &mut Model, c: &Circumstances, wanted: i32, quantiser: Quantiser) -> i32;
}

/// What a coefficient stands for.
#[derive(Debug, Clone, Copy)]
pub(super) struct Quantiser {
    pub scale: Scale,
    /// The step, in units of values.
    pub unit: i32,
}

impl Quantiser {
    /// The difference that a coefficient stands for.
    #[inline(always)]
    pub fn difference(self, coefficient: i32) -> i32 {
        let product = i64::from(coefficient) * i64::from(self.unit) * i64::from(self.scale.inverse);
        ((product + (1 << 11)) >> 12).clamp(-(1 << 20), 1 << 20) as i32
    }
}

/// A level's nodes, whose children's colours are coded.
#[derive(Clone, Copy)]
pub(super) struct Nodes<'a> {
    /// 3³ kernel map of the nodes' level, and of their children's.
    pub map: &'a KernelMap,
    pub children: &'a KernelMap,
    /// Occupancies, and where each node's children begin.
    pub masks: &'a [u8],
    pub first_child: &'a [u32],
    /// The nodes' colours, and how large coefficients were around each: 16 times the mean magnitude, up to 255.
    pub values: &'a [Ycc],
    pub energies: &'a [[u8; 3]],
}

/// How a slice is coded.
#[derive(Debug, Clone, Copy)]
pub(super) struct Coding {
    pub steps: Steps,
    /// How much of the predicted differences is believed, in units of 1/256.
    pub gain: u8,
}

/// What a slice comes to.
pub(super) struct Coded {
    /// The colours of its nodes' children.
    pub values: Vec<Ycc>,
    /// 16 times the mean magnitude of each node's coefficients, up to 255.
    pub energies: Vec<[u8; 3]>,
}

/// Magnitudes of a node's coefficients, up to 127, with their signs.
type Block = [[i8; 3]; 7];

/// Codes the children of the nodes `range`; `truth` gives an encoder the children's colours.
#[inline(always)]
pub(super) fn code<S: Source>(
    source: &mut S,
    model: &mut Model,
    nodes: Nodes<'_>,
    range: Range<usize>,
    coding: Coding,
    truth: Option<&[Ycc]>,
) -> Coded {
    let first = range.start;
    let base = nodes.first_child.get(first).map_or(0, |&child| child as usize);
    let count: usize = nodes.masks[range.clone()].iter().map(|m| m.count_ones() as usize).sum();
    let mut coded = Coded {
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
        let wanted = truth.map(|truth| {
            let at = nodes.first_child[node] as usize - base;
            forward(mask, spread(mask, &truth[at..])).1
        });
        let mut block = BlockCoder {
            model,
            coding,
            scales: &scales,
            joins: &JOINS_OF[usize::from(mask)],
            predicted: forward(mask, near).1,
            parents: forward(mask, far).1,
            gradient: gradient(nodes, node, row),
            energy: nodes.energies[node],
            beside: BEFORE.map(|k| {
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
        let differences = block.code(source, wanted.as_ref());
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

/// The first values, octant by octant of `mask`.
#[inline(always)]
pub(super) fn spread(mask: u8, values: &[Ycc]) -> [[i32; 3]; 8] {
    let mut by_octant = [[0; 3]; 8];
    for (octant, value) in crate::geometry::ones(mask.into()).zip(values) {
        by_octant[octant] = value.map(i32::from);
    }
    by_octant
}

/// Both predictions of a node's children, octant by octant: with the children that were coded before, and without.
#[inline(always)]
fn predict(nodes: Nodes<'_>, node: usize, row: &[u32], base: usize, coded: &[Ycc]) -> ([[i32; 3]; 8], [[i32; 3]; 8]) {
    let (mut near, mut far) = ([[0; 3]; 8], [[0; 3]; 8]);
    let around = NEAR.map(|k| row[k]);
    let own_first = nodes.first_child[node] as usize;
    for (child, octant) in (own_first..).zip(crate::geometry::ones(nodes.masks[node].into())) {
        let mut mean = Mean::default();
        for (weights, &neighbour) in WEIGHTS.iter().zip(&around) {
            if neighbour != KernelMap::ABSENT {
                let neighbour = neighbour as usize;
                let weight = weights[usize::from(nodes.masks[neighbour])][octant];
                mean.add(nodes.values[neighbour], weight.into());
            }
        }
        far[octant] = mean.value();
        let mut more = mean;
        for (&touching, weight) in nodes.children.row(child).iter().zip(TOUCHING_AT) {
            let place = (touching as usize).wrapping_sub(base);
            if place < own_first - base {
                more.add(coded[place], weight);
            }
        }
        near[octant] = more.value();
    }
    (near, far)
}

/// The mean difference to the face neighbours, by channel.
#[inline(always)]
fn gradient(nodes: Nodes<'_>, node: usize, row: &[u32]) -> [u32; 3] {
    let (mut sums, mut count) = ([0u32; 3], 0);
    let own = nodes.values[node];
    for k in &NEAR[1..] {
        if row[*k] != KernelMap::ABSENT {
            let other = nodes.values[row[*k] as usize];
            for t in 0..3 {
                sums[t] += u32::from(own[t].abs_diff(other[t]));
            }
            count += 1;
        }
    }
    sums.map(|sum| sum / count.max(1))
}

/// The steps of the channels, and their inverses.
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

    /// A difference in 16ths of the step, at most 4095.
    #[inline(always)]
    fn sixteenths(&self, channel: usize, difference: u32, scale: Scale) -> u32 {
        let scaled = (u64::from(difference) * scale.forward as u64) >> 8;
        ((scaled * self.inverses[channel]) >> 32).min(4095) as u32
    }
}

/// Eighths of an octave: `8·log₂(2 + x) − 8`, linear within octaves; 0 to 88 for `x` up to 4095.
#[inline(always)]
fn log(x: u32) -> i32 {
    let x = x + 2;
    let octave = x.ilog2();
    ((octave << 3 | (x << 3 >> octave) & 7) - 8) as i32
}

/// The class of a signed number of 16ths of a step: 4 about 0, 0 to 3 below, 5 to 8 above.
#[inline(always)]
fn signed_class(negative: bool, sixteenths: u32) -> usize {
    let steps = usize::from(sixteenths >= 2)
        + usize::from(sixteenths >= 6)
        + usize::from(sixteenths >= 12)
        + usize::from(sixteenths >= 24);
    if negative { 4 - steps } else { 4 + steps }
}

/// 0 for none, 1 for plus, 2 for minus.
#[inline(always)]
fn sign_of(x: i32) -> usize {
    usize::from(x > 0) + 2 * usize::from(x < 0)
}

/// The block of one node.
struct BlockCoder<'a> {
    model: &'a mut Model,
    coding: Coding,
    scales: &'a Scales,
    joins: &'a super::transform::Joins,
    /// Differences of the predictions: with and without children that were coded before.
    predicted: [[i32; 3]; 7],
    parents: [[i32; 3]; 7],
    gradient: [u32; 3],
    energy: [u8; 3],
    /// The blocks at z − 1, y − 1 and x − 1.
    beside: [Block; 3],
    own: Block,
    /// Magnitudes so far, by channel, and how many slots.
    sums: [u32; 3],
    done: u32,
    children: usize,
}

impl BlockCoder<'_> {
    /// Codes all coefficients and returns the differences that they make.
    #[inline(always)]
    fn code<S: Source>(&mut self, source: &mut S, wanted: Option<&[[i32; 3]; 7]>) -> [[i32; 3]; 7] {
        let mut differences = [[0; 3]; 7];
        let joins = self.joins;
        for slot in joins.slots() {
            let wanted = wanted.map(|all| all[slot]);
            differences[slot] = self.triple(source, slot, wanted.unwrap_or_default());
            self.done += 1;
        }
        differences
    }

    /// The three channels of one slot.
    #[inline(always)]
    fn triple<S: Source>(&mut self, source: &mut S, slot: usize, wanted: [i32; 3]) -> [i32; 3] {
        let weights = self.joins.weights(slot);
        let scale = self.scales.scale(weights);
        let mut shared = self.shared(slot, weights, scale);
        let predicted = self.predicted[slot];
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
            let across = if t > 0 {
                magnitudes[0]
            } else {
                magnitudes[1].max(magnitudes[2])
            };
            self.circumstances(&mut shared, t, slot, scale, magnitudes[t], across);
            let follows = if t > 0 {
                follow(self.model.cross[t - 1], luma, self.scales.units[0])
            } else {
                0
            };
            expected += follows;
            let quantiser = Quantiser { scale, unit };
            let q = source.coefficient(self.model, &shared, wanted[t] - expected, quantiser);
            let brought = quantiser.difference(q);
            differences[t] = (expected + brought).clamp(-(1 << 16), 1 << 16);
            if t == 0 {
                luma = brought;
            } else if luma != 0 {
                learn_cross(&mut self.model.cross[t - 1], luma, follows + brought);
            }
            let magnitude = q.unsigned_abs().min(127);
            self.own[slot][t] = q.clamp(-127, 127) as i8;
            self.sums[t] += magnitude;
            match t {
                0 => {
                    shared.luma = magnitude.min(3) as usize;
                    shared.sign.others = sign_of(q);
                }
                1 => {
                    shared.other = magnitude.min(3) as usize;
                    shared.sign.others += 3 * sign_of(q);
                }
                _ => (),
            }
        }
        differences
    }

    /// What all channels of a slot share.
    #[inline(always)]
    fn shared(&self, slot: usize, [v, w]: [usize; 2], scale: Scale) -> Circumstances {
        let forward = if self.scales.lossless {
            super::transform::SCALE[v][w].forward
        } else {
            scale.forward
        };
        Circumstances {
            slot,
            axis: AXIS[slot],
            children: self.children,
            heavy: usize::from(forward > 3000) + usize::from(forward > 3700) + usize::from(forward > 4200),
            ..Circumstances::default()
        }
    }

    /// The circumstances of one channel.
    #[inline(always)]
    fn circumstances(&self, c: &mut Circumstances, t: usize, slot: usize, scale: Scale, magnitude: u32, across: u32) {
        let scales = self.scales;
        let (predicted, parents) = (self.predicted[slot][t], self.parents[slot][t]);
        let mut beside = 0;
        let mut signs = 0;
        for block in &self.beside {
            let q = i32::from(block[slot][t]);
            beside += q.abs().min(2) as usize;
            signs = 3 * signs + sign_of(q);
        }
        c.channel = t;
        c.beside = beside;
        c.energy = log(self.energy[t].into());
        c.gradient = log(scales.sixteenths(t, self.gradient[t], scale));
        c.predicted = log(magnitude);
        c.parents = log(scales.sixteenths(t, parents.unsigned_abs(), scale));
        c.across = log(across);
        let first = self.done == 0;
        let block = if first { 0 } else { log(16 * self.sums[t] / self.done) };
        c.block = if first { 60 } else { block.min(55) };
        c.sign.predicted = signed_class(predicted < 0, magnitude);
        let shift = predicted - parents;
        c.sign.shift = signed_class(shift < 0, scales.sixteenths(t, shift.unsigned_abs(), scale));
        c.sign.beside = signs;
        c.features = [
            c.energy - 24,
            c.gradient - 24,
            c.predicted - 24,
            block - 16,
            c.parents - 24,
            c.across - 24,
            16 * c.luma as i32,
            16 * c.other as i32,
            8 * c.heavy as i32 - 12,
            8 * beside as i32,
            if first { 24 } else { 0 },
            32,
        ];
    }
}

/// What is expected of a chroma, if luma brought `luma`.
#[inline(always)]
fn follow(cross: Cross, luma: i32, unit: i32) -> i32 {
    if luma == 0 {
        return 0;
    }
    let square = cross.square + 64 * i64::from(unit) * i64::from(unit);
    let ratio = (cross.product * 256 / square).clamp(-512, 512) as i32;
    (ratio * luma + 128) >> 8
}

#[inline(always)]
fn learn_cross(cross: &mut Cross, luma: i32, chroma: i32) {
    let (luma, chroma) = (i64::from(luma), i64::from(chroma));
    cross.product += luma * chroma - (cross.product >> 11);
    cross.square += luma * luma - (cross.square >> 11);
}

impl Default for SignCircumstances {
    fn default() -> Self {
        SignCircumstances {
            predicted: 4,
            shift: 4,
            others: 0,
            beside: 0,
        }
    }
}
