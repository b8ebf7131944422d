//! Writing of point clouds as PLY files.

use std::path::Path;

use super::{Coordinates, PointCloud};
use crate::axes::Axes;
use crate::error::{Error, Result};
use crate::output::write_file;

impl PointCloud {
    /// Encodes the cloud as a binary little-endian PLY file: `float x y z` (`double` if `float` would round a
    /// coordinate) and `uchar red green blue`, with the hints as comments. [`PointCloud::from_ply`] restores an equal
    /// cloud.
    pub fn to_ply(&self) -> Vec<u8> {
        let single = |&x: &f64| f64::from(x as f32) == x;
        let scalar = match self.positions.iter().flatten().all(single) {
            true => "float",
            false => "double",
        };
        let mut header = "ply\nformat binary_little_endian 1.0\n".to_owned();
        if let Some(bits) = self.hints.bits {
            header += &format!("comment bits {bits}\n");
        }
        if let Some(p) = self.hints.placement {
            let [x, y, z] = p.origin;
            header += &format!("comment unit {}\ncomment origin {x} {y} {z}\n", p.voxel_size);
        }
        if self.hints.coordinates == Coordinates::World {
            header += "comment coordinates world\n";
        }
        header += &axes_comments(&self.axes);
        header += &format!("element vertex {}\n", self.positions.len());
        for axis in ["x", "y", "z"] {
            header += &format!("property {scalar} {axis}\n");
        }
        header += "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";

        let mut bytes = header.into_bytes();
        bytes.reserve(self.positions.len() * 27);
        for (position, colour) in self.positions.iter().zip(&self.colours) {
            for &x in position {
                match scalar {
                    "float" => bytes.extend((x as f32).to_le_bytes()),
                    _ => bytes.extend(x.to_le_bytes()),
                }
            }
            bytes.extend(colour);
        }
        bytes
    }

    /// Writes [`PointCloud::to_ply`] to a file atomically.
    ///
    /// # Errors
    /// [`Error::Io`](crate::Error::Io).
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        let path = path.as_ref();
        write_file(path, |file| {
            file.write_all(&self.to_ply()).map_err(|source| Error::Io {
                path: path.to_owned(),
                source,
            })
        })
    }
}

/// Comments of a PLY header that say what is known of the coordinates.
pub fn axes_comments(axes: &Axes) -> String {
    let mut text = String::new();
    if let Some(up) = axes.up {
        text += &format!("comment up {up}\n");
    }
    if let Some(metres) = axes.metres_per_unit {
        text += &format!("comment metres_per_unit {metres}\n");
    }
    // A line is what the header can hold.
    let crs = axes.crs.split_whitespace().collect::<Vec<_>>().join(" ");
    if !crs.is_empty() {
        text += &format!("comment crs {crs}\n");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Up;
    use crate::cloud::Hints;
    use crate::{Limits, Placement};

    #[test]
    fn a_written_cloud_reads_back_equal() {
        for x in [0.5, 0.1] {
            let cloud = PointCloud {
                positions: vec![[x, -3.0, 1e6], [7.0, x, 0.25]],
                colours: vec![[1, 2, 3], [255, 0, 128]],
                hints: Hints {
                    bits: Some(11),
                    placement: Some(Placement {
                        origin: [0.1, -1e-300, 1e300],
                        voxel_size: 0.3,
                    }),
                    coordinates: Coordinates::World,
                },
                axes: Axes {
                    up: Some(Up::MinusY),
                    metres_per_unit: Some(0.1),
                    crs: "EPSG:32633".into(),
                },
            };
            let file = tempfile::NamedTempFile::new().unwrap();
            cloud.write(file.path()).unwrap();
            let read = PointCloud::open(file.path(), &Limits::default()).unwrap();
            assert_eq!(read, cloud);
        }
    }
}
