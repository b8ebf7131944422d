//! Motion of blocks between frames, and which blocks stay what they were.

use rayon::prelude::*;

use super::Truth;
use crate::colour::Ycc;
use crate::geometry::{Octree, morton};
use crate::motion::{Previous, PreviousLevel};

/// How far vectors are searched at the coarsest of three levels, in its voxels.
const REACH: i32 = 4;
/// Cost of a voxel that is not there in the previous frame; one that is costs less, by its colour.
const MISSING: f32 = 1.0;
/// The most that a difference of colours costs.
const OTHER_COLOUR: f32 = 0.7;
/// Difference of luma that costs the most, in units of colours.
const FAR_LUMA: f32 = 40.0 * 64.0;
/// Cost of one bit of a vector.
const VECTOR_BIT: f32 = 0.3;
/// The 3³ cells at the start of a window of 4³.
const AROUND: u64 = 0x0777_0777_0777;
/// The cell in their middle.
const CENTRE: u64 = 1 << 21;

/// When a block is kept as it was.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tolerance {
    /// Share of voxels that may be one voxel off.
    pub near: f32,
    /// Share of voxels that may be farther off.
    pub far: f32,
    /// Mean displacement over an eighth of a block, in voxels.
    pub drift: f32,
    /// Mean squared difference of colours where nothing is known of the previous frame's error, in squared units.
    pub error: f32,
    /// The same as a share of that error, and what may be added to it.
    pub worse: [f32; 2],
    /// Mean difference of luma over an eighth of a block, in units of colours.
    pub mean: f32,
}

/// A block of a frame.
#[derive(Debug, Clone)]
pub(super) struct Block {
    pub key: u64,
    pub vector: [i16; 3],
    /// The mean squared error of colours with which it was last coded, if that is known.
    pub error: Option<f32>,
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
    /// Errors of the blocks of the previous frame.
    pub errors: &'a Errors,
    pub top: u8,
    pub block_level: u8,
}

impl Search<'_> {
    /// All blocks that have voxels in either frame, in the order of their keys.
    pub fn blocks(&self, tolerance: Option<Tolerance>) -> Vec<Block> {
        let own = self.octree.level(self.block_level).keys();
        let mut keys = own.to_vec();
        if let Some(level) = self.previous.level(self.top) {
            keys.extend(level.blocks(self.top, self.block_level));
        }
        keys.sort_unstable();
        keys.dedup();
        let found: Vec<[i32; 3]> = own.par_iter().map(|key| self.coarse(*key)).collect();
        let mut blocks = Vec::new();
        let mut before = [0; 3];
        for key in keys {
            if let Ok(i) = own.binary_search(&key) {
                before = self.refined(key, found[i], before);
            }
            blocks.push(Block {
                key,
                vector: before.map(|x| x as i16),
                error: self.errors.get(&self.origin(key, before)).copied(),
                keep: false,
            });
        }
        if let Some(tolerance) = tolerance {
            blocks
                .par_iter_mut()
                .for_each(|block| block.keep = self.may_stay(block, tolerance));
        }
        blocks
    }

    /// The block that the centre of a block was in.
    fn origin(&self, key: u64, vector: [i32; 3]) -> u64 {
        let (side, blocks) = (1i32 << (self.top - self.block_level), 1i32 << self.block_level);
        let at = morton::decode(key).map(|x| x as i32 * side + side / 2);
        let place = [0, 1, 2].map(|axis| ((at[axis] - vector[axis]).div_euclid(side)).clamp(0, blocks - 1) as u32);
        morton::encode(place)
    }

    /// The vector found at the coarsest level, in its voxels.
    fn coarse(&self, key: u64) -> [i32; 3] {
        let down = 2.min(self.top - self.block_level);
        let level = self.top - down;
        let mut best = (f32::INFINITY, [0; 3]);
        for z in -REACH..=REACH {
            for y in -REACH..=REACH {
                for x in -REACH..=REACH {
                    let length = (x.abs() + y.abs() + z.abs()) as f32;
                    let cost = self.cost(level, key, [x, y, z]) + 0.05 * length;
                    if cost < best.0 {
                        best = (cost, [x, y, z]);
                    }
                }
            }
        }
        best.1.map(|x| x << down)
    }

    /// The best vector near the one of the coarsest level, near that of the block before, and 0.
    fn refined(&self, key: u64, coarse: [i32; 3], before: [i32; 3]) -> [i32; 3] {
        let cost = |vector: [i32; 3]| {
            let bits = |i: usize| 2.0 * (1.0 + (vector[i] - before[i]).abs() as f32).log2();
            let bits = if vector == before {
                0.0
            } else {
                3.0 + bits(0) + bits(1) + bits(2)
            };
            self.cost(self.top, key, vector) + VECTOR_BIT * bits
        };
        let mut best = (cost(before), before);
        let mut consider = |vector: [i32; 3]| {
            let cost = cost(vector);
            if cost < best.0 {
                best = (cost, vector);
            }
            best.1
        };
        consider([0; 3]);
        let mut centre = consider(coarse);
        for step in [2, 1, 1] {
            let around = centre;
            for i in 0..27 {
                let offset = [i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1];
                centre = consider([0, 1, 2].map(|axis| around[axis] + step * offset[axis]));
            }
        }
        centre
    }

    /// How badly a vector in voxels of `level` predicts the block's voxels of that level.
    fn cost(&self, level: u8, key: u64, vector: [i32; 3]) -> f32 {
        let Some(previous) = self.previous.level(level) else {
            return 0.0;
        };
        let mut cost = 0.0;
        for i in self.voxels(level, key) {
            let at = self.octree.level(level).coordinate(i);
            let at = [0, 1, 2].map(|axis| at[axis] as i32 - vector[axis]);
            cost += match previous.index(at) {
                None => MISSING,
                Some(index) => {
                    let apart = luma_apart(self.truth.level(level)[i], previous.values[index]);
                    OTHER_COLOUR * (apart.abs() / FAR_LUMA).min(1.0)
                }
            };
        }
        cost
    }

    /// Numbers of the voxels of `level` in a block.
    pub fn voxels(&self, level: u8, key: u64) -> std::ops::Range<usize> {
        let (keys, down) = (self.octree.level(level).keys(), 3 * (level - self.block_level));
        let first = keys.partition_point(|k| k >> down < key);
        first..first + keys[first..].partition_point(|k| k >> down == key)
    }

    /// The voxels of level `top` that the moved previous frame has in a block.
    pub fn moved(&self, block: &Block) -> Vec<Moved> {
        let Some(previous) = self.previous.level(self.top) else {
            return Vec::new();
        };
        let side = 1i32 << (self.top - self.block_level);
        let first = morton::decode(block.key).map(|x| x as i32 * side);
        let vector = block.vector.map(i32::from);
        let mut found = Vec::new();
        for z in (0..side).step_by(4) {
            for y in (0..side).step_by(4) {
                for x in (0..side).step_by(4) {
                    let at = [first[0] + x, first[1] + y, first[2] + z];
                    let from = [0, 1, 2].map(|axis| at[axis] - vector[axis]);
                    let mut window = previous.window(from);
                    while window != 0 {
                        let cell = window.trailing_zeros() as i32;
                        window &= window - 1;
                        let cell = [cell & 3, cell >> 2 & 3, cell >> 4];
                        // Blocks of less than 4³ voxels end before the window does.
                        if cell.iter().any(|c| *c >= side) {
                            continue;
                        }
                        let from = [0, 1, 2].map(|axis| from[axis] + cell[axis]);
                        let at = [0, 1, 2].map(|axis| at[axis] + cell[axis]);
                        found.extend(previous.index(from).map(|index| (at, index)));
                    }
                }
            }
        }
        found
    }

    /// Whether a block differs from the moved previous frame by no more than sampling and noise.
    fn may_stay(&self, block: &Block, tolerance: Tolerance) -> bool {
        let (Some(previous), Some(current)) = (self.previous.level(self.top), self.current.level(self.top)) else {
            return false;
        };
        let (own, moved) = (self.voxels(self.top, block.key), self.moved(block));
        let total = (own.len() + moved.len()) as f32;
        let vector = block.vector.map(i32::from);
        let half = u32::from(self.top - self.block_level).saturating_sub(1);
        let part = |at: [i32; 3]| at.iter().rev().fold(0, |part, x| part << 1 | (x >> half & 1) as usize);
        let mut found = Differences::default();
        for i in own {
            let at = self.octree.level(self.top).coordinate(i).map(|x| x as i32);
            let from = [0, 1, 2].map(|axis| at[axis] - vector[axis]);
            found.place(previous, from, part(at), 1.0);
            if let Some(index) = previous.index(from) {
                let apart = luma_apart(self.truth.level(self.top)[i], previous.values[index]);
                found.colour(part(at), apart);
            }
        }
        for (at, _) in &moved {
            found.place(current, *at, part(*at), -1.0);
        }
        // A few voxels at the border of a block are noise, too.
        found.near <= tolerance.near * total + FEW
            && found.far <= tolerance.far * total
            && found.are_within(block.error, tolerance)
    }
}

/// Voxels of a block that are noise, however few it has.
const FEW: f32 = 4.0;
/// Voxels of which a mean says something.
const MANY: f32 = 16.0;

/// Differences between a block and the moved previous frame.
#[derive(Debug, Default)]
struct Differences {
    /// Voxels that have none at their place but one beside it, and those that have none there.
    near: f32,
    far: f32,
    /// Of each eighth: displacements, and the voxels that were compared.
    displaced: [[f32; 3]; 8],
    placed: [f32; 8],
    /// Of each eighth: differences of colours, and the voxels that were compared.
    colours: [f32; 8],
    coloured: [f32; 8],
    squares: f32,
}

impl Differences {
    /// Compares a voxel with those of the other frame. `sign` tells from which side.
    fn place(&mut self, other: &PreviousLevel, at: [i32; 3], part: usize, sign: f32) {
        let mut around = other.window(at.map(|x| x - 1)) & AROUND;
        self.placed[part] += 1.0;
        if around & CENTRE != 0 {
            return;
        }
        if around == 0 {
            self.far += 1.0;
            return;
        }
        self.near += 1.0;
        let weight = sign / around.count_ones() as f32;
        while around != 0 {
            let cell = around.trailing_zeros();
            around &= around - 1;
            for axis in 0..3 {
                self.displaced[part][axis] += weight * ((cell >> (2 * axis) & 3) as f32 - 1.0);
            }
        }
    }

    fn colour(&mut self, part: usize, apart: f32) {
        self.colours[part] += apart;
        self.squares += apart * apart;
        self.coloured[part] += 1.0;
    }

    /// Whether means and squares are within the tolerance, of a block that was coded with this error.
    fn are_within(&self, error: Option<f32>, tolerance: Tolerance) -> bool {
        let still = (0..8).filter(|part| self.placed[*part] >= MANY).all(|part| {
            let mean = self.displaced[part].map(|sum| sum / self.placed[part]);
            mean.iter().map(|x| x * x).sum::<f32>() <= tolerance.drift * tolerance.drift
        });
        let even = (0..8).filter(|part| self.coloured[*part] >= MANY);
        let even = { even }.all(|part| self.colours[part].abs() <= tolerance.mean * self.coloured[part]);
        let most = error.map_or(tolerance.error, |error| tolerance.worse[0] * error + tolerance.worse[1]);
        still && even && self.squares <= most * self.coloured.iter().sum::<f32>()
    }
}

/// Mean squared errors of colours, of blocks by their keys.
pub type Errors = std::collections::BTreeMap<u64, f32>;

/// The errors of a decoded frame against the frame. Blocks that were kept have the errors that they had.
pub(super) fn errors(octree: &Octree, truth: &Truth, decoded: &Previous, top: u8, kept: &[Block], block: u8) -> Errors {
    let mut errors = Errors::new();
    let Some(level) = decoded.level(top) else {
        return errors;
    };
    let (voxels, down) = (octree.level(top), 3 * (top - block));
    let mut sums = std::collections::BTreeMap::<u64, [f32; 2]>::new();
    for (i, key) in voxels.keys().iter().enumerate() {
        if let Some(index) = level.index(voxels.coordinate(i).map(|x| x as i32)) {
            let apart = luma_apart(truth.level(top)[i], level.values[index]);
            let sum = sums.entry(key >> down).or_default();
            *sum = [sum[0] + apart * apart, sum[1] + 1.0];
        }
    }
    errors.extend(sums.into_iter().map(|(key, [sum, count])| (key, sum / count)));
    for block in kept.iter().filter(|block| block.keep) {
        match block.error {
            Some(error) => errors.insert(block.key, error),
            None => errors.remove(&block.key),
        };
    }
    errors
}

/// Difference of luma, and half of those of chroma.
fn luma_apart(a: Ycc, b: Ycc) -> f32 {
    let apart = |t: usize| f32::from(a[t]) - f32::from(b[t]);
    let chroma = (apart(1).abs() + apart(2).abs()) / 4.0;
    let luma = apart(0);
    if luma < 0.0 { luma - chroma } else { luma + chroma }
}
