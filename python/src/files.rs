//! Files of points and of Gaussians.

use std::io::Write;
use std::path::{Path, PathBuf};

use b2p::cloud::{Note, ReadOptions, voxelise};
use b2p::{ColouredVoxels, Error, Gaussians, Limits, PointCloud, Result, Up, input, output};
use b2p_formats::clouds::{self, PointFormat, WriteOptions};
use b2p_formats::detect::{Group, Kind};
use b2p_formats::splats::{self, Axes, Format};
use pyo3::prelude::*;
use serde_json::{Value, json};

use crate::cloud::PyPointCloud;
use crate::errors;
use crate::gaussians::PyGaussians;
use crate::values::{self, PyLimits};
use crate::work::Work;

/// Bit depth of the grid that points are written on that are on none: the deepest.
const DEEPEST: u8 = 21;

/// What a file holds.
enum Content {
    Cloud(PointCloud, Vec<Note>),
    Gaussians(Gaussians, Option<Up>, Vec<String>),
}

/// Reads a file of points or of Gaussians, of whatever format: it is recognised by its content.
///
/// Points: PLY, LAS, LAZ, PCD, E57, XYZ, CSV, PTS, OBJ, glTF, GLB. Gaussians: PLY, compressed PLY, SPZ, SOG, .splat,
/// glTF, CSV, NPZ. What is mended, guessed or left out is an `InputWarning`.
///
/// Parameters
/// ----------
/// path : path
/// format : str, optional
///     Of Gaussians: "ply", "compressed-ply", "spz", "sog", "splat", "glb", "gltf", "csv" or "npz".
/// up, unit : optional
///     Of points, whatever the file says: as of `PointCloud`.
/// crop : ((float, float, float), (float, float, float)), optional
///     Keep only the points in this box: its lowest and its highest corner.
/// drop_outliers : bool
///     Leave out points far from all others.
/// vertices : bool
///     Take the vertices of a mesh as points. Otherwise meshes are refused.
/// limits : Limits, optional
/// threads : int, optional
///
/// Returns
/// -------
/// PointCloud or Gaussians
///     Gaussians in the axes of PLY files.
#[pyfunction]
#[pyo3(signature = (path, *, format=None, up=None, unit=None, crop=None, drop_outliers=false, vertices=false,
    limits=None, threads=None))]
pub fn read<'py>(
    py: Python<'py>,
    path: PathBuf,
    format: Option<&str>,
    up: Option<&str>,
    unit: Option<&Bound<'py, PyAny>>,
    crop: Option<[[f64; 3]; 2]>,
    drop_outliers: bool,
    vertices: bool,
    limits: Option<PyLimits>,
    threads: Option<usize>,
) -> PyResult<Bound<'py, PyAny>> {
    let limits = values::limits(limits);
    let format: Option<Format> = format
        .map(str::parse)
        .transpose()
        .map_err(|e: Error| errors::exception(py, &e))?;
    let options = ReadOptions {
        up: values::up(py, up)?,
        metres_per_unit: values::unit(unit)?,
        crop,
        drop_outliers,
        vertices,
        ..ReadOptions::default()
    };
    match Work::on(threads).run(py, move |_, _| content(&path, format, &options, &limits))? {
        Content::Cloud(cloud, notes) => Ok(Bound::new(py, PyPointCloud::read(py, cloud, &notes)?)?.into_any()),
        Content::Gaussians(gaussians, up, warnings) => {
            for warning in &warnings {
                errors::warn(py, warning)?;
            }
            let gaussians = PyGaussians {
                up,
                ..PyGaussians::bare(gaussians)
            };
            Ok(Bound::new(py, gaussians)?.into_any())
        }
    }
}

fn content(path: &Path, asked: Option<Format>, options: &ReadOptions, limits: &Limits) -> Result<Content> {
    let bytes = input::read_file(path, limits)?;
    let Some(format) = asked.or_else(|| format_of(path, &bytes)) else {
        let read = clouds::read(bytes, path.parent(), limits, options)?;
        return Ok(Content::Cloud(read.cloud, read.notes));
    };
    let offset = match format {
        Format::Spz | Format::Splat => offset_beside(path).unwrap_or_default(),
        _ => [0.0; 3],
    };
    let splats = splats::read(&bytes, format, &splats::Options { offset }, limits)?;
    let warnings = splats.warnings.clone();
    Ok(Content::Gaussians(splats.into_ply_axes()?, options.up, warnings))
}

/// The format of a file of splats, by its contents; `.splat` and CSV files are known by their names.
fn format_of(path: &Path, bytes: &[u8]) -> Option<Format> {
    let kind = Kind::of(bytes);
    if kind == Kind::Stream {
        return None;
    }
    let found = Format::of_bytes(bytes).filter(|&format| format != Format::Ply || kind == Kind::GaussianPly);
    let is_cloud = kind.group() == Group::Cloud || matches!(kind, Kind::Obj | Kind::Glb | Kind::Gltf);
    let named = || Format::of_path(path).filter(|format| matches!(format, Format::Splat | Format::Csv));
    found.or_else(|| named().filter(|_| !is_cloud))
}

/// Writes points or Gaussians in the format that the ending of the path names. The file appears whole or not at all.
///
/// Parameters
/// ----------
/// path : path
///     Points: .ply, .las, .laz, .pcd, .e57, .xyz. Gaussians: .ply, .compressed.ply, .spz, .sog, .splat, .glb, .gltf,
///     .csv, .npz.
/// thing : PointCloud, (xyz, rgb) or Gaussians
///     PLY keeps the coordinates of points as they are; the other formats put points that are on no voxel grid on one
///     of 2**21 voxels along the longest side. What a format of Gaussians does not keep is an `InputWarning`.
/// format : str, optional
///     The format, whatever the ending is, such as "laz" or "compressed-ply".
/// double : bool
///     Write coordinates of points as doubles, also where floats are exact.
/// limits : Limits, optional
///     Of points as arrays.
/// threads : int, optional
#[pyfunction]
#[pyo3(signature = (path, thing, *, format=None, double=false, limits=None, threads=None))]
pub fn write(
    py: Python<'_>,
    path: PathBuf,
    thing: &Bound<'_, PyAny>,
    format: Option<&str>,
    double: bool,
    limits: Option<PyLimits>,
    threads: Option<usize>,
) -> PyResult<()> {
    let work = Work::on(threads);
    let warnings = if let Ok(gaussians) = thing.cast::<PyGaussians>() {
        let format = splat_format(&path, format).map_err(|error| errors::exception(py, &error))?;
        let gaussians = gaussians.get().inner.clone();
        work.run(py, move |_, _| write_splats(&path, &gaussians, format))?
    } else {
        let format = point_format(&path, format).map_err(|error| errors::exception(py, &error))?;
        let (cloud, grid) = match thing.cast::<PyPointCloud>() {
            Ok(given) => (given.get().cloud.clone(), given.get().grid.clone()),
            Err(_) => {
                let (xyz, rgb): (Bound<'_, PyAny>, Bound<'_, PyAny>) = thing
                    .extract()
                    .map_err(|_| errors::usage(py, "expected a PointCloud, (xyz, rgb) or Gaussians to write"))?;
                (
                    PyPointCloud::of(&xyz, Some(&rgb), None, None, None, limits)?.cloud,
                    None,
                )
            }
        };
        work.run(py, move |_, _| {
            let file = points(&cloud, grid.as_deref(), format, double)?;
            write_file(&path, &file)?;
            Ok(Vec::new())
        })?
    };
    for warning in warnings {
        errors::warn(py, &warning)?;
    }
    Ok(())
}

/// Points as a file.
fn points(cloud: &PointCloud, grid: Option<&ColouredVoxels>, format: PointFormat, double: bool) -> Result<Vec<u8>> {
    let made;
    let grid = match grid {
        Some(grid) => grid,
        None if format == PointFormat::Ply => return Ok(cloud.to_ply()),
        None => {
            made = voxelise(cloud, Some(DEEPEST))?;
            &made
        }
    };
    let options = WriteOptions { double, local: false };
    Ok(clouds::encode(grid, &cloud.axes, format, options)?.bytes)
}

fn point_format(path: &Path, asked: Option<&str>) -> Result<PointFormat> {
    match asked {
        Some(name) => name.parse(),
        None => PointFormat::of(path).ok_or_else(|| {
            let names = ".ply, .las, .laz, .pcd, .e57 or .xyz";
            Error::Usage(format!("{}: no points end like this, but in {names}", path.display()))
        }),
    }
}

fn splat_format(path: &Path, asked: Option<&str>) -> Result<Format> {
    match asked {
        Some(name) => name.parse(),
        None => Format::of_path(path).ok_or_else(|| {
            let names: Vec<_> = Format::all().map(Format::extension).collect();
            let names = names.join(", ");
            Error::Usage(format!("{}: no splats end like this, but in {names}", path.display()))
        }),
    }
}

/// Writes Gaussians, and what was subtracted from coordinates far from the origin into a file beside. Returns what the
/// format does not keep.
fn write_splats(path: &Path, gaussians: &Gaussians, format: Format) -> Result<Vec<String>> {
    let mut warnings = Vec::new();
    output::write_file(path, |to| {
        warnings = splats::write(gaussians, Axes::Ply, format, to, path)?;
        Ok(())
    })?;
    let offset = splats::offset(gaussians, Axes::Ply, format);
    if offset == [0.0; 3] {
        return Ok(warnings);
    }
    let beside = sidecar(path);
    let text = json!({ "file": path.file_name().map(|name| name.to_string_lossy()), "offset": offset });
    write_file(&beside, format!("{text:#}\n").as_bytes())?;
    let [x, y, z] = offset;
    let beside = beside.display();
    warnings.push(format!(
        "coordinates are less an offset of {x} {y} {z}, which {beside} states"
    ));
    Ok(warnings)
}

/// The file that states the offset of another, as the program has it.
fn sidecar(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".offset.json");
    name.into()
}

fn offset_beside(path: &Path) -> Option<[f64; 3]> {
    let small = Limits::default().with_max_bytes(4096);
    let text = input::read_file(&sidecar(path), &small).ok()?;
    let value: Value = serde_json::from_slice(&text).ok()?;
    let [x, y, z] = value["offset"].as_array()?.as_slice() else {
        return None;
    };
    let offset = [x.as_f64()?, y.as_f64()?, z.as_f64()?];
    offset.iter().all(|x| x.is_finite()).then_some(offset)
}

fn write_file(path: &Path, bytes: &[u8]) -> Result<()> {
    output::write_file(path, |to: &mut dyn Write| {
        to.write_all(bytes).map_err(|source| Error::Io {
            path: path.to_owned(),
            source,
        })
    })
}
