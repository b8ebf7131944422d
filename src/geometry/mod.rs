//! Geometry: the occupied voxels of every octree level, their neighbours, and the lossless codec (`docs/format.md`,
//! clauses 2.3, 2.4 and 4).

pub mod codec;
pub mod morton;
mod neighbours;
mod octree;
mod siblings;
mod voxels;
mod windows;

pub use neighbours::KernelMap;
pub use octree::{MAX_VOXELS, Octree};
pub(crate) use siblings::{AROUND, Window, place};
pub use siblings::{RowBuffer, SiblingMap};
pub use voxels::Voxels;
pub(crate) use windows::windows;

/// Positions of the set bits of a mask, ascending.
#[inline(always)]
pub(crate) fn ones(mask: impl Into<u64>) -> impl Iterator<Item = usize> {
    let mut mask = mask.into();
    std::iter::from_fn(move || {
        let position = mask.trailing_zeros() as usize;
        (mask != 0).then(|| {
            mask &= mask - 1;
            position
        })
    })
}
