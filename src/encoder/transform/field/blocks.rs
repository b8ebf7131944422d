//! Vectors of blocks, each searched by itself.

use std::ops::Range;

use rayon::prelude::*;

use super::Frame;
use super::map::{Map, Table, around, floor, number, place, plus};
use crate::geometry::Voxels;
use crate::motion::{Places, offset};

/// Levels from the blocks to the finest level, and samples of a block.
pub(super) const BLOCK: u8 = 4;
const SAMPLES: usize = 64;
/// Levels from where large motions are searched to the finest, and how far that is, in voxels there.
const COARSE: u8 = 2;
const REACH: i32 = 5;
/// Large motions of a block that are refined.
const PROMISING: usize = 3;
/// A movement that is less than this from whole voxels is rounded to them, as sixteenths.
const WHOLE: f32 = 1.0 / 32.0;
/// Energy per voxel that a vector of a block costs, for each voxel of its length.
const LENGTH: f32 = 0.01;

/// A voxel of the previous frame that stands for some of its block.
pub(super) struct Sample {
    pub(super) place: [f32; 3],
    /// From there to the surface near it, where it starts from unless it moves by whole voxels.
    step: [f32; 3],
    pub(super) luma: f32,
    /// How many it stands for.
    pub(super) weight: f32,
}

impl Sample {
    /// Where it is when it has moved by so many voxels.
    #[inline]
    pub(super) fn moved(&self, by: [f32; 3]) -> [f32; 3] {
        let is_whole = by.iter().all(|x| (x - floor(x + 0.5) as f32).abs() < WHOLE);
        let step = if is_whole { [0.0; 3] } else { self.step };
        [0, 1, 2].map(|axis| self.place[axis] + step[axis] + by[axis])
    }
}

/// Samples in the order of their keys, and where those of each block are.
pub(super) struct Samples {
    pub(super) keys: Vec<u64>,
    pub(super) samples: Vec<Sample>,
    pub(super) blocks: Vec<(u64, Range<usize>)>,
}

impl Samples {
    pub(super) fn of(frame: &Frame, top: u8) -> Self {
        let shift = 3 * BLOCK.min(top);
        let voxels = frame.voxels();
        let places = Places::new(&Voxels::from_sorted(top, frame.keys.to_vec()));
        let mut near = places.near();
        let (mut keys, mut samples, mut blocks) = (Vec::new(), Vec::new(), Vec::new());
        for voxels in voxels.chunk_by(|a, b| a.0 >> shift == b.0 >> shift) {
            let (first, count) = (keys.len(), voxels.len().min(SAMPLES));
            for i in 0..count {
                let (key, luma) = voxels[(i * voxels.len() + voxels.len() / 2) / count];
                keys.push(key);
                let offset = offset(near.window(place(key).map(|x| x - 1)));
                samples.push(Sample {
                    place: place(key).map(|x| x as f32),
                    step: offset.map(|x| x as f32 / 16.0),
                    luma,
                    weight: voxels.len() as f32 / count as f32,
                });
            }
            blocks.push((voxels[0].0 >> shift, first..keys.len()));
        }
        Samples { keys, samples, blocks }
    }
}

/// Vectors of blocks, in the order of their keys, in whole voxels.
pub(super) struct Blocks {
    pub(super) vectors: Vec<[i32; 3]>,
}

/// Voxels that one vector is searched for.
#[derive(Clone, Copy)]
struct BlockSamples<'a> {
    map: &'a Map,
    samples: &'a [Sample],
    /// Cost of a voxel of length.
    length: f32,
}

impl BlockSamples<'_> {
    /// The cost of a vector, or, if it is more than `most`, a part of it that is, too.
    fn cost(&self, vector: [i32; 3], most: f32) -> f32 {
        let by = vector.map(|x| x as f32);
        let mut cost = self.length * by.iter().map(|x| x.abs()).sum::<f32>() * self.samples.len() as f32;
        for samples in self.samples.chunks(16) {
            if cost > most {
                break;
            }
            let moved = |sample: &Sample| [0, 1, 2].map(|axis| sample.place[axis] + by[axis]);
            cost += samples
                .iter()
                .map(|sample| self.map.energy(moved(sample), sample.luma))
                .sum::<f32>();
        }
        cost
    }

    /// The vector of least cost of these; of equal ones, the first.
    fn best(&self, vectors: impl IntoIterator<Item = [i32; 3]>) -> ([i32; 3], f32) {
        let mut best = ([0; 3], f32::INFINITY);
        for vector in vectors {
            let cost = self.cost(vector, best.1);
            if cost < best.1 {
                best = (vector, cost);
            }
        }
        best
    }

    /// A vector near this one that costs less.
    fn refined(&self, vector: [i32; 3], steps: &[i32]) -> ([i32; 3], f32) {
        let near = |vector: [i32; 3], step: i32| {
            let offsets = around(1).map(move |offset| plus(vector, offset.map(|x| x * step)));
            std::iter::once(vector).chain(offsets)
        };
        let mut best = (vector, f32::INFINITY);
        for &step in steps {
            best = self.best(near(best.0, step));
        }
        best
    }
}

impl Blocks {
    pub(super) fn search(map: &Map, samples: &Samples, [previous, current]: [&Frame; 2], top: u8) -> Self {
        let levels = COARSE.min(top);
        let coarse_map = Map::of(current.nodes(levels));
        let coarse = previous.nodes(levels);
        let mut far: Vec<[i32; 3]> = around(REACH).collect();
        far.sort_by_key(|vector| vector.iter().map(|x| x * x).sum::<i32>());
        let shift = 3 * (BLOCK.min(top) - levels);
        let coarse: Vec<&[(u64, f32)]> = coarse.chunk_by(|a, b| a.0 >> shift == b.0 >> shift).collect();
        let all_samples: Vec<BlockSamples> = samples
            .blocks
            .iter()
            .map(|(_, range)| BlockSamples::of(map, samples, range))
            .collect();
        let vectors: Vec<[i32; 3]> = (all_samples.par_iter().zip(&coarse))
            .map(|(samples_of_block, nodes)| {
                let promising = Self::promising(&coarse_map, nodes, &far, levels);
                let refined = promising
                    .iter()
                    .map(|vector| samples_of_block.refined(*vector, &[2, 1]).0);
                samples_of_block.best(std::iter::once([0; 3]).chain(refined)).0
            })
            .collect();
        let keys: Vec<u64> = samples.blocks.iter().map(|block| block.0).collect();
        let table = Table::of(&keys.iter().map(|key| number(place(*key))).collect::<Vec<_>>());
        let vectors = (all_samples.par_iter().zip(&keys).zip(&vectors))
            .map(|((samples_of_block, key), own)| {
                let near = around(1).filter_map(|offset| table.find(number(plus(place(*key), offset))));
                let mut tried = vec![*own];
                tried.extend(near.map(|i| vectors[i]));
                tried[1..].sort_unstable();
                tried.dedup();
                samples_of_block.refined(samples_of_block.best(tried).0, &[1]).0
            })
            .collect();
        Blocks { vectors }
    }

    /// Some vectors of least cost of those in `far`, for what `nodes` show of a block, in voxels.
    fn promising(map: &Map, nodes: &[(u64, f32)], far: &[[i32; 3]], levels: u8) -> Vec<[i32; 3]> {
        let sample = |(key, luma): &(u64, f32)| Sample {
            place: place(*key).map(|x| x as f32),
            step: [0.0; 3],
            luma: *luma,
            weight: 1.0,
        };
        let samples: Vec<Sample> = nodes.iter().map(sample).collect();
        let samples_of_block = BlockSamples {
            map,
            samples: &samples,
            length: LENGTH * f32::from(1u8 << levels),
        };
        let mut best = vec![([0; 3], f32::INFINITY); PROMISING];
        for vector in far {
            let cost = samples_of_block.cost(*vector, best[PROMISING - 1].1);
            if cost < best[PROMISING - 1].1 {
                best[PROMISING - 1] = (*vector, cost);
                best.sort_by(|a, b| a.1.total_cmp(&b.1));
            }
        }
        best.into_iter()
            .map(|(vector, _)| vector.map(|x| x << levels))
            .collect()
    }

    /// The median of the vectors of blocks in these ranges, in each axis.
    pub(super) fn median(&self, ranges: impl Iterator<Item = Range<usize>>) -> Option<[i32; 3]> {
        let vectors: Vec<[i32; 3]> = ranges.flat_map(|range| self.vectors[range].iter().copied()).collect();
        let middle = |axis: usize| {
            let mut values: Vec<i32> = vectors.iter().map(|vector| vector[axis]).collect();
            values.sort_unstable();
            values.get(values.len() / 2).copied()
        };
        Some([middle(0)?, middle(1)?, middle(2)?])
    }
}

impl<'a> BlockSamples<'a> {
    fn of(map: &'a Map, samples: &'a Samples, range: &Range<usize>) -> Self {
        BlockSamples {
            map,
            samples: &samples.samples[range.clone()],
            length: LENGTH,
        }
    }
}
