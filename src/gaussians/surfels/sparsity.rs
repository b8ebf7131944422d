//! Which levels and neighbourhoods lack voxels: measured from occupancy alone (`docs/format.md`, clause 6.3.2).
//!
//! A level is sparse if one in 512 of its voxels has no neighbour. Clouds sampled densely from surfaces have next to
//! none, wires and twigs included. Captures at the finest level of their grid have more: points are missing, or stray.
//!
//! In sparse levels, the measure of a neighbourhood is the weight of a voxel's walks (`moments.rs`): a plane has 729 at
//! least, half of one 351 at its border, and a lone voxel 1.

use std::ops::Range;

use rayon::prelude::*;

use super::BLOCK;
use crate::geometry::SiblingMap;

/// A level is sparse if one in so many voxels is lone.
const LONE_SHARE: usize = 512;
/// Levels with fewer voxels are never sparse: at coarse levels, small parts of scenes are lone voxels.
const LEAST: usize = 1024;
/// A sparse level is drawn with surfels if one in so many voxels has at most [`THIN`] within one step, itself included.
const THIN_SHARE: usize = 64;
const THIN: u32 = 3;
/// Twice the number of voxels within one step, itself included, that voxels of a closed surface have on average. Exact
/// voxels of surfaces have 13 to 14, those of thin parts fewer.
const CLOSED_TWICE: i64 = 23;
/// What surfels are widened by, in 64ths, for each half voxel that is lacking, and the most.
const WIDEN: i64 = 10;
const WIDEST: i64 = 26;
/// Weight below which a voxel lacks most neighbours, and takes a window in an open block: less than at a border.
const FEW: u16 = 300;
/// A block is open if one in so many voxels lacks most neighbours and is no speck.
const FEW_SHARE: usize = 8;
/// Weight below which a voxel is a speck: a line of three voxels has 17, an endless one 27.
const SPECK: u16 = 27;
/// A block is open if one in so many voxels is a speck. In others, specks are noise.
const SPECK_SHARE: usize = 4;

/// What holds for a block of voxels of a sparse level.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sparsity {
    /// Whether many voxels lack most neighbours, so that surfaces are known from wider windows only.
    open: bool,
    /// Whether specks are noise.
    noisy: bool,
}

impl Sparsity {
    /// Of a block, from the weight of each voxel.
    pub fn of_block(weights: impl ExactSizeIterator<Item = u16>) -> Self {
        let (all, mut few, mut specks) = (weights.len(), 0, 0);
        for weight in weights {
            few += usize::from((SPECK..FEW).contains(&weight));
            specks += usize::from(weight < SPECK);
        }
        let noisy = SPECK_SHARE * specks < all;
        Sparsity {
            open: FEW_SHARE * few >= all || !noisy,
            noisy,
        }
    }

    /// Whether a voxel of this weight looks for a window.
    pub fn wants_window(self, weight: u16) -> bool {
        self.open && weight < FEW
    }

    /// Whether a voxel of this weight that has no window is noise.
    pub fn is_noise(self, weight: u16) -> bool {
        self.noisy && weight < SPECK
    }
}

/// Whether these voxels of the level of a map are sparse.
///
/// # Panics
/// If `map` has no such voxels.
pub fn is_sparse(map: &SiblingMap, range: Range<usize>) -> bool {
    let all = range.len();
    all >= LEAST && LONE_SHARE * with_few(map, range, 1) >= all
}

/// Whether surfels draw these voxels of the level of a map in place of learned heads, which never saw such
/// neighbourhoods: they are sparse, and more than stray voxels lack neighbours.
///
/// # Panics
/// If `map` has no such voxels.
pub fn is_for_surfels(map: &SiblingMap, range: Range<usize>) -> bool {
    is_sparse(map, range.clone()) && THIN_SHARE * with_few(map, range.clone(), THIN) >= range.len()
}

/// How many of these voxels have so many within one step at most, themselves included.
fn with_few(map: &SiblingMap, range: Range<usize>, most: u32) -> usize {
    let blocks = range.clone().into_par_iter().step_by(BLOCK);
    let counts = blocks.map(|first| {
        let mut masks = [0; BLOCK];
        let masks = &mut masks[..BLOCK.min(range.end - first)];
        map.masks(first, masks);
        masks.iter().filter(|mask| mask.count_ones() <= most).count()
    });
    counts.sum()
}

/// Size of the surfels that close a level which [`is_for_surfels`], in 64ths of the usual radius, for
/// [`HeadMap`](crate::gaussians::HeadMap) to state: from 64 where voxels have the neighbours of a closed surface up to
/// 90 the fewer they have.
pub fn closing_size(map: &SiblingMap) -> u8 {
    let degrees = map.degrees(0..map.len());
    let neighbours: i64 = degrees.iter().map(|&degree| i64::from(degree)).sum();
    let voxels = map.len() as i64;
    let wider = WIDEN * (CLOSED_TWICE * voxels - 2 * neighbours) / voxels.max(1);
    wider.clamp(0, WIDEST) as u8 + 64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Octree, Voxels, morton};

    fn map(depth: u8, cloud: impl Iterator<Item = [u32; 3]>) -> SiblingMap {
        let octree = Octree::new(Voxels::new(depth, cloud.map(morton::encode).collect())).unwrap();
        octree.sibling_map(depth)
    }

    fn plane() -> impl Iterator<Item = [u32; 3]> {
        (0..64 * 64).map(|i| [i % 64, i / 64, 9])
    }

    fn is_sparse_level(map: &SiblingMap) -> bool {
        is_sparse(map, 0..map.len())
    }

    #[test]
    fn full_surfaces_and_wires_are_not_sparse() {
        // Five voxels long, beside the surface.
        let wires = (0..16 * 16 * 5).map(|i| [4 * (i % 16), 4 * (i / 16 % 16), 11 + i / 256]);
        assert!(!is_sparse_level(&map(6, plane())));
        assert!(!is_sparse_level(&map(6, plane().chain(wires))));
    }

    #[test]
    fn one_lone_voxel_in_512_makes_a_level_sparse() {
        let specks = |count: u32| (0..count).map(|i| [3 * i, 40, 50]);
        assert!(!is_sparse_level(&map(6, plane().chain(specks(8)))));
        assert!(is_sparse_level(&map(6, plane().chain(specks(9)))));
    }

    fn is_all_for_surfels(map: &SiblingMap) -> bool {
        is_for_surfels(map, 0..map.len())
    }

    #[test]
    fn learned_heads_draw_surfaces_with_stray_voxels_and_leave_more_of_them_to_surfels() {
        let specks = |count: u32| (0..count).map(|i| [3 * (i % 20), 20 + 3 * (i / 20), 50]);
        assert!(!is_all_for_surfels(&map(6, plane())));
        assert!(!is_all_for_surfels(&map(6, plane().chain(specks(64)))));
        assert!(is_all_for_surfels(&map(6, plane().chain(specks(66)))));
    }

    #[test]
    fn surfels_are_the_wider_the_fewer_neighbours_there_are() {
        // Three layers of voxels: all that a diagonal plane touches.
        let plane = || (0..1u32 << 18).map(|i| [i & 63, i >> 6 & 63, i >> 12]);
        let touched = |[x, y, z]: &[u32; 3]| (95..98).contains(&(x + y + z));
        let hash = |[x, y, z]: &[u32; 3]| u64::from(x + 64 * y + 4096 * z).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 60;
        let part = |of_16: u64| map(6, plane().filter(move |at| touched(at) && hash(at) < of_16));
        let sizes = [16, 10, 6].map(|of_16| closing_size(&part(of_16)));
        assert_eq!(sizes[0], 64);
        assert!((68..88).contains(&sizes[1]) && sizes[2] == 90, "{sizes:?}");
    }

    #[test]
    fn small_levels_are_not_sparse() {
        let lone = |count: u32| (0..count).map(|i| [4 * (i % 16), 4 * (i / 16 % 16), 4 * (i / 256)]);
        assert!(!is_sparse_level(&map(6, lone(1023))));
        assert!(is_sparse_level(&map(6, lone(1024))));
    }

    #[test]
    fn lone_voxels_among_others_are_noise_and_alone_are_not() {
        let block = |weights: &[u16]| Sparsity::of_block(weights.iter().copied());
        assert!(!block(&[1; 1024]).is_noise(1));
        let mixed: Vec<u16> = (0..1000).map(|i| if i % 5 == 0 { 1 } else { 729 }).collect();
        assert!(block(&mixed).is_noise(1) && !block(&mixed).wants_window(1));
        // So it is in a short block.
        assert!(block(&mixed[..10]).is_noise(1));
    }
}
