//! Neighbours of the parents of a slice, and which of them have known children (`docs/format.md`, clause 4.3). They are
//! found for the whole slice in advance: unlike coding, this does not wait for decoded bits.

use crate::geometry::KernelMap;
use std::ops::Range;

/// Offsets of the face neighbours at x + 1, y + 1 and z + 1, as indices into a 3³ row.
pub(super) const LATER_FACES: [usize; 3] = [14, 16, 22];

/// Offsets at which a neighbour can precede in Morton order, as a mask: those with a negative component.
pub(super) const BEFORE_OFFSETS: u32 = {
    let (mut mask, mut k) = (0, 0);
    while k < 27 {
        if k % 3 == 0 || k / 3 % 3 == 0 || k < 9 {
            mask |= 1 << k;
        }
        k += 1;
    }
    mask
};

/// Neighbours of one voxel, as masks of one bit per offset (3³ order; bit 13, the voxel itself, is never set).
#[derive(Debug, Clone, Copy)]
pub(super) struct Neighbourhood {
    /// Occupied neighbours.
    pub there: u32,
    /// Occupied neighbours that precede the voxel in the slice, so that their children are known.
    pub known: u32,
    /// For each direction of [`LATER_FACES`] two bits: 2 if the neighbour is absent, else 1 if the voxel two away is
    /// occupied, else 0.
    pub second: u8,
}

impl Neighbourhood {
    /// Neighbourhoods of the voxels `slice`. `map` is their level's 3³ kernel map.
    #[inline(always)]
    pub fn of_all(map: &KernelMap, slice: &Range<usize>) -> Vec<Self> {
        let mut all = Vec::with_capacity(slice.len());
        for voxel in slice.clone() {
            all.push(Neighbourhood::at(map, slice, voxel));
        }
        for (i, voxel) in slice.clone().enumerate() {
            let row = map.row(voxel);
            for (direction, k) in LATER_FACES.into_iter().enumerate() {
                let second = match row[k] {
                    KernelMap::ABSENT => 2,
                    neighbour => {
                        let neighbour = neighbour as usize;
                        let there = match all.get(neighbour.wrapping_sub(slice.start)) {
                            Some(neighbour) => neighbour.there,
                            None => occupied(map.row(neighbour)),
                        };
                        (there >> k & 1) as u8
                    }
                };
                all[i].second |= second << (2 * direction);
            }
        }
        all
    }

    /// Neighbourhood of the voxel `voxel`, without `second`.
    #[inline(always)]
    pub fn at(map: &KernelMap, slice: &Range<usize>, voxel: usize) -> Self {
        let row = map.row(voxel);
        let (first, before) = (slice.start as u32, (voxel - slice.start) as u32);
        let mut known = 0;
        for (k, &index) in row.iter().enumerate() {
            known |= u32::from(index.wrapping_sub(first) < before) << k;
        }
        Neighbourhood {
            there: occupied(row) & !(1 << KernelMap::CENTRE),
            known: known & BEFORE_OFFSETS,
            second: 0,
        }
    }
}

/// Mask of the occupied voxels of a 3³ row, the voxel itself included.
#[inline(always)]
fn occupied(row: &[u32]) -> u32 {
    let there = |(k, &index)| u32::from(index != KernelMap::ABSENT) << k;
    row.iter().enumerate().map(there).sum()
}
