//! Decoded voxels as files of points.

use std::path::Path;

use b2p::cloud::{ColouredVoxels, PointCloud, axes_comments};
use b2p::{Axes, Error, Placement, Result};

use super::{e57, las, pcd};

/// How far rounding may move a point, in voxels, so that it still tells which voxel it is.
const TOLERANCE: f64 = 0.005;

/// A format of point files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum PointFormat {
    Ply,
    Las,
    Laz,
    Pcd,
    E57,
    /// Rows of text: coordinates and colours.
    Xyz,
}

/// How points are written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct WriteOptions {
    /// Coordinates as doubles, also where floats would do (PLY and PCD; the other formats are as exact in any case).
    pub double: bool,
    /// Coordinates from the grid's origin, for programs that compute with floats (PLY, PCD and XYZ). The offset goes into
    /// a comment, where the format has some, and into a file beside.
    pub local: bool,
}

/// A file of points.
#[derive(Debug, Clone, PartialEq)]
pub struct Encoded {
    /// The file.
    pub bytes: Vec<u8>,
    /// What belongs into a file beside it, as JSON: the offset of local coordinates, grid, axes and unit.
    pub sidecar: Option<String>,
}

impl PointFormat {
    /// The format that a path's ending names. `None` for any other.
    pub fn of(path: &Path) -> Option<Self> {
        let ending = path.extension()?.to_str()?.to_ascii_lowercase();
        Some(match ending.as_str() {
            "ply" => PointFormat::Ply,
            "las" => PointFormat::Las,
            "laz" => PointFormat::Laz,
            "pcd" => PointFormat::Pcd,
            "e57" => PointFormat::E57,
            "xyz" | "txt" | "asc" => PointFormat::Xyz,
            _ => return None,
        })
    }
}

impl std::str::FromStr for PointFormat {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        let path = format!("points.{name}");
        let names = "ply, las, laz, pcd, e57 or xyz";
        Self::of(path.as_ref())
            .ok_or_else(|| Error::Usage(format!("{name:?} is no format of points, expected {names}")))
    }
}

/// Encodes voxels as points at their centres in the world. Reading the file again and voxelising gives the same voxels,
/// except from text and PCD, which have no place for the grid.
///
/// # Errors
/// [`Error::Usage`] if the format cannot hold them.
pub fn encode(voxels: &ColouredVoxels, axes: &Axes, format: PointFormat, options: WriteOptions) -> Result<Encoded> {
    let grid = voxels.placement;
    let mut cloud = voxels.to_world();
    cloud.axes = axes.clone();
    let local = options.local && matches!(format, PointFormat::Ply | PointFormat::Pcd | PointFormat::Xyz);
    if local {
        for position in &mut cloud.positions {
            *position = std::array::from_fn(|axis| position[axis] - grid.origin[axis]);
        }
    }
    let double = options.double || !fits_floats(&cloud, grid.voxel_size);
    let bytes = match format {
        PointFormat::Ply => ply(&cloud, &grid, double, local),
        PointFormat::Las => las::write(&cloud, &grid, false)?,
        PointFormat::Laz => las::write(&cloud, &grid, true)?,
        PointFormat::Pcd => pcd::write(&cloud, double),
        PointFormat::E57 => e57::write(&cloud)?,
        PointFormat::Xyz => xyz(&cloud),
    };
    let sidecar = local.then(|| sidecar(&cloud, &grid));
    Ok(Encoded { bytes, sidecar })
}

/// Whether floats are exact enough for these coordinates.
fn fits_floats(cloud: &PointCloud, voxel_size: f64) -> bool {
    let most = TOLERANCE * voxel_size;
    let fits = |x: &f64| (f64::from(*x as f32) - x).abs() <= most;
    cloud.positions.as_flattened().iter().all(fits)
}

fn ply(cloud: &PointCloud, grid: &Placement, double: bool, local: bool) -> Vec<u8> {
    let scalar = if double { "double" } else { "float" };
    let [x, y, z] = grid.origin;
    let mut header = "ply\nformat binary_little_endian 1.0\n".to_owned();
    if let Some(bits) = cloud.hints.bits {
        header += &format!("comment bits {bits}\n");
    }
    header += &format!("comment unit {}\ncomment origin {x} {y} {z}\n", grid.voxel_size);
    header += match local {
        true => "comment coordinates local\n",
        false => "comment coordinates world\n",
    };
    if local {
        header += &format!("comment offset {x} {y} {z}\n");
    }
    header += &axes_comments(&cloud.axes);
    header += &format!("element vertex {}\n", cloud.positions.len());
    for axis in ["x", "y", "z"] {
        header += &format!("property {scalar} {axis}\n");
    }
    header += "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
    let mut bytes = header.into_bytes();
    bytes.reserve(cloud.positions.len() * 27);
    for (position, colour) in cloud.positions.iter().zip(&cloud.colours) {
        for x in position {
            match double {
                true => bytes.extend(x.to_le_bytes()),
                false => bytes.extend((*x as f32).to_le_bytes()),
            }
        }
        bytes.extend(colour);
    }
    bytes
}

fn xyz(cloud: &PointCloud) -> Vec<u8> {
    let mut text = String::with_capacity(48 * cloud.positions.len());
    for ([x, y, z], [r, g, b]) in cloud.positions.iter().zip(&cloud.colours) {
        text += &format!("{x} {y} {z} {r} {g} {b}\n");
    }
    text.into_bytes()
}

fn sidecar(cloud: &PointCloud, grid: &Placement) -> String {
    let axes = &cloud.axes;
    let mut object = serde_json::json!({
        "offset": grid.origin,
        "voxel_size": grid.voxel_size,
        "bits": cloud.hints.bits,
    });
    if let Some(up) = axes.up {
        object["up"] = up.to_string().into();
    }
    if let Some(metres) = axes.metres_per_unit {
        object["metres_per_unit"] = metres.into();
    }
    if !axes.crs.is_empty() {
        object["crs"] = axes.crs.clone().into();
    }
    format!("{object:#}\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use b2p::Up;
    use b2p::cloud::{ReadOptions, voxelise};
    use b2p::geometry::{Voxels, morton};

    const ALL: [PointFormat; 6] = [
        PointFormat::Ply,
        PointFormat::Las,
        PointFormat::Laz,
        PointFormat::Pcd,
        PointFormat::E57,
        PointFormat::Xyz,
    ];

    /// Some voxels of a grid of millimetres at a place like those of UTM.
    fn voxels() -> ColouredVoxels {
        let at = |i: u32| morton::encode([i % 1000, i * 7 % 1021, i / 3]);
        let mut keys: Vec<u64> = (0..3000).map(at).collect();
        keys.sort_unstable();
        keys.dedup();
        ColouredVoxels {
            colours: (0..keys.len()).map(|i| [i as u8, (i / 256) as u8, 77]).collect(),
            voxels: Voxels::new(10, keys),
            placement: Placement {
                origin: [500_000.0, 4_000_000.0, 120.3],
                voxel_size: 0.001,
            },
        }
    }

    fn axes() -> Axes {
        Axes {
            up: Some(Up::Z),
            metres_per_unit: Some(1.0),
            crs: "PROJCS[\"a\",UNIT[\"metre\",1]]".into(),
        }
    }

    fn back(bytes: Vec<u8>) -> PointCloud {
        let read = super::super::read(bytes, None, &b2p::Limits::default(), &ReadOptions::default());
        read.unwrap().cloud
    }

    #[test]
    fn every_format_gives_back_every_voxel_with_its_colour() {
        let voxels = voxels();
        let world = voxels.to_world();
        for format in ALL {
            for double in [false, true] {
                let options = WriteOptions { double, local: false };
                let encoded = encode(&voxels, &axes(), format, options).unwrap();
                assert_eq!(encoded.sidecar, None);
                let read = back(encoded.bytes);
                assert_eq!(read.colours, voxels.colours, "{format:?}");
                for (a, b) in read.positions.iter().zip(&world.positions) {
                    assert!((0..3).all(|i| (a[i] - b[i]).abs() < 1e-6), "{format:?}: {a:?} {b:?}");
                }
                if format == PointFormat::Ply {
                    assert_eq!(voxelise(&read, None).unwrap(), voxels);
                    assert_eq!(read.axes, axes());
                }
            }
        }
    }

    #[test]
    fn local_coordinates_are_floats_with_the_offset_beside() {
        let voxels = voxels();
        let options = WriteOptions {
            double: false,
            local: true,
        };
        let encoded = encode(&voxels, &axes(), PointFormat::Ply, options).unwrap();
        let header = String::from_utf8_lossy(&encoded.bytes[..500]).into_owned();
        assert!(
            header.contains("property float x") && header.contains("offset 500000 4000000 120.3"),
            "{header}"
        );
        assert_eq!(voxelise(&back(encoded.bytes), None).unwrap(), voxels);
        let sidecar: serde_json::Value = serde_json::from_str(&encoded.sidecar.unwrap()).unwrap();
        assert_eq!(sidecar["offset"][1], 4_000_000.0);
        assert_eq!(sidecar["up"], "z");
        let encoded = encode(&voxels, &axes(), PointFormat::Pcd, options).unwrap();
        assert!(back(encoded.bytes).positions[0][1] < 1.1);
    }

    #[test]
    fn floats_are_written_where_they_are_exact_enough() {
        let mut voxels = voxels();
        let is_float = |voxels: &ColouredVoxels| {
            let encoded = encode(voxels, &Axes::default(), PointFormat::Ply, WriteOptions::default()).unwrap();
            String::from_utf8_lossy(&encoded.bytes[..300]).contains("property float x")
        };
        assert!(!is_float(&voxels));
        voxels.placement.origin = [-0.5; 3];
        assert!(is_float(&voxels));
    }

    #[test]
    fn formats_are_named_by_endings() {
        assert_eq!(PointFormat::of("a/b.LAZ".as_ref()), Some(PointFormat::Laz));
        assert_eq!(PointFormat::of("b.png".as_ref()), None);
        assert_eq!("e57".parse::<PointFormat>().unwrap(), PointFormat::E57);
        assert!("docx".parse::<PointFormat>().unwrap_err().to_string().contains("laz"));
    }
}
