//! Streams to Gaussians and points.

use std::path::PathBuf;

use b2p::container::axes;
use b2p::container::version;
use b2p::error::Stage;
use b2p::{Decoder, Error, Gaussians, Result, SceneDecoder};
use pyo3::prelude::*;

use crate::camera::PyCamera;
use crate::cloud::PyPointCloud;
use crate::gaussians::PyGaussians;
use crate::scene::{self, Input, Part, PyBox};
use crate::source::{Drawing, Loaded, Source, no_points};
use crate::values::{self, PyLimits};
use crate::work::Work;

/// Decodes a stream to Gaussians.
///
/// Parameters
/// ----------
/// stream : path or bytes
///     A `str` or `os.PathLike` is a path; bytes are `bytes`, `bytearray` or anything with a buffer.
/// level : int, optional
///     The octree level; the finest that can be drawn by default.
/// heads : {"best", "quick", "surfels"} or path, optional
///     What makes the Gaussians: the accurate network, the fast one, or opaque discs in closed form. A path with a dot
///     or a slash names a file of weights. Default: the best there are.
/// model : path, optional
///     The file of weights that `heads` are in; for streams of version 2, the model that coded them. Default: those
///     inside the library.
/// per_voxel : int, optional
///     Gaussians of a voxel: 1 or 8 of learned heads, 1 or 4 of surfels.
/// box : ((x, y, z), (x, y, z)), optional
///     Of a scene of blocks: the lowest and the highest corner of the part to decode, in the world.
/// camera : Camera, optional
///     Of a scene of blocks: decodes what this camera sees. Its picture is that of the whole scene.
/// lod : float
///     With a camera: width in pixels that voxels of a coarser level may have where it takes the place of the finest.
/// partial : bool
///     Whether a stream that ends within a level gives the level before; otherwise that is a `TruncatedError`. Of a
///     scene: whether damaged blocks are left out, with an `InputWarning`.
/// limits : Limits, optional
/// threads : int, optional
///     Threads of this call; those of `set_threads` by default.
/// progress : callable, optional
///     Called with the name of each step when it begins.
///
/// Returns
/// -------
/// Gaussians
///     float32 arrays in the cube frame, which are not copied.
#[pyfunction]
#[pyo3(signature = (stream, level=None, heads=None, *, model=None, per_voxel=None, r#box=None, camera=None,
    lod=0.0, partial=false, limits=None, threads=None, progress=None))]
pub fn decode(
    py: Python<'_>,
    stream: &Bound<'_, PyAny>,
    level: Option<u8>,
    heads: Option<&str>,
    model: Option<PathBuf>,
    per_voxel: Option<usize>,
    r#box: Option<PyBox>,
    camera: Option<PyCamera>,
    lod: f64,
    partial: bool,
    limits: Option<PyLimits>,
    threads: Option<usize>,
    progress: Option<Py<PyAny>>,
) -> PyResult<PyGaussians> {
    let source = Source::of(stream)?;
    let part = Part::new(py, r#box, camera, lod)?;
    let limits = values::limits(limits);
    let drawing = Drawing::new(py, heads, model, per_voxel, level)?;
    let work = Work {
        progress,
        ..Work::on(threads)
    };
    let (gaussians, level, up, lost) = work.run(py, move |cancel, log| {
        let source = match Input::of(source, &limits)? {
            Input::Scene(scene) => {
                let decoder = drawing.decoder(&[], &limits)?.with_cancel(cancel.clone());
                let blocks = scene.blocks().len();
                let decoded = log.step("decode scene", blocks, "blocks", || {
                    scene::gaussians(&scene, decoder, &part)
                });
                let (gaussians, lost) = scene::checked(decoded?, partial)?;
                let level = level.or(Some(scene.header().top)).filter(|_| part.lod == 0.0);
                return Ok((gaussians, level, scene::up(&scene), lost));
            }
            Input::Stream(source) => source,
        };
        part.refuse()?;
        let bytes = source.load(&limits)?;
        let decoder = drawing.decoder(&bytes, &limits)?;
        let decoder = decoder.with_cancel(cancel.clone()).with_log(log);
        let (gaussians, level) = gaussians(&decoder, &bytes, partial && level.is_none())?;
        let up = axes(&bytes).ok().and_then(|axes| axes.up);
        Ok((gaussians, level, up, Vec::new()))
    })?;
    scene::warn(py, &lost)?;
    Ok(PyGaussians {
        level,
        up,
        ..PyGaussians::bare(gaussians)
    })
}

/// The Gaussians of a stream, which may be cut anywhere if `partial`, and their level.
pub fn gaussians(decoder: &Decoder, bytes: &[u8], partial: bool) -> Result<(Gaussians, Option<u8>)> {
    let decoding = match partial {
        false => decoder.whole(bytes)?,
        true => {
            let mut decoding = decoder.start();
            decoding.push(bytes);
            match decoding.finish() {
                Err(error) if is_cut(&error) && decoding.is_drawable() => {}
                done => done?,
            }
            decoding
        }
    };
    Ok((decoding.gaussians()?, decoding.level()))
}

/// Whether a stream has ended too early.
fn is_cut(error: &Error) -> bool {
    let stage = Stage::Bitstream;
    matches!(error, Error::Truncated { stage: found, .. } if *found == stage)
}

/// Decodes a stream to the voxels of a level with their colours, which are equal on every machine.
///
/// Parameters
/// ----------
/// stream : path or bytes
///     A stream of version 3; those of version 2 have no colours of voxels.
/// level : int, optional
///     The octree level; the finest by default.
/// box : ((x, y, z), (x, y, z)), optional
///     Of a scene of blocks: the lowest and the highest corner of the part to decode, in the world.
/// partial : bool
///     Whether a stream that ends within a level gives the level before. Of a scene: whether damaged blocks are left
///     out, with an `InputWarning`.
/// limits : Limits, optional
/// threads : int, optional
/// progress : callable, optional
///     Called with the name of each step when it begins.
///
/// Returns
/// -------
/// PointCloud
///     ``xyz, rgb = decode_points(stream)``: the centres of the voxels in the world, float64 [n, 3], and their sRGB
///     colours, uint8 [n, 3]. Its attribute `voxels` has the voxels, uint32 [n, 3].
#[pyfunction]
#[pyo3(signature = (stream, level=None, *, r#box=None, partial=false, limits=None, threads=None, progress=None))]
pub fn decode_points(
    py: Python<'_>,
    stream: &Bound<'_, PyAny>,
    level: Option<u8>,
    r#box: Option<PyBox>,
    partial: bool,
    limits: Option<PyLimits>,
    threads: Option<usize>,
    progress: Option<Py<PyAny>>,
) -> PyResult<PyPointCloud> {
    let source = Source::of(stream)?;
    let part = Part::new(py, r#box, None, 0.0)?;
    let limits = values::limits(limits);
    let drawing = Drawing::for_points(level);
    let work = Work {
        progress,
        ..Work::on(threads)
    };
    let (cloud, lost) = work.run(py, move |cancel, log| {
        let source = match Input::of(source, &limits)? {
            Input::Scene(scene) => {
                let decoder = SceneDecoder::new(drawing.decoder(&[], &limits)?.with_cancel(cancel.clone()));
                let blocks = scene.blocks().len();
                let decoded = log.step("decode scene", blocks, "blocks", || {
                    decoder.points(&scene, &part.wanted())
                });
                let (grid, lost) = scene::checked(decoded?, partial)?;
                return Ok((PyPointCloud::of_grid(grid, scene.axes().unwrap_or_default()), lost));
            }
            Input::Stream(source) => source,
        };
        part.refuse()?;
        let bytes: Loaded = source.load(&limits)?;
        if version(&bytes) == Some(2) {
            return Err(no_points());
        }
        let decoder = drawing.decoder(&bytes, &limits)?;
        let decoder = decoder.with_cancel(cancel.clone()).with_log(log);
        let mut decoding = decoder.start();
        decoding.push(&bytes);
        match decoding.finish() {
            Err(error) if partial && level.is_none() && is_cut(&error) && decoding.level().is_some() => {}
            done => done?,
        }
        let points = decoding.points().map(|points| points.to_voxels());
        Ok((PyPointCloud::decoded(points.ok_or_else(no_points)?, &bytes), Vec::new()))
    })?;
    scene::warn(py, &lost)?;
    Ok(cloud)
}
