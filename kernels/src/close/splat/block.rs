//! What a tile is made of: blocks of 4×4 pixels, and what is put on them.

use super::ellipse::{Crossing, Ellipse};

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
    RaySpace,
    /// That, and puts the splats of each pixel in the order of their depths there, as far as [`super::WAITING`] of them
    /// reach.
    Order,
    /// As `RaySpace`, and keeps which Gaussian each pixel shows most of.
    Ids,
    /// As `RaySpace`, and keeps how much of each Gaussian each pixel shows, for whoever mixes something else than
    /// colours.
    Shares,
}

pub(super) const PLAIN: u8 = 0;
pub(super) const RAY_SPACE: u8 = 1;
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

pub(super) const CLEAR: Block = Block {
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

/// Column and row of the pixels of a block, counted from its middle.
pub(super) const COLUMNS: [f32; AREA] = lane_places(false, 1.0, 1.5);
pub(super) const ROWS: [f32; AREA] = lane_places(true, 1.0, 1.5);
pub(super) const fn lane_places(row: bool, step: f32, middle: f32) -> [f32; AREA] {
    let mut places = [0.0; AREA];
    let mut i = 0;
    while i < AREA {
        let place = if row { i / SIDE as usize } else { i % SIDE as usize };
        places[i] = place as f32 * step - middle;
        i += 1;
    }
    places
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

/// What all blocks of an ellipse share.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct Splat {
    /// The form at the pixels of a block, less what it is in the middle.
    pub u: [f32; AREA],
    pub v: [f32; AREA],
    pub log_opacity: f32,
    pub colour: [f32; 3],
}

/// Per-splat data that only the loops of effects need.
#[derive(Debug, Clone, Copy)]
pub(super) struct EffectData {
    /// Its place among the [`super::Crossing`], or [`usize::MAX`].
    pub crossing: usize,
    /// Depth at the tile's first pixel's corner, and its change by pixel to the right and down.
    pub depth: [f32; 3],
    /// The Gaussian's index in the input.
    pub index: u32,
}
