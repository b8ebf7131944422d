//! The pairs of output and input rows of one tile.

use super::children;
use super::lists::{Lists, fill_map};
#[cfg(target_arch = "x86_64")]
use super::lists_avx2;
use super::rows::TILE;
use super::taps::{ABSENT, Taps};
use crate::simd::Isa;

/// Room for each tap's pairs: a tile's rows, and what vectors write beyond the last.
const ROOM: usize = TILE + 8;

/// The pairs of output and input row of one tile, tap by tap.
#[derive(Default)]
pub(crate) struct TileTaps {
    /// Pairs of each tap.
    lengths: Vec<usize>,
    /// Input rows: [`ROOM`] places for each tap.
    inputs: Vec<u32>,
    /// Output rows within the tile, likewise.
    rows: Vec<u32>,
    /// For each output row, which taps read something.
    masks: Vec<u64>,
    /// One more than the last input row.
    end: usize,
    /// The tile's part of a map that is not there as a whole.
    map: Vec<u32>,
}

/// One tap's pairs, by ascending output row.
#[derive(Clone, Copy)]
pub(crate) struct Pairs<'a> {
    /// Input rows.
    pub inputs: &'a [u32],
    /// Output rows within the tile.
    pub rows: &'a [u32],
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
        self.inputs.resize(volume * ROOM, 0);
        self.rows.resize(volume * ROOM, 0);
        let mut end = 0;
        match *taps {
            Taps::Same => {
                for row in 0..count {
                    self.push(0, row, (first + row) as u32);
                }
                end = first + count;
            }
            Taps::Map { rows, .. } => {
                end = self.fill_from(isa, &rows[first * volume..(first + count) * volume]);
            }
            Taps::AllChildren { neighbours, .. } => {
                end = self.fill_made(isa, count * volume, |map| children::rows_of_all(neighbours, first, map));
            }
            Taps::Made { rows, .. } => {
                end = self.fill_made(isa, count * volume, |map| rows.fill(first, map));
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
        assert!(end <= inputs, "a tap reads row {}, but the input has {inputs}", end - 1);
        self.end = end;
    }

    /// The same of a part with so many entries, which `make` writes.
    fn fill_made(&mut self, isa: Isa, entries: usize, make: impl FnOnce(&mut [u32])) -> usize {
        let mut map = std::mem::take(&mut self.map);
        map.resize(entries, ABSENT);
        make(&mut map);
        let end = self.fill_from(isa, &map);
        self.map = map;
        end
    }

    /// Gathers the pairs of a tile's part of a map, and gives the end of the input rows.
    fn fill_from(&mut self, isa: Isa, map: &[u32]) -> usize {
        let lists = Lists {
            map,
            lengths: &mut self.lengths,
            inputs: &mut self.inputs,
            rows: &mut self.rows,
            masks: &mut self.masks,
            room: ROOM,
        };
        #[cfg(target_arch = "x86_64")]
        if let Some(avx2) = isa.avx2() {
            return lists_avx2::fill_map(avx2, lists);
        }
        let _ = isa;
        fill_map(lists)
    }

    #[inline(always)]
    fn push(&mut self, k: usize, row: usize, input: u32) {
        let length = &mut self.lengths[k];
        self.inputs[k * ROOM + *length] = input;
        self.rows[k * ROOM + *length] = row as u32;
        *length += 1;
        self.masks[row] |= 1 << k;
    }

    /// The pairs of tap `k`. Their rows are below the tile's count, their inputs below the input's.
    pub fn of(&self, k: usize) -> Pairs<'_> {
        Pairs {
            inputs: &self.inputs[k * ROOM..][..self.lengths[k]],
            rows: &self.rows[k * ROOM..][..self.lengths[k]],
        }
    }

    /// Taps of the kernel.
    pub fn volume(&self) -> usize {
        self.lengths.len()
    }

    /// One more than the last input row that a tap reads, or 0.
    pub fn end(&self) -> usize {
        self.end
    }

    /// For each row, bit k of its mask tells whether tap `k` reads something.
    pub fn masks(&self) -> &[u64] {
        &self.masks
    }
}
