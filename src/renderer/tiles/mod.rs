//! Which ellipses touch which square of the picture, nearest first.
//!
//! The ellipses are dealt out to the tiles whose squares their bounds touch ([`Bins`]): counted run by run while they
//! are projected, then written, each as its depth and its place, in the order of the input. Each tile is put in the
//! order of drawing only when it is drawn ([`Nearest`]): by the bits of the depth, which for positive floats is the
//! order of the depths, without loss, and then by place. So nothing depends on the order in which the threads write.
//!
//! An ellipse that fills the picture costs an entry for each tile: where there are too many, the picture is drawn in
//! parts.

mod nearest;
#[cfg(test)]
mod tests;

use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;

pub use b2p_kernels::splat::TILE;
pub use nearest::Nearest;

use crate::error::Result;
use crate::limits::Limits;
use crate::renderer::projection::{Bounds, Ellipse, Ellipses};

/// Entries of the tiles that are drawn in one part, if memory allows; more only where a single tile has more.
const MOST_ENTRIES: u64 = 1 << 25;

/// How many ellipses of one run touch each tile.
#[derive(Debug, Default)]
pub struct Count {
    /// One row and one column more than there are tiles: first, where counts begin and end; then counts; then where the
    /// run's next entry goes.
    tiles: Vec<u32>,
    /// For each ellipse of the run.
    touches: Vec<Touch>,
    pairs: u64,
}

/// What an ellipse needs to be dealt out.
#[derive(Debug, Clone, Copy)]
struct Touch {
    /// The depth's bits.
    depth: u32,
    /// Of the tiles that it may touch, the place of the first in [`Count::tiles`], and how many columns and rows they
    /// are.
    first: u32,
    columns: u32,
    rows: u32,
}

/// A picture's tiles.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
pub struct Grid {
    /// Column and row of the first, counted in tiles from the corner of the whole picture.
    pub first: [usize; 2],
    /// Tiles side by side.
    pub columns: usize,
    /// Rows of tiles.
    pub rows: usize,
}

impl Grid {
    /// The tiles that pixels of `window` are in.
    pub fn new(window: Bounds) -> Self {
        let [x, y] = touched(&window);
        Grid {
            first: [x.start, y.start],
            columns: x.len(),
            rows: y.len(),
        }
    }

    /// The columns and the rows of the tiles that `bounds` (not empty, within the grid) touch.
    #[inline]
    fn touched(&self, bounds: &Bounds) -> [Range<usize>; 2] {
        let [x, y] = touched(bounds);
        let [column, row] = self.first;
        [x.start - column..x.end - column, y.start - row..y.end - row]
    }

    /// Bytes of the counts of as many runs, their sums, and where tiles start.
    pub fn bytes(&self, runs: usize) -> u64 {
        let tiles = (self.columns as u64 + 1) * (self.rows as u64 + 1);
        let [counts, total, start] = [runs * size_of::<u32>(), size_of::<u32>(), size_of::<usize>()];
        tiles * (counts + total + start) as u64
    }
}

impl Count {
    /// Bytes per ellipse.
    pub const BYTES: u64 = size_of::<Touch>() as u64;

    /// Nothing is counted yet; there is room for a run of `length`.
    pub fn start(&mut self, grid: Grid, length: usize) {
        self.tiles.clear();
        self.tiles.resize((grid.columns + 1) * (grid.rows + 1), 0);
        self.touches.clear();
        self.touches.reserve_exact(length);
        self.pairs = 0;
    }

    /// Counts the next ellipses of the run. Each is noted at the corners of what it touches; running sums will give
    /// every tile's count.
    pub fn count(&mut self, grid: Grid, ellipses: &[Ellipse]) {
        let stride = grid.columns + 1;
        let tiles = &mut self.tiles[..];
        let touches = ellipses.iter().map(|ellipse| {
            let [x, y] = grid.touched(&ellipse.bounds);
            let [first, below] = [y.start, y.end].map(|row| row * stride + x.start);
            self.pairs += x.len() as u64 * y.len() as u64;
            for (at, step) in [(first, 1), (below, u32::MAX)] {
                let end = at + x.len();
                tiles[at] = tiles[at].wrapping_add(step);
                tiles[end] = tiles[end].wrapping_sub(step);
            }
            Touch {
                depth: ellipse.depth.to_bits(),
                first: first as u32,
                columns: x.len() as u32,
                rows: y.len() as u32,
            }
        });
        self.touches.extend(touches);
    }

    /// From corners to counts.
    fn sum(&mut self, grid: Grid) {
        let stride = grid.columns + 1;
        for row in self.tiles.chunks_exact_mut(stride) {
            let mut sum = 0u32;
            for tile in row {
                sum = sum.wrapping_add(*tile);
                *tile = sum;
            }
        }
        for i in stride..self.tiles.len() {
            self.tiles[i] = self.tiles[i].wrapping_add(self.tiles[i - stride]);
        }
    }

    /// Writes the keys of the run's ellipses, the first of which has the place `place`, to where the counts say by now.
    /// What touches up to 2×2 tiles, which is nearly everything, is written four times, some of them to where it
    /// already is: without a branch that may go either way.
    fn deal(&mut self, stride: usize, place: usize, entries: &[AtomicU64]) {
        let cursors = &mut self.tiles[..];
        for (i, touch) in self.touches.iter().enumerate() {
            let key = u64::from(touch.depth) << 32 | (place + i) as u64;
            let first = touch.first as usize;
            if touch.columns.max(touch.rows) <= 2 {
                let at = cursors[first];
                let [wide, high] = [touch.columns == 2, touch.rows == 2];
                for (off, there) in [(0, true), (1, wide), (stride, high), (stride + 1, wide & high)] {
                    let tile = if there { first + off } else { first };
                    let at = if there { cursors[tile] } else { at };
                    entries[at as usize].store(key, Ordering::Relaxed);
                    cursors[tile] = at + 1;
                }
            } else {
                for row in 0..touch.rows as usize {
                    let tiles = &mut cursors[first + row * stride..][..touch.columns as usize];
                    for next in tiles {
                        entries[*next as usize].store(key, Ordering::Relaxed);
                        *next += 1;
                    }
                }
            }
        }
    }

    /// As [`Count::deal`], of the tiles of `part` alone.
    fn deal_part(&mut self, stride: usize, place: usize, entries: &[AtomicU64], part: &TileBand) {
        for (i, touch) in self.touches.iter().enumerate() {
            let key = u64::from(touch.depth) << 32 | (place + i) as u64;
            let [row, column] = [touch.first as usize / stride, touch.first as usize % stride];
            let (rows, columns) = (row + touch.rows as usize, column + touch.columns as usize);
            for row in row.max(part.rows.start)..rows.min(part.rows.end) {
                for column in column.max(part.columns.start)..columns.min(part.columns.end) {
                    let next = &mut self.tiles[row * stride + column];
                    entries[*next as usize].store(key, Ordering::Relaxed);
                    *next += 1;
                }
            }
        }
    }
}

/// Tiles that are drawn together: whole rows, or some of one row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TileBand {
    /// Rows of tiles.
    pub rows: Range<usize>,
    /// Columns of tiles.
    pub columns: Range<usize>,
}

/// For every tile of a part, its ellipses, in no order.
#[derive(Debug, Default)]
pub struct Bins {
    grid: Grid,
    /// How many ellipses touch each tile.
    totals: Vec<u32>,
    /// Tile `t` of the part holds `entries[starts[t]..starts[t + 1]]`, counted row by row from the part's first.
    starts: Vec<usize>,
    /// The depth's bits above, the place below. Atomic because threads write side by side, each entry once.
    entries: Vec<AtomicU64>,
    most: u64,
    part: Option<TileBand>,
}

impl Bins {
    /// Sums up the `counts` of the runs, and decides how much is drawn at once.
    ///
    /// # Errors
    /// [`crate::Error::LimitExceeded`] before anything is reserved, if `reserved` bytes, the entries of the fullest
    /// tile, and room to sort it in every thread, are together more than `limits` allow; or if there are more pairs of
    /// an ellipse and a tile.
    pub fn plan(&mut self, grid: Grid, counts: &mut [Count], reserved: u64, limits: &Limits) -> Result<u64> {
        self.grid = grid;
        counts.par_iter_mut().for_each(|count| count.sum(grid));
        let counts = &*counts;
        let pairs = counts.iter().map(|count| count.pairs).sum();
        limits.check_pairs("pairs of Gaussians and tiles to draw", pairs)?;
        self.totals.clear();
        self.totals.resize(grid.columns * grid.rows, 0);
        let rows = self.totals.par_chunks_mut(grid.columns).enumerate();
        rows.for_each(|(row, totals)| {
            for count in counts {
                let run = &count.tiles[row * (grid.columns + 1)..];
                for (total, tile) in totals.iter_mut().zip(run) {
                    *total += tile;
                }
            }
        });
        let fullest = u64::from(self.totals.iter().copied().max().unwrap_or(0));
        let entry = size_of::<u64>() as u64;
        let sorting = fullest * rayon::current_num_threads() as u64 * Nearest::BYTES;
        let reserved = reserved.saturating_add(sorting);
        limits.check_bytes("bytes to draw the picture", reserved.saturating_add(fullest * entry))?;
        self.most = MOST_ENTRIES.min((limits.max_bytes - reserved) / entry).max(fullest);
        Ok(pairs)
    }

    /// The part that follows `last`, or the first.
    pub fn next(&self, last: Option<&TileBand>) -> Option<TileBand> {
        let Grid { columns, rows, .. } = self.grid;
        let (mut row, mut column) = match last {
            None => (0, 0),
            Some(part) if part.columns.end < columns => (part.rows.start, part.columns.end),
            Some(part) => (part.rows.end, 0),
        };
        if row >= rows || columns == 0 {
            return None;
        }
        let sum = |tiles: &[u32]| tiles.iter().copied().map(u64::from).sum::<u64>();
        let (start, mut entries) = (row, 0);
        if column == 0 {
            while row < rows {
                entries += sum(&self.totals[row * columns..][..columns]);
                if entries > self.most {
                    break;
                }
                row += 1;
            }
            if row > start {
                return Some(TileBand {
                    rows: start..row,
                    columns: 0..columns,
                });
            }
        }
        let (first, mut entries) = (column, 0);
        while column < columns {
            entries += u64::from(self.totals[row * columns + column]);
            if entries > self.most {
                break;
            }
            column += 1;
        }
        Some(TileBand {
            rows: row..row + 1,
            columns: first..column,
        })
    }

    /// Deals the ellipses out to the tiles of `part`; the memory is reused.
    ///
    /// # Errors
    /// [`crate::Error::OutOfMemory`].
    pub fn fill(&mut self, part: TileBand, ellipses: &Ellipses, counts: &mut [Count]) -> Result<()> {
        let Grid { columns, .. } = self.grid;
        let stride = columns + 1;
        // Where each tile starts, and within it, each run.
        self.starts.clear();
        let mut next = 0;
        for row in part.rows.clone() {
            for column in part.columns.clone() {
                self.starts.push(next);
                for count in counts.iter_mut() {
                    let tile = &mut count.tiles[row * stride + column];
                    // No part has 2³² entries: a tile has at most as many as there are ellipses, more tiles have fewer.
                    next += std::mem::replace(tile, next as u32) as usize;
                }
            }
        }
        self.starts.push(next);
        if self.entries.len() < next {
            // What is outgrown goes before its successor comes, which has no room to spare: memory is what was planned.
            self.entries = Vec::new();
            self.entries = bytemuck::try_zeroed_vec(next).map_err(|()| crate::Error::OutOfMemory {
                what: "the lists of the tiles",
                bytes: (next * size_of::<u64>()) as u64,
            })?;
        }
        let entries = &self.entries[..];
        let whole = part.rows.len() == self.grid.rows && part.columns.len() == columns;
        let runs = ellipses.runs().zip(counts).with_max_len(1);
        runs.for_each(|(run, count)| {
            if whole {
                count.deal(stride, run.start, entries);
            } else {
                count.deal_part(stride, run.start, entries, &part);
            }
        });
        self.part = Some(part);
        Ok(())
    }

    /// The ellipses of a tile of the part last filled.
    pub fn tile(&self, row: usize, column: usize) -> &[AtomicU64] {
        let Some(part) = &self.part else { return &[] };
        let tile = (row - part.rows.start) * part.columns.len() + column - part.columns.start;
        &self.entries[self.starts[tile]..self.starts[tile + 1]]
    }
}

/// The columns and the rows of the tiles that `bounds` (not empty) touch, counted from the corner of the picture.
#[inline]
fn touched(bounds: &Bounds) -> [Range<usize>; 2] {
    let tiles = |first: u32, end: u32| (first / TILE) as usize..end.div_ceil(TILE) as usize;
    [tiles(bounds.x0, bounds.x1), tiles(bounds.y0, bounds.y1)]
}
