//! The pixels of one tile, front to back.
//!
//! For each ellipse in order: `α = min(0.99, opacity·exp(−½d²))`; a pixel that lets through less than [`super::FINISHED`] is finished. Otherwise
//! `T` becomes `T' = T − α·T`, and the colour gains `(T − T')·colour`: a weight that is the difference of what is stored keeps the
//! weights' sum at 1 to a few units in the last place, however many layers there are.
//!
//! Splats are a few pixels wide, so a tile is cut into blocks of 4×4 pixels. For each splat, the blocks in which its α may reach the
//! floor are found all at once, a block to a lane (`layout.rs`), and of these the ones that still let light through are blended, a
//! pixel to a lane (`pixels.rs`). Within such a block every pixel is blended, however faint.

use super::lanes::{Lanes, by_level};
use super::layout::Work;
use super::pixels::{Best, Pending};
use super::{Bounds, Crossing, Ellipse};
use crate::Isa;
use crate::simd::{Simd, dispatch};

/// Side of a tile in pixels.
pub const TILE: u32 = 32;

/// Side of a block in pixels, and of a window in blocks.
pub(super) const SIDE: u32 = 4;
/// Pixels of a block, and blocks of a window.
pub(super) const AREA: usize = 16;
/// Blocks side by side in a tile, and all of them.
pub(super) const BLOCKS: u32 = TILE / SIDE;
pub(super) const ALL_BLOCKS: usize = (BLOCKS * BLOCKS) as usize;

/// What the loop over a tile's splats does beyond blending ellipses. Each is compiled by itself.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Loop {
    /// Nothing.
    #[default]
    Plain,
    /// Blends [`Crossing`] Gaussians too.
    Care,
    /// That, and puts the splats of each pixel in the order of their depths there, as far as [`super::WAITING`] of them reach.
    Order,
    /// As `Care`, and keeps which Gaussian each pixel shows most of.
    Ids,
    /// As `Care`, and keeps how much of each Gaussian each pixel shows, for whoever mixes something else than colours.
    Shares,
}

pub(super) const PLAIN: u8 = 0;
pub(super) const CARE: u8 = 1;
pub(super) const ORDER: u8 = 2;
pub(super) const IDS: u8 = 3;
pub(super) const SHARES: u8 = 4;

/// What there is to blend.
#[derive(Debug, Clone, Copy)]
pub struct Scene<'a> {
    /// The ellipses.
    pub all: &'a [Ellipse],
    /// Those of them that cross the near plane, by index; not for [`Loop::Plain`].
    pub crossing: &'a [Crossing],
    /// For each ellipse, how its depth changes by pixel to the right and down; for [`Loop::Order`] alone.
    pub slopes: &'a [[f32; 2]],
}

/// 4×4 pixels.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct Block {
    /// Transmittance: the share of what lies behind that is still seen.
    pub through: [f32; AREA],
    /// Red, green and blue so far.
    pub colour: [[f32; AREA]; 3],
}

const CLEAR: Block = Block {
    through: [1.0; AREA],
    colour: [[0.0; AREA]; 3],
};

/// How much of a Gaussian the pixels of a block show.
#[derive(Debug, Clone, Copy)]
pub struct Share {
    /// The Gaussian's index in the input.
    pub index: u32,
    /// Column and row of the block's first pixel in the tile.
    pub at: [u32; 2],
    /// Of each of its 4×4 pixels, row by row.
    pub weights: [f32; AREA],
}

/// A tile being drawn: [`TILE`]² pixels.
#[derive(Debug, Clone)]
pub struct Tile {
    pub(super) blocks: [Block; ALL_BLOCKS],
    /// The blocks, row by row, that are in the picture and still let light through.
    pub(super) open: u64,
    pub(super) corner: [u32; 2],
    /// The pixels that are wanted.
    part: Bounds,
    /// `log₂` of the least α that is drawn, and it itself.
    pub(super) floor: f32,
    pub(super) least: f32,
    pub(super) work: Work,
    what: Loop,
    /// For each block, with [`Loop::Order`].
    pub(super) pending: Vec<Pending>,
    /// For each block, with [`Loop::Ids`].
    pub(super) best: Vec<Best>,
    /// Of what was blended last, with [`Loop::Shares`].
    pub(super) shares: Vec<Share>,
}

impl Default for Tile {
    fn default() -> Self {
        Tile {
            blocks: [CLEAR; ALL_BLOCKS],
            open: 0,
            corner: [0; 2],
            part: Bounds::default(),
            floor: 0.0,
            least: 1.0,
            work: Work::NONE,
            what: Loop::Plain,
            pending: Vec::new(),
            best: Vec::new(),
            shares: Vec::new(),
        }
    }
}

impl Tile {
    /// Clears it and puts its first pixel at `corner`; of its pixels, those of `part`, counted from there, are wanted. An α below
    /// `floor` may be left out.
    ///
    /// # Panics
    /// If the part is empty or reaches out of the tile.
    pub fn start(&mut self, corner: [u32; 2], part: Bounds, floor: f32, what: Loop) {
        let Bounds { x0, y0, x1, y1 } = part;
        assert!(x0 < x1 && x1 <= TILE && y0 < y1 && y1 <= TILE);
        self.blocks.fill(CLEAR);
        self.corner = corner;
        self.floor = floor.log2();
        self.least = floor;
        self.work.items = 0;
        let (first, end) = (|at: u32| at / SIDE, |at: u32| at.div_ceil(SIDE));
        self.open = rectangle(first(x0), end(x1), first(y0), end(y1));
        self.part = part;
        self.what = what;
        self.pending.clear();
        self.best.clear();
        match what {
            Loop::Plain | Loop::Care | Loop::Shares => {}
            Loop::Order => self.pending.resize(ALL_BLOCKS, Pending::NONE),
            Loop::Ids => self.best.resize(ALL_BLOCKS, Best::NONE),
        }
    }

    /// Blends ellipses, nearest first: those of the scene that the lower halves of `keys` number. False once every pixel is finished.
    /// `next`: what will probably be blended after these, to be fetched already.
    ///
    /// # Panics
    /// If there is no such ellipse, or the scene lacks what the loop needs of it.
    pub fn blend(&mut self, isa: Isa, keys: &[u64], next: &[u64], scene: Scene) -> bool {
        self.shares.clear();
        if self.open != 0 {
            match self.what {
                Loop::Plain => self.run::<PLAIN>(isa, keys, next, scene),
                Loop::Care => self.run::<CARE>(isa, keys, next, scene),
                Loop::Order => self.run::<ORDER>(isa, keys, next, scene),
                Loop::Ids => self.run::<IDS>(isa, keys, next, scene),
                Loop::Shares => self.run::<SHARES>(isa, keys, next, scene),
            }
        }
        self.open != 0
    }

    /// With [`Loop::Shares`], how much the pixels show of what the last call of [`Tile::blend`] put on them: in each pixel, all shares of a
    /// picture and the transmittance that is left are together 1.
    pub fn shares(&self) -> &[Share] {
        &self.shares
    }

    fn run<const WHAT: u8>(&mut self, isa: Isa, keys: &[u64], next: &[u64], scene: Scene) {
        let tile = self;
        by_level!(isa, fn body<const WHAT: u8>(tile: &mut Tile, keys: &[u64], next: &[u64], scene: Scene));
    }

    /// Blends what still waits for something nearer. To be called when there is nothing more to blend.
    pub fn finish(&mut self, isa: Isa) {
        if self.what == Loop::Order {
            let tile = self;
            by_level!(isa, fn flush(tile: &mut Tile));
        }
    }

    /// Writes the wanted part of the tile's pixels into `rows`, whose first is the part's first and of which each is `stride` pixels
    /// long: premultiplied colour and transmittance, of which each channel takes `behind` times the transmittance and alpha one more.
    /// How many of them something was drawn on.
    ///
    /// # Panics
    /// If `rows` do not hold the part.
    pub fn write(&self, isa: Isa, behind: [f32; 4], rows: &mut [[f32; 4]], stride: usize) -> u32 {
        let (tile, mut drawn) = (self, 0);
        let count = &mut drawn;
        dispatch!(isa, fn write(tile: &Tile, behind: [f32; 4], rows: &mut [[f32; 4]], stride: usize, count: &mut u32));
        drawn
    }

    /// Writes which Gaussian each pixel of the wanted part shows most of, [`u32::MAX`] for none, as [`Tile::write`] does colours, and
    /// counts as that does.
    ///
    /// # Panics
    /// If `rows` do not hold the part, or the loop was not [`Loop::Ids`].
    pub fn write_ids(&self, rows: &mut [u32], stride: usize) -> u32 {
        let mut drawn = 0;
        let Bounds { x0, y0, x1, y1 } = self.part;
        for (y, row) in (y0..y1).zip(rows.chunks_mut(stride)) {
            for (x, id) in (x0..x1).zip(row) {
                let block = &self.best[(y / SIDE * BLOCKS + x / SIDE) as usize];
                *id = block.id[(y % SIDE * SIDE + x % SIDE) as usize].to_bits();
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
        let blocks = &tile.blocks[y / side * BLOCKS as usize..][..BLOCKS as usize];
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
            let through = part(&block.through);
            let [r, g, b] = [0, 1, 2].map(|k| part(&block.colour[k]));
            let mixed: [[f32; 4]; SIDE as usize] = std::array::from_fn(|i| {
                let t = through[i];
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
            let seen = &through[first..end];
            *count += seen.iter().map(|&t| u32::from(t < 1.0)).sum::<u32>();
        }
    }
}

/// The bits of the blocks in the columns `x0..x1` and the rows `y0..y1`.
#[inline(always)]
pub(super) fn rectangle(x0: u32, x1: u32, y0: u32, y1: u32) -> u64 {
    if x0 >= x1 || y0 >= y1 {
        return 0;
    }
    let row = (0xff >> (BLOCKS - (x1 - x0))) << x0;
    let rows = (!0 >> (BLOCKS * (BLOCKS - (y1 - y0)))) << (BLOCKS * y0);
    (row * 0x0101_0101_0101_0101) & rows
}

#[inline(always)]
fn body<L: Lanes, const WHAT: u8>(tile: &mut Tile, keys: &[u64], next: &[u64], scene: Scene) {
    tile.work_through::<L, WHAT>(keys, next, scene);
}

#[inline(always)]
fn flush<L: Lanes>(tile: &mut Tile) {
    for (block, pending) in tile.blocks.iter_mut().zip(&tile.pending) {
        pending.blend::<L>(block);
    }
}
