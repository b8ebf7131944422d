//! Which input rows each output row reads, and through which tap of the kernel.

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
    ends: Vec<usize>,
    pairs: Vec<Pair>,
}

#[derive(Debug, Default, Clone, Copy)]
pub(crate) struct Pair {
    /// Output row within the tile.
    pub row: u32,
    /// Input row.
    pub input: u32,
}

impl TileTaps {
    /// Gathers the pairs of output rows `first .. first + count`.
    pub fn fill(&mut self, taps: &Taps<'_>, first: usize, count: usize) {
        let volume = taps.volume();
        self.ends.clear();
        self.pairs.resize(volume * count, Pair::default());
        let mut end = 0;
        for k in 0..volume {
            for row in 0..count {
                let i = first + row;
                let (input, used) = match taps {
                    Taps::Same => (i as u32, true),
                    Taps::Map { rows, .. } => {
                        let input = rows[i * volume + k];
                        (input, input != ABSENT)
                    }
                    Taps::Octants { parents, octants } => {
                        (parents[i], usize::from(octants[i]) == k)
                    }
                    Taps::Children => ((i / 8) as u32, i % 8 == k),
                };
                // Written in any case, kept only if used: a branch here would be mispredicted.
                self.pairs[end] = Pair {
                    row: row as u32,
                    input,
                };
                end += usize::from(used);
            }
            self.ends.push(end);
        }
    }

    /// The pairs of tap `k`, by ascending output row.
    pub fn of(&self, k: usize) -> &[Pair] {
        let start = if k == 0 { 0 } else { self.ends[k - 1] };
        &self.pairs[start..self.ends[k]]
    }
}
