//! Gaussians to pictures.

use std::path::PathBuf;
use std::sync::Arc;

use b2p::container::Header;
use b2p::container::axes;
use b2p::scene::ViewOptions;
use b2p::{
    Background, Camera, Cancel, Channel, Decoder, EffectMode, Effects, Error, Extent, Gaussians, Image, Limits, Log,
    Quality, Renderer, Result, SceneDecoder, Up,
};
use numpy::{PyArray1, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::camera::PyCamera;
use crate::decode;
use crate::errors;
use crate::gaussians::PyGaussians;
use crate::scene::{self, Input, Scene};
use crate::source::{Drawing, Source};
use crate::values::{self, PyLimits};
use crate::work::Work;

/// What is drawn.
enum Drawn {
    Gaussians(Decoded),
    Stream(Source),
}

/// Gaussians that are drawn.
struct Decoded {
    gaussians: Arc<Gaussians>,
    up: Option<Up>,
    /// The camera that they were decoded for.
    camera: Option<Camera>,
}

/// What a picture shows, and what it is made of.
#[derive(Clone, Copy, PartialEq)]
enum Show {
    /// Eight bits a channel, straight alpha.
    Bytes,
    /// Floats, premultiplied.
    Floats,
    Alpha,
    Depth,
    Normal,
    Ids,
}

/// A picture that is to become an array.
enum Picture {
    Bytes(Vec<u8>, usize),
    Floats(Vec<f32>, usize),
    Ids(Vec<i32>),
}

/// How a picture is drawn.
struct Sketch {
    camera: PyCamera,
    size: Option<(u32, u32)>,
    show: Show,
    background: Background,
    effects: Effects,
    quality: Quality,
    lod: f64,
    limits: Limits,
}

/// Draws a picture.
///
/// Parameters
/// ----------
/// scene : Gaussians, or a stream as path or bytes
///     A stream is decoded as `decode` does; levels whose voxels fall under a pixel are left out, as `b2p render` does.
///     Of a scene of blocks, what the camera sees is decoded.
/// camera : Camera, optional
///     By default from the front, with the whole object in view.
/// width, height : int, optional
///     Size of the picture in pixels: both or none. By default that of the camera, else 1024 × 1024.
/// background : str or (float, float, float)
///     "white", "black", "grey", "#rrggbb", "transparent", or red, green and blue from 0 to 1.
/// effects : dict, optional
///     "harmonics", "antialias", "supersample", "near", "order" to True, False or "auto", the default.
/// channel : {"colour", "alpha", "depth", "normal", "ids"}
///     What is shown.
/// quality : {"fast", "fine", "exact"}
/// dtype : {"uint8", "float32"}
///     Of colours.
/// level, heads, model, per_voxel, lod : optional
///     As of `decode`, for streams; `lod` for scenes of blocks.
/// limits : Limits, optional
/// threads : int, optional
///
/// Returns
/// -------
/// ndarray, rows from the top
///     "colour": [height, width, 3], or [height, width, 4] with a transparent background; uint8 with straight alpha, to
///     the bit as in the program's PNG files, or float32, premultiplied, display-referred and not clamped.
///     "alpha": float32 [height, width], 0 to 1.
///     "depth": float32 [height, width], distance along the viewing direction in units of the world; inf where nothing
///     is.
///     "normal": float32 [height, width, 3] in the camera's axes (x right, y down, z forward); zeros where nothing is.
///     "ids": int32 [height, width], the index of the Gaussian that a pixel shows most of; -1 where nothing is.
#[pyfunction]
#[pyo3(signature = (scene, camera=None, width=None, height=None, *, background=None, effects=None, channel="colour",
    quality="fine", dtype="uint8", level=None, heads=None, model=None, per_voxel=None, lod=0.0,
    limits=None, threads=None))]
pub fn render<'py>(
    py: Python<'py>,
    scene: &Bound<'py, PyAny>,
    camera: Option<PyCamera>,
    width: Option<u32>,
    height: Option<u32>,
    background: Option<&Bound<'py, PyAny>>,
    effects: Option<&Bound<'py, PyDict>>,
    channel: &str,
    quality: &str,
    dtype: &str,
    level: Option<u8>,
    heads: Option<&str>,
    model: Option<PathBuf>,
    per_voxel: Option<usize>,
    lod: f64,
    limits: Option<PyLimits>,
    threads: Option<usize>,
) -> PyResult<Bound<'py, PyAny>> {
    let size = match (width, height) {
        (Some(width), Some(height)) => Some((width, height)),
        (None, None) => None,
        _ => return Err(errors::usage(py, "width and height are given together or not at all")),
    };
    let sketch = Sketch {
        camera: camera.unwrap_or_else(PyCamera::front),
        size,
        show: show(py, channel, dtype)?,
        background: background.map_or(Ok(Background::WHITE), colour)?,
        effects: effects.map_or(Ok(Effects::default()), forced)?,
        quality: quality.parse().map_err(|e: String| errors::usage(py, e))?,
        lod,
        limits: values::limits(limits),
    };
    let drawing = Drawing::new(py, heads, model, per_voxel, level)?;
    let scene = scene_of(scene, &drawing)?;
    let (picture, [width, height]) = Work::on(threads).run(py, move |cancel, log| {
        let decoded = match scene {
            Drawn::Gaussians(decoded) => decoded,
            Drawn::Stream(source) => sketch.decoded(source, drawing, cancel, log)?,
        };
        cancel.check()?;
        sketch.draw(&decoded)
    })?;
    array(py, picture, width as usize, height as usize)
}

/// Gaussians, or a stream, for which `drawing` is.
fn scene_of(scene: &Bound<'_, PyAny>, drawing: &Drawing) -> PyResult<Drawn> {
    let Ok(gaussians) = scene.cast::<PyGaussians>() else {
        return Source::of(scene).map(Drawn::Stream);
    };
    if !drawing.is_default() {
        let what = "level, heads, model and per_voxel are for streams, these are Gaussians";
        return Err(errors::usage(scene.py(), what));
    }
    let PyGaussians { inner, up, .. } = gaussians.get();
    Ok(Drawn::Gaussians(Decoded {
        gaussians: inner.clone(),
        up: *up,
        camera: None,
    }))
}

impl Sketch {
    /// The Gaussians of a stream, at the level that the camera calls for unless one is named, and what is up.
    fn decoded(&self, source: Source, drawing: Drawing, cancel: &Cancel, log: &Log) -> Result<Decoded> {
        let source = match Input::of(source, &self.limits)? {
            Input::Scene(scene) => return self.seen(&scene, &drawing, cancel, log),
            Input::Stream(source) => source,
        };
        let bytes = source.load(&self.limits)?;
        let decoder = drawing.decoder(&bytes, &self.limits)?;
        let decoder = decoder.with_cancel(cancel.clone()).with_log(log);
        let up = axes(&bytes).ok().and_then(|axes| axes.up);
        let level = match drawing.level() {
            None => self.level(&decoder, &bytes, up)?,
            level => level,
        };
        let (gaussians, _) = decode::gaussians(&decoder.with_level(level), &bytes, false)?;
        Ok(Decoded {
            gaussians: Arc::new(gaussians),
            up,
            camera: None,
        })
    }

    /// What the camera sees of a scene of blocks.
    fn seen(&self, scene: &Scene, drawing: &Drawing, cancel: &Cancel, log: &Log) -> Result<Decoded> {
        let decoder = drawing.decoder(&[], &self.limits)?.with_cancel(cancel.clone());
        let decoder = SceneDecoder::new(decoder);
        let camera = scene::resolved(scene, &decoder, &self.camera, self.size)?;
        let options = ViewOptions::default().with_voxel_pixels(self.lod);
        let seen = log.step("decode what is seen", scene.blocks().len(), "blocks", || {
            decoder.visible(scene, &camera, options)?.whole()
        })?;
        Ok(Decoded {
            gaussians: Arc::new(seen),
            up: scene::up(scene),
            camera: Some(camera),
        })
    }

    /// The coarsest level whose voxels fall under a pixel, if there are finer ones.
    fn level(&self, decoder: &Decoder, bytes: &[u8], up: Option<Up>) -> Result<Option<u8>> {
        let frame = decoder.frame(bytes)?;
        let level = |extent: &Extent| {
            let camera = self.camera.resolve(&frame, extent, up, self.size)?;
            decoder.level_for(bytes, camera.pixels_per_unit())
        };
        match level(&Extent::cube())? {
            None => Ok(None),
            // What keeps the object in view is nearer than what keeps the cube in view.
            Some(_) => level(&extent(bytes, decoder, &self.limits)),
        }
    }

    fn draw(&self, decoded: &Decoded) -> Result<(Picture, [u32; 2])> {
        let gaussians = &*decoded.gaussians;
        let camera = match decoded.camera {
            Some(camera) => camera,
            None => {
                let extent = Extent::of_gaussians(gaussians);
                self.camera.resolve(&gaussians.frame, &extent, decoded.up, self.size)?
            }
        };
        let (channel, background) = match self.show {
            Show::Bytes | Show::Floats => (Channel::Colour, self.background),
            Show::Alpha => (Channel::Colour, Background::Transparent),
            Show::Depth => (Channel::Depth, Background::Transparent),
            Show::Normal => (Channel::Normal, Background::Transparent),
            Show::Ids => return self.ids(gaussians, &camera),
        };
        let mut renderer = Renderer::new()
            .with_background(background)
            .with_channel(channel)
            .with_quality(self.quality)
            .with_effects(self.effects)
            .with_limits(self.limits.clone());
        let image = renderer.render(gaussians, &camera)?;
        let picture = match self.show {
            Show::Alpha => Picture::Floats(image.pixels.iter().map(|pixel| pixel[3]).collect(), 1),
            Show::Depth => {
                let unit = gaussians.frame.unit() as f32;
                Picture::Floats(image.distances().iter().map(|z| z * unit).collect(), 1)
            }
            Show::Normal => Picture::Floats(image.pixels.iter().flat_map(normal).collect(), 3),
            Show::Bytes => bytes(&image, background)?,
            Show::Floats | Show::Ids => match background {
                Background::Transparent => Picture::Floats(image.pixels.into_flattened(), 4),
                _ => Picture::Floats(image.pixels.iter().flat_map(|&[r, g, b, _]| [r, g, b]).collect(), 3),
            },
        };
        Ok((picture, camera.size()))
    }

    fn ids(&self, gaussians: &Gaussians, camera: &Camera) -> Result<(Picture, [u32; 2])> {
        if i32::try_from(gaussians.len()).is_err() {
            return Err(Error::Unsupported {
                what: "a picture of the numbers of 2^31 Gaussians or more",
                detail: format!("there are {}", gaussians.len()),
            });
        }
        let mut renderer = Renderer::new()
            .with_limits(self.limits.clone())
            .with_quality(self.quality);
        let ids = renderer.ids(gaussians, camera)?;
        // Nothing, which is the greatest number, becomes −1.
        let ids = ids.indices.iter().map(|id| *id as i32).collect();
        Ok((Picture::Ids(ids), camera.size()))
    }
}

/// The part of the cube that a stream's object takes, as its base level tells; the whole cube if that cannot be known.
fn extent(bytes: &[u8], decoder: &Decoder, limits: &Limits) -> Extent {
    let base = || {
        let header = Header::parse(bytes, limits).ok()?;
        let mut decoding = decoder.clone().with_level(None).start();
        decoding.push(bytes.get(..header.prefix_bytes(header.base).ok()? as usize)?);
        decoding.advance().ok()??;
        let voxels = decoding.voxels()?;
        let half = f64::from(1u32 << voxels.depth()) / 2.0;
        let spheres = (0..voxels.len()).map(|i| {
            let centre = voxels.coordinate(i).map(|x| (f64::from(x) + 0.5) / half - 1.0);
            (centre, 0.5 / half)
        });
        Some(Extent::of(spheres))
    };
    base().unwrap_or(Extent::cube())
}

/// The normal of a pixel, which is stored premultiplied and from 0 to 1.
fn normal(pixel: &[f32; 4]) -> [f32; 3] {
    let [x, y, z, alpha] = *pixel;
    match alpha > 0.0 {
        true => [x, y, z].map(|n| 2.0 * n / alpha - 1.0),
        false => [0.0; 3],
    }
}

/// Eight bits a channel, as in PNG files.
fn bytes(image: &Image, background: Background) -> Result<Picture> {
    let pixmap = image.to_pixmap()?;
    let straight = pixmap.pixels().iter().map(|pixel| pixel.demultiply());
    Ok(match background {
        Background::Transparent => {
            let bytes = straight.flat_map(|c| [c.red(), c.green(), c.blue(), c.alpha()]);
            Picture::Bytes(bytes.collect(), 4)
        }
        _ => Picture::Bytes(straight.flat_map(|c| [c.red(), c.green(), c.blue()]).collect(), 3),
    })
}

/// The array of a picture, which takes over its memory.
fn array(py: Python<'_>, picture: Picture, width: usize, height: usize) -> PyResult<Bound<'_, PyAny>> {
    Ok(match picture {
        Picture::Bytes(values, channels) => PyArray1::from_vec(py, values)
            .reshape([height, width, channels])?
            .into_any(),
        Picture::Floats(values, 1) => PyArray1::from_vec(py, values).reshape([height, width])?.into_any(),
        Picture::Floats(values, channels) => PyArray1::from_vec(py, values)
            .reshape([height, width, channels])?
            .into_any(),
        Picture::Ids(values) => PyArray1::from_vec(py, values).reshape([height, width])?.into_any(),
    })
}

fn show(py: Python<'_>, channel: &str, dtype: &str) -> PyResult<Show> {
    let floats = match dtype {
        "uint8" => false,
        "float32" => true,
        other => {
            let what = format!("dtype is {other:?}, expected \"uint8\" or \"float32\"");
            return Err(errors::usage(py, what));
        }
    };
    Ok(match channel {
        "colour" | "color" if floats => Show::Floats,
        "colour" | "color" => Show::Bytes,
        "alpha" => Show::Alpha,
        "depth" => Show::Depth,
        "normal" => Show::Normal,
        "ids" => Show::Ids,
        other => {
            let what =
                format!("channel is {other:?}, expected \"colour\", \"alpha\", \"depth\", \"normal\" or \"ids\"");
            return Err(errors::usage(py, what));
        }
    })
}

/// A background by its name or its numbers.
fn colour(value: &Bound<'_, PyAny>) -> PyResult<Background> {
    let py = value.py();
    let Ok(name) = value.extract::<String>() else {
        return Ok(Background::Colour(value.extract()?));
    };
    let named = match name.as_str() {
        "transparent" => return Ok(Background::Transparent),
        "white" => Some([255; 3]),
        "black" => Some([0; 3]),
        "grey" | "gray" => Some([128; 3]),
        _ => hex(&name),
    };
    let named = named.ok_or_else(|| {
        let what = format!("the background is {name:?}, expected white, black, grey, #rrggbb or transparent");
        errors::usage(py, what)
    })?;
    Ok(Background::Colour(named.map(|v| f32::from(v) / 255.0)))
}

fn hex(text: &str) -> Option<[u8; 3]> {
    let digits = text.strip_prefix('#').filter(|d| d.len() == 6 && d.is_ascii())?;
    let channel = |i: usize| u8::from_str_radix(&digits[2 * i..2 * i + 2], 16).ok();
    Some([channel(0)?, channel(1)?, channel(2)?])
}

/// Effects that are forced on or off.
fn forced(given: &Bound<'_, PyDict>) -> PyResult<Effects> {
    let py = given.py();
    let mut effects = Effects::default();
    for (name, choice) in given.iter() {
        let effect = name
            .extract::<String>()?
            .parse()
            .map_err(|e: String| errors::usage(py, e))?;
        let mode = match choice.extract::<bool>() {
            Ok(true) => EffectMode::On,
            Ok(false) => EffectMode::Off,
            Err(_) => choice
                .extract::<String>()?
                .parse()
                .map_err(|e: String| errors::usage(py, e))?,
        };
        effects = effects.with(effect, mode);
    }
    Ok(effects)
}
