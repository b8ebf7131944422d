//! Rate–distortion optimised occupancy: an encoder that may move voxels by one where that saves bits
//! (`docs/format.md`, clause 4, says what is coded).
//!
//! Which of two adjacent layers holds a voxel is often decided by sampling and rounding, and costs several bits. For
//! each parent, in coding order, the encoder chooses the occupancy that minimises D + λ·R. R is the code length under
//! the predictor as it is at that parent. D counts
//!
//! - for each voxel that is left out and each point in it, how much the squared distance to the nearest coded centre
//!   grows, a quarter of it: a patch of the surface has about four points in a voxel;
//! - for each voxel that is added, the squared distance of its centre to the nearest point, less what it would be to a
//!   point inside.
//!
//! Points are the voxels of the next level, whose places in a voxel are known: ±¼ along each axis. Distances are in
//! voxels.
//!
//! A frame of a sequence may show *copied* voxels of the previous frame, which hold no points, in place of some of its
//! own: two samplings of one surface differ in many. So a copied voxel counts three eighths of one that is added, if a
//! point is within one of it, and a true voxel that is not to be shown three sixteenths of one that is left out.
//!
//! Children of parents that are not coded yet count as true ones. Parents keep at least one child, and true voxels lie
//! in them. So each true voxel has a coded voxel within one in each coordinate; each coded voxel has a true one there,
//! since both have the same parent. The decoder is unchanged.

use std::ops::Range;
use std::sync::OnceLock;

use b2p_kernels::{Instructions, Isa, Work};
use rayon::prelude::*;

use super::coder::Encoder;
use super::contexts::CELLS;
use super::guide::Guide;
use super::neighbourhood::Neighbourhood;
use super::predictor::Predictor;
use super::{count, slices};
use crate::geometry::{KernelMap, Octree, ones};

/// Candidates that are kept at each octant.
const BEAM: usize = 8;

/// A code length up to which a child may be what it is not, in units of [`bits`].
const UNLIKELIEST: u32 = 4 << 8;

/// What the encoder may change about a level.
#[derive(Debug, Clone, Copy)]
pub struct Distortion<'a> {
    /// For each voxel of the level, which of its eight children hold points: none if the voxel is copied.
    pub points: &'a [u8],
    /// The Lagrangian multiplier λ: squared distance, in squared voxels, that a bit must save, in units of 1/256.
    pub lambda: u32,
    /// If the level has copied voxels, the occupancies that are to be shown, which have all of those.
    pub shown: Option<&'a [u8]>,
}

/// Chooses and encodes the occupancies of the parents of level `level`, which `octree` has as they truly are. `guide` is
/// what a previous frame tells of the level; parents that it skips have the children of their windows. Returns the
/// occupancies, and for each slice what [`encode_guided`](super::encode_guided) does. The result depends neither on `isa` nor on
/// the number of threads.
///
/// # Panics
/// If `level` is 0 or deeper than the octree, `map` belongs to another level, `slice` is 0, or there is not one
/// mask of points for each voxel of the level and one of shown children for each parent.
pub fn optimise_level(
    isa: Isa,
    octree: &Octree,
    map: &KernelMap,
    level: u8,
    slice: usize,
    distortion: Distortion<'_>,
    guide: Option<Guide<'_>>,
) -> (Vec<u8>, Vec<(u32, Vec<u8>)>) {
    let truth = octree.occupancy(level - 1);
    assert_eq!(map.len(), truth.len(), "one kernel map row per parent");
    assert_eq!(
        octree.level(level).len(),
        distortion.points.len(),
        "one mask of points per voxel"
    );
    let shown = distortion.shown.unwrap_or(truth);
    assert_eq!(shown.len(), truth.len(), "one mask of shown children per parent");
    let ranges: Vec<_> = slices(truth.len(), slice).collect();
    let optimise = |parents: Range<usize>| {
        isa.run(Optimise {
            map,
            parents,
            truth,
            shown,
            first_child: octree.first_child(level - 1),
            distortion,
            guide,
        })
    };
    let coded: Vec<(Vec<u8>, Vec<u8>)> = ranges.into_par_iter().map(optimise).collect();
    let mut all = Vec::with_capacity(truth.len());
    let mut encoded = Vec::with_capacity(coded.len());
    for (masks, bytes) in coded {
        encoded.push((count(&masks) as u32, bytes));
        all.extend(masks);
    }
    (all, encoded)
}

/// Chooses and encodes the occupancies of one slice.
struct Optimise<'a> {
    map: &'a KernelMap,
    parents: Range<usize>,
    truth: &'a [u8],
    shown: &'a [u8],
    first_child: &'a [u32],
    distortion: Distortion<'a>,
    guide: Option<Guide<'a>>,
}

impl Work for Optimise<'_> {
    type Output = (Vec<u8>, Vec<u8>);

    #[inline(always)]
    fn run<I: Instructions>(self, instructions: I) -> (Vec<u8>, Vec<u8>) {
        let Optimise {
            map,
            parents,
            truth,
            shown,
            first_child,
            distortion,
            guide,
        } = self;
        let mut predictor = Predictor::new(instructions, parents.len(), guide);
        let mut encoder = Encoder::new();
        let neighbourhoods = Neighbourhood::of_all(map, &parents);
        let mut masks: Vec<u8> = Vec::with_capacity(parents.len());
        for (parent, neighbourhood) in parents.clone().zip(neighbourhoods) {
            let skipped = guide.map_or(0, |guide| guide.skipped(parent));
            if skipped != 0 {
                masks.push(skipped);
                continue;
            }
            let window = guide.and_then(|guide| guide.window(parent));
            let (row, first) = (map.row(parent), parents.start);
            let points = |parent: usize| &distortion.points[first_child[parent] as usize..];
            let mut surface = Surface::new(truth[parent], shown[parent], points(parent));
            for k in ones(neighbourhood.there) {
                let neighbour = row[k] as usize;
                let coded = match neighbourhood.known >> k & 1 {
                    1 => masks[neighbour - first],
                    _ => shown[neighbour],
                };
                surface.add(k, truth[neighbour], coded, points(neighbour));
            }
            surface.finish();
            let chosen = predictor.choose(neighbourhood, row, first, &masks, &surface, distortion.lambda, window);
            predictor.code(&mut encoder, neighbourhood, row, first, &masks, chosen, window);
            masks.push(chosen);
        }
        (masks, encoder.finish())
    }
}

/// The surface around a parent, as cells of its children's level (see `contexts`).
#[derive(Debug, Clone, Copy)]
pub(super) struct Surface {
    /// The parent's true children, those of them that are not to be shown, and copied ones.
    pub mask: u8,
    hidden: u8,
    copied: u8,
    /// Of each of them which of its children hold points.
    own: [u8; 8],
    /// For each octant the cells that hold a point in it.
    points: [u64; 8],
    /// Coded cells, and true ones where none are coded yet; without the parent's own.
    coded: u64,
    /// Distortion of each child that is not a true one, if it is added.
    added: [u32; 8],
}

impl Surface {
    fn new(all: u8, shown: u8, points: &[u8]) -> Self {
        let holds_points = |(octant, points): (usize, &u8)| u8::from(*points != 0) << octant;
        let mask = ones(all).zip(points).map(holds_points).sum();
        let mut surface = Surface {
            mask,
            hidden: mask & !shown,
            copied: all & !mask,
            own: [0; 8],
            points: [0; 8],
            coded: 0,
            added: [0; 8],
        };
        for (octant, points) in ones(all).zip(points) {
            surface.own[octant] = *points;
        }
        surface.add(KernelMap::CENTRE, all, 0, points);
        surface
    }

    /// Adds the neighbour at offset `k`. `points` start with those of its children.
    #[inline(always)]
    fn add(&mut self, k: usize, truth: u8, coded: u8, points: &[u8]) {
        self.coded |= cells(k, coded);
        for (octant, points) in ones(truth).zip(points) {
            let cell = cells(k, 1 << octant);
            for (at, cells) in self.points.iter_mut().enumerate() {
                *cells |= cell * u64::from(points >> at & 1);
            }
        }
    }

    /// Computes what children cost that are added, once all neighbours are there.
    #[inline(always)]
    fn finish(&mut self) {
        for octant in ones(!self.mask) {
            let shift = shift_of(octant);
            let near = |half: usize| (0..8).any(|at| self.points[at] >> shift & AROUND[7 - at][half] != 0);
            let half = (1..FARTHEST).find(|half| near(*half)).unwrap_or(FARTHEST);
            let is_near = self.copied >> octant & 1 == 1 && half < FARTHEST;
            self.added[octant] = if is_near { COPIED } else { ADDED } * half as u32;
        }
    }

    /// The distortion of a point in octant `octant` that is so many half squared voxels farther from a coded centre than
    /// from its own, in sixteenths of a squared voxel.
    #[inline(always)]
    fn point(&self, octant: usize, half: u32) -> u32 {
        match self.hidden >> octant & 1 {
            0 => POINT * half,
            _ => HIDDEN * half / 8,
        }
    }

    /// A lower bound of the distortion of octant `octant`, if its child is there or not as `bit` says, in sixteenths of
    /// a squared voxel: exact for a child that is added.
    #[inline(always)]
    pub fn least(&self, octant: usize, bit: bool) -> u32 {
        match (self.mask >> octant & 1 == 1, bit) {
            (true, false) => self.point(octant, 1) * self.own[octant].count_ones(),
            (false, true) => self.added[octant],
            _ => 0,
        }
    }

    /// The distortion if the parent's children are `mask`, in sixteenths of a squared voxel.
    #[inline(always)]
    pub fn of(&self, mask: u8) -> u32 {
        let coded = self.coded | cells(KernelMap::CENTRE, mask);
        let mut sum = 0;
        for octant in ones(self.mask & !mask) {
            let around = coded >> shift_of(octant);
            for at in ones(self.own[octant]) {
                let half = (1..FARTHEST).find(|half| around & AROUND[at][*half] != 0);
                sum += self.point(octant, half.unwrap_or(FARTHEST) as u32);
            }
        }
        for octant in ones(mask & !self.mask) {
            sum += self.added[octant];
        }
        sum
    }
}

/// Distortion of a point, of a voxel that is added, and of a copied voxel near a point, for each half squared voxel, in
/// sixteenths of a squared voxel; that of a point in a voxel that is not to be shown, in 128ths.
const POINT: u32 = 2;
const ADDED: u32 = 8;
const COPIED: u32 = 3;
const HIDDEN: u32 = 3;

/// Half squared voxels to the farthest of the cells around a cell.
const FARTHEST: usize = 9;

/// For a point in each octant of a cell, and by half squared voxels, the near cells whose centres are so much farther
/// from it than the cell's own. Along an axis it is ½ to the side where the point is, 1½ to the other.
static AROUND: [[u64; FARTHEST + 1]; 8] = {
    let mut around = [[0; FARTHEST + 1]; 8];
    let mut at = 0;
    while at < 8 * 27 {
        let (octant, k) = (at / 27, at % 27);
        let place = [k % 3, k / 3 % 3, k / 9];
        let (mut half, mut axis) = (0, 0);
        while axis < 3 {
            let side = 2 * (octant >> axis & 1);
            half += match place[axis] {
                1 => 0,
                place if place == side => 1,
                _ => 3,
            };
            axis += 1;
        }
        around[octant][half] |= 1 << (place[0] + 4 * place[1] + 16 * place[2]);
        at += 1;
    }
    around
};

/// How far masks of cells are shifted for the child in `octant`.
#[inline(always)]
fn shift_of(octant: usize) -> usize {
    (octant & 1) + 4 * (octant >> 1 & 1) + 16 * (octant >> 2)
}

/// Cells of the children `mask` of the neighbour at offset `k`.
#[inline(always)]
fn cells(k: usize, mask: u8) -> u64 {
    CELLS[k][0][usize::from(mask & 15)] | CELLS[k][1][usize::from(mask >> 4)]
}

/// Code length of a decision of probability `one / 65536`, in units of 1/256 bit.
#[inline(always)]
pub(super) fn bits(lengths: &[u16; 1 << 12], one: u32, bit: bool) -> u32 {
    let one = if bit { one } else { (1 << 16) - one };
    lengths[(one >> 4) as usize & 4095].into()
}

/// Code lengths by probability, in 4096ths.
pub(super) fn code_lengths() -> &'static [u16; 1 << 12] {
    static LENGTHS: OnceLock<[u16; 1 << 12]> = OnceLock::new();
    LENGTHS.get_or_init(|| {
        std::array::from_fn(|i| {
            let probability = (i as f64 + 0.5) / 4096.0;
            (-256.0 * probability.log2()).round() as u16
        })
    })
}

/// An occupancy in the making.
#[derive(Debug, Clone, Copy)]
pub(super) struct Candidate<C> {
    pub mask: u8,
    /// Code length so far, in units of 1/256 bit.
    pub bits: u32,
    /// At least the distortion so far.
    pub least: u32,
    pub contexts: C,
}

impl<C> Candidate<C> {
    /// Lagrangian cost of a distortion of `distortion` and the bits.
    #[inline(always)]
    pub fn cost(&self, distortion: u32, lambda: u32) -> u64 {
        (u64::from(distortion) << 12) + u64::from(lambda) * u64::from(self.bits)
    }
}

/// Candidates of one octant, at most [`BEAM`] of them.
#[derive(Debug)]
pub(super) struct Beam<C> {
    pub candidates: Vec<Candidate<C>>,
}

impl<C: Copy> Beam<C> {
    pub fn new(contexts: C) -> Self {
        let mut candidates = Vec::with_capacity(2 * BEAM);
        candidates.push(Candidate {
            mask: 0,
            bits: 0,
            least: 0,
            contexts,
        });
        Beam { candidates }
    }

    /// Keeps the best candidates, of equal ones those that came first, and the one of no distortion.
    #[inline(always)]
    pub fn prune(&mut self, lambda: u32) {
        if self.candidates.len() > BEAM {
            self.candidates
                .sort_by_key(|candidate| candidate.cost(candidate.least, lambda));
            let truth = self.candidates.iter().position(|candidate| candidate.least == 0);
            if let Some(truth) = truth.filter(|truth| *truth >= BEAM) {
                self.candidates.swap(BEAM - 1, truth);
            }
            self.candidates.truncate(BEAM);
        }
    }

    /// The occupancy of least cost.
    pub fn best(&self, surface: &Surface, lambda: u32) -> u8 {
        let cost = |candidate: &&Candidate<C>| candidate.cost(surface.of(candidate.mask), lambda);
        let best = self.candidates.iter().min_by_key(cost);
        best.map_or(surface.mask, |best| best.mask)
    }
}

/// Whether a child may be coded as what it is not, if that has this code length.
#[inline(always)]
pub(super) fn may_differ(bits: u32) -> bool {
    bits <= UNLIKELIEST
}

#[cfg(test)]
mod tests;
