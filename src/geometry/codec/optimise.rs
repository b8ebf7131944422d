//! Rate–distortion optimised occupancy: an encoder that may move voxels by one where that saves bits.
//!
//! Which of two adjacent layers holds a voxel is often decided by sampling and rounding, and costs several bits. For
//! each parent, in coding order, the encoder chooses the occupancy that minimises D + λ·R. R is the code length under
//! the predictor as it is at that parent. D counts
//!
//! - for each voxel that is left out, its weight times the squared distance to the nearest coded voxel;
//! - for each voxel that is added, the squared distance to the nearest true voxel.
//!
//! Children of parents that are not coded yet count as true ones. Parents keep at least one child, and true voxels lie
//! in them. So each true voxel has a coded voxel within one in each coordinate; each coded voxel has a true one there,
//! since both have the same parent. The decoder is unchanged.

use std::ops::Range;
use std::sync::OnceLock;

use b2p_kernels::{Instructions, Isa, Work};
use rayon::prelude::*;

use super::coder::Encoder;
use super::contexts::{CELLS, CORNERS, EDGES, FACES};
use super::neighbourhood::Neighbourhood;
use super::predictor::Predictor;
use super::{count, slices};
use crate::geometry::{KernelMap, Octree, ones};

/// Weight of a voxel that holds a whole patch of the surface.
pub const FULL: u8 = 16;

/// Candidates that are kept at each octant.
const BEAM: usize = 8;

/// A code length up to which a child may be what it is not, in units of [`bits`].
const UNLIKELIEST: u32 = 4 << 8;

/// What the encoder may change about a level.
#[derive(Debug, Clone, Copy)]
pub struct Distortion<'a> {
    /// For each voxel of the level how much of the surface it holds, from 1 to [`FULL`].
    pub weights: &'a [u8],
    /// The Lagrangian multiplier λ: squared distance, in squared voxels, that a bit must save, in units of 1/256.
    pub lambda: u32,
}

/// Chooses and encodes the occupancies of the parents of level `level`, which `octree` has as they truly are. Returns
/// them, and for each slice what [`encode_level`](super::encode_level) does. The result depends neither on `isa` nor on
/// the number of threads.
///
/// # Panics
/// If `level` is 0 or deeper than the octree, `map` belongs to another level, `slice` is 0, or there is not one weight
/// for each voxel of the level.
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
        distortion.weights.len(),
        "one weight per voxel"
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
            let children = &distortion.weights[first_child[parent] as usize..];
            let mut surface = Surface::new(truth[parent], children);
            for k in ones(neighbourhood.there) {
                let neighbour = row[k] as usize;
                let coded = match neighbourhood.known >> k & 1 {
                    1 => masks[neighbour - first],
                    _ => truth[neighbour],
                };
                surface.add(k, truth[neighbour], coded);
            }
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
    /// Weights of the true children, by octant.
    weights: [u8; 8],
    /// True cells, the parent's own included.
    truth: u64,
    /// Coded cells, and true ones where none are coded yet; without the parent's own.
    coded: u64,
}

impl Surface {
    fn new(mask: u8, children: &[u8]) -> Self {
        let mut weights = [0; 8];
        for (octant, weight) in ones(mask.into()).zip(children) {
            weights[octant] = *weight;
        }
        let truth = cells(KernelMap::CENTRE, mask);
        Surface {
            mask,
            weights,
            truth,
            coded: 0,
        }
    }

    /// Adds the neighbour at offset `k`.
    #[inline(always)]
    fn add(&mut self, k: usize, truth: u8, coded: u8) {
        self.truth |= cells(k, truth);
        self.coded |= cells(k, coded);
    }

    /// A lower bound of the distortion of octant `octant`, if its child is there or not as `bit` says, in sixteenths of
    /// a squared voxel: exact for a child that is added.
    #[inline(always)]
    pub fn least(&self, octant: usize, bit: bool) -> u32 {
        match (self.mask >> octant & 1 == 1, bit) {
            (true, false) => self.weights[octant].into(),
            (false, true) => u32::from(FULL) * squared_distance(self.truth, octant),
            _ => 0,
        }
    }

    /// The distortion if the parent's children are `mask`, in sixteenths of a squared voxel.
    #[inline(always)]
    pub fn of(&self, mask: u8) -> u32 {
        let coded = self.coded | cells(KernelMap::CENTRE, mask);
        let lost = ones((self.mask & !mask).into())
            .map(|octant| u32::from(self.weights[octant]) * squared_distance(coded, octant));
        let added =
            ones((mask & !self.mask).into()).map(|octant| u32::from(FULL) * squared_distance(self.truth, octant));
        lost.sum::<u32>() + added.sum::<u32>()
    }
}

/// Cells of the children `mask` of the neighbour at offset `k`.
#[inline(always)]
fn cells(k: usize, mask: u8) -> u64 {
    CELLS[k][0][usize::from(mask & 15)] | CELLS[k][1][usize::from(mask >> 4)]
}

/// Squared distance from a child to the nearest of `cells` but itself; 4 if none is around it.
#[inline(always)]
fn squared_distance(cells: u64, octant: usize) -> u32 {
    let around = cells >> ((octant & 1) + 4 * (octant >> 1 & 1) + 16 * (octant >> 2));
    match (around & FACES, around & EDGES, around & CORNERS) {
        (0, 0, 0) => 4,
        (0, 0, _) => 3,
        (0, _, _) => 2,
        _ => 1,
    }
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

    /// The level optimised with this λ, in slices of 1000, and the octree that it decodes to.
    fn optimised(octree: &Octree, level: u8, lambda: u32) -> (Vec<(u32, Vec<u8>)>, Octree) {
        let map = octree.kernel_map(level - 1);
        let weights = vec![FULL; octree.level(level).len()];
        let distortion = Distortion {
            weights: &weights,
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
    fn any_number_of_threads_and_any_instructions_give_the_same_bytes() {
        let octree = noisy_plane();
        let with_threads = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            pool.unwrap().install(|| optimised(&octree, 7, 200))
        };
        let one = with_threads(1);
        assert_eq!(one, with_threads(3));
        let map = octree.kernel_map(6);
        let weights = vec![FULL; octree.level(7).len()];
        let distortion = Distortion {
            weights: &weights,
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
        fn distortions_match_their_definition(
            truth in prop::array::uniform27(any::<u8>()), coded in prop::array::uniform27(any::<u8>()),
            weights in prop::array::uniform8(1u8..=FULL), mask in 1u8..
        ) {
            let own = truth[KernelMap::CENTRE].max(1);
            let children: Vec<u8> = ones(own.into()).map(|octant| weights[octant]).collect();
            let mut surface = Surface::new(own, &children);
            for k in (0..27).filter(|k| *k != KernelMap::CENTRE) {
                surface.add(k, truth[k], coded[k]);
            }
            // Places of the children around and in the parent, if its own are these.
            let places = |around: &[u8; 27], own: u8| -> Vec<[i32; 3]> {
                let of = |k: usize, o: usize| {
                    let parent = [k % 3, k / 3 % 3, k / 9].map(|x| 2 * (x as i32 - 1));
                    let child = [o & 1, o >> 1 & 1, o >> 2].map(|x| x as i32);
                    std::array::from_fn(|c| parent[c] + child[c])
                };
                let mask = |k: usize| if k == KernelMap::CENTRE { own } else { around[k] };
                (0..27).flat_map(|k| ones(mask(k).into()).map(move |o| of(k, o))).collect()
            };
            let nearest = |octant: usize, places: &[[i32; 3]]| {
                let at = [octant & 1, octant >> 1 & 1, octant >> 2].map(|x| x as i32);
                let squared = |p: &[i32; 3]| (0..3).map(|c| (p[c] - at[c]).pow(2) as u32).sum::<u32>();
                let near = |p: &&[i32; 3]| (0..3).all(|c| (p[c] - at[c]).abs() <= 1);
                places.iter().filter(near).map(squared).min().unwrap_or(4)
            };
            let (all, kept) = (places(&truth, own), places(&coded, mask));
            let mut want = 0;
            for octant in 0..8 {
                match (own >> octant & 1, mask >> octant & 1) {
                    (1, 0) => want += u32::from(weights[octant]) * nearest(octant, &kept),
                    (0, 1) => want += u32::from(FULL) * nearest(octant, &all),
                    _ => {}
                }
            }
            prop_assert_eq!(surface.of(mask), want);
            let least = (0..8).map(|octant| surface.least(octant, mask >> octant & 1 == 1));
            prop_assert!(least.sum::<u32>() <= want);
        }
    }
}
