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
//! Children of parents that are not coded yet count as true ones. Parents keep at least one child, and true voxels lie
//! in them. So each true voxel has a coded voxel within one in each coordinate; each coded voxel has a true one there,
//! since both have the same parent. The decoder is unchanged.

use std::ops::Range;
use std::sync::OnceLock;

use b2p_kernels::{Instructions, Isa, Work};
use rayon::prelude::*;

use super::coder::Encoder;
use super::contexts::CELLS;
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
    /// For each voxel of the level, which of its eight children hold points.
    pub points: &'a [u8],
    /// The Lagrangian multiplier λ: squared distance, in squared voxels, that a bit must save, in units of 1/256.
    pub lambda: u32,
}

/// Chooses and encodes the occupancies of the parents of level `level`, which `octree` has as they truly are. Returns
/// them, and for each slice what [`encode_level`](super::encode_level) does. The result depends neither on `isa` nor on
/// the number of threads.
///
/// # Panics
/// If `level` is 0 or deeper than the octree, `map` belongs to another level, `slice` is 0, or there is not one
/// mask of points for each voxel of the level.
pub fn optimise_level(
    isa: Isa,
    octree: &Octree,
    map: &KernelMap,
    level: u8,
    slice: usize,
    distortion: Distortion<'_>,
) -> (Vec<u8>, Vec<(u32, Vec<u8>)>) {
    let truth = octree.occupancy(level - 1);
    assert_eq!(map.len(), truth.len(), "one kernel map row per parent");
    assert_eq!(
        octree.level(level).len(),
        distortion.points.len(),
        "one mask of points per voxel"
    );
    let ranges: Vec<_> = slices(truth.len(), slice).collect();
    let optimise = |parents: Range<usize>| {
        isa.run(Optimise {
            map,
            parents,
            truth,
            first_child: octree.first_child(level - 1),
            distortion,
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
    first_child: &'a [u32],
    distortion: Distortion<'a>,
}

impl Work for Optimise<'_> {
    type Output = (Vec<u8>, Vec<u8>);

    #[inline(always)]
    fn run<I: Instructions>(self, instructions: I) -> (Vec<u8>, Vec<u8>) {
        let Optimise {
            map,
            parents,
            truth,
            first_child,
            distortion,
        } = self;
        let (mut predictor, mut encoder) = (Predictor::new(instructions, parents.len()), Encoder::new());
        let neighbourhoods = Neighbourhood::of_all(map, &parents);
        let mut masks: Vec<u8> = Vec::with_capacity(parents.len());
        for (parent, neighbourhood) in parents.clone().zip(neighbourhoods) {
            let (row, first) = (map.row(parent), parents.start);
            let points = |parent: usize| &distortion.points[first_child[parent] as usize..];
            let mut surface = Surface::new(truth[parent], points(parent));
            for k in ones(neighbourhood.there) {
                let neighbour = row[k] as usize;
                let coded = match neighbourhood.known >> k & 1 {
                    1 => masks[neighbour - first],
                    _ => truth[neighbour],
                };
                surface.add(k, truth[neighbour], coded, points(neighbour));
            }
            surface.finish();
            let chosen = predictor.choose(neighbourhood, row, first, &masks, &surface, distortion.lambda);
            predictor.code(&mut encoder, neighbourhood, row, first, &masks, chosen);
            masks.push(chosen);
        }
        (masks, encoder.finish())
    }
}

/// The surface around a parent, as cells of its children's level (see `contexts`).
#[derive(Debug, Clone, Copy)]
pub(super) struct Surface {
    /// The parent's true children.
    pub mask: u8,
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
    fn new(mask: u8, points: &[u8]) -> Self {
        let mut surface = Surface {
            mask,
            own: [0; 8],
            points: [0; 8],
            coded: 0,
            added: [0; 8],
        };
        for (octant, points) in ones(mask.into()).zip(points) {
            surface.own[octant] = *points;
        }
        surface.add(KernelMap::CENTRE, mask, 0, points);
        surface
    }

    /// Adds the neighbour at offset `k`. `points` start with those of its children.
    #[inline(always)]
    fn add(&mut self, k: usize, truth: u8, coded: u8, points: &[u8]) {
        self.coded |= cells(k, coded);
        for (octant, points) in ones(truth.into()).zip(points) {
            let cell = cells(k, 1 << octant);
            for (at, cells) in self.points.iter_mut().enumerate() {
                *cells |= cell * u64::from(points >> at & 1);
            }
        }
    }

    /// Computes what children cost that are added, once all neighbours are there.
    #[inline(always)]
    fn finish(&mut self) {
        for octant in ones((!self.mask).into()) {
            let shift = shift_of(octant);
            let near = |half: usize| (0..8).any(|at| self.points[at] >> shift & AROUND[7 - at][half] != 0);
            let half = (1..FARTHEST).find(|half| near(*half)).unwrap_or(FARTHEST);
            self.added[octant] = ADDED * half as u32;
        }
    }

    /// A lower bound of the distortion of octant `octant`, if its child is there or not as `bit` says, in sixteenths of
    /// a squared voxel: exact for a child that is added.
    #[inline(always)]
    pub fn least(&self, octant: usize, bit: bool) -> u32 {
        match (self.mask >> octant & 1 == 1, bit) {
            (true, false) => POINT * self.own[octant].count_ones(),
            (false, true) => self.added[octant],
            _ => 0,
        }
    }

    /// The distortion if the parent's children are `mask`, in sixteenths of a squared voxel.
    #[inline(always)]
    pub fn of(&self, mask: u8) -> u32 {
        let coded = self.coded | cells(KernelMap::CENTRE, mask);
        let mut sum = 0;
        for octant in ones((self.mask & !mask).into()) {
            let around = coded >> shift_of(octant);
            for at in ones(self.own[octant].into()) {
                let half = (1..FARTHEST).find(|half| around & AROUND[at][*half] != 0);
                sum += POINT * half.unwrap_or(FARTHEST) as u32;
            }
        }
        for octant in ones((mask & !self.mask).into()) {
            sum += self.added[octant];
        }
        sum
    }
}

/// Distortion of a point, and of a voxel that is added, for each half squared voxel, in sixteenths of a squared voxel.
const POINT: u32 = 2;
const ADDED: u32 = 8;

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
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::cancel::Cancel;
    use crate::container::Slice;
    use crate::geometry::codec::{decode_level, encode_level};
    use crate::geometry::{Voxels, morton};
    use crate::testing::Random;

    /// A tilted plane of depth 7, whose voxels lie in one of two layers where noise decides.
    fn noisy_plane() -> Octree {
        let mut random = Random(3);
        let column = |i: u32| {
            let (x, y) = (i % 128, i / 128);
            let noise = (random.next() % 100) as f32 / 100.0;
            morton::encode([x, y, (20.0 + 0.21 * x as f32 + 0.13 * y as f32 + noise) as u32])
        };
        Octree::new(Voxels::new(7, (0..128 * 128).map(column).collect())).unwrap()
    }

    /// Points in the voxels of a level: some, by their places, where the octree ends with it.
    fn points(octree: &Octree, level: u8) -> Vec<u8> {
        let some = |key: &u64| (key.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 56) as u8 | 1;
        match level == octree.depth() {
            true => octree.level(level).keys().iter().map(some).collect(),
            false => octree.occupancy(level).to_vec(),
        }
    }

    /// The level optimised with this λ, in slices of 1000, and the octree that it decodes to.
    fn optimised(octree: &Octree, level: u8, lambda: u32) -> (Vec<(u32, Vec<u8>)>, Octree) {
        let map = octree.kernel_map(level - 1);
        let points = points(octree, level);
        let distortion = Distortion {
            points: &points,
            lambda,
        };
        let (masks, encoded) = optimise_level(Isa::detect(), octree, &map, level, 1000, distortion);
        let slices: Vec<_> = encoded
            .iter()
            .map(|(voxels, bytes)| Slice {
                voxels: *voxels,
                bytes,
                offset: 0,
            })
            .collect();
        let mut decoded = octree.truncated(level - 1);
        decode_level(Isa::detect(), &mut decoded, &map, &slices, 1000, &Cancel::default()).unwrap();
        assert_eq!(decoded.occupancy(level - 1), masks);
        (encoded, decoded)
    }

    fn size(encoded: &[(u32, Vec<u8>)]) -> usize {
        encoded.iter().map(|(_, bytes)| bytes.len()).sum()
    }

    /// Whether every voxel of `a` has one of `b` within one in each coordinate.
    fn is_near(a: &Voxels, b: &Voxels) -> bool {
        let side = 1i64 << a.depth();
        (0..a.len()).all(|i| {
            let at = a.coordinate(i).map(i64::from);
            (0..27i64).any(|k| {
                let d = [k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1];
                let place: [i64; 3] = std::array::from_fn(|c| at[c] + d[c]);
                let inside = place.iter().all(|x| (0..side).contains(x));
                inside && b.keys().binary_search(&morton::encode(place.map(|x| x as u32))).is_ok()
            })
        })
    }

    #[test]
    fn a_bit_that_may_cost_nothing_leaves_the_level_exact() {
        let octree = noisy_plane();
        let (encoded, decoded) = optimised(&octree, 7, 0);
        let exact = encode_level(Isa::detect(), &octree, &octree.kernel_map(6), 7, 1000);
        assert_eq!((encoded, decoded), (exact, octree));
    }

    #[test]
    fn the_larger_lambda_the_fewer_bytes() {
        let octree = noisy_plane();
        let sizes = [0, 64, 256, 1024].map(|lambda| size(&optimised(&octree, 7, lambda).0));
        assert!(sizes.is_sorted_by(|a, b| a > b), "{sizes:?}");
        assert!(2 * sizes[3] < sizes[0], "{sizes:?}");
    }

    #[test]
    fn every_number_of_threads_and_every_instruction_set_give_the_same_bytes() {
        let octree = noisy_plane();
        let with_threads = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            pool.unwrap().install(|| optimised(&octree, 7, 200))
        };
        let one = with_threads(1);
        assert_eq!(one, with_threads(3));
        let map = octree.kernel_map(6);
        let points = points(&octree, 7);
        let distortion = Distortion {
            points: &points,
            lambda: 200,
        };
        for isa in Isa::available() {
            assert_eq!(
                optimise_level(isa, &octree, &map, 7, 1000, distortion).1,
                one.0,
                "{isa}"
            );
        }
    }

    proptest! {
        #[test]
        fn coded_voxels_lie_within_one_of_true_ones_and_these_of_coded_ones(
            keys in prop::collection::vec(0u64..1 << 12, 1..400), lambda in 0u32..20_000
        ) {
            let octree = Octree::new(Voxels::new(4, keys)).unwrap();
            let (_, decoded) = optimised(&octree, 4, lambda);
            prop_assert!(is_near(decoded.level(4), octree.level(4)));
            prop_assert!(is_near(octree.level(4), decoded.level(4)));
            prop_assert_eq!(decoded.truncated(3), octree.truncated(3));
        }

        #[test]
        fn distortions_match_their_definition(keys in prop::collection::vec(0u64..1 << 12, 1..200), mask in 1u8..) {
            let octree = Octree::new(Voxels::new(4, keys)).unwrap();
            let (parents, truth) = (octree.level(2), octree.occupancy(2));
            let points = octree.occupancy(3);
            let (map, first) = (octree.kernel_map(2), octree.first_child(2));
            for parent in 0..parents.len() {
                let of = |parent: usize| &points[first[parent] as usize..];
                let mut surface = Surface::new(truth[parent], of(parent));
                for k in (0..27).filter(|k| *k != KernelMap::CENTRE) {
                    let neighbour = map.row(parent)[k];
                    if neighbour != KernelMap::ABSENT {
                        let neighbour = neighbour as usize;
                        surface.add(k, truth[neighbour], truth[neighbour], of(neighbour));
                    }
                }
                surface.finish();
                let want = by_definition(&octree, parent, mask);
                prop_assert_eq!(surface.of(mask), want);
                let least = (0..8).map(|octant| surface.least(octant, mask >> octant & 1 == 1));
                prop_assert!(least.sum::<u32>() <= want);
            }
        }
    }

    /// The distortion if a voxel of level 2 has these children and all others are exact, by coordinates in quarters of
    /// a voxel of level 3.
    fn by_definition(octree: &Octree, parent: usize, mask: u8) -> u32 {
        let centre = |key: u64| morton::decode(key).map(|x| 4 * i64::from(x) + 2);
        let point = |key: u64| morton::decode(key).map(|x| 2 * i64::from(x) + 1);
        let squared = |a: [i64; 3], b: [i64; 3]| (0..3).map(|c| (a[c] - b[c]).pow(2)).sum::<i64>();
        let near = |a: u64, b: u64| {
            let (a, b) = (morton::decode(a), morton::decode(b));
            (0..3).all(|c| a[c].abs_diff(b[c]) <= 1)
        };
        let key = octree.level(2).keys()[parent];
        let coded: Vec<u64> = (0..512)
            .filter(|child| match child >> 3 == key {
                true => mask >> (child & 7) & 1 == 1,
                false => octree.level(3).keys().binary_search(child).is_ok(),
            })
            .collect();
        let mut sum = 0;
        for child in key << 3..=key << 3 | 7 {
            let here = octree.level(3).keys().binary_search(&child).is_ok();
            let points = octree.level(4).keys();
            let nearest = |distances: &mut dyn Iterator<Item = i64>| (distances.min().unwrap() - 3) / 8;
            match (here, mask >> (child & 7) & 1 == 1) {
                (true, false) => {
                    for own in points.iter().filter(|point| *point >> 3 == child) {
                        let around = coded.iter().filter(|other| near(**other, child));
                        let mut distances = around.map(|other| squared(centre(*other), point(*own)));
                        sum += POINT * nearest(&mut distances) as u32;
                    }
                }
                (false, true) => {
                    let around = points.iter().filter(|point| near(*point >> 3, child));
                    let mut distances = around.map(|other| squared(centre(child), point(*other)));
                    sum += ADDED * nearest(&mut distances) as u32;
                }
                _ => {}
            }
        }
        sum
    }
}
