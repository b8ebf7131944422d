//! The previous frame, warped by a lattice (`docs/format.md`, clauses 17.10.4 to 17.10.6, 17.10.9).

mod places;
mod surface;
#[cfg(test)]
mod tests;
mod touched;

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::bricks::Bricks;
use super::lattice::Lattice;
use super::payload::malformed;
use super::previous::{Previous, PreviousLevel};
use crate::colour::Ycc;
use crate::error::{Error, Result};
use crate::geometry::{Voxels, morton, ones};
use places::{Place, places};
#[cfg(feature = "encoder")]
pub use surface::offset;
use touched::{Run, Touched};

/// The clause of more near cells than a warped frame may have.
pub const TOO_MANY: &str = "17.10.5";

/// Weight of a cell from which on it is near. A voxel that comes to a cell exactly gives 4096.
const NEAR: u64 = 640;
/// Units of the weight from which on a cell is a voxel, and the least of them: all near cells.
const UNIT: u64 = 16;
pub const LEAST: u8 = (NEAR / UNIT) as u8;

/// The most near cells for each voxel of the previous frame.
const MOST_NEAR: usize = 4;

/// Levels of cells of a tile, and cells along its sides.
const TILE: u32 = 3;
const SIDE: i32 = 1 << TILE;
const CELLS: usize = 1 << (3 * TILE);

/// The levels of the previous frame as a lattice warps it.
#[derive(Debug, Clone)]
pub struct Warped {
    levels: Vec<WarpedLevel>,
}

/// A level of a warped frame.
#[derive(Debug, Clone)]
pub struct WarpedLevel {
    /// The near cells with their colours.
    pub near: PreviousLevel,
    /// The voxels.
    pub voxels: Bricks,
}

/// The near cells of the finest level, before it is known which are voxels.
pub struct Scattered {
    top: u8,
    cells: Vec<Cell>,
}

/// A near cell: its key, whether it is a voxel, its weight, and its colour sums.
#[derive(Debug, Clone, Copy)]
struct Cell {
    key: u64,
    voxel: bool,
    weight: u64,
    sums: [i64; 3],
}

impl Scattered {
    /// Moves the voxels of `previous`, of level `top`, by a lattice with vectors in voxels of level `unit`. If `smooth`,
    /// they start from the surface that the voxels around them tell of.
    ///
    /// # Errors
    /// [`Error::Malformed`] if more cells are near than a frame may have.
    pub fn new(previous: &PreviousLevel, lattice: &Lattice, [top, unit]: [u8; 2], smooth: bool) -> Result<Self> {
        let places = places(previous, lattice, [top, unit], smooth);
        let cells = scattered(&places, &previous.values, top)?;
        Ok(Scattered { top, cells })
    }

    /// The least weight, in its units, from which on at most `count` cells are voxels.
    #[cfg(feature = "encoder")]
    pub fn least(&self, count: usize) -> u8 {
        let mut of_weight = [0; 256];
        for cell in &self.cells {
            of_weight[(cell.weight / UNIT).min(255) as usize] += 1;
        }
        let mut left = count;
        let fits = |least: &u8| {
            let fits = of_weight[usize::from(*least)] <= left;
            left = left.saturating_sub(of_weight[usize::from(*least)]);
            fits
        };
        (LEAST..=u8::MAX).rev().take_while(fits).last().unwrap_or(u8::MAX)
    }

    /// The frame in which cells from this weight on are voxels.
    pub fn warped(self, least: u8) -> Warped {
        let Scattered { top, mut cells } = self;
        for cell in &mut cells {
            cell.voxel = cell.weight >= UNIT * u64::from(least);
        }
        let mut levels = Vec::with_capacity(usize::from(top) + 1);
        for level in (0..=top).rev() {
            let made = || WarpedLevel::new(level, &cells);
            match level {
                0 => levels.push(made()),
                _ => {
                    let (made, above) = rayon::join(made, || parents(&cells));
                    levels.push(made);
                    cells = above;
                }
            }
        }
        levels.reverse();
        Warped { levels }
    }
}

impl Warped {
    /// A level.
    ///
    /// # Errors
    /// [`Error::Usage`] if it was not made.
    pub fn at(&self, level: u8) -> Result<&WarpedLevel> {
        { self.levels.get(usize::from(level)) }
            .ok_or_else(|| Error::Usage(format!("level {level} of the warped frame was not made")))
    }

    /// Bytes of memory per voxel of the previous frame at most, while it is made: near cells of the finest level, and as
    /// many of all levels above, each in a brick of its own; places, and the tiles that each touches.
    pub const fn bytes_per_voxel() -> usize {
        let near = Previous::bytes_per_voxel() + Bricks::bytes_per_voxel() + 2 * size_of::<Cell>();
        2 * MOST_NEAR * near + size_of::<Place>() + Touched::bytes_per_voxel()
    }

    /// Keys and colours of the voxels of the finest level.
    #[cfg(any(test, feature = "encoder"))]
    pub fn finest(&self) -> (Vec<u64>, Vec<Ycc>) {
        let Some(level) = self.levels.last() else {
            return Default::default();
        };
        let mut found = (Vec::new(), Vec::new());
        for (place, mask, _) in level.voxels.each() {
            let brick = morton::encode(place) << 6;
            for key in ones(mask) {
                let key = brick | key as u64;
                let index = level.near.index(morton::decode(key).map(|x| x as i32));
                found.0.push(key);
                found
                    .1
                    .push(index.map_or_else(Ycc::default, |index| level.near.values[index]));
            }
        }
        found
    }
}

impl WarpedLevel {
    fn new(level: u8, cells: &[Cell]) -> Self {
        let near = || {
            let keys = cells.iter().map(|cell| cell.key).collect();
            let values = cells.iter().map(Cell::colour).collect();
            PreviousLevel::new(&Voxels::from_sorted(level, keys), values)
        };
        let voxels = || {
            let voxels = cells.iter().filter(|cell| cell.voxel).map(|cell| cell.key);
            Bricks::new(&Voxels::from_sorted(level, voxels.collect()))
        };
        let (near, voxels) = rayon::join(near, voxels);
        WarpedLevel { near, voxels }
    }
}

impl Cell {
    /// The mean, rounded to the nearest, halves up.
    fn colour(&self) -> Ycc {
        let weight = self.weight as i64;
        if weight >= 1 << 30 {
            return self.sums.map(|sum| (2 * sum + weight).div_euclid(2 * weight) as i16);
        }
        // Numbers of at most 47 bits, whose quotient is above 0, and no nearer to a whole number than 2⁻³¹: floats round
        // it down correctly, and divide faster.
        let least = 2 * weight * (1 << 15);
        self.sums.map(|sum| {
            let above = (2 * sum + weight + least) as f64 / (2 * weight) as f64;
            (above as i64 - (1 << 15)) as i16
        })
    }
}

/// Bits of a coordinate in a tile, spread as in a Morton key.
const SPREAD: [usize; SIDE as usize] = [0, 1, 8, 9, 64, 65, 72, 73];

/// The near cells of voxels at these places, in the order of keys.
fn scattered(places: &[Place], values: &[Ycc], top: u8) -> Result<Vec<Cell>> {
    let touched = Touched::new(places, top);
    // A small cube is less than a tile.
    let side = SIDE.min(1 << top);
    let most = MOST_NEAR * places.len() + 64;
    let count = AtomicUsize::new(0);
    let grids = || (vec![[0i32; 4]; CELLS], vec![[0i64; 4]; CELLS]);
    let of_tile = |(grid, wide): &mut (Vec<[i32; 4]>, Vec<[i64; 4]>), runs: &&[Run]| {
        // No more is kept than may be.
        if count.load(Ordering::Relaxed) > most {
            return Vec::new();
        }
        let tile = runs[0].tile;
        let corner = morton::decode(tile).map(|x| x as i32 * SIDE);
        let voxels = || {
            let voxels = runs.iter().flat_map(|run| touched.voxels(run));
            voxels.map(|voxel| (places[voxel], values[voxel]))
        };
        let few = runs.iter().map(|run| run.range.len()).sum::<usize>() < FEW;
        let near = match few.then(|| sums(grid, voxels(), corner, side)) {
            Some(given) if within_32_bits(grid, &given) => near(grid, given, tile),
            _ => {
                grid.fill([0; 4]);
                let given = sums(wide, voxels(), corner, side);
                near(wide, given, tile)
            }
        };
        count.fetch_add(near.len(), Ordering::Relaxed);
        near
    };
    let tiles: Vec<&[Run]> = touched.runs.chunk_by(|a, b| a.tile == b.tile).collect();
    let found: Vec<Vec<Cell>> = tiles.par_iter().with_min_len(16).map_init(grids, of_tile).collect();
    if count.into_inner() > most {
        let expected = format!("at most {most}");
        return Err(malformed(TOO_MANY, "near cells of the warped frame", "more", expected));
    }
    Ok(found.concat())
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
        let value = [1, i32::from(value[0]), i32::from(value[1]), i32::from(value[2])];
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

/// Whether sums cannot have left 32 bits: values have at most 16, the weight of a cell 16, too.
fn within_32_bits(grid: &[[i32; 4]], given: &Given) -> bool {
    let cells = |(word, given): (usize, &u64)| ones(*given).map(move |bit| word << 6 | bit);
    let mut given = given.iter().enumerate().flat_map(cells);
    given.all(|cell| (0..1 << 16).contains(&grid[cell][0]))
}

/// A bit for each cell of a tile that was given something.
type Given = [u64; CELLS / 64];

/// Adds up what the voxels at these places give to the cells of the tile at `corner`, of which `side` along each axis are
/// in the cube.
#[inline(always)]
fn sums<S: Sums>(grid: &mut [S], voxels: impl Iterator<Item = (Place, Ycc)>, corner: [i32; 3], side: i32) -> Given {
    let mut given = [0u64; CELLS / 64];
    for (place, value) in voxels {
        let low = [0, 1, 2].map(|axis| (place[axis] >> 4) - corner[axis]);
        let shares = place.map(|x| [16 - (x & 15), x & 15]);
        let inside = low.iter().all(|x| (0..side - 1).contains(x));
        // Of each axis, what both cells are in the number of a cell.
        let cells = [0, 1, 2].map(|axis| [low[axis], low[axis] + 1].map(|x| SPREAD[x as usize & 7] << axis));
        for i in 0..8 {
            let step = [i & 1, i >> 1 & 1, i >> 2];
            let weight = shares[0][step[0]] * shares[1][step[1]] * shares[2][step[2]];
            let is_there = |axis: usize| (0..side).contains(&(low[axis] + step[axis] as i32));
            if inside || (weight > 0 && is_there(0) && is_there(1) && is_there(2)) {
                let cell = (cells[0][step[0]] | cells[1][step[1]] | cells[2][step[2]]) & (CELLS - 1);
                grid[cell].add(weight, value);
                given[cell >> 6] |= 1 << (cell & 63);
            }
        }
    }
    given
}

/// The near cells of a tile, of which those that were `given` something are looked at. `grid` is left without sums.
fn near<S: Sums>(grid: &mut [S], given: Given, tile: u64) -> Vec<Cell> {
    let count = given.iter().map(|given| given.count_ones() as usize).sum();
    let mut near = Vec::with_capacity(count);
    for (word, given) in given.into_iter().enumerate() {
        for bit in ones(given) {
            let [weight, sums @ ..] = std::mem::take(&mut grid[word << 6 | bit]).wide();
            if weight as u64 >= NEAR {
                near.push(Cell {
                    key: tile << (3 * TILE) | (word << 6 | bit) as u64,
                    voxel: false,
                    weight: weight as u64,
                    sums,
                });
            }
        }
    }
    near
}

/// The parents of cells in the order of keys.
fn parents(cells: &[Cell]) -> Vec<Cell> {
    let mut parents: Vec<Cell> = Vec::with_capacity(cells.len() / 3 + 1);
    for cell in cells {
        let key = cell.key >> 3;
        match parents.last_mut().filter(|parent| parent.key == key) {
            Some(parent) => {
                parent.voxel |= cell.voxel;
                parent.weight += cell.weight;
                (0..3).for_each(|t| parent.sums[t] += cell.sums[t]);
            }
            None => parents.push(Cell { key, ..*cell }),
        }
    }
    parents
}
