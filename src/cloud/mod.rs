//! Point clouds: PLY files, colours of any range, and voxelisation.
//!
//! A reader of a file format makes [`RawPoints`]. [`RawPoints::finish`] makes a [`PointCloud`] of them: it leaves out
//! bad points, converts colours, and reports what it did. [`voxelise`] makes the octree's finest level: it keeps
//! coordinates that are voxels already, and fits a grid to all others. [`voxelise_closed`] chooses the level by the
//! spacing of the points.

mod colours;
mod common_grid;
mod dialects;
mod hidden;
pub mod ply;
mod points;
mod raw;
mod select;
mod voxelise;
mod write;

pub use colours::{ColourRange, RawColours, Stored};
pub use common_grid::{CommonGrid, GridNeed};
pub use points::{Coordinates, Hints, PointCloud, is_a_mesh};
pub use raw::{Note, RawPoints, ReadOptions};

pub use voxelise::{ColouredVoxels, GridReport, voxelise, voxelise_closed, voxelise_memory};
pub use write::axes_comments;

use crate::error::{Error, Stage};

/// An error in a file or in its points.
fn malformed(at: impl ToString, field: impl ToString, value: impl ToString, expected: impl ToString) -> Error {
    Error::malformed(Stage::Cloud, at, field, value, expected)
}

/// A number with commas between groups of three digits.
pub(crate) fn grouped(count: u64) -> String {
    let digits = count.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}
