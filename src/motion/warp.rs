//! The previous frame, warped by a lattice (`docs/format.md`, clauses 17.10.4 to 17.10.6).

use std::collections::HashMap;
use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::bricks::Bricks;
use super::lattice::{Corners, Lattice};
use super::payload::malformed;
use super::previous::{Previous, PreviousLevel};
use crate::colour::Ycc;
use crate::error::{Error, Result};
use crate::geometry::{Voxels, morton, ones};

/// The clause of more near cells than a warped frame may have.
pub const TOO_MANY: &str = "17.10.5";

/// Weight of a cell from which on it is near. A voxel that comes to a cell exactly gives 4096.
const NEAR: u64 = 640;
/// Units of the weight from which on a cell is a voxel, and the least of them: all near cells.
const UNIT: u64 = 16;
pub const LEAST: u8 = (NEAR / UNIT) as u8;

/// The most tiles that a voxel touches.
const TOUCHED: usize = 8;
/// The most near cells for each voxel of the previous frame.
const MOST_NEAR: usize = 4;

/// Levels of cells of a tile, and cells along its sides.
const TILE: u32 = 3;
const SIDE: i32 = 1 << TILE;
const CELLS: usize = 1 << (3 * TILE);
/// Bricks per task that finds places.
const BRICKS: usize = 512;
/// Voxels per task that finds tiles.
const CHUNK: usize = 1 << 10;

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

/// A voxel of the previous frame on its way: twice its place in sixteenths of a cell.
type Place = [i32; 3];

impl Scattered {
    /// Moves the voxels of `previous`, of level `top`, by a lattice with vectors in voxels of level `unit`.
    ///
    /// # Errors
    /// [`Error::Malformed`] if more cells are near than a frame may have.
    pub fn new(previous: &PreviousLevel, lattice: &Lattice, [top, unit]: [u8; 2]) -> Result<Self> {
        let places = places(previous, lattice, [top, unit]);
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
        2 * MOST_NEAR * near
            + size_of::<Place>()
            + TOUCHED * (size_of::<(u16, u16)>() + size_of::<u16>() + size_of::<Run>())
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

/// Where each voxel moves to, in sixteenths of a cell.
fn places(previous: &PreviousLevel, lattice: &Lattice, [top, unit]: [u8; 2]) -> Vec<Place> {
    let corners = lattice.finest();
    // Cells of a node along an axis, as a shift.
    let depth = top + 1 - lattice.levels().len() as u8;
    let field = Field {
        corners,
        depth,
        shift: u32::from(3 * (depth + 1) + unit - top),
    };
    let bricks: Vec<_> = previous.bricks.each().collect();
    let of_chunk = |bricks: &[([u32; 3], u64, usize)]| {
        let mut places = Vec::with_capacity(bricks.len() * 16);
        let mut node = Node::default();
        for (place, mask, _) in bricks {
            for key in ones(*mask) {
                let [x, y, z] = [0, 1, 2].map(|axis| (key as u32 >> axis & 1) | (key as u32 >> (axis + 2) & 2));
                let at = [4 * place[0] + x, 4 * place[1] + y, 4 * place[2] + z];
                places.push(field.moved(&mut node, at));
            }
        }
        places
    };
    let chunks: Vec<Vec<Place>> = bricks.par_chunks(BRICKS).map(of_chunk).collect();
    chunks.concat()
}

/// A field of vectors between the corners of nodes.
struct Field<'a> {
    corners: &'a Corners,
    /// A node has this many levels of voxels.
    depth: u8,
    /// From sums of weighted vectors to sixteenths of a voxel.
    shift: u32,
}

/// A node that was looked up, with the vectors of its corners.
#[derive(Default)]
struct Node {
    place: Option<[u32; 3]>,
    vectors: [[i64; 3]; 8],
    still: bool,
}

impl Field<'_> {
    /// Where the voxel at this place moves to. `node` is the one of the voxel before.
    #[inline]
    fn moved(&self, node: &mut Node, at: [u32; 3]) -> Place {
        let place = at.map(|x| x >> self.depth);
        if node.place != Some(place) {
            node.place = Some(place);
            for (i, vector) in node.vectors.iter_mut().enumerate() {
                let step = [i & 1, i >> 1 & 1, i >> 2].map(|x| x as u32);
                let corner = self.corners.number([0, 1, 2].map(|axis| place[axis] + step[axis]));
                *vector = self.corners.vectors[corner].map(i64::from);
            }
            node.still = node.vectors == [[0; 3]; 8];
        }
        if node.still {
            return at.map(|x| 16 * x as i32);
        }
        let side = 2i64 << self.depth;
        let offset = [0, 1, 2].map(|axis| 2 * i64::from(at[axis] - (place[axis] << self.depth)) + 1);
        let mut sums = [0i64; 3];
        for (i, vector) in node.vectors.iter().enumerate() {
            let weight = |axis: usize| match i >> axis & 1 {
                1 => offset[axis],
                _ => side - offset[axis],
            };
            let weight = weight(0) * weight(1) * weight(2);
            (0..3).for_each(|axis| sums[axis] += weight * vector[axis]);
        }
        let half = 1i64 << (self.shift - 1);
        [0, 1, 2].map(|axis| 16 * at[axis] as i32 + ((16 * sums[axis] + half) >> self.shift) as i32)
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

/// The voxels that give weight to each tile.
struct Touched {
    /// Of each chunk of voxels their numbers in the chunk, by tiles.
    chunks: Vec<Vec<u16>>,
    /// In the order of tiles.
    runs: Vec<Run>,
}

/// Voxels of a chunk that touch a tile.
struct Run {
    tile: u64,
    chunk: usize,
    range: Range<usize>,
}

/// The tiles that the voxels of a chunk touch, in the order in which they are met.
#[derive(Default)]
struct Tiles {
    places: Vec<[i32; 3]>,
    numbers: HashMap<[i32; 3], usize>,
    /// How many voxels touch each.
    counts: Vec<usize>,
    /// For each touch the tile's number here and the voxel's in the chunk.
    touches: Vec<(u16, u16)>,
}

impl Tiles {
    /// Of one voxel after the other; each mostly touches the tile of the one before.
    fn touch(&mut self, tile: [i32; 3], last: &mut usize, voxel: usize) {
        if self.places.get(*last) != Some(&tile) {
            *last = *self.numbers.entry(tile).or_insert_with(|| {
                self.places.push(tile);
                self.counts.push(0);
                self.places.len() - 1
            });
        }
        self.counts[*last] += 1;
        self.touches.push((*last as u16, voxel as u16));
    }

    /// The voxels by tiles, and where those of each tile are.
    fn sorted(self, chunk: usize) -> (Vec<u16>, Vec<Run>) {
        let mut end = 0;
        let runs = { self.places.iter().zip(&self.counts) }.map(|(place, count)| {
            let tile = morton::encode(place.map(|x| x as u32));
            let range = end..end + count;
            end = range.end;
            Run { tile, chunk, range }
        });
        let runs: Vec<Run> = runs.collect();
        let mut next: Vec<usize> = runs.iter().map(|run| run.range.start).collect();
        let mut voxels = vec![0; self.touches.len()];
        for (tile, voxel) in self.touches {
            voxels[next[usize::from(tile)]] = voxel;
            next[usize::from(tile)] += 1;
        }
        (voxels, runs)
    }
}

impl Touched {
    fn new(places: &[Place], top: u8) -> Self {
        let tiles = 1i32 << u32::from(top).saturating_sub(TILE);
        let of_chunk = |(chunk, places): (usize, &[Place])| {
            let (mut found, mut last) = (Tiles::default(), [0; 8]);
            for (i, place) in places.iter().enumerate() {
                let first = place.map(|x| x >> (4 + TILE));
                // The last cell that has weight.
                let end = place.map(|x| (x + 15) >> (4 + TILE));
                for z in first[2]..=end[2] {
                    for y in first[1]..=end[1] {
                        for x in first[0]..=end[0] {
                            if [x, y, z].iter().all(|x| (0..tiles).contains(x)) {
                                let side = (x - first[0]) + 2 * (y - first[1]) + 4 * (z - first[2]);
                                found.touch([x, y, z], &mut last[side as usize & 7], i);
                            }
                        }
                    }
                }
            }
            found.sorted(chunk)
        };
        let found: Vec<_> = places.par_chunks(CHUNK).enumerate().map(of_chunk).collect();
        let (chunks, runs): (Vec<Vec<u16>>, Vec<Vec<Run>>) = found.into_iter().unzip();
        let mut runs: Vec<Run> = runs.into_iter().flatten().collect();
        runs.sort_unstable_by_key(|run| (run.tile, run.chunk));
        Touched { chunks, runs }
    }

    /// The numbers of a run's voxels.
    fn voxels(&self, run: &Run) -> impl Iterator<Item = usize> {
        let first = run.chunk * CHUNK;
        let touched = &self.chunks[run.chunk][run.range.clone()];
        touched.iter().map(move |touched| first + usize::from(*touched))
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Octree;
    use proptest::prelude::*;
    use std::collections::{BTreeMap, BTreeSet};

    /// A frame of `top` levels, with values that differ.
    fn frame(top: u8, keys: Vec<u64>) -> (PreviousLevel, Voxels) {
        let voxels = Voxels::new(top, keys);
        let values = (0..voxels.len())
            .map(|i| (i % 4000) as i16)
            .map(|i| [i % 700 * 37 % 500, -i, i])
            .collect();
        (PreviousLevel::new(&voxels, values), voxels)
    }

    /// A lattice of that frame with vectors that `vector` makes of the places of corners.
    fn lattice(voxels: &Voxels, level: u8, vector: impl Fn([u32; 3]) -> [i16; 3]) -> Lattice {
        let octree = Octree::new(voxels.clone()).unwrap();
        let mut lattice = Lattice::of(octree.level(level).keys(), level);
        let corners = lattice.level_mut(level).1;
        for i in 0..corners.vectors.len() {
            corners.vectors[i] = vector(corners.at(i));
        }
        lattice
    }

    fn keys(level: &WarpedLevel) -> Vec<u64> {
        let near = level.near.bricks.each();
        near.flat_map(|(place, mask, _)| ones(mask).map(move |key| morton::encode(place) << 6 | key as u64))
            .collect()
    }

    /// The warped frame as the clauses say it, cell by cell: of each near cell of the finest level its weight and sums.
    fn plain(
        previous: &PreviousLevel,
        voxels: &Voxels,
        lattice: &Lattice,
        [top, unit]: [u8; 2],
    ) -> BTreeMap<u64, (i64, [i64; 3])> {
        let level = lattice.levels().len() as u8 - 1;
        let side = 1i64 << (top - level);
        let mut cells = BTreeMap::<u64, (i64, [i64; 3])>::new();
        for (i, key) in voxels.keys().iter().enumerate() {
            let at = morton::decode(*key).map(i64::from);
            let node = at.map(|x| x / side);
            let mut sums = [0i128; 3];
            for d in 0..8i64 {
                let d = [d & 1, d >> 1 & 1, d >> 2];
                let offset = [0, 1, 2].map(|axis| 2 * (at[axis] - node[axis] * side) + 1);
                let weights = [0, 1, 2].map(|axis| {
                    if d[axis] == 1 {
                        offset[axis]
                    } else {
                        2 * side - offset[axis]
                    }
                });
                let corners = lattice.finest();
                let corner = corners.number([0, 1, 2].map(|axis| (node[axis] + d[axis]) as u32));
                let weight: i64 = weights.iter().product();
                for (sum, x) in sums.iter_mut().zip(corners.vectors[corner]) {
                    *sum += i128::from(weight) * i128::from(x);
                }
            }
            let shift = 3 * (top - level + 1) + unit - top;
            let moved =
                [0, 1, 2].map(|axis| 16 * i128::from(at[axis]) + ((16 * sums[axis] + (1 << (shift - 1))) >> shift));
            for d in 0..8i128 {
                let d = [d & 1, d >> 1 & 1, d >> 2];
                let share = |axis: usize| match d[axis] {
                    1 => moved[axis].rem_euclid(16),
                    _ => 16 - moved[axis].rem_euclid(16),
                };
                let weight = (share(0) * share(1) * share(2)) as i64;
                let place = [0, 1, 2].map(|axis| moved[axis].div_euclid(16) + d[axis]);
                if weight > 0 && place.iter().all(|x| (0..1 << top).contains(x)) {
                    let cell = cells.entry(morton::encode(place.map(|x| x as u32))).or_default();
                    cell.0 += weight;
                    (0..3).for_each(|t| cell.1[t] += weight * i64::from(previous.values[i][t]));
                }
            }
        }
        cells.retain(|_, (weight, _)| *weight >= 640);
        cells
    }

    proptest! {
        #[test]
        fn warped_frames_are_those_of_a_plain_search(
            top in 2u8..6,
            depth in 2u8..6,
            keys_of in prop::collection::vec(0u64..1 << 15, 1..300),
            turned in prop::array::uniform9(-3i16..4),
            shift in prop::array::uniform3(-20i16..21),
            least in LEAST..,
        ) {
            let (level, unit) = (top.saturating_sub(depth), top + 2);
            let side = 1i32 << (top - level);
            let (previous, voxels) = frame(top, keys_of.into_iter().map(|key| key & ((1 << (3 * top)) - 1)).collect());
            let lattice = lattice(&voxels, level, |at| [0, 1, 2].map(|axis| {
                let sum: i32 = (0..3).map(|i| i32::from(turned[3 * axis + i]) * at[i] as i32 * side / 8).sum();
                sum as i16 + shift[axis]
            }));
            let expected = plain(&previous, &voxels, &lattice, [top, unit]);
            match Scattered::new(&previous, &lattice, [top, unit]) {
                Err(error) => {
                    prop_assert_eq!(error.clause(), Some(TOO_MANY));
                    prop_assert!(expected.len() > 4 * voxels.len() + 64);
                }
                Ok(scattered) => { let warped = scattered.warped(least); for level in 0..=top {
                    let down = 3 * (top - level);
                    let mut nodes = BTreeMap::<u64, (i64, [i64; 3])>::new();
                    let mut there = BTreeSet::new();
                    for (key, (weight, sums)) in &expected {
                        let node = nodes.entry(key >> down).or_default();
                        node.0 += weight;
                        (0..3).for_each(|t| node.1[t] += sums[t]);
                        if *weight >= 16 * i64::from(least) {
                            there.insert(key >> down);
                        }
                    }
                    let found = warped.at(level).unwrap();
                    prop_assert_eq!(keys(found), nodes.keys().copied().collect::<Vec<_>>());
                    for (i, (key, (weight, sums))) in nodes.iter().enumerate() {
                        let colour = sums.map(|sum| (sum as f64 / *weight as f64 + 0.5).floor() as i16);
                        prop_assert_eq!(found.near.values[i], colour);
                        let place = morton::decode(*key).map(|x| x as i32);
                        prop_assert_eq!(found.voxels.index(place).is_some(), there.contains(key));
                    }
                }},
            }
        }
    }

    #[test]
    fn a_lattice_without_motion_leaves_all_as_it_is_and_whole_steps_move_it() {
        let (previous, voxels) = frame(5, (0..4000).map(|i| i * 7 % 32_768).collect());
        let still = Scattered::new(&previous, &lattice(&voxels, 3, |_| [0; 3]), [5, 7])
            .unwrap()
            .warped(128);
        assert_eq!(keys(still.at(5).unwrap()), voxels.keys());
        assert_eq!(still.at(5).unwrap().near.values, previous.values);
        let moved = Scattered::new(&previous, &lattice(&voxels, 3, |_| [4, -8, 0]), [5, 7])
            .unwrap()
            .warped(128);
        let (cells, colours) = moved.finest();
        for (key, colour) in cells.iter().zip(colours) {
            let [x, y, z] = morton::decode(*key).map(|x| x as i32);
            let index = previous.index([x - 1, y + 2, z]).expect("a voxel was there");
            assert_eq!(previous.values[index], colour);
        }
    }

    #[test]
    fn voxels_that_all_fall_apart_are_refused_by_their_number() {
        // Eight cells are near each of them, a quarter of a weight each.
        let (previous, voxels) = frame(6, (0..200).map(|i| i * 1237 % (1 << 18)).collect());
        let apart = lattice(&voxels, 4, |_| [2, 2, 2]);
        // An eighth of the weight for each of eight cells is less than makes them near; two axes give four of a quarter.
        assert!(
            keys(
                Scattered::new(&previous, &apart, [6, 8])
                    .unwrap()
                    .warped(128)
                    .at(6)
                    .unwrap()
            )
            .is_empty()
        );
        let apart = lattice(&voxels, 4, |_| [2, 2, 0]);
        let near = keys(
            Scattered::new(&previous, &apart, [6, 8])
                .unwrap()
                .warped(128)
                .at(6)
                .unwrap(),
        );
        assert!(near.len() > 2 * voxels.len(), "{}", near.len());
    }

    #[test]
    fn sums_that_leave_32_bits_are_added_in_64() {
        let (mut narrow, mut wide) = (vec![[0i32; 4]; CELLS], vec![[0i64; 4]; CELLS]);
        let voxels = |count: usize| std::iter::repeat_n(([35, 40, 48], [i16::MIN, i16::MAX, -7]), count);
        for (count, fits) in [(1, true), (39, true), (400, false), (100_000, false)] {
            let given = sums(&mut narrow, voxels(count), [0; 3], SIDE);
            assert_eq!(within_32_bits(&narrow, &given), fits, "{count}");
            assert_eq!(sums(&mut wide, voxels(count), [0; 3], SIDE), given);
            let [a, b] = [near(&mut narrow, given, 0), near(&mut wide, given, 0)];
            let sums = |cells: Vec<Cell>| {
                cells
                    .iter()
                    .map(|cell| (cell.key, cell.weight, cell.sums))
                    .collect::<Vec<_>>()
            };
            assert_eq!(sums(a) == sums(b), fits, "{count}");
        }
    }
}
