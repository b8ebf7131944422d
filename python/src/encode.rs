//! Point clouds to streams.

use std::sync::Arc;

use b2p::cloud::{voxelise, voxelise_closed};
use b2p::encoder::transform::{self, GeometryTarget, Options, Outline, QualityTarget, Tune};
use b2p::scene::{BLOCK_VOXELS, ONE_PIECE};
use b2p::{Cancel, Error, Limits, Log, PointCloud, Result, SceneEncoder, container};
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::cloud::PyPointCloud;
use crate::values::{self, PyLimits};
use crate::work::Work;
use crate::{errors, source};

/// Share of a stream, one in so many bytes, that a coordinate system may take, as of the program's streams.
const CRS_SHARE: f64 = 20.0;

/// What was asked for.
struct Asked {
    bits: Option<u8>,
    bits_per_point: Option<f64>,
    quality: Option<u8>,
    effort: Option<u8>,
    tune: Option<Tune>,
    outline: Outline,
    head_maps: bool,
    /// Voxels of a block at most, for clouds with more than that; by default those of the program.
    block_size: Option<usize>,
    /// Whether large clouds become scenes.
    blocks: bool,
    limits: Limits,
    options: Options,
}

/// Codes a coloured point cloud as a stream, as `b2p encode` does.
///
/// Parameters
/// ----------
/// xyz : array_like of numbers, [n, 3], or PointCloud
///     Coordinates in the world, in any unit. Points with a coordinate that is not finite are left out, with a warning.
/// rgb : array_like of uint8 or of floats from 0 to 1, [n, 3], optional
///     sRGB colours. Without any, points are shaded by their height, with a warning.
/// bits : int, optional
///     Depth of the voxel grid, 1 to 21: 2**bits voxels along the longest side. By default the finest grid on which
///     surfaces are closed.
/// bits_per_point : float, optional
///     Make the best stream of at most so many bits for each occupied voxel, the whole stream counted.
/// quality : int, optional
///     0 to 100: chooses quantisation step and finest level. 100 is lossless, 38 the default.
/// step : float or (float, float), optional
///     Quantisation step of luma, or steps of luma and chroma, in 255ths, 0.5 to 1000. Default: 20.
/// lossless : bool
///     Code the mean colours of the finest level's voxels exactly.
/// geometry : "exact", "visual" or float
///     Geometry of the finest level: its voxels as they are, or moved by at most one where that saves bits and looks
///     alike; a number from 0 to 100 is the Lagrangian of that, in squared voxels per bit. Lossless streams
///     keep all voxels.
/// levels : (int, int), optional
///     First and last level that the stream may be cut after, the last at most `bits`. Default: bits - 3 to bits - 1.
/// effort : int, optional
///     0 (quick) to 9; 8 and 9 compare pictures from all sides, and take 3 and 5 times as long. Default: 7.
/// tune : "visual" or "psnr"
///     What coded colours approach: those with which the cloud is drawn as it is, or the mean colours of voxels.
/// outline : "surface" or "cloud"
///     How far Gaussians reach: to the surface that the points sample, or as far as the cloud itself does when it is drawn
///     as surfels, for captures.
/// filter : bool
///     Whether the stream has the colour filter, which decoders apply before they draw.
/// head_maps : bool
///     Whether the stream says where surfels draw better than the learned heads.
/// block_size : int, optional
///     Make a scene of a cloud with more voxels: blocks of at most so many, which are coded and read one by one. By
///     default clouds with more than 2**22 voxels become blocks of 2**21.
/// blocks : bool
///     If False, code a cloud of any size in one piece.
/// up, unit, crs : optional
///     As of `PointCloud`, for clouds that do not say.
/// limits : Limits, optional
/// threads : int, optional
///     Threads of this call; those of `set_threads` by default.
/// progress : callable, optional
///     Called with the name of each step when it begins.
///
/// Returns
/// -------
/// bytes
///     The stream or scene, which `decode`, `decode_points`, `open`, `info` and `render` take.
#[pyfunction]
#[pyo3(signature = (xyz, rgb=None, *, bits=None, bits_per_point=None, quality=None, step=None, lossless=false,
    geometry=None, levels=None, effort=None, tune=None, outline="surface", filter=true, head_maps=true,
    block_size=None, blocks=true, up=None, unit=None, crs=None, limits=None, threads=None, progress=None))]
pub fn encode<'py>(
    py: Python<'py>,
    xyz: &Bound<'py, PyAny>,
    rgb: Option<&Bound<'py, PyAny>>,
    bits: Option<u8>,
    bits_per_point: Option<f64>,
    quality: Option<u8>,
    step: Option<&Bound<'py, PyAny>>,
    lossless: bool,
    geometry: Option<&Bound<'py, PyAny>>,
    levels: Option<(u8, u8)>,
    effort: Option<u8>,
    tune: Option<&str>,
    outline: &str,
    filter: bool,
    head_maps: bool,
    block_size: Option<usize>,
    blocks: bool,
    up: Option<&str>,
    unit: Option<&Bound<'py, PyAny>>,
    crs: Option<String>,
    limits: Option<PyLimits>,
    threads: Option<usize>,
    progress: Option<Py<PyAny>>,
) -> PyResult<Bound<'py, PyBytes>> {
    check(py, bits_per_point, quality, step.is_some(), lossless)?;
    if block_size.is_some_and(|size| size == 0 || !blocks) {
        let what = "block_size is at least 1, and goes without blocks=False";
        return Err(errors::usage(py, what));
    }
    let limits_of_blocks = limits.as_ref().map_or_else(Limits::default, |limits| limits.0.clone());
    let mut options = Options {
        levels: levels.map(|(first, last)| first..=last),
        geometry: geometry.map_or(Ok(GeometryTarget::Visual), shape)?,
        filter,
        ..Options::default()
    };
    match step {
        Some(step) => options.fineness = steps(step)?,
        None if lossless => options.fineness = QualityTarget::Lossless,
        None => {}
    }
    let cloud = cloud(xyz, rgb, up, unit, crs, limits)?;
    let asked = Asked {
        bits,
        bits_per_point,
        quality,
        effort,
        tune: tune.map(|tune| tuned(py, tune)).transpose()?,
        outline: outlined(py, outline)?,
        head_maps,
        block_size,
        blocks,
        limits: limits_of_blocks,
        options,
    };
    let work = Work {
        progress,
        ..Work::on(threads)
    };
    let (stream, left_out) = work.run(py, move |cancel, log| code(&cloud, asked, cancel, log))?;
    if left_out > 0 {
        let what = format!("left out the coordinate system: its {left_out} bytes are too many at this rate");
        errors::warn(py, &what)?;
    }
    Ok(PyBytes::new(py, &stream))
}

/// Fails if what is asked for contradicts itself.
fn check(
    py: Python<'_>,
    bits_per_point: Option<f64>,
    quality: Option<u8>,
    has_step: bool,
    lossless: bool,
) -> PyResult<()> {
    let asked = [bits_per_point.is_some(), quality.is_some(), has_step, lossless];
    if asked.iter().filter(|asked| **asked).count() > 1 {
        let what = "at most one of bits_per_point, quality, step and lossless can be asked for";
        return Err(errors::usage(py, what));
    }
    match quality {
        Some(quality @ 101..) => Err(errors::usage(
            py,
            format!("the quality is {quality}, expected 0 to 100"),
        )),
        _ => Ok(()),
    }
}

/// The cloud of arrays, or the one that was given; what was named beside holds for both.
fn cloud(
    xyz: &Bound<'_, PyAny>,
    rgb: Option<&Bound<'_, PyAny>>,
    up: Option<&str>,
    unit: Option<&Bound<'_, PyAny>>,
    crs: Option<String>,
    limits: Option<PyLimits>,
) -> PyResult<Arc<PointCloud>> {
    let py = xyz.py();
    let Ok(given) = xyz.cast::<PyPointCloud>() else {
        let made = PyPointCloud::of(xyz, rgb, up, unit, crs, limits)?;
        return Ok(made.cloud);
    };
    if rgb.is_some() {
        return Err(errors::usage(py, "the cloud has colours of its own, rgb is not for it"));
    }
    let (up, unit) = (values::up(py, up)?, values::unit(unit)?);
    let mut cloud = given.get().cloud.clone();
    if up.is_some() || unit.is_some() || crs.is_some() {
        let axes = &mut Arc::make_mut(&mut cloud).axes;
        axes.up = up.or(axes.up);
        axes.metres_per_unit = unit.or(axes.metres_per_unit);
        axes.crs = crs.unwrap_or(std::mem::take(&mut axes.crs));
    }
    Ok(cloud)
}

/// How exactly geometry is coded.
fn shape(geometry: &Bound<'_, PyAny>) -> PyResult<GeometryTarget> {
    if let Ok(lambda) = geometry.extract::<f32>()
        && (0.0..=100.0).contains(&lambda)
    {
        return Ok(GeometryTarget::Lambda(lambda));
    }
    match geometry.extract::<String>().as_deref() {
        Ok("exact") => Ok(GeometryTarget::Exact),
        Ok("visual") => Ok(GeometryTarget::Visual),
        _ => {
            let what = "\"exact\", \"visual\" or a number from 0 to 100";
            let what = format!("geometry is {}, expected {what}", geometry.repr()?);
            Err(errors::usage(geometry.py(), &what))
        }
    }
}

/// What coded colours approach.
fn tuned(py: Python<'_>, tune: &str) -> PyResult<Tune> {
    match tune {
        "visual" => Ok(Tune::Visual),
        "psnr" => Ok(Tune::Psnr),
        _ => Err(errors::usage(
            py,
            format!("tune is '{tune}', expected 'visual' or 'psnr'"),
        )),
    }
}

/// How far Gaussians reach.
fn outlined(py: Python<'_>, outline: &str) -> PyResult<Outline> {
    match outline {
        "surface" => Ok(Outline::Surface),
        "cloud" => Ok(Outline::Cloud),
        _ => Err(errors::usage(
            py,
            format!("outline is '{outline}', expected 'surface' or 'cloud'"),
        )),
    }
}

/// One step, or luma's and chroma's.
fn steps(step: &Bound<'_, PyAny>) -> PyResult<QualityTarget> {
    if let Ok(luma) = step.extract() {
        return Ok(QualityTarget::Step(luma));
    }
    let (luma, chroma) = step.extract()?;
    Ok(QualityTarget::Steps { luma, chroma })
}

/// The stream, and how many bytes of a coordinate system are not in it.
fn code(cloud: &PointCloud, asked: Asked, cancel: &Cancel, log: &Log) -> Result<(Vec<u8>, usize)> {
    let grid = log.step("voxelise", cloud.positions.len(), "points", || match asked.bits {
        None => voxelise_closed(cloud).map(|(grid, _)| grid),
        Some(bits) => voxelise(cloud, Some(bits)),
    })?;
    let mut options = asked.options;
    options.heads = Some(source::embedded_heads()?);
    options.head_maps = asked.head_maps;
    options.outline = asked.outline;
    if let Some(quality) = asked.quality {
        options.set_quality(quality, grid.voxels.depth());
    }
    if let Some(effort) = asked.effort {
        options.set_effort(effort);
    }
    if let Some(tune) = asked.tune {
        options.tune = tune;
    }
    let (points, voxels) = (cloud.positions.len(), grid.voxels.len());
    if asked.blocks && voxels > asked.block_size.unwrap_or(ONE_PIECE) {
        let encoder = SceneEncoder::new()
            .with_options(options)
            .with_block_voxels(asked.block_size.unwrap_or(BLOCK_VOXELS))
            .with_memory(asked.limits.max_bytes)
            .with_axes(cloud.axes.clone())
            .with_cancel(cancel.clone());
        let scene = log.step("code blocks", voxels, "voxels", || match asked.bits_per_point {
            Some(most) => encoder.encode_to_rate(&grid, most).map(|(scene, ..)| scene),
            None => encoder.encode(&grid),
        })?;
        return Ok((scene, 0));
    }
    let merged = (points > voxels).then_some(points as u64);
    let voxels = voxels as f64;
    let mut axes = cloud.axes.clone();
    let mut left_out = 0;
    let Some(most) = asked.bits_per_point else {
        let stream = transform::encode(&grid, &options, log)?.bytes;
        return Ok((container::with_source(&stream, &axes, merged)?, 0));
    };
    if !(most.is_finite() && most > 0.0) {
        return Err(Error::Usage(format!(
            "bits_per_point is {most}, expected a number above 0"
        )));
    }
    if axes.crs.len() as f64 > most * voxels / 8.0 / CRS_SHARE {
        left_out = axes.crs.len();
        axes.crs.clear();
    }
    // The rate counts the whole stream.
    let reserved = container::source_bytes(&axes, merged) as f64 * 8.0 / voxels;
    let (encoded, _) = transform::encode_to_rate(&grid, &options, most - reserved, log)?;
    Ok((container::with_source(&encoded.bytes, &axes, merged)?, left_out))
}
