//! Which input rows each output row reads, and through which tap of the kernel.

use crate::isa::{Isa, dispatch};
use crate::rows::TILE;

/// Marks a tap that reads nothing.
pub const ABSENT: u32 = u32::MAX;

/// The rule that gives every output row its input rows.
#[derive(Debug, Clone, Copy)]
pub enum Taps<'a> {
    /// One tap: row `i` reads row `i`. A linear layer.
    Same,
    /// `volume` taps: entry `i·volume + k` is the row that row `i` reads through tap `k`, or [`ABSENT`].
    Map {
        /// Taps of the kernel.
        volume: usize,
        /// One entry per output row and tap.
        rows: &'a [u32],
    },
    /// Eight taps, of which row `i` uses only `octants[i]`, to read row `parents[i]`.
    Octants {
        /// The row of each row's parent.
        parents: &'a [u32],
        /// Each row's place in its parent, 0..8.
        octants: &'a [u8],
    },
    /// Eight taps: row `8p + o` reads row `p` through tap `o`. All children of every voxel.
    Children,
}

impl Taps<'_> {
    /// Taps of the kernel.
    pub fn volume(&self) -> usize {
        match self {
            Taps::Same => 1,
            Taps::Map { volume, .. } => *volume,
            Taps::Octants { .. } | Taps::Children => 8,
        }
    }
}

/// The pairs of output and input row of one tile, tap by tap.
#[derive(Default)]
pub(crate) struct TileTaps {
    lengths: Vec<u32>,
    /// `TILE` places for each tap, and some to spare.
    pairs: Vec<Pair>,
    /// For each output row, which taps read something.
    masks: Vec<u64>,
}

#[derive(Debug, Default, Clone, Copy)]
pub(crate) struct Pair {
    /// Output row within the tile.
    pub row: u32,
    /// Input row.
    pub input: u32,
}

impl TileTaps {
    /// Gathers the pairs of output rows `first .. first + count`, at most [`TILE`] of them.
    ///
    /// # Panics
    /// If a tap reads row `inputs` or one beyond, or the rows are not all there.
    pub fn fill(&mut self, isa: Isa, taps: &Taps<'_>, first: usize, count: usize, inputs: usize) {
        assert!(count <= TILE, "a tile has {count} rows");
        let volume = taps.volume();
        self.lengths.clear();
        self.lengths.resize(volume, 0);
        self.masks.clear();
        self.masks.resize(count, 0);
        self.pairs.resize(volume * TILE, Pair::default());
        let mut end = 0;
        match *taps {
            Taps::Same => {
                for row in 0..count {
                    self.push(0, row, (first + row) as u32);
                }
                end = first + count;
            }
            Taps::Map { rows, .. } => {
                let rows = &rows[first * volume..(first + count) * volume];
                let (tile, past) = (&mut *self, &mut end);
                dispatch!(isa, fn fill_map(tile: &mut TileTaps, volume: usize, rows: &[u32], past: &mut usize));
            }
            Taps::Octants { parents, octants } => {
                let (parents, octants) = (&parents[first..][..count], &octants[first..][..count]);
                for (row, (&parent, &octant)) in parents.iter().zip(octants).enumerate() {
                    if octant < 8 {
                        self.push(usize::from(octant), row, parent);
                        end = end.max(parent as usize + 1);
                    }
                }
            }
            Taps::Children => {
                for row in 0..count {
                    self.push((first + row) % 8, row, ((first + row) / 8) as u32);
                }
                end = (first + count).div_ceil(8);
            }
        }
        assert!(
            end <= inputs,
            "a tap reads row {}, but the input has {inputs}",
            end - 1
        );
    }

    #[inline(always)]
    fn push(&mut self, k: usize, row: usize, input: u32) {
        let length = &mut self.lengths[k];
        self.pairs[k * TILE + *length as usize] = Pair {
            row: row as u32,
            input,
        };
        *length += 1;
        self.masks[row] |= 1 << k;
    }

    /// The pairs of tap `k`, by ascending output row. Their rows are below the tile's count, their inputs below the input's.
    pub fn of(&self, k: usize) -> &[Pair] {
        &self.pairs[k * TILE..][..self.lengths[k] as usize]
    }

    /// For each row, bit k of its mask tells whether tap `k` reads something.
    pub fn masks(&self) -> &[u64] {
        &self.masks
    }
}

#[inline(always)]
fn fill_map(tile: &mut TileTaps, volume: usize, rows: &[u32], past: &mut usize) {
    for k in 0..volume {
        let pairs = &mut tile.pairs[k * TILE..][..TILE];
        let mut length = 0;
        for (row, (taps, mask)) in rows.chunks_exact(volume).zip(&mut tile.masks).enumerate() {
            let input = taps[k];
            let used = input != ABSENT;
            // Written in any case, kept only if used: a branch here would be mispredicted.
            pairs[length] = Pair {
                row: row as u32,
                input,
            };
            length += usize::from(used);
            *mask |= u64::from(used) << k;
            *past = (*past).max((input.wrapping_add(1)) as usize);
        }
        tile.lengths[k] = length as u32;
    }
}
