//! Which neighbourhoods lack voxels: measured block by block, from occupancy alone.
//!
//! The measure is the weight of a voxel's walks (`moments.rs`): a plane has 729 at least, half of one 351 at its border,
//! and a lone voxel 1. Dense clouds have blocks of which a fifteenth of the voxels has few; captures at their finest
//! level have a seventh to a half.

use b2p_kernels::zeros;
use rayon::prelude::*;

use super::BLOCK;
use super::moments::ROUNDS;
use crate::geometry::KernelMap;

/// Weight below which a voxel lacks neighbours.
const FEW: u16 = 512;
/// Weight below which a voxel lacks most neighbours, and takes a window in an open block: less than at a border.
const SPARSE: u16 = 300;
/// Weight below which a voxel is a speck: a line of three voxels has 17, an endless one 27.
const SPECK: u16 = 27;
/// A block is thin, or open, if one in so many voxels lacks neighbours, or most of them, and is no speck.
const FEW_SHARE: usize = 8;
/// A block is thin and open if one in so many voxels is a speck. In others, specks are noise.
const SPECK_SHARE: usize = 4;

/// What holds for a block of voxels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sparsity {
    /// Whether many voxels lack most neighbours, so that surfaces are known from wider windows only.
    open: bool,
    /// Whether many voxels lack neighbours.
    thin: bool,
    /// Whether specks are noise.
    noisy: bool,
}

impl Sparsity {
    /// Of a block, from the weight of each voxel.
    pub fn of_block(weights: impl ExactSizeIterator<Item = u16>) -> Self {
        let (all, mut few, mut sparse, mut specks) = (weights.len(), 0, 0, 0);
        for weight in weights {
            few += usize::from((SPECK..FEW).contains(&weight));
            sparse += usize::from((SPECK..SPARSE).contains(&weight));
            specks += usize::from(weight < SPECK);
        }
        let noisy = SPECK_SHARE * specks < all;
        Sparsity {
            open: FEW_SHARE * sparse >= all || !noisy,
            thin: FEW_SHARE * few >= all || !noisy,
            noisy,
        }
    }

    /// Whether a voxel of this weight looks for a window.
    pub fn wants_window(self, weight: u16) -> bool {
        self.open && weight < SPARSE
    }

    /// Whether a voxel of this weight that has no window is noise.
    pub fn is_noise(self, weight: u16) -> bool {
        self.noisy && weight < SPECK
    }
}

/// For every voxel of a level whether surfels draw it in place of learned heads, which never saw such neighbourhoods;
/// `None` if none.
///
/// # Panics
/// If `map` is not a 3³ map.
pub fn sparse_voxels(map: &KernelMap) -> Option<Vec<bool>> {
    let weights = weights(map);
    let mut sparse = vec![false; weights.len()];
    let blocks = sparse.par_chunks_mut(BLOCK).zip(weights.par_chunks(BLOCK));
    let any = blocks.map(|(sparse, weights)| {
        let block = Sparsity::of_block(weights.iter().copied());
        let each = sparse.iter_mut().zip(weights);
        each.for_each(|(sparse, &weight)| *sparse = block.thin || block.is_noise(weight));
        sparse.contains(&true)
    });
    let any = any.reduce(|| false, |a, b| a | b);
    any.then_some(sparse)
}

/// Number of walks from every voxel: the first of its moments after all steps.
fn weights(map: &KernelMap) -> Vec<u16> {
    assert_eq!(map.volume(), 27, "walks need a 3³ map");
    let mut from = vec![1u16; map.len()];
    let mut to: Vec<u16> = zeros(map.len());
    for _ in 0..ROUNDS {
        let blocks = to.par_chunks_mut(BLOCK).zip(map.rows().par_chunks(27 * BLOCK));
        blocks.for_each(|(to, rows)| {
            for (to, row) in to.iter_mut().zip(rows.chunks_exact(27)) {
                *to = row.iter().filter_map(|&at| from.get(at as usize)).sum();
            }
        });
        std::mem::swap(&mut from, &mut to);
    }
    from
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Octree, Voxels, morton};

    fn map(depth: u8, cloud: impl Iterator<Item = [u32; 3]>) -> KernelMap {
        let octree = Octree::new(Voxels::new(depth, cloud.map(morton::encode).collect())).unwrap();
        (0..depth).fold(octree.kernel_map(0), |map, level| octree.child_map(level, &map))
    }

    fn plane() -> impl Iterator<Item = [u32; 3]> {
        (0..64 * 64).map(|i| [i % 64, i / 64, 9])
    }

    #[test]
    fn full_surfaces_are_not_sparse() {
        assert_eq!(sparse_voxels(&map(6, plane())), None);
    }

    #[test]
    fn lone_voxels_beside_a_surface_are_noise() {
        let specks = (0..20).map(|i| [3 * i, 40, 50]);
        let sparse = sparse_voxels(&map(6, plane().chain(specks))).unwrap();
        assert_eq!(sparse.iter().filter(|&&on| on).count(), 20);
    }

    #[test]
    fn clouds_of_lone_voxels_are_sparse_and_not_noise() {
        let lone = (0..4096).map(|i| [4 * (i % 16), 4 * (i / 16 % 16), 4 * (i / 256)]);
        assert_eq!(sparse_voxels(&map(6, lone)), Some(vec![true; 4096]));
        assert!(!Sparsity::of_block([1; 1024].into_iter()).is_noise(1));
    }
}
