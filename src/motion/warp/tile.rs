//! What voxels give to the cells of a tile (`docs/format.md`, clauses 17.10.4 and 17.10.5).

use b2p_kernels::scatter::{NUMBERS, PARTS, scatter};
use b2p_kernels::{Instructions, Isa, Work};

use super::NEAR;
use super::levels::Cell;
use super::places::Place;
use crate::geometry::morton;

/// Levels of cells of a tile, and cells along its sides.
pub(super) const TILE: u32 = 3;
const SIDE: i32 = 1 << TILE;
pub(super) const CELLS: usize = 1 << (3 * TILE);

/// From a cell to the next one along each axis. There is a cell more on each side of a tile, which is not looked at.
const STEPS: [usize; 3] = [1, SIDE as usize + 2, (SIDE as usize + 2) * (SIDE as usize + 2)];
/// All cells.
const ALL: usize = STEPS[1] * STEPS[2];

/// Of each Morton key in a tile the place of its cell.
const PLACES: [u16; CELLS] = {
    let mut places = [0; CELLS];
    let mut key = 0;
    while key < CELLS {
        let mut axis = 0;
        while axis < 3 {
            let x = (key >> axis & 1) + 2 * (key >> (axis + 3) & 1) + 4 * (key >> (axis + 6) & 1);
            places[key] += ((x + 1) * STEPS[axis]) as u16;
            axis += 1;
        }
        key += 1;
    }
    places
};

/// Fewer voxels than these cannot make the weight of a cell leave 32 bits.
const FEW: usize = 1 << 18;
/// Sums of cells that have less weight than this have not left 32 bits: values have at most 16.
const LIGHT: u64 = 1 << 16;

/// 1 and the three values of a voxel, twice.
pub(super) type Value = [i16; 2 * NUMBERS];

/// The cells of a tile, each with the sums of weights, and of weighted Y, Co and Cg.
pub(super) struct Grid {
    narrow: Vec<i32>,
    wide: Vec<[i64; NUMBERS]>,
}

impl Grid {
    pub fn new() -> Self {
        Grid {
            narrow: vec![0; NUMBERS * ALL],
            wide: Vec::new(),
        }
    }

    /// Adds the near cells of the tile with key `tile` to `cells`, in the order of keys. `voxels` are the `number` ones that
    /// give something to it; none is farther from it than a cell.
    pub fn near<I>(
        &mut self,
        isa: Isa,
        tile: u64,
        top: u8,
        number: usize,
        voxels: impl Fn() -> I,
        cells: &mut Vec<Cell>,
    ) where
        I: Iterator<Item = (Place, Value)>,
    {
        let corner = morton::decode(tile).map(|x| x as i32 * SIDE);
        // A small cube is less than a tile.
        let keys = CELLS.min(1 << (3 * u32::from(top)));
        if number < FEW {
            self.narrow.fill(0);
            let (voxels, sums) = (voxels(), &mut self.narrow);
            isa.run(Narrow { corner, voxels, sums });
            let sums = |place: usize| [0, 1, 2, 3].map(|i| i64::from(self.narrow[NUMBERS * place + i]));
            if near(keys, tile, |place| self.narrow[NUMBERS * place].into(), sums, cells) < LIGHT {
                return;
            }
            cells.clear();
        }
        self.wide.clear();
        self.wide.resize(ALL, [0; NUMBERS]);
        for (place, value) in voxels() {
            add(&mut self.wide, corner, place, value);
        }
        near(keys, tile, |place| self.wide[place][0], |place| self.wide[place], cells);
    }
}

/// The place of the lowest cell that a voxel gives something to, and how far it is beyond that along each axis.
#[inline(always)]
fn lowest(corner: [i32; 3], place: Place) -> (usize, [i32; 3]) {
    let along = |axis: usize| ((place[axis] >> 4) - corner[axis] + 1) as usize * STEPS[axis];
    (along(0) + along(1) + along(2), place.map(|x| x & (PARTS - 1)))
}

/// Adds up what voxels give to cells, in 32 bits.
struct Narrow<'a, I> {
    corner: [i32; 3],
    voxels: I,
    sums: &'a mut [i32],
}

impl<I: Iterator<Item = (Place, Value)>> Work for Narrow<'_, I> {
    type Output = ();

    #[inline(always)]
    fn run<S: Instructions>(self, simd: S) {
        let steps = [STEPS[1], STEPS[2]].map(|step| NUMBERS * step);
        for (place, value) in self.voxels {
            let (first, high) = lowest(self.corner, place);
            scatter(simd, self.sums, NUMBERS * first, steps, &value, high);
        }
    }
}

/// Adds what a voxel gives to cells, in 64 bits.
fn add(sums: &mut [[i64; NUMBERS]], corner: [i32; 3], place: Place, value: Value) {
    let (first, high) = lowest(corner, place);
    for i in 0..8 {
        let step = [i & 1, i >> 1 & 1, i >> 2];
        let share = |axis: usize| {
            if step[axis] == 1 {
                high[axis]
            } else {
                PARTS - high[axis]
            }
        };
        let weight = i64::from(share(0) * share(1) * share(2));
        let cell = first + step[0] * STEPS[0] + step[1] * STEPS[1] + step[2] * STEPS[2];
        for (sum, value) in sums[cell].iter_mut().zip(value) {
            *sum += weight * i64::from(value);
        }
    }
}

/// Adds the near ones of the first `keys` cells of a tile to `cells`. Returns the largest weight of any.
#[inline(always)]
fn near(
    keys: usize,
    tile: u64,
    weight: impl Fn(usize) -> i64,
    sums: impl Fn(usize) -> [i64; NUMBERS],
    cells: &mut Vec<Cell>,
) -> u64 {
    let mut most = 0;
    for (key, place) in PLACES[..keys].iter().enumerate() {
        let place = usize::from(*place);
        let weight = weight(place) as u64;
        most = most.max(weight);
        if weight >= NEAR {
            let [_, sums @ ..] = sums(place);
            cells.push(Cell {
                key: tile << (3 * TILE) | key as u64,
                voxel: false,
                weight,
                sums,
            });
        }
    }
    most
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_that_leave_32_bits_are_added_in_64() {
        let voxels = |count: usize| {
            let value = [1, i16::MIN, i16::MAX, -7];
            std::iter::repeat_n(([35, 40, 48], std::array::from_fn(|i| value[i % 4])), count)
        };
        let cells = |count: usize, number: usize| {
            let mut cells = Vec::new();
            Grid::new().near(Isa::detect(), 0, 3, number, || voxels(count), &mut cells);
            cells
                .iter()
                .map(|cell: &Cell| (cell.key, cell.weight, cell.sums))
                .collect::<Vec<_>>()
        };
        for count in [1, 39, 400, 100_000] {
            let wide = cells(count, FEW);
            assert_eq!(cells(count, count), wide, "{count}");
            let all: i64 = wide.iter().map(|cell| cell.2[0]).sum();
            let near: u64 = wide.iter().map(|cell| cell.1).sum();
            assert_eq!(all, near as i64 * i64::from(i16::MIN), "{count}");
        }
    }
}
