//! Decoded voxels as files of points.

use std::path::Path;

use b2p::cloud::{ColouredVoxels, Coordinates, PointCloud, axes_comments};
use b2p::{Axes, Error, Result, Up};

use super::{e57, las, pcd};
use crate::sidecar::Sidecar;

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
    /// Coordinates from the grid's origin, for programs that compute with floats (PLY, PCD and XYZ). The offset goes
    /// into a comment, where the format has some, and into a file beside.
    pub local: bool,
}

/// A file of points.
#[derive(Debug, Clone, PartialEq)]
pub struct Encoded {
    /// The file.
    pub bytes: Vec<u8>,
    /// What belongs into a file beside it: the offset of local coordinates, and what the format has no place for.
    pub sidecar: Option<Sidecar>,
    /// What was changed, for the user.
    pub notes: Vec<String>,
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
    let mut cloud = voxels.to_world();
    cloud.axes = axes.clone();
    encode_cloud(cloud, format, options)
}

/// Encodes a cloud. Coordinates are exact, but for LAS and LAZ files, whose steps are a power of ten, or the voxels of
/// the cloud's grid. Voxels with a grid are written at their places in the world, except to PLY files, which state the
/// grid.
///
/// # Errors
/// [`Error::Usage`] if the format cannot hold them.
pub fn encode_cloud(mut cloud: PointCloud, format: PointFormat, options: WriteOptions) -> Result<Encoded> {
    let mut notes = Vec::new();
    if format != PointFormat::Ply && place_voxels(&mut cloud) {
        notes.push("voxels are written as points at their centres in the world".into());
    }
    let grid = cloud
        .hints
        .placement
        .filter(|_| cloud.hints.coordinates == Coordinates::World);
    let in_world = grid.is_some() || cloud.hints.placement.is_none();
    let local = options.local && in_world && matches!(format, PointFormat::Ply | PointFormat::Pcd | PointFormat::Xyz);
    let mut offset = [0.0; 3];
    if local {
        offset = grid.map_or_else(|| lowest(&cloud.positions).map(f64::floor), |grid| grid.origin);
        for position in &mut cloud.positions {
            *position = std::array::from_fn(|axis| position[axis] - offset[axis]);
        }
    }
    let double = options.double || !fits_floats(&cloud, grid.map_or(0.0, |grid| grid.voxel_size));
    let bytes = match format {
        PointFormat::Ply => ply(&cloud, double, local.then_some(offset)),
        PointFormat::Las | PointFormat::Laz => {
            let steps = grid.map_or_else(|| las::Steps::of(&cloud.positions), |grid| las::Steps::of_grid(&grid));
            if !steps.exact {
                let size = steps.scale;
                notes.push(format!(
                    "coordinates are rounded to {size:e}, the finest step that LAS has room for"
                ));
            }
            las::write(&cloud, &steps, format == PointFormat::Laz)?
        }
        PointFormat::Pcd => pcd::write(&cloud, double),
        PointFormat::E57 => e57::write(&cloud)?,
        PointFormat::Xyz => xyz(&cloud),
    };
    let lost = lost(&cloud.axes, format);
    let sidecar = (local || !lost.is_empty()).then(|| Sidecar {
        offset,
        axes: if local { cloud.axes.clone() } else { lost },
        bits: cloud.hints.bits.filter(|_| grid.is_some()),
        grid,
        turned_from: None,
    });
    Ok(Encoded { bytes, sidecar, notes })
}

/// Moves voxels to their places in the world. Whether there were any.
fn place_voxels(cloud: &mut PointCloud) -> bool {
    let (Some(grid), Coordinates::Voxels) = (cloud.hints.placement, cloud.hints.coordinates) else {
        return false;
    };
    cloud.hints.coordinates = Coordinates::World;
    if !cloud.positions.as_flattened().iter().all(|x| x.fract() == 0.0) {
        // The comments are those of another cloud.
        cloud.hints = Default::default();
        return false;
    }
    for position in &mut cloud.positions {
        *position = std::array::from_fn(|axis| grid.origin[axis] + grid.voxel_size * (position[axis] + 0.5));
    }
    true
}

fn lowest(positions: &[[f64; 3]]) -> [f64; 3] {
    let least = |low: [f64; 3], p: &[f64; 3]| std::array::from_fn(|axis| low[axis].min(p[axis]));
    positions
        .iter()
        .fold(positions.first().copied().unwrap_or_default(), least)
}

/// What readers of a file of this format would not learn from it.
fn lost(axes: &Axes, format: PointFormat) -> Axes {
    let crs = axes.crs.clone();
    let told = match format {
        PointFormat::Ply => return Axes::default(),
        PointFormat::Pcd | PointFormat::Xyz => Axes::default(),
        PointFormat::Las | PointFormat::Laz => las::told(axes),
        PointFormat::E57 => Axes {
            up: Some(Up::Z),
            metres_per_unit: Some(1.0),
            crs,
        },
    };
    Axes {
        up: axes.up.filter(|_| axes.up != told.up),
        metres_per_unit: axes
            .metres_per_unit
            .filter(|_| axes.metres_per_unit != told.metres_per_unit),
        crs: if told.crs == axes.crs {
            String::new()
        } else {
            axes.crs.clone()
        },
    }
}

/// Whether floats are exact enough for these coordinates.
fn fits_floats(cloud: &PointCloud, voxel_size: f64) -> bool {
    let most = TOLERANCE * voxel_size;
    let fits = |x: &f64| (f64::from(*x as f32) - x).abs() <= most;
    cloud.positions.as_flattened().iter().all(fits)
}

fn ply(cloud: &PointCloud, double: bool, offset: Option<[f64; 3]>) -> Vec<u8> {
    let scalar = if double { "double" } else { "float" };
    let hints = &cloud.hints;
    let mut header = "ply\nformat binary_little_endian 1.0\n".to_owned();
    if let Some(bits) = hints.bits {
        header += &format!("comment bits {bits}\n");
    }
    if let Some(grid) = hints.placement {
        let [x, y, z] = grid.origin;
        header += &format!("comment unit {}\ncomment origin {x} {y} {z}\n", grid.voxel_size);
    }
    match offset {
        Some([x, y, z]) => header += &format!("comment coordinates local\ncomment offset {x} {y} {z}\n"),
        None if hints.coordinates == Coordinates::World => header += "comment coordinates world\n",
        None => {}
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
    use std::fmt::Write;
    let mut text = String::with_capacity(48 * cloud.positions.len());
    for ([x, y, z], [r, g, b]) in cloud.positions.iter().zip(&cloud.colours) {
        // Strings take all that is written.
        let _ = writeln!(text, "{x} {y} {z} {r} {g} {b}");
    }
    text.into_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;
    use b2p::Placement;
    use b2p::cloud::{Hints, ReadOptions, voxelise};
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
                // These two have no place for axes.
                let lossy = matches!(format, PointFormat::Pcd | PointFormat::Xyz);
                assert_eq!(
                    encoded.sidecar.map(|beside| beside.axes),
                    lossy.then(axes),
                    "{format:?}"
                );
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
        let sidecar = encoded.sidecar.unwrap();
        assert_eq!(sidecar.offset[1], 4_000_000.0);
        assert_eq!(sidecar.axes.up, Some(Up::Z));
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
    fn points_without_a_grid_come_back_exactly_and_las_says_what_it_rounds() {
        let mut cloud = PointCloud {
            positions: (0..500)
                .map(|i| [500_000.001 + f64::from(i) * 0.01, -0.125, f64::from(i % 7) * 1e-3])
                .collect(),
            colours: (0..500).map(|i| [i as u8, 9, 200]).collect(),
            ..PointCloud::default()
        };
        for format in ALL {
            let encoded = encode_cloud(cloud.clone(), format, WriteOptions::default()).unwrap();
            assert_eq!((encoded.sidecar, encoded.notes), (None, Vec::new()), "{format:?}");
            let read = back(encoded.bytes);
            assert_eq!(read.colours, cloud.colours, "{format:?}");
            for (a, b) in read.positions.iter().zip(&cloud.positions) {
                let near = if format == PointFormat::Las || format == PointFormat::Laz {
                    1e-9
                } else {
                    0.0
                };
                assert!((0..3).all(|i| (a[i] - b[i]).abs() <= near), "{format:?}: {a:?} {b:?}");
            }
        }
        cloud.positions[7][1] = std::f64::consts::PI;
        let encoded = encode_cloud(cloud, PointFormat::Las, WriteOptions::default()).unwrap();
        assert!(encoded.notes[0].contains("rounded to 1e-8"), "{:?}", encoded.notes);
    }

    #[test]
    fn voxels_with_a_grid_are_written_at_their_places_but_stay_voxels_in_ply() {
        let cloud = PointCloud {
            positions: vec![[0.0; 3], [3.0, 1.0, 2.0]],
            colours: vec![[1, 2, 3], [4, 5, 6]],
            hints: Hints {
                bits: Some(5),
                placement: Some(Placement {
                    origin: [10.0, 20.0, 30.0],
                    voxel_size: 2.0,
                }),
                coordinates: Coordinates::Voxels,
            },
            axes: Axes::default(),
        };
        let write = |format| encode_cloud(cloud.clone(), format, WriteOptions::default()).unwrap();
        assert_eq!(back(write(PointFormat::Ply).bytes), cloud);
        let las = write(PointFormat::Las);
        assert!(las.notes[0].contains("centres in the world"));
        assert_eq!(back(las.bytes).positions, [[11.0, 21.0, 31.0], [17.0, 23.0, 35.0]]);
    }

    #[test]
    fn formats_are_named_by_endings() {
        assert_eq!(PointFormat::of("a/b.LAZ".as_ref()), Some(PointFormat::Laz));
        assert_eq!(PointFormat::of("b.png".as_ref()), None);
        assert_eq!("e57".parse::<PointFormat>().unwrap(), PointFormat::E57);
        assert!("docx".parse::<PointFormat>().unwrap_err().to_string().contains("laz"));
    }
}
