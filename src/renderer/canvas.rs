//! What is drawn on, tile by tile.

use std::ops::Range;
use std::time::{Duration, Instant};

use b2p_kernels::Isa;
use b2p_kernels::splat::{Loop, Scene, Share, Tile};
use bytemuck::Zeroable;

use super::Background;
use crate::renderer::projection::Bounds;
use crate::renderer::tiles::{Bins, Grid, Nearest, TILE};

/// Side of the blocks that [`Share`] is about.
pub(super) const SIDE: usize = 4;

/// A picture's place and what is behind it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Canvas {
    /// The tiles, of samples.
    pub grid: Grid,
    /// The pixels.
    pub window: Bounds,
    /// Samples that a pixel is the mean of, along each side; it divides a tile's side.
    pub shrink: u32,
    pub background: Background,
}

/// What is drawn, and how.
#[derive(Debug, Clone, Copy)]
pub(super) struct Contents<'a> {
    pub isa: Isa,
    pub bins: &'a Bins,
    pub scene: Scene<'a>,
    /// The least α.
    pub floor: f32,
    pub what: Loop,
}

/// Buffers that one thread reuses from tile to tile.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    nearest: Nearest,
    tile: Tile,
    samples: Vec<[f32; 4]>,
    /// Of each of the tile's pixels, what [`Mixed`] adds up.
    sums: Vec<f32>,
    /// Samples that something was drawn on.
    pub touched: u64,
    pub sorting: Duration,
    pub blending: Duration,
}

/// What a picture is made of.
pub(super) trait Output: Sync {
    type Pixel: Copy + Zeroable + Send;

    /// What the loop over splats does in any case.
    const LOOP: Option<Loop>;

    /// Where nothing is drawn.
    fn empty(&self, background: Background) -> Self::Pixel;

    /// Before anything is drawn on the tile.
    fn start(&self, _scratch: &mut Scratch) {}

    /// After some splats were drawn on it; `corner` is its first pixel's place in the whole picture.
    fn look(&self, _scratch: &mut Scratch, _corner: [u32; 2]) {}

    /// Writes the wanted `part` of the tile into `rows` of `width` pixels each.
    fn write(
        &self,
        scratch: &mut Scratch,
        isa: Isa,
        canvas: &Canvas,
        part: Bounds,
        rows: &mut [Self::Pixel],
        width: usize,
    );
}

/// Red, green, blue and alpha.
pub(super) struct Colours;

impl Output for Colours {
    type Pixel = [f32; 4];

    const LOOP: Option<Loop> = None;

    fn empty(&self, background: Background) -> [f32; 4] {
        let [r, g, b, a] = background.behind();
        [r, g, b, 1.0 + a]
    }

    fn write(
        &self,
        scratch: &mut Scratch,
        isa: Isa,
        canvas: &Canvas,
        part: Bounds,
        rows: &mut [[f32; 4]],
        width: usize,
    ) {
        let size = [part.x1 - part.x0, part.y1 - part.y0];
        let behind = canvas.background.behind();
        let touched = if canvas.shrink == 1 {
            scratch.tile.write(isa, behind, rows, width)
        } else {
            scratch.samples.resize((TILE * TILE) as usize, [0.0; 4]);
            let stride = size[0] as usize;
            let touched = scratch.tile.write(isa, behind, &mut scratch.samples, stride);
            let samples = &scratch.samples[..stride * size[1] as usize];
            shrink(samples, stride, canvas.shrink as usize, rows, width);
            touched
        };
        scratch.touched += u64::from(touched);
    }
}

/// The index of a Gaussian.
pub(super) struct Indices;

impl Output for Indices {
    type Pixel = u32;

    const LOOP: Option<Loop> = Some(Loop::Ids);

    fn empty(&self, _: Background) -> u32 {
        u32::MAX
    }

    fn write(&self, scratch: &mut Scratch, _: Isa, _: &Canvas, _: Bounds, rows: &mut [u32], width: usize) {
        scratch.touched += u64::from(scratch.tile.write_ids(rows, width));
    }
}

/// What Gaussians have `N` numbers of, mixed as their colours would be.
pub(super) struct Mixed<F, const N: usize>(pub F);

impl<F: Fn(usize) -> [f32; N] + Sync, const N: usize> Output for Mixed<F, N> {
    type Pixel = [f32; N];

    const LOOP: Option<Loop> = Some(Loop::Shares);

    fn empty(&self, _: Background) -> [f32; N] {
        [0.0; N]
    }

    fn start(&self, scratch: &mut Scratch) {
        scratch.sums.clear();
        scratch.sums.resize((TILE * TILE) as usize * N, 0.0);
    }

    fn look(&self, scratch: &mut Scratch, _: [u32; 2]) {
        let (sums, _) = scratch.sums.as_chunks_mut::<N>();
        let mut last = None;
        for share in scratch.tile.shares() {
            // The blocks of a Gaussian come one after the other.
            let numbers = match last {
                Some((index, numbers)) if index == share.index => numbers,
                _ => (self.0)(share.index as usize),
            };
            last = Some((share.index, numbers));
            let [x, y] = share.at.map(|at| at as usize);
            for (row, weights) in share.weights.chunks_exact(SIDE).enumerate() {
                let pixels = &mut sums[(y + row) * TILE as usize + x..][..SIDE];
                for (sums, &weight) in pixels.iter_mut().zip(weights) {
                    if weight > 0.0 {
                        for (sum, x) in sums.iter_mut().zip(numbers) {
                            *sum += weight * x;
                        }
                    }
                }
            }
        }
    }

    fn write(&self, scratch: &mut Scratch, _: Isa, _: &Canvas, part: Bounds, rows: &mut [[f32; N]], width: usize) {
        let (sums, _) = scratch.sums.as_chunks::<N>();
        let columns = part.x0 as usize..part.x1 as usize;
        let lines = sums.chunks_exact(TILE as usize);
        let lines = lines.take(part.y1 as usize).skip(part.y0 as usize);
        for (line, row) in lines.zip(rows.chunks_mut(width)) {
            row[..columns.len()].copy_from_slice(&line[columns.clone()]);
        }
    }
}

impl Scratch {
    /// How much the tile's pixels show of what was drawn last.
    pub fn shares(&self) -> &[Share] {
        self.tile.shares()
    }

    /// Draws a tile into `band`, the pixels of its row of tiles.
    pub fn draw<O: Output>(
        &mut self,
        [column, row]: [usize; 2],
        canvas: &Canvas,
        contents: &Contents,
        output: &O,
        band: &mut [O::Pixel],
    ) {
        let Contents { isa, scene, .. } = *contents;
        let columns = canvas.columns(column);
        let width = canvas.width();
        let entries = contents.bins.tile(row, column);
        if entries.is_empty() {
            let empty = output.empty(canvas.background);
            for line in band.chunks_exact_mut(width) {
                line[columns.clone()].fill(empty);
            }
            return;
        }
        let start = Instant::now();
        self.nearest.take(entries);
        let sorted = Instant::now();
        let (corner, part) = canvas.tile([column, row]);
        self.tile.start(corner, part, contents.floor, contents.what);
        output.start(self);
        let nearest = std::mem::take(&mut self.nearest);
        nearest.each(|keys, next| {
            let open = self.tile.blend(isa, keys, next, scene);
            output.look(self, corner);
            open
        });
        self.nearest = nearest;
        self.tile.finish(isa);
        output.write(self, isa, canvas, part, &mut band[columns.start..], width);
        self.sorting += sorted - start;
        self.blending += sorted.elapsed();
    }
}

impl Canvas {
    /// Pixels in a row.
    pub fn width(&self) -> usize {
        (self.window.x1 - self.window.x0) as usize
    }

    /// The columns of the window's pixels that a column of tiles has.
    fn columns(&self, column: usize) -> Range<usize> {
        self.within(self.grid.first[0] + column, self.window.x0, self.window.x1)
    }

    /// The rows of the window's pixels that a row of tiles has.
    pub fn rows(&self, row: usize) -> Range<usize> {
        self.within(self.grid.first[1] + row, self.window.y0, self.window.y1)
    }

    /// Of the pixels of the tile that has the place `tile` in a row or column of the whole picture, those between `low`
    /// and `high`, counted from `low`.
    fn within(&self, tile: usize, low: u32, high: u32) -> Range<usize> {
        let side = TILE / self.shrink;
        let first = tile as u32 * side;
        let (start, end) = (first.max(low), (first + side).min(high));
        (start - low) as usize..(end - low) as usize
    }

    /// A tile's first sample in the whole picture, and its samples of the pixels that the window has.
    fn tile(&self, tile: [usize; 2]) -> ([u32; 2], Bounds) {
        let corner = [0, 1].map(|k| (self.grid.first[k] + tile[k]) as u32 * TILE);
        let (columns, rows) = (self.columns(tile[0]), self.rows(tile[1]));
        let x = |at: usize| (at as u32 + self.window.x0) * self.shrink - corner[0];
        let y = |at: usize| (at as u32 + self.window.y0) * self.shrink - corner[1];
        let part = Bounds {
            x0: x(columns.start),
            y0: y(rows.start),
            x1: x(columns.end),
            y1: y(rows.end),
        };
        (corner, part)
    }
}

/// The mean of `times`×`times` samples for each pixel. Both are given row by row, with the lengths of their rows.
fn shrink(samples: &[[f32; 4]], stride: usize, times: usize, pixels: &mut [[f32; 4]], width: usize) {
    let share = 1.0 / (times * times) as f32;
    let rows = samples.chunks_exact(stride * times);
    for (lines, row) in rows.zip(pixels.chunks_mut(width)) {
        for (x, pixel) in row.iter_mut().take(stride / times).enumerate() {
            let mut sum = [0.0; 4];
            for line in lines.chunks_exact(stride) {
                for sample in &line[x * times..][..times] {
                    for (sum, value) in sum.iter_mut().zip(sample) {
                        *sum += value;
                    }
                }
            }
            *pixel = sum.map(|sum| sum * share);
        }
    }
}
