//! What is near each place of a frame.

use std::array::from_fn;

use rayon::prelude::*;

use super::Frame;
use crate::colour::Ycc;
use crate::geometry::morton;

/// Energy of a luma that is off by one 255th, and the most that a luma costs.
const LUMA: f32 = 1.0 / (12.0 * 12.0);
const OTHER_LUMA: f32 = 2.0;
/// The square of the distance that counts as far.
const FAR: f32 = 4.0;
/// Cells along an edge of a brick: eight, and one of the next brick, so that any cell and those after it are in one.
const EDGE: usize = 9;
const CELLS: usize = EDGE * EDGE * EDGE;
/// Cells from one to the last of the eight that start there.
const SPAN: usize = 2 + EDGE + EDGE * EDGE;
/// A cell is the square of its distance in its upper bits, and the luma there in the others, in 16ths.
const LUMA_BITS: u32 = 12;
const LUMA_MASK: i16 = (1 << LUMA_BITS) - 1;
/// A cell that is far from all voxels. No voxel has this luma.
const NOWHERE: i16 = 4 << LUMA_BITS | LUMA_MASK;

/// The number of a cell, brick or block at a place, which may be outside the cube.
pub(super) fn number(place: [i32; 3]) -> u64 {
    let axis = |i: usize| u64::from(place[i].cast_unsigned() & 0x1f_ffff) << (21 * i);
    axis(0) | axis(1) | axis(2)
}

/// The place of a Morton key.
pub(super) fn place(key: u64) -> [i32; 3] {
    morton::decode(key).map(u32::cast_signed)
}

/// A place and another one.
pub(super) fn plus(a: [i32; 3], b: [i32; 3]) -> [i32; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// Offsets of at most `reach` along each axis, x fastest.
pub(super) fn around(reach: i32) -> impl Iterator<Item = [i32; 3]> {
    let axis = move || -reach..=reach;
    axis().flat_map(move |z| axis().flat_map(move |y| axis().map(move |x| [x, y, z])))
}

/// The integer below. The function of the standard library is a call on many machines.
#[inline]
pub(super) fn floor(x: f32) -> i32 {
    let near = x as i32;
    near - i32::from((near as f32) > x)
}

/// Finds places by number.
pub(super) struct Table {
    slots: Vec<(u64, u32)>,
    shift: u32,
}

impl Table {
    const EMPTY: u32 = u32::MAX;

    /// A table of these numbers, each once.
    pub(super) fn of(numbers: &[u64]) -> Self {
        let bits = (2 * numbers.len()).next_power_of_two().trailing_zeros().max(1);
        let (mut slots, shift) = (vec![(0, Self::EMPTY); 1 << bits], 64 - bits);
        for (&number, i) in numbers.iter().zip(0..) {
            let mut slot = Self::hash(number, shift);
            while slots[slot].1 != Self::EMPTY {
                slot = (slot + 1) & (slots.len() - 1);
            }
            slots[slot] = (number, i);
        }
        Table { slots, shift }
    }

    fn hash(number: u64, shift: u32) -> usize {
        (number.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> shift) as usize
    }

    /// Which of the numbers this is.
    #[inline]
    pub(super) fn find(&self, number: u64) -> Option<usize> {
        let mut slot = Self::hash(number, self.shift);
        loop {
            let (other, i) = self.slots[slot];
            if i == Self::EMPTY {
                return None;
            }
            if other == number {
                return Some(i as usize);
            }
            slot = (slot + 1) & (self.slots.len() - 1);
        }
    }
}

impl Frame<'_> {
    /// Keys and lumas of the voxels, these in 255ths.
    pub(super) fn voxels(&self) -> Vec<(u64, f32)> {
        let luma = |value: &Ycc| f32::from(value[0]) / 64.0;
        self.keys.iter().copied().zip(self.values.iter().map(luma)).collect()
    }

    /// Keys and mean lumas of the nodes so many levels above.
    pub(super) fn nodes(&self, levels: u8) -> Vec<(u64, f32)> {
        let voxels = self.voxels();
        let node = |voxel: &(u64, f32)| voxel.0 >> (3 * levels);
        let nodes = voxels.chunk_by(|a, b| node(a) == node(b));
        nodes
            .map(|voxels| {
                (
                    node(&voxels[0]),
                    voxels.iter().map(|voxel| voxel.1).sum::<f32>() / voxels.len() as f32,
                )
            })
            .collect()
    }
}

/// A voxel on a map: its place, and its luma as a cell has it.
type Voxel = ([i32; 3], i16);

/// What is near each place of a frame, in bricks of 8³ cells.
pub(super) struct Map {
    bricks: Table,
    cells: Vec<i16>,
}

impl Map {
    /// The map of voxels in ascending order.
    pub(super) fn of(voxels: Vec<(u64, f32)>) -> Self {
        let luma = |luma: f32| ((luma * 16.0).max(0.0) as i16).min(LUMA_MASK - 1);
        let voxels: Vec<Voxel> = voxels.into_iter().map(|(key, y)| (place(key), luma(y))).collect();
        let brick = |voxel: &Voxel| voxel.0.map(|x| x >> 3);
        let full: Vec<&[Voxel]> = voxels.chunk_by(|a, b| brick(a) == brick(b)).collect();
        let mut bricks: Vec<[i32; 3]> = full
            .iter()
            .flat_map(|voxels| Self::reached(brick(&voxels[0]), voxels))
            .collect();
        bricks.sort_unstable_by_key(|brick| number(*brick));
        bricks.dedup();
        let table = Table::of(&full.iter().map(|voxels| number(brick(&voxels[0]))).collect::<Vec<_>>());
        let mut cells = vec![NOWHERE; CELLS * bricks.len()];
        cells
            .par_chunks_exact_mut(CELLS)
            .zip(&bricks)
            .for_each(|(cells, brick)| {
                let near = around(1).filter_map(|offset| table.find(number(plus(*brick, offset))));
                draw(cells, *brick, near.flat_map(|i| full[i]));
            });
        let bricks: Vec<u64> = bricks.into_iter().map(number).collect();
        Map {
            bricks: Table::of(&bricks),
            cells,
        }
    }

    /// The bricks with cells from which voxels of the brick `at` are seen.
    fn reached(at: [i32; 3], voxels: &[Voxel]) -> impl Iterator<Item = [i32; 3]> + use<> {
        let (mut low, mut high) = ([7; 3], [0; 3]);
        for place in voxels.iter().map(|voxel| voxel.0.map(|x| x & 7)) {
            (0..3).for_each(|axis| low[axis] = place[axis].min(low[axis]));
            (0..3).for_each(|axis| high[axis] = place[axis].max(high[axis]));
        }
        // The cell before is read with this one.
        let seen = move |offset: &[i32; 3]| {
            (0..3).all(|axis| (low[axis] - 3) >> 3 <= offset[axis] && offset[axis] <= (high[axis] + 2) >> 3)
        };
        around(1).filter(seen).map(move |offset| plus(at, offset))
    }

    /// The cells from the one at a place on.
    #[inline]
    fn find(&self, [x, y, z]: [i32; 3]) -> Option<&[i16; SPAN]> {
        let brick = self.bricks.find(number([x >> 3, y >> 3, z >> 3]))?;
        let [x, y, z] = [x, y, z].map(|x| x as usize & 7);
        self.cells[brick * CELLS + x + EDGE * y + EDGE * EDGE * z..].first_chunk()
    }

    /// The energy of a voxel at a place: how far it is from the nearest voxel, and how much its luma differs.
    #[inline]
    pub(super) fn energy(&self, place: [f32; 3], luma: f32) -> f32 {
        let cell = self
            .find(place.map(|x| floor(x + 0.5)))
            .map_or(NOWHERE, |cells| cells[0]);
        if cell == NOWHERE {
            return FAR + OTHER_LUMA;
        }
        let off = luma_of(cell) - luma;
        f32::from(cell >> LUMA_BITS) + (off * off * LUMA).min(OTHER_LUMA)
    }

    /// The same, of what is between the cells around.
    #[inline]
    pub(super) fn smooth_energy(&self, place: [f32; 3], luma: f32) -> f32 {
        let low = place.map(floor);
        let Some(cells) = self.find(low) else {
            return FAR + OTHER_LUMA;
        };
        let weights = weights([0, 1, 2].map(|axis| place[axis] - low[axis] as f32));
        let cells: [i16; 8] = from_fn(|i| cells[(i & 1) + (i >> 1 & 1) * EDGE + (i >> 2) * EDGE * EDGE]);
        let seen: [f32; 8] = from_fn(|i| if cells[i] == NOWHERE { 0.0 } else { weights[i] });
        let near = sum(seen);
        if near < 1e-3 {
            return FAR + OTHER_LUMA;
        }
        let distance = sum(from_fn(|i| weights[i] * f32::from(cells[i] >> LUMA_BITS)));
        let off = sum(from_fn(|i| seen[i] * luma_of(cells[i]))) - near * luma;
        distance + (off * off * LUMA / near).min(OTHER_LUMA * near) + OTHER_LUMA * (1.0 - near)
    }
}

/// The sum, in an order that suits vectors.
#[inline]
fn sum(x: [f32; 8]) -> f32 {
    let half: [f32; 4] = from_fn(|i| x[i] + x[i + 4]);
    (half[0] + half[2]) + (half[1] + half[3])
}

/// The luma of a cell.
#[inline]
fn luma_of(cell: i16) -> f32 {
    f32::from(cell & LUMA_MASK) / 16.0
}

/// Where a brick is drawn: with all cells that voxels within two of it are seen from, and some that rows end in.
const SHEET: [usize; 3] = [20, 17, 17];
/// Of the cells that a voxel is seen from, which are not far, the rows: where each starts on the sheet, and what it has.
const ROWS: [(usize, [i16; 8]); 13] = {
    // More than any cell has.
    const NOTHING: i16 = i16::MAX - LUMA_MASK;
    let (mut rows, mut count, mut i) = ([(0, [NOTHING; 8]); 13], 0, 0);
    while i < 25 {
        let (y, z) = (i % 5, i / 5);
        let square = (y as i32 - 2) * (y as i32 - 2) + (z as i32 - 2) * (z as i32 - 2);
        if square <= 4 {
            rows[count].0 = SHEET[0] * (y + SHEET[1] * z);
            let mut x = 0;
            while x < 5 {
                let square = square + (x - 2) * (x - 2);
                if square <= 4 {
                    rows[count].1[x as usize] = (square as i16) << LUMA_BITS;
                }
                x += 1;
            }
            count += 1;
        }
        i += 1;
    }
    rows
};

/// Draws voxels in and near a brick into its cells. Of the nearest a cell has the darkest, whatever their order.
fn draw<'a>(cells: &mut [i16], brick: [i32; 3], voxels: impl Iterator<Item = &'a Voxel>) {
    let mut sheet = [NOWHERE; SHEET[0] * SHEET[1] * SHEET[2]];
    for (at, luma) in voxels {
        let at = plus(*at, brick.map(|x| 2 - 8 * x));
        if at.iter().any(|x| !(0..EDGE as i32 + 4).contains(x)) {
            continue;
        }
        let [x, y, z] = at.map(|x| x as usize);
        let sheet = &mut sheet[x + SHEET[0] * (y + SHEET[1] * z)..];
        for (start, row) in ROWS {
            let cells = &mut sheet[start..start + 8];
            cells
                .iter_mut()
                .zip(row)
                .for_each(|(cell, square)| *cell = (*cell).min(square + luma));
        }
    }
    for (i, row) in cells.chunks_exact_mut(EDGE).enumerate() {
        let start = 4 + SHEET[0] * (4 + i % EDGE + SHEET[1] * (4 + i / EDGE));
        row.copy_from_slice(&sheet[start..start + EDGE]);
    }
}

/// Shares of eight corners in a place between them, x fastest.
#[inline]
pub(super) fn weights([x, y, z]: [f32; 3]) -> [f32; 8] {
    let (a, b, c, d) = ((1.0 - y) * (1.0 - z), y * (1.0 - z), (1.0 - y) * z, y * z);
    let less = 1.0 - x;
    [less * a, x * a, less * b, x * b, less * c, x * c, less * d, x * d]
}
