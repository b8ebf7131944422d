//! Point clouds: PLY files and voxelisation.
//!
//! The reader accepts any number types and any order of properties. [`voxelise`] makes the octree's finest level: it
//! keeps coordinates that are voxels already, and fits a grid to all others. [`voxelise_closed`] chooses a coarser
//! level if the points are too sparse for that one.

pub mod ply;
mod points;
mod voxelise;
mod write;

pub use points::{Hints, PointCloud};
pub use voxelise::{ColouredVoxels, voxelise, voxelise_closed};

use crate::error::{Error, Stage};

/// An error in a file or in its points.
fn malformed(at: impl ToString, field: impl ToString, value: impl ToString, expected: impl ToString) -> Error {
    Error::malformed(Stage::Cloud, at, field, value, expected)
}
