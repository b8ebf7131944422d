//! The previous frame, warped by a lattice (`docs/format.md`, clauses 17.10.4 to 17.10.6, 17.10.9).

mod levels;
mod places;
mod surface;
#[cfg(test)]
mod tests;
mod tile;
mod touched;

use std::sync::atomic::{AtomicUsize, Ordering};

use b2p_kernels::Isa;
use rayon::prelude::*;

use super::bricks::Bricks;
use super::lattice::Lattice;
use super::payload::malformed;
use super::previous::{Previous, PreviousLevel};
use crate::colour::Ycc;
use crate::error::{Error, Result};
#[cfg(any(test, feature = "encoder"))]
use crate::geometry::{morton, ones};
use levels::{Cell, Part, parents};
use places::{Place, places};
#[cfg(feature = "encoder")]
pub use surface::offset;
use tile::{CELLS, Grid, TILE};
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
/// Tiles per task.
const TILES: usize = 16;

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
    /// Of each brick of near cells those that are voxels, as a mask by `x + 4y + 16z`.
    pub voxels: Vec<u64>,
}

/// The voxels of a frame where they have moved to.
pub struct Scattered<'a> {
    isa: Isa,
    top: u8,
    values: &'a [Ycc],
    places: Vec<Place>,
    touched: Touched,
}

/// The levels of some tiles: the finest, the one above, and the cells of the level above that.
#[derive(Default)]
struct Tiles {
    finest: Part,
    above: Part,
    cells: Vec<Cell>,
}

impl<'a> Scattered<'a> {
    /// Moves the voxels of `previous`, of level `top`, by a lattice with vectors in voxels of level `unit`. If `smooth`,
    /// they start from the surface that the voxels around them tell of.
    pub fn new(isa: Isa, previous: &'a PreviousLevel, lattice: &Lattice, [top, unit]: [u8; 2], smooth: bool) -> Self {
        let places = places(previous, lattice, [top, unit], smooth);
        let touched = Touched::new(&places, top);
        Scattered {
            isa,
            top,
            values: &previous.values,
            places,
            touched,
        }
    }

    /// The least weight, in its units, from which on at most `count` cells are voxels.
    ///
    /// # Errors
    /// [`Error::Malformed`] if more cells are near than a frame may have.
    #[cfg(feature = "encoder")]
    pub fn least(&self, count: usize) -> Result<u8> {
        let weights = self.tiles(|weights: &mut Vec<u8>, cells: &mut [Cell]| {
            weights.extend(cells.iter().map(|cell| (cell.weight / UNIT).min(255) as u8));
        })?;
        let mut of_weight = [0; 256];
        for weight in weights.into_iter().flatten() {
            of_weight[usize::from(weight)] += 1;
        }
        let mut left = count;
        let fits = |least: &u8| {
            let fits = of_weight[usize::from(*least)] <= left;
            left = left.saturating_sub(of_weight[usize::from(*least)]);
            fits
        };
        Ok((LEAST..=u8::MAX).rev().take_while(fits).last().unwrap_or(u8::MAX))
    }

    /// The frame in which cells from this weight on are voxels.
    ///
    /// # Errors
    /// [`Error::Malformed`] if more cells are near than a frame may have.
    pub fn warped(&self, least: u8) -> Result<Warped> {
        let least = UNIT * u64::from(least);
        let tiles = self.tiles(|tiles: &mut Tiles, cells: &mut [Cell]| {
            for cell in &mut *cells {
                cell.voxel = cell.weight >= least;
            }
            tiles.finest.add(cells);
            let above = parents(cells);
            tiles.above.add(&above);
            tiles.cells.extend(parents(&above));
        })?;
        let (mut finest, mut above, mut cells) = (Vec::new(), Vec::new(), Vec::new());
        for tiles in tiles {
            finest.push(tiles.finest);
            above.push(tiles.above);
            cells.extend(tiles.cells);
        }
        let top = self.top;
        let made = |level: u8, parts: &[Part]| WarpedLevel::new(level, parts);
        let coarser = || {
            let mut levels = vec![made(top - 1, &above)];
            for level in (0..top - 1).rev() {
                levels.push(made(level, &[Part::of(&cells)]));
                cells = parents(&cells);
            }
            levels
        };
        let (finest, mut levels) = rayon::join(|| made(top, &finest), coarser);
        levels.reverse();
        levels.push(finest);
        Ok(Warped { levels })
    }

    /// Calls `take` with the near cells of tile after tile, and what it makes of those that are one task.
    fn tiles<T: Default + Send>(&self, take: impl Fn(&mut T, &mut [Cell]) + Sync) -> Result<Vec<T>> {
        let most = MOST_NEAR * self.places.len() + 64;
        let count = AtomicUsize::new(0);
        let of_tiles = |(grid, cells): &mut (Grid, Vec<Cell>), tiles: &[&[Run]]| {
            let mut made = T::default();
            for runs in tiles {
                // No more is kept than may be.
                if count.load(Ordering::Relaxed) > most {
                    break;
                }
                let voxels = || {
                    let voxels = runs.iter().flat_map(|run| self.touched.voxels(run));
                    voxels.map(|voxel| {
                        let [y, co, cg] = self.values[voxel];
                        (self.places[voxel], [1, y, co, cg, 1, y, co, cg])
                    })
                };
                let number = runs.iter().map(|run| run.range.len()).sum();
                cells.clear();
                grid.near(self.isa, runs[0].tile, self.top, number, voxels, cells);
                count.fetch_add(cells.len(), Ordering::Relaxed);
                take(&mut made, cells);
            }
            made
        };
        let tiles: Vec<&[Run]> = self.touched.runs.chunk_by(|a, b| a.tile == b.tile).collect();
        let tasks = tiles.par_chunks(TILES);
        let made = tasks
            .map_init(|| (Grid::new(), Vec::with_capacity(CELLS)), of_tiles)
            .collect();
        if count.into_inner() > most {
            let expected = format!("at most {most}");
            return Err(malformed(TOO_MANY, "near cells of the warped frame", "more", expected));
        }
        Ok(made)
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
        let near = Previous::bytes_per_voxel() + size_of::<u64>() + Part::bytes_per_cell();
        2 * MOST_NEAR * near + MOST_NEAR * size_of::<Cell>() + size_of::<Place>() + Touched::bytes_per_voxel()
    }

    /// Keys and colours of the voxels of the finest level.
    #[cfg(any(test, feature = "encoder"))]
    pub fn finest(&self) -> (Vec<u64>, Vec<Ycc>) {
        let mut found = (Vec::new(), Vec::new());
        let levels = self.levels.last().into_iter();
        for (key, value) in levels.flat_map(WarpedLevel::voxels) {
            found.0.push(key);
            found.1.push(value);
        }
        found
    }
}

impl WarpedLevel {
    fn new(level: u8, parts: &[Part]) -> Self {
        let bricks = || parts.iter().flat_map(|part| &part.bricks);
        let values = parts
            .iter()
            .map(|part| part.values.as_slice())
            .collect::<Vec<_>>()
            .concat();
        let near = Bricks::of_masks(level, bricks().map(|brick| (brick.key, brick.near)));
        WarpedLevel {
            near: PreviousLevel::of_bricks(near, values),
            voxels: bricks().map(|brick| super::bricks::cells(brick.voxels)).collect(),
        }
    }

    /// Keys and colours of the voxels.
    #[cfg(any(test, feature = "encoder"))]
    fn voxels(&self) -> impl Iterator<Item = (u64, Ycc)> {
        let of_brick = |((place, near, first), voxels): (([u32; 3], u64, usize), u64)| {
            let key = morton::encode(place) << 6;
            let values = &self.near.values[first..];
            let cells = ones(near)
                .zip(values)
                .map(move |(cell, value)| (cell as u64 | key, *value));
            let is_voxel = move |cell: u64| voxels >> super::bricks::cell(cell as usize & 63) & 1 == 1;
            cells.filter(move |(cell, _)| is_voxel(*cell))
        };
        self.near
            .bricks
            .each()
            .zip(self.voxels.iter().copied())
            .flat_map(of_brick)
    }
}
