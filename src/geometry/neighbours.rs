//! Kernel maps: the indices of every voxel's occupied neighbours (`docs/format.md`, clause 2.4).
//!
//! A kernel map is built from that of the level above, without searching or hashing. The neighbour of a child lies in
//! its parent or in one of its parent's 26 neighbours, whose children are found by counting bits of the occupancy. The
//! window around up to eight siblings is looked up once per parent.

use std::sync::OnceLock;

use b2p_kernels::{Plan, Taps, copy_row, zeros};
use rayon::prelude::*;

use super::ones;

/// The neighbours of every voxel under a 3³ or 2³ kernel.
///
/// Row `i` holds `volume` indices of input voxels in the kernel's offset order (x fastest), [`KernelMap::ABSENT`] where
/// none is: offsets −1, 0, 1 along each axis for 3³, `k = (dx+1) + 3(dy+1) + 9(dz+1)`; 0, 1 for 2³, `k = dx + 2dy +
/// 4dz`.
#[derive(Debug, Clone)]
pub struct KernelMap {
    volume: usize,
    rows: Vec<u32>,
    /// Layout of the map for convolution layers, built on first use.
    plan: OnceLock<Plan>,
}

impl PartialEq for KernelMap {
    fn eq(&self, other: &Self) -> bool {
        self.volume == other.volume && self.rows == other.rows
    }
}

impl Eq for KernelMap {}

impl KernelMap {
    /// Index of an unoccupied neighbour.
    pub const ABSENT: u32 = u32::MAX;
    /// Index of the voxel itself in a 3³ row.
    pub const CENTRE: usize = 13;

    /// A map of rows of `volume` indices each.
    ///
    /// # Panics
    /// If the last row is incomplete.
    pub fn new(volume: usize, rows: Vec<u32>) -> Self {
        assert_eq!(rows.len() % volume, 0, "kernel map rows must be whole");
        KernelMap {
            volume,
            rows,
            plan: OnceLock::new(),
        }
    }

    /// The map in the form of convolution layers.
    pub fn taps(&self) -> Taps<'_> {
        let plan = || Plan::new(self.len());
        Taps::Map {
            volume: self.volume,
            rows: &self.rows,
            plan: Some(self.plan.get_or_init(plan)),
        }
    }

    /// The 3³ map of level 0, which has one voxel.
    pub fn root() -> Self {
        let mut rows = vec![Self::ABSENT; 27];
        rows[Self::CENTRE] = 0;
        KernelMap::new(27, rows)
    }

    /// The neighbours of all eight children of *every* voxel of this 3³ map. The child in octant `o` of voxel `i` has
    /// the index `8i + o`.
    ///
    /// # Panics
    /// If this is not a 3³ map, or has more than 2²⁹ − 1 voxels.
    pub fn generated_children(&self) -> GeneratedChildren<'_> {
        assert_eq!(self.volume, 27, "children come from a 3³ map");
        assert!(self.len() < 1 << 29, "child indices must fit 32 bits");
        GeneratedChildren {
            parents: self,
            plan: Plan::new(8 * self.len()),
        }
    }

    /// The 2³ map of the same voxels.
    ///
    /// # Panics
    /// If this is not a 3³ map.
    pub fn forward(&self) -> Self {
        assert_eq!(self.volume, 27, "a 2³ map is part of a 3³ map");
        let rows = self
            .rows
            .par_chunks_exact(27)
            .flat_map_iter(|row| [13, 14, 16, 17, 22, 23, 25, 26].map(|k| row[k]))
            .collect();
        KernelMap::new(8, rows)
    }

    /// Number of kernel offsets: 27, 8 or 1.
    pub fn volume(&self) -> usize {
        self.volume
    }

    /// Number of voxels.
    pub fn len(&self) -> usize {
        self.rows.len() / self.volume
    }

    /// Whether there are no voxels.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Row of voxel `i`.
    pub fn row(&self, i: usize) -> &[u32] {
        &self.rows[i * self.volume..(i + 1) * self.volume]
    }

    /// All rows, concatenated.
    pub fn rows(&self) -> &[u32] {
        &self.rows
    }
}

/// All eight children of every voxel of a level, and their neighbours under a 3³ kernel.
#[derive(Debug)]
pub struct GeneratedChildren<'a> {
    parents: &'a KernelMap,
    plan: Plan,
}

impl GeneratedChildren<'_> {
    /// The neighbours in the form of convolution layers.
    pub fn taps(&self) -> Taps<'_> {
        Taps::AllChildren {
            neighbours: &self.parents.rows,
            plan: &self.plan,
        }
    }
}

/// Number of parents of one task.
const BLOCK: usize = 1024;

/// The 3³ map of the children of the voxels of `map`, given the occupancy and the first child of each.
///
/// # Panics
/// If `map` is not a 3³ map, or the numbers of voxels differ.
pub(super) fn of_children(map: &KernelMap, occupancy: &[u8], first_child: &[u32]) -> KernelMap {
    assert_eq!(map.volume, 27, "children come from a 3³ map");
    assert_eq!(map.len(), occupancy.len(), "one occupancy per voxel");
    assert_eq!(map.len(), first_child.len(), "one first child per voxel");
    let count = |masks: &[u8]| masks.iter().map(|m| m.count_ones() as usize).sum::<usize>();
    let mut rows = zeros(count(occupancy) * 27);

    let mut tasks = Vec::with_capacity(map.len().div_ceil(BLOCK));
    let mut rest = rows.as_mut_slice();
    for (parents, masks) in map.rows.chunks(BLOCK * 27).zip(occupancy.chunks(BLOCK)) {
        let (block, after) = rest.split_at_mut(count(masks) * 27);
        tasks.push((parents, masks, block));
        rest = after;
    }
    tasks.into_par_iter().for_each(|(parents, masks, block)| {
        let mut rows = block.chunks_exact_mut(27);
        for (parent, &mask) in parents.chunks_exact(27).zip(masks) {
            let window = window(parent, occupancy, first_child);
            for (octant, row) in ones(mask).zip(&mut rows) {
                copy_row(&window, octant, row);
            }
        }
    });
    KernelMap::new(27, rows)
}

/// Of every occupancy, the number of children before each octant, −1 where there is no child.
static RANKS: [[i32; 8]; 256] = {
    let mut ranks = [[-1; 8]; 256];
    let mut mask = 0;
    while mask < 256 {
        let (mut octant, mut rank) = (0, 0);
        while octant < 8 {
            if mask >> octant & 1 == 1 {
                ranks[mask][octant] = rank;
                rank += 1;
            }
            octant += 1;
        }
        mask += 1;
    }
    ranks
};

/// For every position of the window of 4³ children around a voxel's children, x fastest: eight times the offset of the
/// neighbour that it lies in, plus the octant there.
const WINDOW: [u8; 64] = {
    let mut window = [0; 64];
    let mut i = 0;
    while i < 64 {
        // Window position 0..4 along an axis is child coordinate −1..2: parent offset −1, 0, 0, 1, octant 1, 0, 1, 0.
        let [x, y, z] = [i & 3, i >> 2 & 3, i >> 4];
        let neighbour = ((x + 1) >> 1) + 3 * ((y + 1) >> 1) + 9 * ((z + 1) >> 1);
        let octant = ((x + 1) & 1) + 2 * ((y + 1) & 1) + 4 * ((z + 1) & 1);
        window[i] = (8 * neighbour + octant) as u8;
        i += 1;
    }
    window
};

/// The children in the window around the children of a voxel with these 27 neighbours. It has no branches: the presence
/// of neighbours is unpredictable.
#[inline(always)]
fn window(neighbours: &[u32], occupancy: &[u8], first_child: &[u32]) -> [u32; 64] {
    let mut children = [[0; 8]; 27];
    for (children, &q) in children.iter_mut().zip(neighbours) {
        let present = q != KernelMap::ABSENT;
        let q = if present { q as usize } else { 0 };
        let mask = if present { occupancy[q] } else { 0 };
        let first = first_child[q];
        for (child, rank) in children.iter_mut().zip(RANKS[usize::from(mask)]) {
            // All bits are set, as in ABSENT, where the rank is negative.
            *child = first.wrapping_add(rank as u32) | (rank >> 31) as u32;
        }
    }
    let mut window = [0; 64];
    for (to, from) in window.iter_mut().zip(WINDOW) {
        *to = children[usize::from(from) >> 3][usize::from(from) & 7];
    }
    window
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Octree, Voxels, morton};
    use b2p_kernels::reference::tap;
    use proptest::prelude::*;

    /// Kernel map by definition, with a binary search for every neighbour.
    fn by_search(voxels: &Voxels, offsets: std::ops::RangeInclusive<i64>) -> KernelMap {
        let width = offsets.clone().count();
        let side = 1i64 << voxels.depth();
        let mut rows = Vec::new();
        for i in 0..voxels.len() {
            let [x, y, z] = voxels.coordinate(i).map(i64::from);
            for dz in offsets.clone() {
                for dy in offsets.clone() {
                    for dx in offsets.clone() {
                        let at = [x + dx, y + dy, z + dz];
                        let inside = at.iter().all(|c| (0..side).contains(c));
                        let key = morton::encode(at.map(|c| c as u32));
                        let found = voxels.keys().binary_search(&key).ok();
                        rows.push(match found {
                            Some(index) if inside => index as u32,
                            _ => KernelMap::ABSENT,
                        });
                    }
                }
            }
        }
        KernelMap::new(width * width * width, rows)
    }

    fn check(voxels: Voxels) {
        let octree = Octree::new(voxels).unwrap();
        for level in 0..=octree.depth() {
            let map = octree.kernel_map(level);
            let voxels = octree.level(level);
            assert_eq!(map, by_search(voxels, -1..=1));
            assert_eq!(map.forward(), by_search(voxels, 0..=1));
            if voxels.depth() < morton::MAX_DEPTH {
                let all = voxels.keys().iter().flat_map(|k| k << 3..=k << 3 | 7);
                let all = Voxels::from_sorted(voxels.depth() + 1, all.collect());
                let children = map.generated_children();
                let rows = (0..all.len()).flat_map(|i| {
                    let taps = children.taps();
                    (0..27).map(move |k| tap(&taps, i, k).map_or(KernelMap::ABSENT, |i| i as u32))
                });
                assert_eq!(KernelMap::new(27, rows.collect()), by_search(&all, -1..=1));
            }
        }
    }

    proptest! {
        #[test]
        fn the_map_built_from_the_level_above_matches_a_search(
            keys in prop::collection::vec(0u64..1 << 12, 1..300)
        ) {
            check(Voxels::new(4, keys));
        }
    }

    #[test]
    fn maps_of_extreme_clouds_match_a_search() {
        check(Voxels::new(0, vec![0]));
        check(Voxels::new(3, (0..512).collect()));
        check(Voxels::new(21, vec![0, (1 << 63) - 1]));
        check(Voxels::new(21, vec![1 << 62, (1 << 62) - 1]));
    }

    #[test]
    fn maps_of_several_blocks_match_a_search() {
        let bowl = (0..1u32 << 14).map(|i| {
            let [x, y] = [i % 128, i / 128];
            morton::encode([x, y, (x * x + y * y) / 256])
        });
        let octree = Octree::new(Voxels::new(7, bowl.collect())).unwrap();
        assert!(octree.level(6).len() > 2 * BLOCK);
        assert_eq!(octree.kernel_map(7), by_search(octree.level(7), -1..=1));
    }
}
