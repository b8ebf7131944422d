//! Moments of consecutive voxels after all steps (`docs/format.md`, clause 6.2), from those within two steps of them:
//! what is not drawn at the moment takes no memory.

use std::ops::Range;

use b2p_kernels::{Isa, zeros};

use super::moments::{Moments, ROUNDS};
use super::passes;
use crate::geometry::{KernelMap, RowBuffer, SiblingMap, Voxels};

/// Voxels and those around them, at most. There is always room for a single voxel.
const MOST: usize = 8192;
/// Neighbours beyond the range, of its voxels or of the first ring's, at most.
const MOST_BEYOND: usize = 1 << 15;
/// Bytes that making the moments of up to 4096 voxels takes at most: rows, neighbours beyond, both twice while they
/// grow; moments before and after a step, coordinates, occupied places, rings.
pub const BYTES: u64 = (MOST * (2 * 27 * 2 + 2 * size_of::<Moments>() + 12 + 4 + 4) + 2 * 8 * MOST_BEYOND) as u64;

/// The moments of consecutive voxels after all steps.
///
/// # Panics
/// If the map is not that of the voxels, or these are not among them.
pub fn after_all_steps(isa: Isa, voxels: &Voxels, map: &SiblingMap, range: Range<usize>) -> Vec<Moments> {
    if let Some(near) = Near::of(isa, map, range.clone()) {
        return near.moments(isa, voxels, map);
    }
    let middle = range.start + range.len() / 2;
    let mut moments = after_all_steps(isa, voxels, map, range.start..middle);
    moments.extend(after_all_steps(isa, voxels, map, middle..range.end));
    moments
}

/// Consecutive voxels, and those within two steps of them.
struct Near {
    range: Range<usize>,
    /// The voxels one step away, and two steps away, ascending.
    rings: [Vec<u32>; 2],
    /// For the voxels of the range, then of the first ring, their 27 neighbours: places in the range, the first ring and
    /// the second one, all in a row.
    rows: Vec<u16>,
}

impl Near {
    /// `None` if they are too many.
    fn of(isa: Isa, map: &SiblingMap, range: Range<usize>) -> Option<Self> {
        let mut finder = Finder::new(isa, map, range.clone());
        finder.add_rows(range.clone())?;
        let first = finder.name(&[])?;
        for run in runs(&first) {
            finder.add_rows(run)?;
        }
        let second = finder.name(&first)?;
        Some(Near {
            range,
            rings: [first, second],
            rows: finder.rows,
        })
    }

    /// The moments of the voxels of the range.
    fn moments(&self, isa: Isa, voxels: &Voxels, map: &SiblingMap) -> Vec<Moments> {
        let mut moments = self.after_one_step(isa, voxels, map);
        for round in 1..ROUNDS {
            // Each step needs a ring less.
            let rings = self.rings[..ROUNDS - 1 - round].iter();
            let count = self.range.len() + rings.map(Vec::len).sum::<usize>();
            let mut next: Vec<Moments> = zeros(count + 1);
            isa.run(passes::Sum {
                from: &moments,
                rows: &self.rows,
                to: &mut next[..count],
            });
            moments = next;
        }
        moments.truncate(self.range.len());
        moments
    }

    /// The moments of all voxels after one step, then one element of zeros.
    fn after_one_step(&self, isa: Isa, voxels: &Voxels, map: &SiblingMap) -> Vec<Moments> {
        let others = self.rings.iter().flatten().map(|&voxel| voxel as usize);
        let all = self.range.clone().chain(others);
        let coordinates: Vec<[u32; 3]> = all.map(|voxel| voxels.coordinate(voxel)).collect();
        let mut masks = vec![0; coordinates.len()];
        let mut rest = masks.as_mut_slice();
        let runs = self.rings.iter().flat_map(|ring| runs(ring));
        for run in std::iter::once(self.range.clone()).chain(runs) {
            let (own, others) = rest.split_at_mut(run.len());
            map.masks(run.start, own);
            rest = others;
        }
        let mut moments = zeros(coordinates.len() + 1);
        isa.run(passes::FirstStep {
            masks: &masks,
            coordinates: &coordinates,
            to: &mut moments[..coordinates.len()],
        });
        moments
    }
}

/// Finds what is around consecutive voxels, ring by ring.
struct Finder<'a> {
    isa: Isa,
    map: &'a SiblingMap,
    range: Range<usize>,
    rows: Vec<u16>,
    /// Neighbours beyond the range that have no place yet, and where in `rows` it is missing.
    missing: Vec<(u32, u32)>,
    buffer: RowBuffer,
    /// The last rows of the buffer that have neighbours beyond the range.
    edge: Vec<u32>,
    /// By the last bits of its number, a voxel beyond the range and its place: most are found without a search.
    places: Box<[(u32, u16); SLOTS]>,
}

/// Voxels beyond the range whose places are found without a search, at most.
const SLOTS: usize = 2048;
/// A place that is not known.
const UNKNOWN: u16 = u16::MAX;

impl<'a> Finder<'a> {
    fn new(isa: Isa, map: &'a SiblingMap, range: Range<usize>) -> Self {
        Finder {
            isa,
            map,
            rows: Vec::with_capacity(27 * range.len() * 9 / 8),
            range,
            missing: Vec::new(),
            buffer: RowBuffer::new(),
            edge: Vec::new(),
            places: Box::new([(KernelMap::ABSENT, UNKNOWN); SLOTS]),
        }
    }

    /// Appends the rows of voxels of the level. `None` if too many of their neighbours lie beyond the range.
    fn add_rows(&mut self, voxels: Range<usize>) -> Option<()> {
        let (first, count) = (self.range.start as u32, self.range.len() as u32);
        for start in voxels.clone().step_by(RowBuffer::ROWS) {
            let rows = self
                .buffer
                .fill(self.map, start..voxels.end.min(start + RowBuffer::ROWS));
            let index = self.rows.len();
            self.rows.resize(index + rows.len(), 0);
            self.isa.run(passes::Locate {
                rows,
                range: (first, count),
                to: &mut self.rows[index..],
                edge: &mut self.edge,
            });
            for row in self.edge.drain(..) {
                let start = 27 * row as usize;
                for (i, &q) in (index + start..).zip(&rows[start..][..27]) {
                    if q != KernelMap::ABSENT && q.wrapping_sub(first) >= count {
                        self.missing.push((q, i as u32));
                    }
                }
            }
            if self.missing.len() > MOST_BEYOND {
                return None;
            }
        }
        Some(())
    }

    /// Gives places to the neighbours beyond the range, after those of the ones that are `known`, and returns those that
    /// are not, ascending. `None` if these are too many.
    fn name(&mut self, known: &[u32]) -> Option<Vec<u32>> {
        let count = self.range.len();
        let mut new: Vec<u32> = Vec::new();
        for &(q, _) in &self.missing {
            let slot = &mut self.places[q as usize % SLOTS];
            if slot.0 != q {
                *slot = (q, UNKNOWN);
                new.push(q);
            }
        }
        new.sort_unstable();
        new.dedup();
        new.retain(|q| known.binary_search(q).is_err());
        if count + known.len() + new.len() > MOST {
            return None;
        }
        for (place, &q) in (count + known.len()..).zip(&new) {
            self.places[q as usize % SLOTS] = (q, place as u16);
        }
        for (q, index) in self.missing.drain(..) {
            let place = match self.places[q as usize % SLOTS] {
                (found, place) if found == q && place != UNKNOWN => place,
                _ => match (known.binary_search(&q), new.binary_search(&q)) {
                    (Ok(place), _) => (count + place) as u16,
                    (_, Ok(place) | Err(place)) => (count + known.len() + place) as u16,
                },
            };
            self.rows[index as usize] = place;
        }
        Some(new)
    }
}

/// Ranges of consecutive voxels among ascending ones.
fn runs(voxels: &[u32]) -> impl Iterator<Item = Range<usize>> {
    let runs = voxels.chunk_by(|a, b| a + 1 == *b);
    runs.map(|run| run[0] as usize..run[0] as usize + run.len())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gaussians::surfels::moments;
    use crate::geometry::{Octree, morton};
    use proptest::prelude::*;

    /// The moments of all voxels of a level after all steps, by definition.
    fn of_level(voxels: &Voxels, map: &SiblingMap) -> Vec<Moments> {
        let count = voxels.len();
        let mut masks = vec![0; count];
        map.masks(0, &mut masks);
        let first = masks.iter().enumerate();
        let mut all: Vec<Moments> = first
            .map(|(i, &mask)| moments::absolute(mask, voxels.coordinate(i)))
            .collect();
        for _ in 1..ROUNDS {
            let sum = |i: usize| {
                let row = map.row(i).into_iter().filter(|&q| q != KernelMap::ABSENT);
                row.fold([0u16; 16], |sum, q| {
                    std::array::from_fn(|k| sum[k].wrapping_add(all[q as usize][k]))
                })
            };
            all = (0..count).map(sum).collect();
        }
        all
    }

    /// Compares the moments of parts of so many voxels with those of the whole level.
    fn check(depth: u8, keys: Vec<u64>, sizes: &[usize]) {
        let octree = Octree::new(Voxels::new(depth, keys)).unwrap();
        let (voxels, map) = (octree.level(depth), octree.sibling_map(depth));
        let expected = of_level(voxels, &map);
        for isa in [Isa::SCALAR, Isa::detect()] {
            for &size in sizes {
                for first in (0..voxels.len()).step_by(size) {
                    let range = first..voxels.len().min(first + size);
                    let found = after_all_steps(isa, voxels, &map, range.clone());
                    assert!(found == expected[range.clone()], "{range:?}, {isa}");
                }
            }
        }
    }

    proptest! {
        #[test]
        fn moments_of_parts_are_those_of_the_level(
            keys in prop::collection::vec(0u64..1 << 12, 1..600), size in 1usize..700
        ) {
            check(4, keys, &[size]);
        }
    }

    #[test]
    fn parts_of_a_solid_are_halved_until_there_is_room_for_what_is_around_them() {
        check(5, (0..1 << 15).collect(), &[700, 4096]);
        let large = Octree::new(Voxels::new(6, (0..1 << 18).collect())).unwrap();
        let map = large.sibling_map(6);
        assert!(Near::of(Isa::detect(), &map, 14_700..14_700 + 4096).is_none());
        let range = 14_700..14_700 + 4096;
        let halves = [14_700..14_700 + 2048, 14_700 + 2048..14_700 + 4096];
        let all = |range| after_all_steps(Isa::detect(), large.level(6), &map, range);
        assert!(all(range) == halves.map(all).concat());
    }

    #[test]
    fn a_voxel_of_a_solid_has_room_for_all_that_are_around_it() {
        let whole = Octree::new(Voxels::new(5, (0..1 << 15).collect())).unwrap();
        let middle = whole.level(5).keys().binary_search(&morton::encode([9, 9, 9])).unwrap();
        let near = Near::of(Isa::detect(), &whole.sibling_map(5), middle..middle + 1).unwrap();
        assert_eq!(near.rings.map(|ring| ring.len()), [26, 98]);
    }

    #[test]
    fn surfaces_and_lone_voxels_are_not_halved() {
        let bowl = (0..1u32 << 16).map(|i| {
            let [x, y] = [i % 256, i / 256];
            morton::encode([x, y, (x * x + y * y) / 512])
        });
        let far = (0..5000u64).map(|i| i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 1);
        for (depth, keys) in [(8, bowl.collect::<Vec<_>>()), (21, far.collect())] {
            let octree = Octree::new(Voxels::new(depth, keys)).unwrap();
            let map = octree.sibling_map(depth);
            for first in (0..map.len()).step_by(4096) {
                assert!(Near::of(Isa::detect(), &map, first..map.len().min(first + 4096)).is_some());
            }
        }
    }
}
