//! Which input rows each output row reads, and through which tap of the kernel.

use super::plan::Plan;

/// Marks a tap that reads nothing.
pub const ABSENT: u32 = u32::MAX;

/// Rows of a kernel map that are made when they are read.
pub trait MadeRows: std::fmt::Debug + std::panic::RefUnwindSafe + Sync {
    /// Writes the rows from row `first` on, one after the other, as [`Taps::Map`] has them.
    ///
    /// # Panics
    /// If there are not so many.
    fn fill(&self, first: usize, rows: &mut [u32]);
}

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
        /// The same, arranged for vector kernels.
        plan: Option<&'a Plan>,
    },
    /// The same with rows that are made when a plan is.
    Made {
        /// Taps of the kernel.
        volume: usize,
        /// Makes the rows.
        rows: &'a dyn MadeRows,
        /// The rows, arranged for vector kernels.
        plan: &'a Plan,
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
    /// 27 taps: row `8p + o` is the child in octant `o` of voxel `p`, and reads the children of `p` and its neighbours
    /// around it. All children of every voxel.
    AllChildren {
        /// Entry `p·27 + k` is the neighbour of voxel `p` at offset `k`, x fastest, or [`ABSENT`].
        neighbours: &'a [u32],
        /// The rows, arranged for vector kernels.
        plan: &'a Plan,
    },
}

impl Taps<'_> {
    /// Taps of the kernel.
    pub fn volume(&self) -> usize {
        match self {
            Taps::Same => 1,
            Taps::Map { volume, .. } | Taps::Made { volume, .. } => *volume,
            Taps::Octants { .. } | Taps::Children => 8,
            Taps::AllChildren { .. } => 27,
        }
    }
}
