//! What voxels give to the cells of a tile (`docs/format.md`, clauses 17.10.4 and 17.10.5).

use super::NEAR;
use super::levels::Cell;
use super::places::Place;
use crate::colour::Ycc;
use crate::geometry::{morton, ones};

/// Levels of cells of a tile, and cells along its sides.
pub(super) const TILE: u32 = 3;
pub(super) const SIDE: i32 = 1 << TILE;
pub(super) const CELLS: usize = 1 << (3 * TILE);

/// Bits of a coordinate in a tile, spread as in a Morton key.
const SPREAD: [usize; SIDE as usize] = [0, 1, 8, 9, 64, 65, 72, 73];

/// The cells of a tile, without sums but while one is made.
pub(super) struct Grid {
    narrow: Vec<[i32; 4]>,
    wide: Vec<[i64; 4]>,
}

impl Grid {
    pub fn new() -> Self {
        Grid {
            narrow: vec![[0; 4]; CELLS],
            wide: vec![[0; 4]; CELLS],
        }
    }

    /// Adds the near cells of the tile with key `tile` to `cells`, in the order of keys: those of `number` voxels.
    pub fn near<I>(&mut self, tile: u64, top: u8, number: usize, voxels: impl Fn() -> I, cells: &mut Vec<Cell>)
    where
        I: Iterator<Item = (Place, Ycc)>,
    {
        let corner = morton::decode(tile).map(|x| x as i32 * SIDE);
        // A small cube is less than a tile.
        let side = SIDE.min(1 << top);
        if number < FEW {
            let given = sums(&mut self.narrow, voxels(), corner, side);
            if near(&mut self.narrow, given, tile, cells) < LIGHT {
                return;
            }
            cells.clear();
        }
        let given = sums(&mut self.wide, voxels(), corner, side);
        near(&mut self.wide, given, tile, cells);
    }
}

/// Sums of weights, and of weighted Y, Co and Cg.
trait Sums: Copy + Default {
    fn add(&mut self, weight: i32, value: Ycc);

    fn wide(self) -> [i64; 4];
}

impl Sums for [i32; 4] {
    #[inline(always)]
    fn add(&mut self, weight: i32, value: Ycc) {
        // What leaves 32 bits is found by the weight, and added again in 64.
        let value = [1, value[0], value[1], value[2]].map(i32::from);
        // Both have 16 bits, of which products are faster.
        let weight = i32::from(weight as i16);
        for (sum, value) in self.iter_mut().zip(value) {
            *sum = sum.wrapping_add(weight * value);
        }
    }

    #[inline(always)]
    fn wide(self) -> [i64; 4] {
        self.map(i64::from)
    }
}

impl Sums for [i64; 4] {
    fn add(&mut self, weight: i32, value: Ycc) {
        let value = [1, i64::from(value[0]), i64::from(value[1]), i64::from(value[2])];
        for (sum, value) in self.iter_mut().zip(value) {
            *sum += i64::from(weight) * value;
        }
    }

    fn wide(self) -> [i64; 4] {
        self
    }
}

/// Fewer voxels than these cannot make the weight of a cell leave 32 bits.
const FEW: usize = 1 << 18;
/// Sums of cells that have less weight than this have not left 32 bits: values have at most 16.
const LIGHT: u64 = 1 << 16;

/// A bit for each cell of a tile that was given something.
type Given = [u64; CELLS / 64];

/// Adds up what the voxels at these places give to the cells of the tile at `corner`, of which `side` along each axis are
/// in the cube.
#[inline(always)]
fn sums<S: Sums>(grid: &mut [S], voxels: impl Iterator<Item = (Place, Ycc)>, corner: [i32; 3], side: i32) -> Given {
    let Ok(grid) = <&mut [S; CELLS]>::try_from(grid) else {
        unreachable!("a tile has {CELLS} cells")
    };
    let mut given = [0u64; CELLS / 64];
    for (place, value) in voxels {
        let low = [0, 1, 2].map(|axis| (place[axis] >> 4) - corner[axis]);
        let high = place.map(|x| x & 15);
        // Of each axis, what both cells are in the number of a cell.
        let cells = [0, 1, 2].map(|axis| [low[axis], low[axis] + 1].map(|x| SPREAD[x as usize & 7] << axis));
        let mut give = |x: usize, y: usize, z: usize, weight: i32| {
            let cell = (cells[0][x] | cells[1][y] | cells[2][z]) & (CELLS - 1);
            grid[cell].add(weight, value);
            given[cell >> 6] |= 1 << (cell & 63);
        };
        let mut give_both = |y: usize, z: usize, weight: i32| {
            if (0..side - 1).contains(&low[0]) {
                give(0, y, z, weight * (16 - high[0]));
                give(1, y, z, weight * high[0]);
            } else if (0..side).contains(&low[0]) {
                give(0, y, z, weight * (16 - high[0]));
            } else if low[0] == -1 && high[0] > 0 {
                give(1, y, z, weight * high[0]);
            }
        };
        let has = |axis: usize, step: i32| (0..side).contains(&(low[axis] + step)) && (step == 0 || high[axis] > 0);
        if has(1, 0) && has(2, 0) {
            give_both(0, 0, (16 - high[1]) * (16 - high[2]));
        }
        if has(1, 1) && has(2, 0) {
            give_both(1, 0, high[1] * (16 - high[2]));
        }
        if has(1, 0) && has(2, 1) {
            give_both(0, 1, (16 - high[1]) * high[2]);
        }
        if has(1, 1) && has(2, 1) {
            give_both(1, 1, high[1] * high[2]);
        }
    }
    given
}

/// Adds the near cells of a tile to `cells`, of which those that were `given` something are looked at. `grid` is left
/// without sums. Returns the largest weight.
fn near<S: Sums>(grid: &mut [S], given: Given, tile: u64, cells: &mut Vec<Cell>) -> u64 {
    let mut most = 0;
    for (word, given) in given.into_iter().enumerate() {
        for bit in ones(given) {
            let [weight, sums @ ..] = std::mem::take(&mut grid[word << 6 | bit]).wide();
            let weight = weight as u64;
            most = most.max(weight);
            if weight >= NEAR {
                cells.push(Cell {
                    key: tile << (3 * TILE) | (word << 6 | bit) as u64,
                    voxel: false,
                    weight,
                    sums,
                });
            }
        }
    }
    most
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_that_leave_32_bits_are_added_in_64() {
        let (mut narrow, mut wide) = (vec![[0i32; 4]; CELLS], vec![[0i64; 4]; CELLS]);
        let voxels = |count: usize| std::iter::repeat_n(([35, 40, 48], [i16::MIN, i16::MAX, -7]), count);
        let cells = |grid: &mut Grid, count: usize, number: usize| {
            let mut cells = Vec::new();
            grid.near(0, 3, number, || voxels(count), &mut cells);
            cells
                .iter()
                .map(|cell: &Cell| (cell.key, cell.weight, cell.sums))
                .collect::<Vec<_>>()
        };
        for (count, fits) in [(1, true), (39, true), (400, false), (100_000, false)] {
            let given = sums(&mut narrow, voxels(count), [0; 3], SIDE);
            assert_eq!(sums(&mut wide, voxels(count), [0; 3], SIDE), given);
            let [mut a, mut b] = [Vec::new(), Vec::new()];
            assert_eq!(near(&mut narrow, given, 0, &mut a) < LIGHT, fits, "{count}");
            near(&mut wide, given, 0, &mut b);
            let of_cells = |cells: Vec<Cell>| {
                { cells.iter() }
                    .map(|cell| (cell.key, cell.weight, cell.sums))
                    .collect()
            };
            let [a, b]: [Vec<_>; 2] = [a, b].map(of_cells);
            assert_eq!(a == b, fits, "{count}");
            // A grid takes what fits, and is left without sums.
            let mut grid = Grid::new();
            for number in [count, FEW] {
                assert_eq!(cells(&mut grid, count, number), b, "{count}");
            }
        }
    }
}
