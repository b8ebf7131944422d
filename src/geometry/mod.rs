//! Which voxels are occupied, at every octree level.

pub mod morton;
pub mod neighbours;
mod voxels;

pub use neighbours::KernelMap;
pub use voxels::Voxels;
