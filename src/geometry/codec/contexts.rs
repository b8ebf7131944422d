//! Contexts of a child: hashes of the known occupancy around it (`docs/format.md`, clause 4.6).
//!
//! *Cells* are voxels of the children's level. A cell is *occupied* if it is known to be, and *unknown* if its parent
//! is occupied but its own occupancy is not known: the children of a voxel that follows or is in another slice, and own
//! children not yet coded. Else it is empty. The 4³ cells around this voxel's children, of coordinates −1 to 2 where
//! the children have 0 and 1, are numbered `(x + 1) + 4(y + 1) + 16(z + 1)`. Two masks of 64 bits hold the occupied and
//! the unknown cells.
//!
//! For the child in octant `c = x + 2y + 4z`, both masks are shifted right by `x + 4y + 16z`: the 3³ cells around the
//! child then have the bits `i + 4j + 16k`, each 0 to 2, the child itself bit 21. The *near* cells are these without
//! the child, its *face cells* the bits 5, 17, 20, 22, 25, 37.
//!
//! *presence* is a mask of 27 bits of the voxel's occupied neighbours (offset order, bit 13 never set). For the six
//! face neighbours, at the offsets 4, 10, 12, 14, 16, 22, in this order from the lowest bit up:
//! - *faces* has 1 bit: the neighbour is occupied;
//! - *far* has 8 bits: its child in octant `c` is occupied (1) or unknown (2);
//! - *face occupancies*, of the first three alone, has 9 bits: 0 if the neighbour is absent, 1 if its children are
//!   unknown, else 256 plus its occupancy;
//! - *second*, of the last three alone, has 2 bits: 2 if the neighbour is absent, else 1 if the voxel two away in that
//!   direction is occupied, else 0.
//!
//! # Contexts
//! With *node* as in `network` (`1 << c | occupancy of the octants below`), each of five contexts has a hash of 64
//! bits. It starts from the number of the context. A word is added by `h = (h ^ word)·0x9E3779B97F4A7C15`, then `h = h
//! ^ (h >> 32)`.
//!
//! | context | words |
//! |---|---|
//! | 1 | occupied face cells + (c << 48) + (faces << 51); unknown face cells |
//! | 2 | occupied near cells; unknown near cells |
//! | 3 | the hash of context 2; far |
//! | 4 | node + (face occupancies << 8) |
//! | 5 | node + (presence << 8) + (second << 35) |

use super::neighbourhood::{LATER_FACES, Neighbourhood};
use b2p_kernels::mixing::CONTEXTS;

/// Offsets of the face neighbours that can precede in Morton order, as indices into a 3³ row.
const EARLIER_FACES: [usize; 3] = [4, 10, 12];

/// Near cells, in the shifted masks.
const NEAR: u64 = {
    let (mut mask, mut at) = (0, 0);
    while at < 27 {
        if at != 13 {
            mask |= 1 << cell_of(at);
        }
        at += 1;
    }
    mask
};
/// Face cells, in the shifted masks.
const FACES: u64 = 1 << 5 | 1 << 17 | 1 << 20 | 1 << 22 | 1 << 25 | 1 << 37;
/// Cells of this voxel's own children, in the masks before the shift.
const OWN: u64 = 0b0110_0110 << 20 | 0b0110_0110 << 36;

/// Index among 4³ cells of the cell with the index `at` among 3³.
const fn cell_of(at: usize) -> usize {
    at % 3 + 4 * (at / 3 % 3) + 16 * (at / 9)
}

/// Cells of a neighbour's children, by its offset, by half of its occupancy (low or high four octants), and by these
/// four bits.
pub(super) static CELLS: [[[u64; 16]; 2]; 27] = {
    let mut cells = [[[0; 16]; 2]; 27];
    let mut k = 0;
    while k < 27 {
        let mut octant = 0;
        while octant < 8 {
            // Coordinates of the child, plus 1: −1 to 4, of which 0 to 3 are near.
            let x = 2 * (k % 3) + (octant & 1);
            let y = 2 * (k / 3 % 3) + (octant >> 1 & 1);
            let z = 2 * (k / 9) + (octant >> 2);
            let near = 0 < x && x < 5 && 0 < y && y < 5 && 0 < z && z < 5;
            let mut half = 0;
            while near && half < 16 {
                if half >> (octant & 3) & 1 == 1 {
                    cells[k][octant >> 2][half] |= 1 << (x - 1 + 4 * (y - 1) + 16 * (z - 1));
                }
                half += 1;
            }
            octant += 1;
        }
        k += 1;
    }
    cells
};

/// What present known contexts one voxel.
#[derive(Debug, Clone, Copy)]
pub(super) struct Contexts {
    occupied: u64,
    unknown: u64,
    presence: u64,
    faces_present: u64,
    second: u64,
    face_occupancies: u64,
    /// Occupancies of the face neighbours, one byte each; 0 unless known.
    known_faces: u64,
    /// For each face neighbour one byte: 2 if it is occupied but its children are unknown.
    unknown_faces: u64,
    /// Occupancies of the neighbours with known children, by offset.
    masks: [u8; 27],
}

impl Contexts {
    /// The state before any neighbour is added.
    #[inline(always)]
    pub fn new() -> Self {
        Contexts {
            occupied: 0,
            unknown: OWN,
            presence: 0,
            faces_present: 0,
            second: 0,
            face_occupancies: 0,
            known_faces: 0,
            unknown_faces: 0,
            masks: [0; 27],
        }
    }

    /// Adds the neighbour at offset `k`, whose children are unknown.
    #[inline(always)]
    pub fn add_presence(&mut self, k: usize) {
        self.unknown |= CELLS[k][0][15] | CELLS[k][1][15];
    }

    /// Adds the neighbour at offset `k`, of occupancy `mask`.
    #[inline(always)]
    pub fn add_children(&mut self, k: usize, mask: u8) {
        self.masks[k] = mask;
        let (low, high) = (usize::from(mask & 15), usize::from(mask >> 4));
        self.occupied |= CELLS[k][0][low] | CELLS[k][1][high];
    }

    /// Sets what depends on the face neighbours, after all neighbours have been added.
    #[inline(always)]
    pub fn set_faces(&mut self, neighbours: Neighbourhood) {
        let Neighbourhood { there, known, second } = neighbours;
        let bit = |mask: u32, k: usize| u64::from(mask >> k & 1);
        self.presence = there.into();
        self.second = second.into();
        for (i, k) in EARLIER_FACES.into_iter().enumerate() {
            let (present, mask) = (bit(there, k), u64::from(self.masks[k]));
            let known = bit(known, k);
            self.known_faces |= mask << (8 * i);
            self.unknown_faces |= (present & !known) << (8 * i + 1);
            self.face_occupancies |= (known << 8 | mask | present & !known) << (9 * i);
            self.faces_present |= present << i;
        }
        for (i, k) in (3..).zip(LATER_FACES) {
            let present = bit(there, k);
            self.unknown_faces |= present << (8 * i + 1);
            self.faces_present |= present << i;
        }
    }

    /// Hashes of the five contexts of the child in `octant`. `node` is `1 << octant | occupancy of the octants below`.
    #[inline(always)]
    pub fn hashes(&self, octant: usize, node: usize) -> [u64; CONTEXTS] {
        let shift = (octant & 1) + 4 * (octant >> 1 & 1) + 16 * (octant >> 2);
        let (occupied, unknown) = (self.occupied >> shift, self.unknown >> shift);
        let far = self.known_faces >> octant & 0x0101_0101_0101 | self.unknown_faces;
        let node = node as u64;
        let near = hash(hash(2, occupied & NEAR), unknown & NEAR);
        let faces = occupied & FACES | (octant as u64) << 48 | self.faces_present << 51;
        [
            hash(hash(1, faces), unknown & FACES),
            near,
            hash(hash(3, near), far),
            hash(4, node | self.face_occupancies << 8),
            hash(5, node | self.presence << 8 | self.second << 35),
        ]
    }

    /// Sets whether the child in `octant` is occupied.
    #[inline(always)]
    pub fn set_child(&mut self, octant: usize, there: bool) {
        let cell = 21 + (octant & 1) + 4 * (octant >> 1 & 1) + 16 * (octant >> 2);
        self.unknown &= !(1 << cell);
        self.occupied |= u64::from(there) << cell;
    }

    /// Corrects the child in `octant`, which was set wrongly.
    #[inline(always)]
    pub fn flip_child(&mut self, octant: usize) {
        let cell = 21 + (octant & 1) + 4 * (octant >> 1 & 1) + 16 * (octant >> 2);
        self.occupied ^= 1 << cell;
    }
}

/// Adds a word to a hash.
#[inline(always)]
fn hash(h: u64, word: u64) -> u64 {
    let h = (h ^ word).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    h ^ h >> 32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Octree, Voxels, morton, ones};
    use proptest::prelude::*;
    use std::ops::Range;

    /// State of a cell: 0 empty, 1 occupied, 2 unknown. `at` is its position, in voxels of the children's level, from
    /// the child in octant 0 of the voxel `here`, of whose children those below `octant` are known.
    fn state(octree: &Octree, slice: &Range<usize>, here: usize, octant: usize, at: [i64; 3]) -> u64 {
        let level = octree.depth() - 1;
        let own = octree.level(level).coordinate(here).map(i64::from);
        let side = 1i64 << level;
        let parent: [i64; 3] = std::array::from_fn(|k| own[k] + at[k].div_euclid(2));
        let child = (0..3).fold(0, |o, k| o | (at[k].rem_euclid(2) as usize) << k);
        if parent.iter().any(|x| !(0..side).contains(x)) {
            return 0;
        }
        let key = morton::encode(parent.map(|x| x as u32));
        let Ok(index) = octree.level(level).keys().binary_search(&key) else {
            return 0;
        };
        let known = if index == here {
            child < octant
        } else {
            slice.start <= index && index < here
        };
        match known {
            true => u64::from(octree.occupancy(level)[index] >> child & 1),
            false => 2,
        }
    }

    /// The hashes of the contexts from their definition, cell by cell.
    fn by_definition(octree: &Octree, slice: &Range<usize>, here: usize, octant: usize) -> [u64; CONTEXTS] {
        let child = [octant & 1, octant >> 1 & 1, octant >> 2].map(|x| x as i64);
        let cell = |d: [i64; 3]| state(octree, slice, here, octant, [0, 1, 2].map(|k| child[k] + d[k]));
        let (mut near, mut faces) = ([0u64; 2], [0u64; 2]);
        for at in 0..27i64 {
            let d = [at % 3 - 1, at / 3 % 3 - 1, at / 9 - 1];
            let distance: i64 = d.iter().map(|x| x.abs()).sum();
            let bit = d[0] + 1 + 4 * (d[1] + 1) + 16 * (d[2] + 1);
            for (which, of) in [1, 2].into_iter().enumerate() {
                let present = u64::from(distance > 0 && cell(d) == of) << bit;
                near[which] |= present;
                faces[which] |= if distance == 1 { present } else { 0 };
            }
        }
        let level = octree.depth() - 1;
        let (voxels, masks) = (octree.level(level), octree.occupancy(level));
        let place = |d: [i64; 3]| {
            let at: [i64; 3] = std::array::from_fn(|k| i64::from(voxels.coordinate(here)[k]) + d[k]);
            let inside = at.iter().all(|x| (0..1i64 << level).contains(x));
            let key = morton::encode(at.map(|x| if inside { x as u32 } else { 0 }));
            voxels.keys().binary_search(&key).ok().filter(|_| inside)
        };
        let sides = [[0, 0, -1], [0, -1, 0], [-1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]];
        let (mut faces_present, mut far, mut face_occupancies, mut second, mut presence) = (0, 0, 0, 0, 0);
        for (i, d) in sides.into_iter().enumerate() {
            far |= cell(d.map(|x| 2 * x)) << (8 * i);
            faces_present |= u64::from(place(d).is_some()) << i;
            if i < 3 {
                face_occupancies |= place(d).map_or(0, |n| match slice.contains(&n) && n < here {
                    true => 256 + u64::from(masks[n]),
                    false => 1,
                }) << (9 * i);
            } else {
                let more = u64::from(place(d.map(|x| 2 * x)).is_some());
                second |= if place(d).is_some() { more } else { 2 } << (2 * (i - 3));
            }
        }
        for k in (0..27i64).filter(|&k| k != 13) {
            let d = [k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1];
            presence |= u64::from(place(d).is_some()) << k;
        }
        let node = 1u64 << octant | u64::from(masks[here]) & ((1 << octant) - 1);
        let words = |number: u64, words: &[u64]| {
            words.iter().fold(number, |h, word| {
                let h = (h ^ word).wrapping_mul(0x9E37_79B9_7F4A_7C15);
                h ^ (h >> 32)
            })
        };
        let two = words(2, &near);
        [
            words(
                1,
                &[faces[0] + ((octant as u64) << 48) + (faces_present << 51), faces[1]],
            ),
            two,
            words(3, &[two, far]),
            words(4, &[node + (face_occupancies << 8)]),
            words(5, &[node + (presence << 8) + (second << 35)]),
        ]
    }

    proptest! {
        #[test]
        fn hashes_match_their_definition(keys in prop::collection::vec(0u64..1 << 12, 1..700), slice in 1usize..200) {
            let octree = Octree::new(Voxels::new(4, keys)).unwrap();
            let (map, masks) = (octree.kernel_map(3), octree.occupancy(3));
            for here in 0..masks.len() {
                let first = here / slice * slice;
                let slice = first..masks.len().min(first + slice);
                let neighbours = Neighbourhood::of_all(&map, &slice)[here - first];
                let mut contexts = Contexts::new();
                ones(neighbours.there & !neighbours.known).for_each(|k| contexts.add_presence(k));
                for k in ones(neighbours.known) {
                    contexts.add_children(k, masks[map.row(here)[k] as usize]);
                }
                contexts.set_faces(neighbours);
                for octant in 0..8 {
                    let node = 1 << octant | usize::from(masks[here]) & ((1 << octant) - 1);
                    let want = by_definition(&octree, &slice, here, octant);
                    prop_assert_eq!(contexts.hashes(octant, node), want);
                    contexts.set_child(octant, masks[here] >> octant & 1 == 1);
                }
            }
        }
    }
}
