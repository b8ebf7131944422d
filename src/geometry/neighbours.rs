//! Kernel maps: for every voxel, which of its neighbours are occupied and where they are.

/// The neighbours of every voxel under a 3³ or 2³ kernel.
///
/// Row `i` holds `volume` indices of input voxels in the kernel's offset order (x fastest), [`KernelMap::ABSENT`] where none is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KernelMap {
    volume: usize,
    rows: Vec<u32>,
}

impl KernelMap {
    /// Marks an unoccupied neighbour.
    pub const ABSENT: u32 = u32::MAX;

    /// Wraps rows of `volume` indices each.
    pub fn new(volume: usize, rows: Vec<u32>) -> Self {
        assert_eq!(rows.len() % volume, 0, "kernel map rows must be whole");
        KernelMap { volume, rows }
    }

    /// Number of kernel offsets: 27, 8 or 1.
    pub fn volume(&self) -> usize {
        self.volume
    }

    /// Number of voxels.
    pub fn len(&self) -> usize {
        self.rows.len() / self.volume
    }

    /// Whether there are no voxels.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// The neighbours of voxel `i`.
    pub fn row(&self, i: usize) -> &[u32] {
        &self.rows[i * self.volume..(i + 1) * self.volume]
    }

    /// All rows, one after the other.
    pub fn rows(&self) -> &[u32] {
        &self.rows
    }
}
