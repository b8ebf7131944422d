//! The pixels of one tile, front to back.
//!
//! For each ellipse in order: `α = min(0.99, opacity·exp(−½d²))`; a pixel of a transmittance below [`super::FINISHED`]
//! is finished. Otherwise `T` becomes `T' = T − α·T`, and the colour gains `(T − T')·colour`: a weight that is the
//! difference of what is stored keeps the weights' sum at 1 to a few units in the last place, however many layers there
//! are.
//!
//! Splats are a few pixels wide, so a tile is cut into blocks of 4×4 pixels. For each splat, the blocks in which its α
//! may reach the floor are found all at once, a block to a lane (`layout.rs`), and of these the ones that are not
//! finished are blended, a pixel to a lane (`pixels.rs`). Within such a block every pixel is blended, however faint.

use super::block::{
    ALL_BLOCKS, AREA, BLOCKS, CLEAR, IDS, Loop, ORDER, PLAIN, RAY_SPACE, SHARES, SIDE, Scene, Share, TILE, rectangle,
};
use super::ellipse::Bounds;
use super::layout::Canvas;
use super::pixels::{Best, Pending};
use crate::simd::{Isa, Simd, dispatch};

/// A tile being drawn: [`TILE`]² pixels.
#[derive(Debug, Clone)]
pub struct Tile {
    canvas: Canvas,
    /// The pixels that are wanted.
    part: Bounds,
    what: Loop,
}

impl Default for Tile {
    fn default() -> Self {
        Tile {
            canvas: Canvas::CLEAR,
            part: Bounds::default(),
            what: Loop::Plain,
        }
    }
}

impl Tile {
    /// Clears it and puts its first pixel at `corner`; of its pixels, those of `part`, counted from there, are wanted.
    /// An α below `floor` may be left out.
    ///
    /// # Panics
    /// If the part is empty or reaches out of the tile.
    pub fn start(&mut self, corner: [u32; 2], part: Bounds, floor: f32, what: Loop) {
        let Bounds { x0, y0, x1, y1 } = part;
        assert!(x0 < x1 && x1 <= TILE && y0 < y1 && y1 <= TILE);
        let canvas = &mut self.canvas;
        canvas.blocks.fill(CLEAR);
        canvas.corner = corner;
        canvas.floor = floor.log2();
        canvas.least = floor;
        canvas.work.items = 0;
        let (first, end) = (|at: u32| at / SIDE, |at: u32| at.div_ceil(SIDE));
        canvas.open = rectangle(first(x0), end(x1), first(y0), end(y1));
        self.part = part;
        self.what = what;
        canvas.pending.clear();
        canvas.best.clear();
        match what {
            Loop::Plain | Loop::RaySpace | Loop::Shares => {}
            Loop::Order => canvas.pending.resize(ALL_BLOCKS, Pending::NONE),
            Loop::Ids => canvas.best.resize(ALL_BLOCKS, Best::NONE),
        }
    }

    /// Blends ellipses, nearest first: those of the scene that the lower halves of `keys` number. False once every
    /// pixel is finished. `next`: what will probably be blended after these, to be fetched already.
    ///
    /// # Panics
    /// If there is no such ellipse, or the scene lacks what the loop needs of it.
    pub fn blend(&mut self, isa: Isa, keys: &[u64], next: &[u64], scene: Scene) -> bool {
        self.canvas.shares.clear();
        if self.canvas.open != 0 {
            match self.what {
                Loop::Plain => self.run::<PLAIN>(isa, keys, next, scene),
                Loop::RaySpace => self.run::<RAY_SPACE>(isa, keys, next, scene),
                Loop::Order => self.run::<ORDER>(isa, keys, next, scene),
                Loop::Ids => self.run::<IDS>(isa, keys, next, scene),
                Loop::Shares => self.run::<SHARES>(isa, keys, next, scene),
            }
        }
        self.canvas.open != 0
    }

    /// With [`Loop::Shares`], how much the pixels show of what the last call of [`Tile::blend`] put on them: in each
    /// pixel, all shares of a picture and the transmittance that is left are together 1.
    pub fn shares(&self) -> &[Share] {
        &self.canvas.shares
    }

    fn run<const WHAT: u8>(&mut self, isa: Isa, keys: &[u64], next: &[u64], scene: Scene) {
        let canvas = &mut self.canvas;
        dispatch!(isa, fn body<; const WHAT: u8>(canvas: &mut Canvas, keys: &[u64], next: &[u64], scene: Scene));
    }

    /// Blends what still waits for something nearer. To be called when there is nothing more to blend.
    pub fn finish(&mut self, isa: Isa) {
        if self.what == Loop::Order {
            let canvas = &mut self.canvas;
            dispatch!(isa, fn flush(canvas: &mut Canvas));
        }
    }

    /// Writes the wanted part of the tile's pixels into `rows`, whose first is the part's first and of which each is
    /// `stride` pixels long: premultiplied colour and transmittance, of which each channel takes `behind` times the
    /// transmittance and alpha one more. How many of them something was drawn on.
    ///
    /// # Panics
    /// If `rows` do not hold the part.
    pub fn write(&self, isa: Isa, behind: [f32; 4], rows: &mut [[f32; 4]], stride: usize) -> u32 {
        let (tile, mut drawn) = (self, 0);
        let count = &mut drawn;
        dispatch!(isa, fn write(tile: &Tile, behind: [f32; 4], rows: &mut [[f32; 4]], stride: usize, count: &mut u32));
        drawn
    }

    /// Writes which Gaussian each pixel of the wanted part shows most of, [`u32::MAX`] for none, as [`Tile::write`]
    /// does colours, and counts as that does.
    ///
    /// # Panics
    /// If `rows` do not hold the part, or the loop was not [`Loop::Ids`].
    pub fn write_ids(&self, rows: &mut [u32], stride: usize) -> u32 {
        let mut drawn = 0;
        let Bounds { x0, y0, x1, y1 } = self.part;
        for (y, row) in (y0..y1).zip(rows.chunks_mut(stride)) {
            for (x, id) in (x0..x1).zip(row) {
                let block = &self.canvas.best[(y / SIDE * BLOCKS + x / SIDE) as usize];
                *id = block.id((y % SIDE * SIDE + x % SIDE) as usize);
                drawn += u32::from(*id != u32::MAX);
            }
        }
        drawn
    }
}

#[inline(always)]
fn write<S: Simd>(_: S, tile: &Tile, behind: [f32; 4], rows: &mut [[f32; 4]], stride: usize, count: &mut u32) {
    let side = SIDE as usize;
    let [x0, y0, x1, y1] = {
        let Bounds { x0, y0, x1, y1 } = tile.part;
        [x0 as usize, y0 as usize, x1 as usize, y1 as usize]
    };
    for (y, row) in (y0..y1).zip(rows.chunks_mut(stride)) {
        let blocks = &tile.canvas.blocks[y / side * BLOCKS as usize..][..BLOCKS as usize];
        let lanes = y % side * side;
        let mut row = &mut row[..x1 - x0];
        for (i, block) in blocks.iter().enumerate().skip(x0 / side) {
            if row.is_empty() {
                break;
            }
            // Of the block's columns, from the first to the end that the part has.
            let first = x0.saturating_sub(i * side);
            let end = (x1 - i * side).min(side);
            let pixels;
            (pixels, row) = row.split_at_mut(end - first);
            let part = |from: &[f32; AREA]| -> [f32; SIDE as usize] { std::array::from_fn(|i| from[lanes + i]) };
            let transmittance = part(&block.through);
            let [r, g, b] = [0, 1, 2].map(|k| part(&block.colour[k]));
            let mixed: [[f32; 4]; SIDE as usize] = std::array::from_fn(|i| {
                let t = transmittance[i];
                [
                    r[i] + t * behind[0],
                    g[i] + t * behind[1],
                    b[i] + t * behind[2],
                    1.0 + t * behind[3],
                ]
            });
            match <&mut [[f32; 4]; SIDE as usize]>::try_from(&mut *pixels) {
                Ok(pixels) => *pixels = mixed,
                Err(_) => pixels.copy_from_slice(&mixed[first..end]),
            }
            let seen = &transmittance[first..end];
            *count += seen.iter().map(|&t| u32::from(t < 1.0)).sum::<u32>();
        }
    }
}

#[inline(always)]
fn body<S: Simd, const WHAT: u8>(simd: S, canvas: &mut Canvas, keys: &[u64], next: &[u64], scene: Scene) {
    canvas.work_through::<_, WHAT>(simd, keys, next, scene);
}

#[inline(always)]
fn flush<S: Simd>(simd: S, canvas: &mut Canvas) {
    for (block, pending) in canvas.blocks.iter_mut().zip(&canvas.pending) {
        pending.blend(simd, block);
    }
}
