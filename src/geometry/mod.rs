//! Which voxels are occupied, at every octree level.

pub mod codec;
pub mod morton;
mod neighbours;
mod octree;
mod voxels;

pub use neighbours::KernelMap;
pub use octree::{MAX_VOXELS, Octree};
pub use voxels::Voxels;

/// The places of the ones in a mask, ascending.
#[inline(always)]
pub(crate) fn ones(mut mask: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let place = mask.trailing_zeros() as usize;
        (mask != 0).then(|| {
            mask &= mask - 1;
            place
        })
    })
}
