//! Codes the colours of a slice, node by node (`docs/format.md`, clause 5.7).

use std::ops::Range;

use b2p_kernels::Instructions;
use b2p_kernels::butterflies;

use super::model::Model;
use super::node::{Block, CoefficientCoder, Lanes, NodeCoder, Scales, log_class};
use super::prediction::{Coded, EARLIER_FACES, FaceNeighbours};
use super::space::{Steps, Ycc, clamp};
use super::transform::{EVEN, JOINS, JOINS_OF};
use super::weights::Weights;
use crate::geometry::codec::guide::Mode;
use crate::geometry::{RowBuffer, SiblingMap, Window};

/// The nodes of a level, whose children's colours are coded.
#[derive(Clone, Copy)]
pub(super) struct Nodes<'a> {
    /// The map of the nodes' level.
    pub map: &'a SiblingMap,
    /// That of the children's level.
    pub children: &'a SiblingMap,
    /// The weights of the children.
    pub weights: Weights<'a>,
    /// Levels from the children's to the stream's last, at most 3.
    pub height: usize,
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
    let mut own_weighting = EVEN[0];
    let (mut buffer, mut rows) = (RowBuffer::new(), [].as_slice());
    for node in range.clone() {
        let place = (node - first) % RowBuffer::ROWS;
        if place == 0 {
            rows = buffer.fill(nodes.map, node..range.end.min(node + RowBuffer::ROWS));
        }
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
        let row = &rows[27 * place..][..27];
        let around = FaceNeighbours::new(row, nodes.masks, nodes.values, node);
        let joins = &JOINS_OF[usize::from(mask)];
        let window = nodes.children.window(node);
        let first_child = nodes.first_child[node] as usize;
        let weighting = nodes.weights.weighting(mask, first_child, &window, &mut own_weighting);
        let fractions = &weighting.fractions;
        let mut predicted = predict(nodes, node, &around, &coded, &window);
        if mode == Mode::Inter {
            predict_moved(&mut predicted, nodes, node);
        }
        let target = truth.map(|truth| {
            let at = nodes.first_child[node] as usize - base;
            let wide = spread(mask, &truth[at..]).map(|[y, co, cg]| [y, co, cg, 0, 0, 0, 0, 0]);
            butterflies::forward(simd, &JOINS, fractions, wide).map(|[y, co, cg, ..]| [y, co, cg])
        });
        let (magnitudes, signs) = sum_blocks(EARLIER_FACES.map(|k| {
            let block = (row[k] as usize).wrapping_sub(first).min(range.len());
            &blocks[block]
        }));
        let mut block = NodeCoder {
            model,
            scales: &scales,
            joins,
            weighting,
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
            height: nodes.height,
        };
        coder.start(node);
        let differences = block.code(simd, coder, target.as_ref());
        let (own, sums, done) = (block.own, block.sums, block.done);
        blocks[node - first] = own;
        energies[node - first] = sums.map(|sum| (16 * sum / done.max(1)).min(255) as u8);
        let [y, co, cg] = nodes.values[node].map(i32::from);
        let mean = [y, co, cg, 0, 0, 0, 0, 0];
        let values = butterflies::inverse(simd, &JOINS, fractions, mean, &differences);
        let fraction = coding.steps.fraction();
        for octant in crate::geometry::ones(mask) {
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
    for (octant, value) in crate::geometry::ones(mask).zip(values) {
        by_octant[octant] = value.map(i32::from);
    }
    by_octant
}

/// Both predictions of a node's children, by octant, in four lanes each: `near`, which includes the children coded
/// before, then `far`, from the nodes of the level above alone (`docs/format.md`, 5.6.5).
#[inline(always)]
fn predict(nodes: Nodes<'_>, node: usize, around: &FaceNeighbours, coded: &Coded, window: &Window) -> [Lanes; 8] {
    let mut predicted = [[0; 8]; 8];
    let sums = around.sums();
    for octant in crate::geometry::ones(nodes.masks[node]) {
        let far = [0, 1, 2, 3].map(|lane| sums[lane][octant]);
        let near = coded.sums(window.around(octant), far);
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
    for (child, octant) in (first..).zip(crate::geometry::ones(nodes.masks[node])) {
        if let Some(moved) = guide.moved[child] {
            for t in 0..3 {
                shifts[t] += i32::from(moved[t]) - predicted[octant][t];
                predicted[octant][t] = moved[t].into();
            }
            count += 1;
        }
    }
    let shifts = shifts.map(|shift| shift / count.max(1));
    for (child, octant) in (first..).zip(crate::geometry::ones(nodes.masks[node])) {
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

#[cfg(test)]
mod tests {
    use super::*;

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
