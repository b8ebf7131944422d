//! Voxels of a level in bricks of 4³ and tiles of 2³ bricks, found by position.

mod near;
mod windows;

use crate::geometry::{Voxels, morton, ones};
pub use near::Near;
pub use windows::Windows;

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

/// A brick: its voxels as a mask by Morton key, as a mask by `x + 4y + 16z`, and the number of its first voxel.
#[derive(Debug, Clone, Copy)]
struct Brick {
    mask: u64,
    cells: u64,
    first: u32,
}

/// 2³ bricks: their place among such, the number of the first that has voxels, and a bit for each of these, by octant.
#[derive(Debug, Clone, Copy)]
struct Tile {
    /// Of 21 bits each, x lowest: made faster than a Morton key.
    place: u64,
    first: u32,
    there: u8,
}

/// The voxels of a level by position.
#[derive(Debug, Clone)]
pub struct Bricks {
    /// In the order of keys, as tiles are.
    bricks: Vec<Brick>,
    tiles: Vec<Tile>,
    /// Open addressing: a tile's number and 1, or 0. A power of two, at least twice as many as tiles.
    table: Vec<u32>,
    /// Tiles along an axis.
    side: i32,
}

impl Bricks {
    pub fn new(voxels: &Voxels) -> Self {
        let bricks = voxels.keys().chunk_by(|a, b| a >> 6 == b >> 6);
        let mask = |keys: &[u64]| keys.iter().fold(0, |mask, key| mask | 1 << (key & 63));
        Self::of_masks(voxels.depth(), bricks.map(|keys| (keys[0] >> 6, mask(keys))))
    }

    /// Of bricks in the order of keys: the key of each, and its voxels as a mask by Morton key.
    pub fn of_masks(depth: u8, masks: impl Iterator<Item = (u64, u64)>) -> Self {
        let (mut bricks, mut tiles) = (Vec::new(), Vec::<Tile>::new());
        let (mut last, mut voxels) = (None, 0);
        for (key, mask) in masks {
            if last != Some(key >> 3) {
                last = Some(key >> 3);
                tiles.push(Tile {
                    place: packed(morton::decode(key >> 3)),
                    first: bricks.len() as u32,
                    there: 0,
                });
            }
            if let Some(tile) = tiles.last_mut() {
                tile.there |= 1 << (key & 7);
            }
            bricks.push(Brick {
                mask,
                cells: cells(mask),
                first: voxels,
            });
            voxels += mask.count_ones();
        }
        let mut table = vec![0; (2 * tiles.len()).next_power_of_two().max(2)];
        for (i, tile) in tiles.iter().enumerate() {
            let mut at = slot(tile.place, table.len());
            while table[at] != 0 {
                at = (at + 1) & (table.len() - 1);
            }
            table[at] = i as u32 + 1;
        }
        Bricks {
            bricks,
            tiles,
            table,
            side: 1 << depth.saturating_sub(3),
        }
    }

    /// Bytes of memory per voxel at most: a brick and a tile for each.
    pub const fn bytes_per_voxel() -> usize {
        size_of::<Brick>() + size_of::<Tile>() + 4 * size_of::<u32>()
    }

    /// Each brick in turn: its place among bricks, its voxels as a mask by Morton key, and the number of its first voxel.
    pub fn each(&self) -> impl Iterator<Item = ([u32; 3], u64, usize)> {
        let of_tile = |tile: &Tile| {
            let at = [0, 21, 42].map(|bit| (tile.place >> bit) as u32 & 0x1f_ffff);
            let bricks = &self.bricks[tile.first as usize..];
            ones(tile.there).zip(bricks).map(move |(octant, brick)| {
                let place = [0, 1, 2].map(|axis| 2 * at[axis] + (octant as u32 >> axis & 1));
                (place, brick.mask, brick.first as usize)
            })
        };
        self.tiles.iter().flat_map(of_tile)
    }

    /// Keys of the bricks without their `down` lowest bits, each once.
    pub fn nodes(&self, down: u32) -> Vec<u64> {
        let mut keys: Vec<u64> = self.each().map(|brick| morton::encode(brick.0) >> down).collect();
        keys.dedup();
        keys
    }

    /// The number of the tile at this place among tiles.
    #[inline]
    fn tile(&self, at: [i32; 3]) -> Option<usize> {
        if at.iter().any(|x| !(0..self.side).contains(x)) {
            return None;
        }
        let place = packed(at.map(|x| x as u32));
        let mut slot = slot(place, self.table.len());
        loop {
            let number = (self.table[slot] as usize).checked_sub(1)?;
            if self.tiles[number].place == place {
                return Some(number);
            }
            slot = (slot + 1) & (self.table.len() - 1);
        }
    }

    /// The brick at this place among bricks.
    #[inline]
    fn brick(&self, at: [i32; 3]) -> Option<&Brick> {
        let tile = self.tile(at.map(|x| x >> 1))?;
        Some(&self.bricks[self.tiles[tile].brick(at)?])
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

    /// The voxels of a brick, as a mask by `x + 4y + 16z`.
    #[inline]
    pub fn cells(&self, brick: usize) -> u64 {
        self.bricks[brick].cells
    }

    /// For queries of which each is near the one before.
    pub fn near(&self) -> Near<'_> {
        Near::new(self)
    }

    /// Calls `each` with the place and number of all voxels in a box of `side`³ cells from the place `first` on.
    pub fn in_box(&self, first: [i32; 3], side: i32, mut each: impl FnMut([i32; 3], usize)) {
        let low = first.map(|x| (x >> 2).max(0));
        let high = first.map(|x| ((x + side - 1) >> 2).min(2 * self.side - 1));
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

/// Far from all voxels.
const NOWHERE: i32 = i32::MIN / 4;

impl Tile {
    /// The number of the brick at this place among bricks, which is in the tile, if it has voxels.
    #[inline]
    fn brick(&self, at: [i32; 3]) -> Option<usize> {
        let octant = at[0] & 1 | (at[1] & 1) << 1 | (at[2] & 1) << 2;
        (self.there >> octant & 1 == 1).then(|| self.number(octant as usize))
    }

    /// The number of the brick in this octant.
    #[inline]
    fn number(&self, octant: usize) -> usize {
        let before = self.there & ((1 << octant) - 1);
        self.first as usize + before.count_ones() as usize
    }
}

/// A mask by Morton key as one by `x + 4y + 16z`.
#[inline]
pub fn cells(mask: u64) -> u64 {
    // Bits of a key are x, y, z, x, y, z, those of a cell x, x, y, y, z, z: pairs of them change places.
    let swapped = |mask: u64, moved: u64, by: u32| {
        let changed = (mask ^ mask >> by) & moved;
        mask ^ changed ^ changed << by
    };
    let mask = swapped(mask, SWAPS[0].0, SWAPS[0].1);
    let mask = swapped(mask, SWAPS[1].0, SWAPS[1].1);
    swapped(mask, SWAPS[2].0, SWAPS[2].1)
}

/// Of a Morton key in a brick the cell, `x + 4y + 16z`.
#[cfg(any(test, feature = "encoder"))]
pub fn cell(key: usize) -> u8 {
    CELLS[key]
}

/// For each pair of bits of a key that change places, the lower one first: of the keys with only the lower one of both set,
/// the bits; and how far the ones with only the higher one are from these.
const SWAPS: [(u64, u32); 3] = [swap(1, 3), swap(2, 3), swap(3, 4)];

const fn swap(low: u32, high: u32) -> (u64, u32) {
    let (mut keys, mut key) = (0, 0);
    while key < 64 {
        if key >> low & 1 == 1 && key >> high & 1 == 0 {
            keys |= 1 << key;
        }
        key += 1;
    }
    (keys, (1 << high) - (1 << low))
}

/// A place among tiles, as a number.
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

    #[test]
    fn masks_of_keys_become_masks_of_cells() {
        let mut all = 0;
        for (key, cell) in CELLS.iter().enumerate() {
            assert_eq!(cells(1 << key), 1 << cell);
            all |= if key % 3 == 0 { 1 << key } else { 0 };
        }
        let expected = (0..64)
            .filter(|key| key % 3 == 0)
            .fold(0, |mask, key| mask | 1 << CELLS[key]);
        assert_eq!(cells(all), expected);
    }

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
            let mut windows = Windows::new(&bricks, |brick| [bricks.cells(brick), !bricks.cells(brick)]);
            for step in 0..27 {
                let brick = [step % 3, step / 3 % 3, step / 9];
                let brick = [0, 1, 2].map(|axis| (at[axis] >> 2) + brick[axis] - 1);
                let [found, others] = *windows.of_brick(brick);
                for octant in 0..8 {
                    let node = [0, 1, 2].map(|axis| 4 * brick[axis] + 2 * (octant as i32 >> axis & 1));
                    prop_assert_eq!(found[octant], near.window(node.map(|x| x - 1)));
                    prop_assert_eq!(others[octant], near.window_of(node.map(|x| x - 1), |brick| !bricks.cells(brick)));
                }
            }
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
