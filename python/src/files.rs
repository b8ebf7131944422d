//! Files of points and of Gaussians.

use std::io::Write;
use std::path::{Path, PathBuf};

use b2p::cloud::{Note, ReadOptions, voxelise};
use b2p::{ColouredVoxels, Error, Gaussians, Limits, PointCloud, Result, Up, input, output};
use b2p_formats::clouds::{self, PointFormat, WriteOptions};
use b2p_formats::detect::{Group, Kind};
use b2p_formats::sidecar::Sidecar;
use b2p_formats::splats::{self, Axes, Format};
use pyo3::prelude::*;

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
/// drop_hidden : bool
///     Leave out points that cannot be seen from outside, such as what closed surfaces surround.
/// vertices : bool
///     Take the vertices of a mesh as points. Otherwise meshes are refused.
/// limits : Limits, optional
/// threads : int, optional
///
/// Returns
/// -------
/// PointCloud or Gaussians
///     Gaussians in the axes of their cloud, if the file states them, else in those of PLY files.
#[pyfunction]
#[pyo3(signature = (path, *, format=None, up=None, unit=None, crop=None, drop_outliers=false, drop_hidden=false,
    vertices=false, limits=None, threads=None))]
pub fn read<'py>(
    py: Python<'py>,
    path: PathBuf,
    format: Option<&str>,
    up: Option<&str>,
    unit: Option<&Bound<'py, PyAny>>,
    crop: Option<[[f64; 3]; 2]>,
    drop_outliers: bool,
    drop_hidden: bool,
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
        drop_hidden,
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
        let beside = Sidecar::beside(path).unwrap_or_default();
        let mut read = clouds::read(bytes, path.parent(), limits, &beside.options(options))?;
        beside.complete(&mut read.cloud);
        return Ok(Content::Cloud(read.cloud, read.notes));
    };
    // Other formats say themselves what is beside them, too.
    let beside = match format {
        Format::Spz | Format::Splat | Format::Csv => Sidecar::beside(path).unwrap_or_default(),
        _ => Sidecar::default(),
    };
    let unsaid = splats::Options {
        offset: beside.offset,
        turned_from: beside.turned_from,
    };
    let splats = splats::read(&bytes, format, &unsaid, limits)?;
    let warnings = splats.warnings.clone();
    let up = match splats.axes {
        Axes::Cloud(up) => Some(up),
        Axes::Ply | Axes::Gltf => options.up,
    };
    Ok(Content::Gaussians(splats.into_cloud(), up, warnings))
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
///     of 2**21 voxels along the longest side. Gaussians whose `up` is known are turned to the axes of the format. What
///     a format of Gaussians does not keep is an `InputWarning`.
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
        let axes = gaussians.get().up.map_or(Axes::Ply, Axes::Cloud);
        let gaussians = gaussians.get().inner.clone();
        work.run(py, move |_, _| write_splats(&path, &gaussians, axes, format))?
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

/// Writes Gaussians, turned to the axes of the format if theirs are known, and a file beside with what the format has
/// no place for. Returns what is lost or unexpected.
fn write_splats(path: &Path, gaussians: &Gaussians, axes: Axes, format: Format) -> Result<Vec<String>> {
    let offset = splats::offset(gaussians.frame, axes, format);
    let turned_from = match axes {
        Axes::Cloud(up) if matches!(format, Format::Spz | Format::Splat | Format::Csv) => Some(up),
        _ => None,
    };
    let beside = Sidecar::path_of(path);
    let ours = Sidecar::beside(path).is_some();
    let needed = offset != [0.0; 3] || turned_from.is_some();
    if needed && !ours && beside.exists() {
        let what = "exists already and is of another program: coordinates that the format has no place for go there";
        return Err(Error::Usage(format!("{}: {what}", beside.display())));
    }
    let mut warnings = Vec::new();
    output::write_file(path, |to| {
        warnings = splats::write(gaussians, axes, format, to, path)?;
        Ok(())
    })?;
    if needed {
        let sidecar = Sidecar {
            offset,
            turned_from,
            ..Sidecar::default()
        };
        write_file(&beside, sidecar.to_json(path).as_bytes())?;
        warnings.push(format!("{} states {}", beside.display(), sidecar.contents()));
    } else if ours {
        std::fs::remove_file(&beside).map_err(|source| Error::Io { path: beside, source })?;
    }
    Ok(warnings)
}

fn write_file(path: &Path, bytes: &[u8]) -> Result<()> {
    output::write_file(path, |to: &mut dyn Write| {
        to.write_all(bytes).map_err(|source| Error::Io {
            path: path.to_owned(),
            source,
        })
    })
}
