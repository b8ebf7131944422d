//! A layer's weights in tiles, and the memory of a thread that multiplies by them.

use super::pairing;
use super::tiles::{LINE, TILE};
use crate::sparse::rows::{Extents, PANEL, Words};

/// Tiles of weights that the first cache holds besides rows and products.
const CACHED: usize = 28;

/// What is in the tiles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Scheme {
    /// High digits, low ones and their sums in three passes of a tile row each 64 channels.
    Digits,
    /// 32 high digits and 32 low ones in a tile row, which meet three tiles of weights: columns of high, mixed and low
    /// products.
    Both,
    /// 32 channels of two taps in a tile row, of one digit: see [`super::pairs`].
    Pairs,
    /// 32 channels in bf16.
    Bf16,
}

/// A layer's weights in tiles.
#[derive(Debug, Clone)]
pub(crate) struct Weights {
    pub extents: Extents,
    pub(super) scheme: Scheme,
    /// `[pass][tap][chunk][column]` tiles: four input bytes of one output channel are a word.
    pub(super) tiles: Vec<Words>,
    /// Of each tap, its pair and half, if taps are multiplied in pairs.
    pub(super) homes: Vec<[usize; 2]>,
}

impl Weights {
    pub fn new(extents: Extents, scheme: Scheme) -> Weights {
        let mut weights = Weights {
            extents,
            scheme,
            tiles: Vec::new(),
            homes: pairing::homes(extents.volume),
        };
        let taps = match scheme {
            Scheme::Pairs => extents.volume.div_ceil(2),
            _ => extents.volume,
        };
        let tiles = weights.passes() * taps * weights.chunks() * weights.columns();
        weights.tiles.resize(tiles * TILE, Words::default());
        weights
    }

    /// Passes over a group's rows, each of its own tile rows.
    pub(super) fn passes(&self) -> usize {
        match self.scheme {
            Scheme::Digits => 3,
            Scheme::Both | Scheme::Pairs | Scheme::Bf16 => 1,
        }
    }

    /// Tile rows that an input row takes in each pass.
    pub(super) fn chunks(&self) -> usize {
        match self.scheme {
            Scheme::Digits => self.extents.cin.div_ceil(LINE),
            Scheme::Both | Scheme::Pairs | Scheme::Bf16 => self.extents.cin.div_ceil(LINE / 2),
        }
    }

    /// Columns of tiles in each pass.
    pub(super) fn columns(&self) -> usize {
        match self.scheme {
            Scheme::Both | Scheme::Pairs => 3 * self.extents.panels(),
            Scheme::Digits | Scheme::Bf16 => self.extents.panels(),
        }
    }

    /// Columns that are multiplied at once: as many in each block.
    pub(super) fn width(&self) -> usize {
        let most = if self.scheme == Scheme::Both { 6 } else { 4 };
        let blocks = self.columns().div_ceil(most);
        self.columns().div_ceil(blocks)
    }

    /// Taps that all groups are multiplied by before the next ones, at so many columns.
    pub(super) fn taps(&self, width: usize) -> usize {
        match self.scheme {
            // Rows are short: their sums would be stored and loaded too often.
            Scheme::Both | Scheme::Pairs => self.extents.volume,
            Scheme::Digits | Scheme::Bf16 => (CACHED / width).max(1),
        }
    }

    /// The words, one for each output channel of a column, that multiply the bytes from `byte` on of a tap's tile rows.
    pub fn words(&mut self, pass: usize, tap: usize, byte: usize, column: usize) -> &mut [u32; PANEL] {
        let (chunk, byte) = (byte / LINE, byte % LINE);
        let tap = pass * self.extents.volume + tap;
        let tile = (tap * self.chunks() + chunk) * self.columns() + column;
        &mut self.tiles[tile * TILE + byte / 4].0
    }
}

/// Memory that a thread reuses.
#[derive(Default)]
pub(crate) struct Buffers {
    /// The input rows that a tile reads, as tile rows, and a row of zeros: `[pass][row][chunk]`.
    pub rows: Vec<Words>,
    /// What a group multiplies now, and what next.
    pub(super) gathered: Vec<Words>,
    /// The products: `[pass][block of columns][group][column]` tiles.
    pub(super) products: Vec<Words>,
    /// What [`super::pairs`] multiplies.
    pub(super) steps: pairing::Steps,
}
