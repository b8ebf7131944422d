//! Coloured points as stored in a file.

use std::path::Path;

use super::raw::{Note, ReadOptions};
use crate::axes::Axes;
use crate::error::{Error, Result};
use crate::input;
use crate::limits::Limits;
use crate::placement::Placement;

/// Coloured points, with the file's hints at their voxel grid.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointCloud {
    /// Finite coordinates.
    pub positions: Vec<[f64; 3]>,
    /// sRGB colours, one per point.
    pub colours: Vec<[u8; 3]>,
    /// Voxel grid in the file's comments.
    pub hints: Hints,
    /// What is known of the coordinates.
    pub axes: Axes,
}

/// The voxel grid in a file's comments: `bits B`, `unit U`, `origin X Y Z`, `shift X Y Z`, `coordinates world`.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Hints {
    /// The bit depth `B`, 1 to 21.
    pub bits: Option<u8>,
    /// Placement of the grid, if both unit and origin are given: the centre of voxel `v` is `(v + ½ − shift)·unit +
    /// origin`.
    pub placement: Option<Placement>,
    /// What the coordinates are.
    pub coordinates: Coordinates,
}

/// What the coordinates of points with hints are.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Coordinates {
    /// Voxels, if they are integers.
    #[default]
    Voxels,
    /// Places in the world, also if they are integers.
    World,
}

impl PointCloud {
    /// Reads a PLY file.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::LimitExceeded`] for a file that is too large, and those of [`PointCloud::from_ply`].
    pub fn open(path: impl AsRef<Path>, limits: &Limits) -> Result<Self> {
        Self::from_ply(&input::read_file(path.as_ref(), limits)?, limits)
    }

    /// Reads a PLY file from memory, and refuses what would have to be mended or guessed.
    ///
    /// Requires `x y z` of any number type and colours (see [`PointCloud::read_ply`]).
    ///
    /// # Errors
    /// [`Error::Malformed`] if one is absent, there are no points, a coordinate is not finite or a colour out of range;
    /// [`Error::Truncated`] if the file ends early; [`Error::LimitExceeded`] if there are more points than `limits`
    /// allow.
    pub fn from_ply(bytes: &[u8], limits: &Limits) -> Result<Self> {
        let options = ReadOptions {
            strict: true,
            vertices: true,
            ..ReadOptions::default()
        };
        Ok(Self::read_ply(bytes, limits, &options)?.0)
    }

    /// Reads a PLY file from memory. Also returns what was mended or guessed.
    ///
    /// Properties are found by these names, in any case: `x y z`; `red green blue`, `r g b` or `diffuse_red` and the
    /// others; else `intensity`, `grey`, `gray`, `scalar_intensity` or `reflectance`; `nx ny nz`. All number types are
    /// accepted; the range of colours follows from type and maximum.
    ///
    /// # Errors
    /// Those of [`PointCloud::from_ply`] that `options` do not have mended; [`Error::Unsupported`] for a mesh.
    pub fn read_ply(bytes: &[u8], limits: &Limits, options: &ReadOptions) -> Result<(Self, Vec<Note>)> {
        super::dialects::read(bytes, limits, options)?.finish(options)
    }
}

/// The error of reading a mesh as points.
pub fn is_a_mesh(detail: &str) -> Error {
    Error::Unsupported {
        what: "a mesh as a point cloud",
        detail: format!(
            "this is a mesh{detail}: sample it first with `b2p-lab voxelize`, or take its vertices with --vertices"
        ),
    }
}

impl Hints {
    /// Comments are free text: those that do not parse are ignored.
    pub(super) fn from_comments(comments: &[String]) -> Self {
        let mut bits = None;
        let mut coordinates = Coordinates::Voxels;
        let (mut unit, mut origin, mut shift) = (None, None, [0.0; 3]);
        for comment in comments {
            let mut words = comment.split_ascii_whitespace();
            let Some(key) = words.next() else { continue };
            if comment == "coordinates world" {
                coordinates = Coordinates::World;
            }
            let values: Option<Vec<f64>> = words.take(4).map(number).collect();
            match (key, values.as_deref()) {
                ("bits", Some(&[b])) if b.fract() == 0.0 && (1.0..=21.0).contains(&b) => {
                    bits = Some(b as u8);
                }
                ("unit", Some(&[u])) => unit = Some(u),
                ("origin", Some(&[x, y, z])) => origin = Some([x, y, z]),
                ("shift", Some(&[x, y, z])) => shift = [x, y, z],
                _ => {}
            }
        }
        let placement = unit.zip(origin).map(|(unit, origin)| Placement {
            origin: std::array::from_fn(|i| origin[i] - shift[i] * unit),
            voxel_size: unit,
        });
        Hints {
            bits,
            placement: placement.filter(Placement::is_valid),
            coordinates,
        }
    }
}

/// Parses a number, with or without Python's `np.float64( )` around it.
fn number(word: &str) -> Option<f64> {
    let bare = word.strip_prefix("np.float64(").and_then(|w| w.strip_suffix(')'));
    bare.unwrap_or(word).parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(types: &str, rows: &str) -> Result<PointCloud> {
        let mut text = "ply\nformat ascii 1.0\nelement vertex ".to_owned();
        text += &format!("{}\n", rows.lines().count());
        for (name, scalar) in ["blue", "z", "x", "green", "y", "red"].iter().zip(types.split(' ')) {
            text += &format!("property {scalar} {name}\n");
        }
        text += "end_header\n";
        text += rows;
        PointCloud::from_ply(text.as_bytes(), &Limits::default())
    }

    #[test]
    fn columns_are_found_by_name_and_colours_converted_to_bytes() {
        let types = "uchar float double ushort int float";
        let cloud = read(types, "7 1.5 -2.25 65535 9 0.5\n0 0 0 128 0 1\n").unwrap();
        assert_eq!(cloud.positions, [[-2.25, 9.0, 1.5], [0.0; 3]]);
        assert_eq!(cloud.colours, [[128, 255, 7], [255, 0, 0]]);
        assert_eq!(cloud.hints, Hints::default());
    }

    #[test]
    fn errors_name_the_property_and_the_row() {
        let types = "uchar float float uchar float float";
        let error = |types: &str, rows: &str| read(types, rows).unwrap_err().to_string();
        let text = error(types, "1 2 3 4 5 0.5\n1 2 3 4 nan 0.5\n");
        assert_eq!(text, "cloud: at line 12: property y is NaN, expected a finite number");
        let text = error("float float float float float float", "0 2 3 0 5 1.1\n");
        assert!(text.contains("point 0: red is 1.1"), "{text}");
        assert!(error("float float float float float float", "1 2 3 4 5 nan\n").contains("NaN"));
        assert!(error(types, "").contains("at least one point"));
        let bare = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nproperty uchar r\nend_header\n1 2 3 4\n";
        let text = PointCloud::from_ply(bare, &Limits::default()).unwrap_err().to_string();
        assert!(text.contains("property of vertex g is absent"), "{text}");
    }

    #[test]
    fn the_grid_is_read_from_comments_and_free_text_is_ignored() {
        let hints = |lines: &[&str]| Hints::from_comments(&lines.iter().map(|l| l.to_string()).collect::<Vec<_>>());
        let grid = ["bits 11", "unit np.float64(0.5)", "origin 1 2 3", "shift 4 0 0"];
        let placement = Placement {
            origin: [-1.0, 2.0, 3.0],
            voxel_size: 0.5,
        };
        assert_eq!(hints(&["coordinates world"]).coordinates, Coordinates::World);
        assert_eq!(hints(&grid).bits, Some(11));
        assert_eq!(hints(&grid).placement, Some(placement));
        let text = [
            "bits and pieces",
            "bits 22",
            "unit 1 2",
            "origin Stanford",
            "",
            "unit -1",
            "origin 0 0 0",
        ];
        assert_eq!(hints(&text), Hints::default());
    }

    #[test]
    fn a_missing_file_is_named() {
        let error = PointCloud::open("no/such/cloud.ply", &Limits::default()).unwrap_err();
        assert!(error.to_string().starts_with("no/such/cloud.ply: "));
    }
}
