//! A level's voxels in parts, each with what lies around it: their children are eight times as many, and need not all
//! be in memory at once.

use std::ops::Range;

use b2p_kernels::zeros;
use rayon::prelude::*;

use crate::geometry::KernelMap;

/// Some voxels of a level, one after the other, and rings of neighbours around them.
pub(super) struct VoxelPart {
    /// The voxels' rows in the level: first those of the part, then ring by ring.
    pub voxels: Vec<u32>,
    /// How many voxels there are without any ring, with one, and so on.
    pub ends: Vec<usize>,
    /// The 3³ map of all voxels but those of the last ring.
    pub map: KernelMap,
}

/// Cuts a level into parts.
pub(super) struct VoxelParts<'a> {
    map: &'a KernelMap,
    /// For each voxel, its place in the present part.
    places: Vec<u32>,
}

impl<'a> VoxelParts<'a> {
    pub fn new(map: &'a KernelMap) -> Self {
        VoxelParts {
            map,
            places: vec![KernelMap::ABSENT; map.len()],
        }
    }

    /// The part of these rows, with at least one ring around it: of fewer of them, down to one, if with the rings they
    /// were more than `most`.
    ///
    /// Two steps from child to neighbouring child lead to a neighbour of the parent at most: what `2n` layers of 3³
    /// make of the children of the part and of `n` rings is, for the part itself, what they make of all children.
    pub fn part(&mut self, mut rows: Range<usize>, rings: usize, most: usize) -> VoxelPart {
        let (mut voxels, mut ends) = self.surround(rows.clone(), rings);
        while voxels.len() > most && rows.len() > 1 {
            self.forget(&voxels);
            rows.end = rows.start + rows.len() / 2;
            (voxels, ends) = self.surround(rows.clone(), rings);
        }
        let (map, places) = (self.map, &self.places);
        let seen = ends[rings - 1];
        let mut near = zeros(seen * 27);
        let rows = near.par_chunks_exact_mut(27).zip(&voxels[..seen]);
        rows.with_min_len(256).for_each(|(row, &voxel)| {
            for (place, &q) in row.iter_mut().zip(map.row(voxel as usize)) {
                *place = match q {
                    KernelMap::ABSENT => q,
                    q => places[q as usize],
                };
            }
        });
        self.forget(&voxels);
        VoxelPart {
            voxels,
            ends,
            map: KernelMap::new(27, near),
        }
    }

    /// Gives rows and the rings around them their places, ring by ring, and tells how many there are with each.
    fn surround(&mut self, rows: Range<usize>, rings: usize) -> (Vec<u32>, Vec<usize>) {
        let VoxelParts { map, places } = self;
        let mut voxels: Vec<u32> = (rows.start as u32..rows.end as u32).collect();
        for (&voxel, place) in voxels.iter().zip(0..) {
            places[voxel as usize] = place;
        }
        let mut ends = vec![voxels.len()];
        let mut seen = 0;
        for _ in 0..rings {
            for at in seen..voxels.len() {
                for &q in map.row(voxels[at] as usize) {
                    if q != KernelMap::ABSENT && places[q as usize] == KernelMap::ABSENT {
                        places[q as usize] = voxels.len() as u32;
                        voxels.push(q);
                    }
                }
            }
            seen = ends[ends.len() - 1];
            ends.push(voxels.len());
        }
        (voxels, ends)
    }

    /// Takes their places away.
    fn forget(&mut self, voxels: &[u32]) {
        for &voxel in voxels {
            self.places[voxel as usize] = KernelMap::ABSENT;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Octree, Voxels, morton};

    #[test]
    fn a_part_s_map_names_the_neighbours_of_the_level_s() {
        let bowl = (0..1u32 << 12).map(|i| {
            let [x, y] = [i % 64, i / 64];
            morton::encode([x, y, (x * x + y * y) / 128])
        });
        let octree = Octree::new(Voxels::new(6, bowl.collect())).unwrap();
        let map = &octree.kernel_map(6);
        let mut parts = VoxelParts::new(map);
        for (rows, rings) in [(0..100, 1), (700..1400, 3), (4000..map.len(), 2)] {
            let part = parts.part(rows.clone(), rings, map.len());
            assert_eq!(part.ends.len(), rings + 1);
            assert_eq!(part.ends[0], rows.len());
            assert_eq!(part.voxels.len(), part.ends[rings]);
            assert_eq!(part.map.len(), part.ends[rings - 1]);
            for i in 0..part.map.len() {
                let named = part.map.row(i).iter().map(|&q| match q {
                    KernelMap::ABSENT => q,
                    q => part.voxels[q as usize],
                });
                assert!(named.eq(map.row(part.voxels[i] as usize).iter().copied()));
            }
            let mut voxels = part.voxels.clone();
            voxels.sort_unstable();
            voxels.dedup();
            assert_eq!(voxels.len(), part.voxels.len(), "each voxel once");
        }
    }

    #[test]
    fn a_part_whose_surroundings_are_too_many_is_made_smaller() {
        let octree = Octree::new(Voxels::new(4, (0..1 << 12).collect())).unwrap();
        let map = &octree.kernel_map(4);
        let mut parts = VoxelParts::new(map);
        let whole = parts.part(0..512, 3, map.len());
        assert_eq!((whole.ends[0], whole.voxels.len()), (512, 11 * 11 * 11));
        let part = parts.part(0..512, 3, 1000);
        assert!(part.voxels.len() <= 1000 && (1..512).contains(&part.ends[0]));
        assert_eq!(parts.part(0..512, 3, 1).ends[0], 1, "not less than a voxel");
        assert_eq!(parts.part(0..512, 3, map.len()).voxels, whole.voxels);
    }
}
