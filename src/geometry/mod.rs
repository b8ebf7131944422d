//! Which voxels are occupied, at every octree level.

pub mod codec;
pub mod morton;
mod neighbours;
mod octree;
mod voxels;

pub use neighbours::KernelMap;
pub use octree::{MAX_VOXELS, Octree};
pub use voxels::Voxels;
