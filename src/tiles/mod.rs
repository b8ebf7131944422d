//! Which ellipses touch which square of the picture, nearest first.
//!
//! The ellipses are dealt out to the tiles whose squares their bounds touch ([`Bins`]): counted run by run while they are projected,
//! then written, each as its depth and its place, in the order of the input. Each tile is put in the order of drawing only when it
//! is drawn, and only as far as light gets ([`Nearest`]): by the bits of the depth, which for positive floats is the order of the
//! depths, without loss, and then by place. So nothing depends on the order in which the threads write.
//!
//! An ellipse that fills the picture costs an entry for each tile: where there are too many, the picture is drawn in parts.

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
use crate::projection::{Bounds, Ellipse, Ellipses};

/// Entries of the tiles that are drawn in one part, if memory allows; more only where a single tile has more.
const MOST_ENTRIES: u64 = 1 << 25;

/// How many ellipses of one run touch each tile.
#[derive(Debug, Default)]
pub struct Count {
    /// One row and one column more than there are tiles: first, where counts begin and end; then counts; then where the run's next
    /// entry goes.
    tiles: Vec<u32>,
    pairs: u64,
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

    /// Bytes of the counts of as many runs.
    pub fn bytes(&self, runs: usize) -> u64 {
        let tiles = (self.columns as u64 + 1) * (self.rows as u64 + 1);
        tiles * (runs as u64 * size_of::<u32>() as u64 + size_of::<u64>() as u64)
    }
}

impl Count {
    /// Counts the ellipses of a run. Each is noted at the corners of what it touches; running sums then give every tile's count.
    pub fn count(&mut self, grid: Grid, ellipses: &[Ellipse]) {
        let stride = grid.columns + 1;
        self.tiles.clear();
        self.tiles.resize(stride * (grid.rows + 1), 0);
        self.pairs = 0;
        for ellipse in ellipses {
            let [x, y] = grid.touched(&ellipse.bounds);
            self.pairs += x.len() as u64 * y.len() as u64;
            for (row, step) in [(y.start, 1), (y.end, u32::MAX)] {
                let row = &mut self.tiles[row * stride..][..stride];
                row[x.start] = row[x.start].wrapping_add(step);
                row[x.end] = row[x.end].wrapping_sub(step);
            }
        }
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
}

/// Tiles that are drawn together: whole rows, or some of one row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Part {
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
    part: Option<Part>,
}

impl Bins {
    /// Sums up the `counts` of the runs, and decides how much is drawn at once.
    ///
    /// # Errors
    /// [`crate::Error::LimitExceeded`] before anything is reserved, if `reserved` bytes, the entries of the fullest tile, and room to
    /// sort it in every thread, are together more than `limits` allow.
    pub fn plan(
        &mut self,
        grid: Grid,
        counts: &[Count],
        reserved: u64,
        limits: &Limits,
    ) -> Result<u64> {
        self.grid = grid;
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
        let sorting = fullest * rayon::current_num_threads() as u64 * entry;
        let reserved = reserved.saturating_add(sorting);
        limits.check_bytes(
            "bytes to draw the picture",
            reserved.saturating_add(fullest * entry),
        )?;
        self.most = MOST_ENTRIES
            .min((limits.max_bytes - reserved) / entry)
            .max(fullest);
        Ok(counts.iter().map(|count| count.pairs).sum())
    }

    /// The part that follows `last`, or the first.
    pub fn next(&self, last: Option<&Part>) -> Option<Part> {
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
                return Some(Part {
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
        Some(Part {
            rows: row..row + 1,
            columns: first..column,
        })
    }

    /// Deals the ellipses out to the tiles of `part`; the memory is reused.
    pub fn fill(&mut self, part: Part, ellipses: &Ellipses, counts: &mut [Count]) {
        let Grid { columns, .. } = self.grid;
        let (width, stride) = (part.columns.len(), columns + 1);
        // Where each tile starts, and within it, each run.
        self.starts.clear();
        let mut next = 0;
        for row in part.rows.clone() {
            for column in part.columns.clone() {
                self.starts.push(next);
                let mut at = 0;
                for count in counts.iter_mut() {
                    let tile = &mut count.tiles[row * stride + column];
                    at += std::mem::replace(tile, at);
                }
                next += at as usize;
            }
        }
        self.starts.push(next);
        if self.entries.len() < next {
            // What is outgrown goes before its successor comes, which has no room to spare: memory is what was planned.
            self.entries = Vec::new();
            self.entries.reserve_exact(next);
            self.entries.resize_with(next, AtomicU64::default);
        }
        let (grid, starts, entries) = (self.grid, &self.starts, &self.entries);
        let all = ellipses.all();
        ellipses
            .runs()
            .zip(counts)
            .with_max_len(1)
            .for_each(|(run, count)| {
                let first = run.start;
                for (i, ellipse) in all[run].iter().enumerate() {
                    let key = u64::from(ellipse.depth.to_bits()) << 32 | (first + i) as u64;
                    let [x, y] = grid.touched(&ellipse.bounds);
                    for row in y.start.max(part.rows.start)..y.end.min(part.rows.end) {
                        let tiles = x.start.max(part.columns.start)..x.end.min(part.columns.end);
                        for column in tiles {
                            let next = &mut count.tiles[row * stride + column];
                            let tile =
                                (row - part.rows.start) * width + column - part.columns.start;
                            entries[starts[tile] + *next as usize].store(key, Ordering::Relaxed);
                            *next += 1;
                        }
                    }
                }
            });
        self.part = Some(part);
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
