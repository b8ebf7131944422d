//! Voxels of a level in bricks of 4³, found by position.

use crate::geometry::{Voxels, morton};

/// Bits of all cells whose x, and y, is below n.
const X_BELOW: [u64; 5] = [
    0,
    0x1111_1111_1111_1111,
    0x3333_3333_3333_3333,
    0x7777_7777_7777_7777,
    u64::MAX,
];
const Y_BELOW: [u64; 5] = [
    0,
    0x000f_000f_000f_000f,
    0x00ff_00ff_00ff_00ff,
    0x0fff_0fff_0fff_0fff,
    u64::MAX,
];

/// Of each Morton key in a brick the cell, `x + 4y + 16z`, and the other way round.
const CELLS: [u8; 64] = {
    let mut cells = [0; 64];
    let mut key = 0;
    while key < 64 {
        let (x, y, z) = (
            key & 1 | key >> 2 & 2,
            key >> 1 & 1 | key >> 3 & 2,
            key >> 2 & 1 | key >> 4 & 2,
        );
        cells[key] = (x + 4 * y + 16 * z) as u8;
        key += 1;
    }
    cells
};
const KEYS: [u8; 64] = {
    let mut keys = [0; 64];
    let mut key = 0;
    while key < 64 {
        keys[CELLS[key] as usize] = key as u8;
        key += 1;
    }
    keys
};

/// By axis, bits of all Morton keys in a brick whose coordinate is below n.
const BELOW: [[u64; 5]; 3] = {
    let mut below = [[0; 5]; 3];
    let mut key = 0;
    while key < 64 {
        let mut axis = 0;
        while axis < 3 {
            let mut n = (CELLS[key] >> (2 * axis) & 3) as usize + 1;
            while n < 5 {
                below[axis][n] |= 1 << key;
                n += 1;
            }
            axis += 1;
        }
        key += 1;
    }
    below
};

/// A brick: its place, its voxels as a mask by Morton key, as a mask by `x + 4y + 16z`, and the number of its first
/// voxel.
#[derive(Debug, Clone, Copy)]
struct Brick {
    /// Of 21 bits each, x lowest: made faster than a Morton key.
    place: u64,
    mask: u64,
    cells: u64,
    first: u32,
}

/// The voxels of a level by position.
#[derive(Debug, Clone)]
pub struct Bricks {
    bricks: Vec<Brick>,
    /// Open addressing: a brick's number and 1, or 0. A power of two, at least twice as many as bricks.
    table: Vec<u32>,
    /// Bricks along an axis.
    side: i32,
}

impl Bricks {
    pub fn new(voxels: &Voxels) -> Self {
        let mut bricks: Vec<Brick> = Vec::new();
        let mut last = None;
        for (i, key) in voxels.keys().iter().enumerate() {
            if last != Some(key >> 6) {
                last = Some(key >> 6);
                bricks.push(Brick {
                    place: packed(morton::decode(key >> 6)),
                    mask: 0,
                    cells: 0,
                    first: i as u32,
                });
            }
            if let Some(brick) = bricks.last_mut() {
                brick.mask |= 1 << (key & 63);
                brick.cells |= 1 << CELLS[(key & 63) as usize];
            }
        }
        let mut table = vec![0; (2 * bricks.len()).next_power_of_two().max(2)];
        for (i, brick) in bricks.iter().enumerate() {
            let mut at = slot(brick.place, table.len());
            while table[at] != 0 {
                at = (at + 1) & (table.len() - 1);
            }
            table[at] = i as u32 + 1;
        }
        Bricks {
            bricks,
            table,
            side: 1 << voxels.depth().saturating_sub(2),
        }
    }

    /// Bytes of memory per voxel at most: a brick for each.
    pub const fn bytes_per_voxel() -> usize {
        size_of::<Brick>() + 4 * size_of::<u32>()
    }

    /// Each brick in turn: its place among bricks, its voxels as a mask by Morton key, and the number of its first voxel.
    pub fn each(&self) -> impl Iterator<Item = ([u32; 3], u64, usize)> {
        let each = |brick: &Brick| {
            let place = [0, 21, 42].map(|bit| (brick.place >> bit) as u32 & 0x1f_ffff);
            (place, brick.mask, brick.first as usize)
        };
        self.bricks.iter().map(each)
    }

    /// Keys of the bricks without their `down` lowest bits, each once.
    pub fn nodes(&self, down: u32) -> Vec<u64> {
        let key = |brick: &Brick| morton::encode([0, 21, 42].map(|bit| (brick.place >> bit) as u32 & 0x1f_ffff));
        let mut keys: Vec<u64> = self.bricks.iter().map(|brick| key(brick) >> down).collect();
        keys.dedup();
        keys
    }

    /// The brick at this place among bricks.
    #[inline]
    fn brick(&self, at: [i32; 3]) -> Option<&Brick> {
        if at.iter().any(|x| !(0..self.side).contains(x)) {
            return None;
        }
        let place = packed(at.map(|x| x as u32));
        let mut slot = slot(place, self.table.len());
        loop {
            let brick = self.bricks.get((self.table[slot] as usize).checked_sub(1)?)?;
            if brick.place == place {
                return Some(brick);
            }
            slot = (slot + 1) & (self.table.len() - 1);
        }
    }

    /// The number of the voxel at this place, if there is one.
    #[inline]
    pub fn index(&self, at: [i32; 3]) -> Option<usize> {
        self.brick(at.map(|x| x >> 2))?.index(at)
    }

    /// The 4³ cells from this place on, as a mask by `x + 4y + 16z`.
    pub fn window(&self, at: [i32; 3]) -> u64 {
        self.near().window(at)
    }

    /// For queries of which each is near the one before.
    pub fn near(&self) -> Near<'_> {
        Near {
            bricks: self,
            base: [NOWHERE; 3],
            known: 0,
            found: [None; 27],
        }
    }

    /// Calls `each` with the place and number of all voxels in a box of `side`³ cells from the place `first` on.
    pub fn in_box(&self, first: [i32; 3], side: i32, mut each: impl FnMut([i32; 3], usize)) {
        let low = first.map(|x| (x >> 2).max(0));
        let high = first.map(|x| ((x + side - 1) >> 2).min(self.side - 1));
        // Of the brick with this number along an axis, the keys that are in the box.
        let inside = |axis: usize, brick: i32| {
            let below = |end: i32| BELOW[axis][(end - 4 * brick).clamp(0, 4) as usize];
            below(first[axis] + side) & !below(first[axis])
        };
        for z in low[2]..=high[2] {
            for y in low[1]..=high[1] {
                let row = inside(2, z) & inside(1, y);
                for x in low[0]..=high[0] {
                    let Some(brick) = self.brick([x, y, z]) else {
                        continue;
                    };
                    let mut keys = brick.mask & row & inside(0, x);
                    while keys != 0 {
                        let key = keys.trailing_zeros() as usize & 63;
                        let cell = i32::from(CELLS[key]);
                        let here = [4 * x + (cell & 3), 4 * y + (cell >> 2 & 3), 4 * z + (cell >> 4)];
                        each(here, brick.number(key));
                        keys &= keys - 1;
                    }
                }
            }
        }
    }
}

impl Brick {
    /// The number of the voxel at this place, which is in the brick, if there is one.
    #[inline]
    fn index(&self, at: [i32; 3]) -> Option<usize> {
        let [x, y, z] = at.map(|x| (x & 3) as usize);
        let cell = x + 4 * y + 16 * z;
        if self.cells >> cell & 1 == 0 {
            return None;
        }
        Some(self.number(KEYS[cell].into()))
    }

    /// The number of the voxel with this key in the brick.
    #[inline]
    fn number(&self, key: usize) -> usize {
        let before = self.mask & ((1 << key) - 1);
        self.first as usize + before.count_ones() as usize
    }
}

/// The 3³ bricks from a place on. They are kept from one query to the next.
#[derive(Debug, Clone)]
pub struct Near<'a> {
    bricks: &'a Bricks,
    /// The place of the first brick among pairs of bricks.
    base: [i32; 3],
    /// A bit for each brick that has been looked up.
    known: u32,
    found: [Option<&'a Brick>; 27],
}

/// Far from all voxels.
const NOWHERE: i32 = i32::MIN / 4;

impl<'a> Near<'a> {
    /// Goes to the bricks around this place.
    #[inline]
    pub fn go(&mut self, at: [i32; 3]) {
        let base = at.map(|x| x >> 3);
        if base != self.base {
            (self.base, self.known) = (base, 0);
        }
    }

    /// The brick this many steps from the first one, 0 to 2 along each axis.
    #[inline]
    fn brick(&mut self, step: [i32; 3]) -> Option<&'a Brick> {
        let slot = ((step[0] + 3 * step[1] + 9 * step[2]) as usize).min(26);
        if self.known >> slot & 1 == 0 {
            self.known |= 1 << slot;
            self.found[slot] = self
                .bricks
                .brick([0, 1, 2].map(|axis| 2 * self.base[axis] + step[axis]));
        }
        self.found[slot]
    }

    /// The number of the voxel at this place, if there is one.
    #[inline]
    pub fn index(&mut self, at: [i32; 3]) -> Option<usize> {
        let steps = |base: [i32; 3]| [0, 1, 2].map(|axis| (at[axis] >> 2).wrapping_sub(2 * base[axis]));
        let mut step = steps(self.base);
        if step.iter().any(|x| !(0..3).contains(x)) {
            self.go(at);
            step = steps(self.base);
        }
        self.brick(step)?.index(at)
    }

    /// The 4³ cells from this place on, as a mask by `x + 4y + 16z`.
    #[inline]
    pub fn window(&mut self, at: [i32; 3]) -> u64 {
        self.go(at);
        let first = at.map(|x| x >> 2 & 1);
        let [ox, oy, oz] = at.map(|x| (x & 3) as usize);
        let mut window = 0;
        for i in 0..8 {
            let [dx, dy, dz] = [i & 1, i >> 1 & 1, i >> 2];
            if (dx == 1 && ox == 0) || (dy == 1 && oy == 0) || (dz == 1 && oz == 0) {
                continue;
            }
            let Some(brick) = self.brick([first[0] + dx, first[1] + dy, first[2] + dz]) else {
                continue;
            };
            let cells = brick.cells;
            let cells = match dx {
                0 => (cells & !X_BELOW[ox]) >> ox,
                _ => (cells & X_BELOW[ox]) << (4 - ox),
            };
            let cells = match dy {
                0 => (cells & !Y_BELOW[oy]) >> (4 * oy),
                _ => (cells & Y_BELOW[oy]) << (4 * (4 - oy)),
            };
            window |= match dz {
                0 => cells >> (16 * oz),
                _ => cells << (16 * (4 - oz)),
            };
        }
        window
    }
}

/// A place among bricks, as a number.
#[inline]
fn packed([x, y, z]: [u32; 3]) -> u64 {
    u64::from(x) | u64::from(y) << 21 | u64::from(z) << 42
}

/// Where a place is looked for first in a table of this size.
#[inline]
fn slot(place: u64, size: usize) -> usize {
    (place.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 32) as usize & (size - 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn windows_and_indices_are_those_of_a_search(
            depth in 0u8..6,
            keys in prop::collection::vec(0u64..1 << 15, 1..400),
            at in prop::array::uniform3(-40i32..40),
        ) {
            let keys = keys.into_iter().map(|key| key & ((1 << (3 * depth)) - 1)).collect();
            let voxels = Voxels::new(depth, keys);
            let bricks = Bricks::new(&voxels);
            let find = |at: [i32; 3]| {
                let inside = at.iter().all(|x| (0..1 << depth).contains(x));
                let key = morton::encode(at.map(|x| if inside { x as u32 } else { 0 }));
                voxels.keys().binary_search(&key).ok().filter(|_| inside)
            };
            let (mut window, mut near) = (0u64, bricks.near());
            for cell in 0..64i32 {
                let here = [at[0] + cell % 4, at[1] + cell / 4 % 4, at[2] + cell / 16];
                prop_assert_eq!(bricks.index(here), find(here));
                prop_assert_eq!(near.index(here), find(here));
                window |= u64::from(find(here).is_some()) << cell;
            }
            prop_assert_eq!(bricks.window(at), window);
            prop_assert_eq!(near.window(at), window);
        }

        #[test]
        fn all_voxels_of_a_box_are_found(
            keys in prop::collection::vec(0u64..1 << 12, 1..400),
            first in prop::array::uniform3(-9i32..20),
            side in 1i32..12,
        ) {
            let voxels = Voxels::new(4, keys);
            let mut found = Vec::new();
            Bricks::new(&voxels).in_box(first, side, |at, index| found.push((index, at)));
            found.sort_unstable();
            let all = voxels.keys().iter().map(|key| morton::decode(*key).map(|x| x as i32)).enumerate();
            let inside = all.filter(|(_, at)| (0..3).all(|axis| (first[axis]..first[axis] + side).contains(&at[axis])));
            prop_assert_eq!(found, inside.collect::<Vec<_>>());
        }
    }
}
