//! The smooth field that moves a frame onto the one that follows (`docs/format.md`, clauses 17.10.1 to 17.10.4).
//!
//! Vectors of blocks are searched first, each by itself. They show large motions, which descent alone would not reach.
//! Then the corners of the lattice are fitted, coarse to fine, where what a vector gains is worth its bits.

mod blocks;
mod map;

use std::array::from_fn;
use std::ops::Range;

use rayon::prelude::*;

use crate::colour::Ycc;
use crate::geometry::morton;
use crate::motion::{Corners, Lattice};
use blocks::{BLOCK, Blocks, Sample, Samples};
use map::{Map, weights};

/// Bits that a unit of energy of one voxel is worth.
const GAIN: f32 = 0.5;
/// A corner moves voxels that it has less of a share in than this too little to look at.
const LITTLE: f32 = 1.0 / 16.0;
/// A corner moves by these in turn, in quarters of a voxel.
const STEPS: [i16; 6] = [8, 4, 2, 1, 2, 1];

/// A frame's voxels of one level: Morton keys in ascending order, and Y, Co and Cg of each.
pub(super) struct Frame<'a> {
    pub keys: &'a [u64],
    pub values: &'a [Ycc],
}

/// The lattice of a frame whose voxels of level `top` have these keys, with vectors of 0.
fn lattice_of(keys: &[u64], level: u8, top: u8) -> Lattice {
    let mut nodes: Vec<u64> = keys.iter().map(|key| key >> (3 * (top - level))).collect();
    nodes.dedup();
    Lattice::of(&nodes, level)
}

/// The lattice of level `lattice` that moves the voxels of `previous` of level `top` best onto those of `current`, with
/// vectors in voxels of level `unit`. It is zero everywhere where nothing moves.
pub(super) fn estimate(previous: &Frame, current: &Frame, [lattice, top]: [u8; 2], unit: u8) -> Lattice {
    let mut field = lattice_of(previous.keys, lattice, top);
    let map = Map::of(current.voxels());
    let samples = Samples::of(previous, top);
    let blocks = Blocks::search(&map, &samples, [previous, current], top);
    for level in 0..=lattice {
        let (above, corners) = field.level_mut(level);
        let fit = Fit::new(&map, &samples, corners, [level, lattice, top], unit);
        match above {
            None => corners.vectors.fill(fit.common(&blocks)),
            Some(above) => fit.descend(&blocks, above, corners),
        }
    }
    field
}

/// A node of a level of the lattice.
struct Node {
    low: [f32; 3],
    samples: Range<usize>,
    /// The blocks in it, or the one that it is in.
    blocks: Range<usize>,
    corners: [usize; 8],
}

/// One level of the lattice as it is fitted.
struct Fit<'a> {
    map: &'a Map,
    samples: &'a Samples,
    nodes: Vec<Node>,
    /// Of each corner the nodes that it belongs to, and which of their corners it is.
    touching: Vec<Vec<(usize, usize)>>,
    /// Corners of each parity. Those of one share no nodes.
    classes: [Vec<usize>; 8],
    /// Edge of a node in voxels.
    edge: f32,
    /// Voxels per unit of a vector.
    unit: f32,
    /// One sample of so many is looked at.
    stride: usize,
    /// Whether what is between cells counts.
    smooth: bool,
    steps: &'static [i16],
    /// The most of a component.
    most: i32,
}

impl<'a> Fit<'a> {
    fn new(map: &'a Map, samples: &'a Samples, corners: &Corners, [level, last, top]: [u8; 3], unit: u8) -> Self {
        let (size, block) = (top - level, BLOCK.min(top));
        let mut nodes = Vec::new();
        let (mut first, mut blocks) = (0, 0..0);
        for keys in samples.keys.chunk_by(|a, b| a >> (3 * size) == b >> (3 * size)) {
            let key = keys[0] >> (3 * size);
            let low = morton::decode(key);
            let of = |key: u64| samples.blocks.partition_point(|other| other.0 < key);
            blocks = of(keys[0] >> (3 * block))..of((keys[keys.len() - 1] >> (3 * block)) + 1).max(blocks.start);
            nodes.push(Node {
                low: low.map(|x| x as f32),
                samples: first..first + keys.len(),
                blocks: blocks.clone(),
                corners: from_fn(|i| {
                    let i = i as u32;
                    corners.number([low[0] + (i & 1), low[1] + (i >> 1 & 1), low[2] + (i >> 2)])
                }),
            });
            first += keys.len();
        }
        let mut touching = vec![Vec::new(); corners.vectors.len()];
        for (i, node) in nodes.iter().enumerate() {
            (0..8).for_each(|corner| touching[node.corners[corner]].push((i, corner)));
        }
        let mut classes = [const { Vec::new() }; 8];
        for i in 0..corners.vectors.len() {
            let [x, y, z] = corners.at(i).map(|x| x as usize & 1);
            classes[x + 2 * y + 4 * z].push(i);
        }
        let smooth = level + 1 >= last;
        Fit {
            map,
            samples,
            nodes,
            touching,
            classes,
            edge: (1u32 << size) as f32,
            unit: 1.0 / (1u32 << (unit - top)) as f32,
            stride: if level == last {
                1
            } else if smooth {
                2
            } else {
                4
            },
            smooth,
            steps: if smooth { &STEPS } else { &STEPS[..3] },
            most: 1 << unit.min(14),
        }
    }

    /// One vector for all corners.
    fn common(&self, blocks: &Blocks) -> [i16; 3] {
        let chunks: Vec<&[Sample]> = self.samples.samples.chunks(1024).collect();
        let cost = |vector: [i16; 3]| {
            let by = vector.map(|x| f32::from(x) * self.unit);
            let energy = |sample: &Sample| sample.weight * self.map.smooth_energy(sample.moved(by), sample.luma);
            let sums = chunks
                .par_iter()
                .map(|samples| samples.iter().step_by(self.stride).map(energy).sum::<f32>());
            let sums: Vec<f32> = sums.collect();
            GAIN * self.stride as f32 * sums.iter().sum::<f32>() + bits([0; 3], vector)
        };
        let mut best = ([0; 3], cost([0; 3]));
        let mut improve = |vector: [i16; 3]| {
            let cost = cost(vector);
            if cost < best.1 {
                best = (vector, cost);
            }
            best.0
        };
        let median = blocks.median(std::iter::once(0..blocks.vectors.len()));
        let mut vector = median.map_or([0; 3], |median| improve(self.vector(median)));
        for step in self.steps {
            for moved in self.steps_from(vector, *step) {
                vector = improve(moved);
            }
        }
        vector
    }

    /// Moves corners by steps, as long as this costs less.
    fn descend(&self, blocks: &Blocks, above: &Corners, corners: &mut Corners) {
        let count = corners.vectors.len();
        let predicted: Vec<[i16; 3]> = (0..count).map(|i| corners.predicted(Some(above), i)).collect();
        corners.vectors.clone_from(&predicted);
        // Steps that each corner was tried with since a corner near it moved.
        let mut settled = vec![0; count];
        for (round, step) in self.steps.iter().enumerate() {
            for class in &self.classes {
                let moved = |&i: &usize| {
                    let mut tried = vec![predicted[i]];
                    if round == 0 {
                        let ranges = self.touching[i]
                            .iter()
                            .map(|(node, _)| self.nodes[*node].blocks.clone());
                        tried.extend(blocks.median(ranges).map(|median| self.vector(median)));
                    }
                    tried.extend(self.steps_from(corners.vectors[i], *step));
                    (i, self.best(i, &corners.vectors, predicted[i], tried))
                };
                let open: Vec<usize> = class.iter().copied().filter(|i| settled[*i] & step == 0).collect();
                let moved: Vec<(usize, [i16; 3])> = open.par_iter().map(moved).collect();
                for (i, vector) in moved {
                    if vector != corners.vectors[i] {
                        corners.vectors[i] = vector;
                        let near = self.touching[i].iter().flat_map(|(node, _)| self.nodes[*node].corners);
                        near.for_each(|i| settled[i] = 0);
                    } else {
                        settled[i] |= step;
                    }
                }
            }
        }
    }

    /// A vector of whole voxels in units.
    fn vector(&self, voxels: [i32; 3]) -> [i16; 3] {
        voxels.map(|x| ((x as f32 / self.unit) as i32).clamp(-self.most, self.most) as i16)
    }

    /// The vectors that are one step along an axis from this one.
    fn steps_from(&self, vector: [i16; 3], step: i16) -> impl Iterator<Item = [i16; 3]> {
        let quarters = 0.25 / self.unit;
        let step = ((f32::from(step) * quarters) as i32).max(1);
        (0..6).map(move |i| {
            let mut moved = vector;
            let sign = if i & 1 == 0 { step } else { -step };
            moved[i / 2] = (i32::from(moved[i / 2]) + sign).clamp(-self.most, self.most) as i16;
            moved
        })
    }

    /// The vector of corner `i` of least cost: the one it has, or one of `tried`.
    fn best(&self, i: usize, vectors: &[[i16; 3]], predicted: [i16; 3], tried: Vec<[i16; 3]>) -> [i16; 3] {
        let own = vectors[i];
        let energy = self.energies(i, vectors, &[own])[0];
        let mut best = (own, GAIN * energy + bits(predicted, own));
        // No vector can gain more.
        if own == predicted && GAIN * energy < bits([0; 3], [1, 0, 0]) - bits([0; 3], [0; 3]) {
            return own;
        }
        let tried: Vec<[i16; 3]> = tried.into_iter().filter(|vector| *vector != own).collect();
        for (vector, energy) in tried.iter().zip(self.energies(i, vectors, &tried)) {
            let cost = GAIN * energy + bits(predicted, *vector);
            if cost < best.1 {
                best = (*vector, cost);
            }
        }
        best.0
    }

    /// The energies of voxels around corner `i`, if it had each of these vectors.
    fn energies(&self, i: usize, vectors: &[[i16; 3]], tried: &[[i16; 3]]) -> [f32; 8] {
        let mut sums = [0.0; 8];
        for (node, corner) in &self.touching[i] {
            let node = &self.nodes[*node];
            let ends = node
                .corners
                .map(|corner| vectors[corner].map(|x| f32::from(x) * self.unit));
            for sample in self.samples.samples[node.samples.clone()].iter().step_by(self.stride) {
                let part = [0, 1, 2].map(|axis| (sample.place[axis] + 0.5) / self.edge - node.low[axis]);
                let weights = weights(part);
                let share = weights[*corner];
                if share < LITTLE {
                    continue;
                }
                // How far it moves if the corner has no vector.
                let mut rest = [0.0; 3];
                for j in (0..8).filter(|j| j != corner) {
                    (0..3).for_each(|axis| rest[axis] += weights[j] * ends[j][axis]);
                }
                for (sum, vector) in sums.iter_mut().zip(tried) {
                    let by = [0, 1, 2].map(|axis| rest[axis] + share * self.unit * f32::from(vector[axis]));
                    let at = sample.moved(by);
                    let energy = if self.smooth {
                        self.map.smooth_energy(at, sample.luma)
                    } else {
                        self.map.energy(at, sample.luma)
                    };
                    *sum += sample.weight * energy;
                }
            }
        }
        sums.map(|sum| sum * self.stride as f32)
    }
}

/// About what a vector costs in bits where another one is predicted.
fn bits(predicted: [i16; 3], vector: [i16; 3]) -> f32 {
    if vector == predicted {
        return 1.0;
    }
    let axis = |axis: usize| {
        let off = (i32::from(vector[axis]) - i32::from(predicted[axis])).abs();
        0.8 + 2.0 * (1.0 + off as f32).log2()
    };
    2.0 + axis(0) + axis(1) + axis(2)
}

#[cfg(test)]
mod tests {
    use super::map::{around, place, plus};
    use super::*;

    /// Keys and values of a frame.
    type Voxels = (Vec<u64>, Vec<Ycc>);

    const TOP: u8 = 7;
    const UNIT: u8 = TOP + 2;

    fn frame((keys, values): &Voxels) -> Frame<'_> {
        Frame { keys, values }
    }

    fn estimated(previous: &Voxels, current: &Voxels) -> Lattice {
        estimate(&frame(previous), &frame(current), [TOP - 4, TOP], UNIT)
    }

    /// A bumpy surface around the middle of the cube, turned about z by an angle, then moved.
    fn bumpy(angle: f32, by: [i32; 3]) -> Voxels {
        let (sin, cos) = angle.sin_cos();
        let mut voxels = Vec::new();
        for [x, y, z] in around(50) {
            let at = [x, y, z].map(|x| x as f32);
            let [x, y, z] = [cos * at[0] + sin * at[1], cos * at[1] - sin * at[0], at[2]];
            let radius = (x * x + y * y + z * z).sqrt();
            let bumps = 2.0 * ((x * 0.3).sin() + (y * 0.25).sin() + (z * 0.35).sin());
            if (radius - 40.0 - bumps).abs() < 0.6 {
                let luma = 128.0 + 40.0 * ((x * 0.13).sin() + (y * 0.17).cos() + (z * 0.11).sin());
                let place = plus(plus(at.map(|x| x as i32), [64; 3]), by);
                voxels.push((
                    morton::encode(place.map(i32::cast_unsigned)),
                    [(luma * 64.0) as i16, 0, 0],
                ));
            }
        }
        voxels.sort_unstable();
        voxels.into_iter().unzip()
    }

    #[test]
    fn between_equal_frames_nothing_moves() {
        let frame = bumpy(0.0, [0; 3]);
        let field = estimated(&frame, &frame);
        let still = |corners: &Corners| corners.vectors.iter().all(|vector| *vector == [0; 3]);
        assert!(field.levels().iter().all(still));
    }

    #[test]
    fn a_frame_that_moves_as_a_whole_has_one_vector() {
        let field = estimated(&bumpy(0.0, [0; 3]), &bumpy(0.0, [3, -2, 1]));
        let moves = |corners: &Corners| corners.vectors.iter().all(|vector| *vector == [12, -8, 4]);
        assert!(field.levels().iter().all(moves));
    }

    #[test]
    fn a_frame_that_turns_is_followed_by_any_number_of_threads() {
        let (previous, current) = (bumpy(0.0, [0; 3]), bumpy(0.07, [0; 3]));
        let field = estimated(&previous, &current);
        let still = lattice_of(&previous.0, TOP - 4, TOP);
        let energy = |field: &Lattice| mean(&frame(&previous), &frame(&current), field, [TOP - 4, TOP]);
        assert!(
            energy(&field) < energy(&still) / 3.0,
            "{} of {}",
            energy(&field),
            energy(&still)
        );
        let alone = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert_eq!(alone.install(|| estimated(&previous, &current)), field);
    }

    #[test]
    fn frames_without_voxels_have_a_field() {
        let (none, some) = (Voxels::default(), bumpy(0.0, [0; 3]));
        assert!(estimated(&none, &some).is_still());
        assert!(estimated(&some, &none).is_still());
    }

    /// Mean energy of all voxels that a field moves.
    fn mean(previous: &Frame, current: &Frame, field: &Lattice, [level, top]: [u8; 2]) -> f32 {
        let map = Map::of(current.voxels());
        let corners = field.finest();
        let edge = (1u32 << (top - level)) as f32;
        let energy = |(key, luma): &(u64, f32)| {
            let node = morton::decode(key >> (3 * (top - level)));
            let at = place(*key).map(|x| x as f32);
            let weights = weights([0, 1, 2].map(|axis| (at[axis] + 0.5) / edge - node[axis] as f32));
            let mut moved = at;
            for (i, weight) in (0u32..).zip(weights) {
                let corner = corners.number([node[0] + (i & 1), node[1] + (i >> 1 & 1), node[2] + (i >> 2)]);
                (0..3).for_each(|axis| moved[axis] += weight * f32::from(corners.vectors[corner][axis]) / 4.0);
            }
            map.smooth_energy(moved, *luma)
        };
        previous.voxels().iter().map(energy).sum::<f32>() / previous.keys.len() as f32
    }
}
