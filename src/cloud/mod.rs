//! Point clouds: in from PLY files, onto the voxel grid, and out again.
//!
//! A cloud is read whatever its number types and the order of its properties. [`voxelise`] then gives the
//! octree's finest level: as it stands if the coordinates already are a voxel grid's, else fitted to one; [`voxelise_closed`] a coarser one where points
//! lie too far apart for that.

pub mod ply;
mod points;
mod voxelise;
mod write;

pub use points::{Hints, PointCloud};
pub use voxelise::{ColouredVoxels, voxelise, voxelise_closed};

use crate::error::{Error, Stage};

/// Something in a file or among its points that is no cloud.
fn malformed(at: impl ToString, field: impl ToString, value: impl ToString, expected: impl ToString) -> Error {
    Error::malformed(Stage::Cloud, at, field, value, expected)
}
