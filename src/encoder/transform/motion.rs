//! Motion of blocks between frames.

use rayon::prelude::*;

use super::Truth;
use super::choice::{self, Weights};
use super::noise::Sampled;
use crate::colour::Ycc;
use crate::geometry::{Octree, morton};
use crate::motion::{Groups, Previous, PreviousLevel, predicted};

/// How far vectors are searched at the coarsest of three levels, in its voxels.
const REACH: i32 = 4;
/// Cost of a voxel that is not there in the previous frame; one that is costs less, by its colour.
const MISSING: f32 = 1.0;
/// The most that a difference of colours costs.
const OTHER_COLOUR: f32 = 0.7;
/// Difference of luma that costs the most, in units of colours.
const FAR_LUMA: f32 = 40.0 * 64.0;
/// Voxels of a block that vectors are compared by.
const SAMPLE: usize = 160;
/// Vectors of a block whose costs in rate and distortion are compared.
const PROMISING: usize = 8;
/// How many times its bits a part's vector costs: it also costs those of parts that are predicted by it.
const OTHERS: f32 = 2.0;
/// The 3³ cells at the start of a window of 4³.
pub(super) const AROUND: u64 = 0x0777_0777_0777;
/// The cell in their middle.
pub(super) const CENTRE: u64 = 1 << 21;

/// A block of a frame.
#[derive(Debug, Clone)]
pub(super) struct Block {
    pub key: u64,
    pub vector: [i16; 3],
    /// Its voxels become those of the moved previous frame.
    pub keep: bool,
}

/// A voxel of the moved previous frame: its place, and its number there.
pub(super) type Moved = ([i32; 3], usize);

/// What is compared: a frame and the frame before.
pub(super) struct Search<'a> {
    pub octree: &'a Octree,
    pub truth: &'a Truth,
    pub previous: &'a Previous,
    /// The frame itself, found by position.
    pub current: &'a Previous,
    /// What the cloud has in the voxels of its finest level.
    pub samples: &'a [Sampled],
    pub top: u8,
    pub block_level: u8,
}

impl Search<'_> {
    /// All parts of blocks that have voxels in either frame, in the order of their keys, with vectors of least cost.
    /// `blocks` are those of `Search::blocks` a level above.
    pub fn parts(&self, blocks: &[Block], weights: Weights) -> Vec<Block> {
        let keys: Vec<u64> = blocks.iter().map(|block| block.key).collect();
        let vectors: Vec<[i16; 3]> = blocks.iter().map(|block| block.vector).collect();
        let groups = Groups::new(&keys, &vectors);
        let parts = self.keys();
        let numbers: Vec<usize> = groups.of(&parts).collect();
        let mut of_blocks = Vec::new();
        let mut first = 0;
        for numbers in numbers.chunk_by(|a, b| a == b) {
            of_blocks.push((numbers[0], &parts[first..first + numbers.len()]));
            first += numbers.len();
        }
        let of_blocks = of_blocks.into_par_iter();
        of_blocks
            .flat_map_iter(|(block, parts)| {
                let tried = candidates(&keys, &vectors, block);
                self.parts_of(groups, block, parts, &tried, weights)
            })
            .collect()
    }

    /// The parts `keys` of a block, each with the vector of least cost. They have that of the block if this costs less in
    /// all, and are kept if the block as a whole is: chance shows less in many voxels than in few.
    fn parts_of(&self, groups: Groups, block: usize, keys: &[u64], tried: &[[i16; 3]], weights: Weights) -> Vec<Block> {
        let common = groups.vector(block);
        let (mut vectors, mut sum) = (Vec::new(), 0.0);
        for key in keys {
            let (vector, cost) = self.part(groups, (block, *key), tried, &vectors, weights);
            vectors.push(vector);
            sum += cost;
        }
        let whole = Search {
            block_level: self.block_level - 1,
            ..*self
        };
        let [kept, coded] = choice::costs(&whole, keys[0] >> 3, common, weights);
        let undivided = kept.min(coded) <= sum;
        if undivided {
            vectors.fill(common);
        }
        let block = |(key, vector): (&u64, _)| Block {
            key: *key,
            vector,
            keep: undivided && kept <= coded,
        };
        keys.iter().zip(vectors).map(block).collect()
    }

    /// The vector of least cost of a part of a block, and that cost. `before` are the vectors of parts before it.
    fn part(
        &self,
        groups: Groups,
        (block, key): (usize, u64),
        tried: &[[i16; 3]],
        before: &[[i16; 3]],
        weights: Weights,
    ) -> ([i16; 3], f32) {
        let common = groups.vector(block);
        let nearby = groups.nearby(block, key, before);
        let mut all = vec![common];
        if self.octree.level(self.block_level).keys().binary_search(&key).is_ok() {
            let near = self.near(key, common, tried);
            all.extend(self.promising(key, tried.iter().copied().chain([near]).collect()));
            all.extend(before);
            all.sort_unstable();
            all.dedup();
        }
        let cost = |vector: [i16; 3]| {
            let bits = OTHERS * apart_bits(vector, common, &nearby);
            (vector, choice::cost(self, key, vector, weights) + weights.lambda * bits)
        };
        let best = all.into_iter().map(cost).min_by(|a, b| a.1.total_cmp(&b.1));
        best.unwrap_or((common, 0.0))
    }

    /// Keys of the blocks that have voxels in either frame.
    fn keys(&self) -> Vec<u64> {
        let mut keys = self.octree.level(self.block_level).keys().to_vec();
        if let Some(level) = self.previous.level(self.top) {
            keys.extend(level.nodes(self.top, self.block_level));
        }
        keys.sort_unstable();
        keys.dedup();
        keys
    }

    /// The best vector near `common` and `tried`.
    fn near(&self, key: u64, common: [i16; 3], tried: &[[i16; 3]]) -> [i16; 3] {
        let sample = self.sample(self.top, key);
        let mut best = Best {
            origin: common.map(i32::from),
            ..Best::default()
        };
        best.consider(&sample, common.map(i32::from));
        for vector in tried {
            best.consider(&sample, vector.map(i32::from));
        }
        best.refine(&sample, &[2, 1, 1]);
        best.vector.map(|x| x as i16)
    }

    /// All blocks that have voxels in either frame, in the order of their keys, without vectors.
    pub fn still(&self) -> Vec<Block> {
        let still = |key| Block {
            key,
            vector: [0; 3],
            keep: false,
        };
        self.keys().into_iter().map(still).collect()
    }

    /// All blocks that have voxels in either frame, in the order of their keys, with vectors of least cost.
    pub fn blocks(&self, weights: Weights) -> Vec<Block> {
        let own = self.octree.level(self.block_level).keys();
        let keys = self.keys();
        let found: Vec<[i16; 3]> = own
            .par_iter()
            .map(|key| self.refined(*key, self.coarse(*key)))
            .collect();
        let tried: Vec<Vec<([i16; 3], f32)>> = own
            .par_iter()
            .enumerate()
            .map(|(i, key)| {
                let tried = self.promising(*key, candidates(own, &found, i)).into_iter();
                tried
                    .map(|vector| (vector, choice::cost(self, *key, vector, weights)))
                    .collect()
            })
            .collect();
        let (mut coded, mut vectors) = (Vec::new(), Vec::new());
        let mut blocks: Vec<Block> = Vec::new();
        for key in keys {
            // Blocks of no voxels of either frame are not coded.
            coded.push(key);
            let (predicted, sure) = predicted(&coded, &vectors, [0; 3]);
            let cost = |(vector, cost): &([i16; 3], f32)| cost + weights.lambda * vector_bits(*vector, predicted, sure);
            let tried = own.binary_search(&key).map(|i| &tried[i]);
            let best = tried
                .ok()
                .and_then(|tried| tried.iter().min_by(|a, b| cost(a).total_cmp(&cost(b))));
            let vector = best.map_or(predicted, |best| best.0);
            vectors.push(vector);
            blocks.push(Block {
                key,
                vector,
                keep: false,
            });
        }
        blocks
    }

    /// The [`PROMISING`] vectors of least cost at the finest level, and 0, which tells noise from motion.
    fn promising(&self, key: u64, vectors: Vec<[i16; 3]>) -> Vec<[i16; 3]> {
        let sample = self.sample(self.top, key);
        let cost = |vector: &[i16; 3]| sample.cost(vector.map(i32::from), f32::INFINITY);
        let mut ranked: Vec<(f32, [i16; 3])> = vectors.iter().map(|vector| (cost(vector), *vector)).collect();
        ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (best, others) = ranked.split_at(PROMISING.min(ranked.len()));
        let zero = others.iter().filter(|ranked| ranked.1 == [0; 3]);
        best.iter().chain(zero).map(|ranked| ranked.1).collect()
    }

    /// The vector found at the coarsest level, in its voxels.
    fn coarse(&self, key: u64) -> [i32; 3] {
        let down = 2.min(self.top - self.block_level);
        let sample = self.sample(self.top - down, key);
        let mut best = Best::default();
        for z in -REACH..=REACH {
            for y in -REACH..=REACH {
                for x in -REACH..=REACH {
                    best.consider(&sample, [x, y, z]);
                }
            }
        }
        best.vector.map(|x| x << down)
    }

    /// The best vector near the one of the coarsest level, and near 0.
    fn refined(&self, key: u64, coarse: [i32; 3]) -> [i16; 3] {
        let sample = self.sample(self.top, key);
        let mut best = Best::default();
        best.consider(&sample, [0; 3]);
        best.consider(&sample, coarse);
        best.refine(&sample, &[2, 1, 1]);
        best.vector.map(|x| x as i16)
    }

    /// At most [`SAMPLE`] voxels of a block at a level, spread over it.
    fn sample(&self, level: u8, key: u64) -> Sample<'_> {
        let voxels = self.voxels(level, key);
        let every = voxels.len().div_ceil(SAMPLE).max(1);
        let voxel = |i: usize| {
            let place = self.octree.level(level).coordinate(i).map(|x| x as i32);
            (place, self.truth.level(level)[i])
        };
        Sample {
            voxels: voxels.step_by(every).map(voxel).collect(),
            previous: self.previous.level(level),
        }
    }

    /// Numbers of the voxels of `level` in a block.
    pub fn voxels(&self, level: u8, key: u64) -> std::ops::Range<usize> {
        self.octree.level(level).within(key, 3 * (level - self.block_level))
    }

    /// The voxels of level `top` that the previous frame has in a block, moved by `vector`.
    pub fn moved(&self, key: u64, vector: [i16; 3]) -> Vec<Moved> {
        let side = 1i32 << (self.top - self.block_level);
        let vector = vector.map(i32::from);
        let first = morton::decode(key).map(|x| x as i32 * side);
        let mut found = Vec::new();
        if let Some(previous) = self.previous.level(self.top) {
            previous.in_box([0, 1, 2].map(|axis| first[axis] - vector[axis]), side, |from, index| {
                found.push(([0, 1, 2].map(|axis| from[axis] + vector[axis]), index));
            });
        }
        found
    }
}

/// Voxels of a block, and the level of the previous frame that they are looked for in.
struct Sample<'a> {
    voxels: Vec<([i32; 3], Ycc)>,
    previous: Option<&'a PreviousLevel>,
}

impl Sample<'_> {
    /// How badly a vector in voxels of the level predicts the voxels. What exceeds `most` may be less than the whole.
    fn cost(&self, vector: [i32; 3], most: f32) -> f32 {
        let Some(previous) = self.previous else {
            return 0.0;
        };
        let mut cost = 0.0;
        for (place, truth) in &self.voxels {
            cost += match previous.index([0, 1, 2].map(|axis| place[axis] - vector[axis])) {
                None => MISSING,
                Some(index) => {
                    let apart = luma_apart(*truth, previous.values[index]);
                    OTHER_COLOUR * (apart.abs() / FAR_LUMA).min(1.0)
                }
            };
            if cost > most {
                break;
            }
        }
        cost
    }
}

/// The vector of least cost so far.
struct Best {
    cost: f32,
    vector: [i32; 3],
    /// Of equally good vectors the one nearest to this one is the best.
    origin: [i32; 3],
}

impl Default for Best {
    fn default() -> Self {
        Best {
            cost: f32::INFINITY,
            vector: [0; 3],
            origin: [0; 3],
        }
    }
}

impl Best {
    /// Of equal costs the first vector stays.
    fn consider(&mut self, sample: &Sample, vector: [i32; 3]) {
        let length: i32 = (0..3).map(|axis| (vector[axis] - self.origin[axis]).abs()).sum();
        let length = 0.05 * length as f32;
        let cost = sample.cost(vector, self.cost - length) + length;
        if cost < self.cost {
            (self.cost, self.vector) = (cost, vector);
        }
    }

    /// Tries the vectors around the best one, at these distances in turn.
    fn refine(&mut self, sample: &Sample, steps: &[i32]) {
        for step in steps {
            let around = self.vector;
            for i in 0..27 {
                let offset = [i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1];
                self.consider(sample, [0, 1, 2].map(|axis| around[axis] + step * offset[axis]));
            }
        }
    }
}

/// Vectors to try for block `i`: its own, those of the blocks around it, and 0.
fn candidates(keys: &[u64], found: &[[i16; 3]], i: usize) -> Vec<[i16; 3]> {
    let at = morton::decode(keys[i]).map(|x| x as i32);
    let mut tried = vec![found[i], [0; 3]];
    for k in 0..27 {
        let place = [at[0] + k % 3 - 1, at[1] + k / 3 % 3 - 1, at[2] + k / 9 - 1];
        if place.iter().all(|x| *x >= 0)
            && let Ok(i) = keys.binary_search(&morton::encode(place.map(|x| x as u32)))
            && !tried.contains(&found[i])
        {
            tried.push(found[i]);
        }
    }
    tried
}

/// Bits of a vector, about.
fn vector_bits(vector: [i16; 3], predicted: [i16; 3], sure: usize) -> f32 {
    if vector == predicted {
        return [1.0, 1.0, 0.4][sure];
    }
    let component = |axis: usize| {
        let apart = f32::from(vector[axis]) - f32::from(predicted[axis]);
        0.8 + 2.0 * (1.0 + apart.abs()).log2()
    };
    [1.0, 1.0, 2.0][sure] + component(0) + component(1) + component(2)
}

/// Bits of a vector in a group of which most have another one, about.
fn apart_bits(vector: [i16; 3], common: [i16; 3], nearby: &[[i16; 3]]) -> f32 {
    if vector == common {
        return 0.5;
    }
    if let Some(i) = nearby.iter().position(|other| *other == vector) {
        return 3.0 + i as f32;
    }
    let component = |axis: usize| {
        let apart = f32::from(vector[axis]) - f32::from(common[axis]);
        0.8 + 2.0 * (1.0 + apart.abs()).log2()
    };
    5.0 + component(0) + component(1) + component(2)
}

/// Difference of luma, and half of those of chroma.
fn luma_apart(a: Ycc, b: Ycc) -> f32 {
    let apart = |t: usize| f32::from(a[t]) - f32::from(b[t]);
    let chroma = (apart(1).abs() + apart(2).abs()) / 4.0;
    let luma = apart(0);
    if luma < 0.0 { luma - chroma } else { luma + chroma }
}
