//! Which neighbours the voxels of a slice have, and which of them will have told their children by then: found for all of a slice ahead, for
//! coding waits for every bit, and this does not.

use crate::geometry::KernelMap;
use std::ops::Range;

/// The offsets one voxel on along an axis, by their places in a 3³ row.
pub(super) const AFTER: [usize; 3] = [14, 16, 22];

/// The offsets at which a neighbour can come earlier in Morton order: those with a negative component.
pub(super) const MAY_BE_EARLIER: u32 = {
    let (mut mask, mut k) = (0, 0);
    while k < 27 {
        if k % 3 == 0 || k / 3 % 3 == 0 || k < 9 {
            mask |= 1 << k;
        }
        k += 1;
    }
    mask
};

/// What is known of the neighbours of one voxel, a bit for each offset (3³ order; bit 13, the voxel itself, is never set).
#[derive(Debug, Clone, Copy)]
pub(super) struct Neighbourhood {
    /// Which are occupied.
    pub there: u32,
    /// Which come earlier in the slice, so that their children are known.
    pub earlier: u32,
    /// For each direction of [`AFTER`] 2 bits: 2 if no neighbour is there, else 1 if the next in that direction is occupied.
    pub beyond: u8,
}

impl Neighbourhood {
    /// Those of the voxels `slice`, whose 3³ kernel map is `map`.
    #[inline(always)]
    pub fn of_all(map: &KernelMap, slice: &Range<usize>) -> Vec<Self> {
        let mut all = Vec::with_capacity(slice.len());
        for here in slice.clone() {
            all.push(Neighbourhood::at(map, slice, here));
        }
        for (i, here) in slice.clone().enumerate() {
            let row = map.row(here);
            for (direction, k) in AFTER.into_iter().enumerate() {
                let beyond = match row[k] {
                    KernelMap::ABSENT => 2,
                    side => {
                        let side = side as usize;
                        let there = match all.get(side.wrapping_sub(slice.start)) {
                            Some(side) => side.there,
                            None => occupied(map.row(side)),
                        };
                        (there >> k & 1) as u8
                    }
                };
                all[i].beyond |= beyond << (2 * direction);
            }
        }
        all
    }

    /// That of the voxel `here`, but for what is beyond.
    #[inline(always)]
    pub fn at(map: &KernelMap, slice: &Range<usize>, here: usize) -> Self {
        let row = map.row(here);
        let (first, before) = (slice.start as u32, (here - slice.start) as u32);
        let mut earlier = 0;
        for (k, &index) in row.iter().enumerate() {
            earlier |= u32::from(index.wrapping_sub(first) < before) << k;
        }
        Neighbourhood {
            there: occupied(row) & !(1 << KernelMap::CENTRE),
            earlier: earlier & MAY_BE_EARLIER,
            beyond: 0,
        }
    }
}

/// Which of a voxel's neighbours are occupied, itself among them.
#[inline(always)]
fn occupied(row: &[u32]) -> u32 {
    let there = |(k, &index)| u32::from(index != KernelMap::ABSENT) << k;
    row.iter().enumerate().map(there).sum()
}
