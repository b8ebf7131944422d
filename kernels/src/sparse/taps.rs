//! Which input rows each output row reads, and through which tap of the kernel.

use super::children;
#[cfg(target_arch = "x86_64")]
use super::lists;
use super::plan::Plan;
use super::rows::TILE;
#[cfg(target_arch = "x86_64")]
use crate::simd::Simd;
use crate::simd::{Isa, Level};

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
        /// The same, arranged for [`Isa`]s.
        plan: Option<&'a Plan>,
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
    /// 27 taps: row `8p + o` is the child in octant `o` of voxel `p`, and reads the children of `p` and its neighbours around it. All
    /// children of every voxel.
    AllChildren {
        /// Entry `p·27 + k` is the neighbour of voxel `p` at offset `k`, x fastest, or [`ABSENT`].
        neighbours: &'a [u32],
        /// The rows, arranged for [`Isa`]s.
        plan: &'a Plan,
    },
}

impl Taps<'_> {
    /// Taps of the kernel.
    pub fn volume(&self) -> usize {
        match self {
            Taps::Same => 1,
            Taps::Map { volume, .. } => *volume,
            Taps::Octants { .. } | Taps::Children => 8,
            Taps::AllChildren { .. } => 27,
        }
    }
}

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
                let mut map = std::mem::take(&mut self.map);
                map.resize(count * volume, ABSENT);
                children::rows_of_all(neighbours, first, &mut map);
                end = self.fill_from(isa, &map);
                self.map = map;
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
        match isa.level() {
            Level::Scalar(_) => fill_map(lists),
            #[cfg(target_arch = "aarch64")]
            Level::Neon(_) | Level::NeonDot(..) => fill_map(lists),
            #[cfg(target_arch = "x86_64")]
            Level::Avx2(token) | Level::AvxVnni(_, token) => lists::fill_map(token, lists),
            #[cfg(target_arch = "x86_64")]
            Level::Avx512(token) | Level::Amx(_, token) => lists::fill_map(token.narrow(), lists),
        }
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

/// A tile of a kernel map, and where its pairs go.
pub(crate) struct Lists<'a> {
    /// One entry per row and tap.
    pub map: &'a [u32],
    /// To be written, one per tap.
    pub lengths: &'a mut [usize],
    /// `room` for each tap.
    pub inputs: &'a mut [u32],
    /// Likewise.
    pub rows: &'a mut [u32],
    /// One per row, zero so far.
    pub masks: &'a mut [u64],
    /// More than there are rows.
    pub room: usize,
}

/// Sorts a kernel map's entries by tap, and gives the end of the input rows that it names.
fn fill_map(lists: Lists<'_>) -> usize {
    let mut end = 0;
    let volume = lists.lengths.len();
    for (k, length) in lists.lengths.iter_mut().enumerate() {
        let inputs = &mut lists.inputs[k * lists.room..][..lists.room];
        let rows = &mut lists.rows[k * lists.room..][..lists.room];
        let taps = lists.map.chunks_exact(volume);
        for (row, (taps, mask)) in taps.zip(&mut *lists.masks).enumerate() {
            let input = taps[k];
            let used = input != ABSENT;
            // Written in any case, kept only if used: a branch here would be mispredicted.
            inputs[*length] = input;
            rows[*length] = row as u32;
            *length += usize::from(used);
            *mask |= u64::from(used) << k;
            end = end.max(input.wrapping_add(1));
        }
    }
    end as usize
}
