//! Point clouds: in from files, onto the voxel grid.

pub mod ply;
