//! Scenes of blocks: whole, in part, and as far as a camera sees them.

use std::borrow::Cow;

use b2p::container::scene::BlockEntry;
use b2p::geometry::morton;
use b2p::scene::ViewOptions;
use b2p::{
    Camera, DecodedScene, Decoder, Error, FileSource, Gaussians, Limits, Result, SceneDecoder, SceneReader, Up, Wanted,
};
use pyo3::prelude::*;
use pyo3::pybacked::PyBackedBytes;
use serde_json::{Value, json};

use crate::camera::PyCamera;
use crate::errors;
use crate::source::Source;

/// Bytes that tell a scene from a stream.
pub const START: usize = 16;

/// What a scene is read from.
pub enum SceneSource {
    /// A file, of which parts are read when they are needed.
    File(FileSource),
    Memory(PyBackedBytes),
}

impl b2p::Source for SceneSource {
    fn length(&self) -> u64 {
        match self {
            SceneSource::File(file) => file.length(),
            SceneSource::Memory(bytes) => bytes.length(),
        }
    }

    fn read(&self, offset: u64, count: usize) -> Result<Cow<'_, [u8]>> {
        match self {
            SceneSource::File(file) => file.read(offset, count),
            SceneSource::Memory(bytes) => bytes.read(offset, count),
        }
    }
}

/// A scene in a file or in memory.
pub type Scene = SceneReader<SceneSource>;

/// A stream of one frame, or a scene of blocks.
pub enum Input {
    Stream(Source),
    Scene(Box<Scene>),
}

impl Input {
    /// Looks at the first bytes of a source, and reads the index of a scene.
    pub fn of(source: Source, limits: &Limits) -> Result<Self> {
        let source = match source {
            Source::Memory(bytes) if SceneReader::is_scene(&bytes) => SceneSource::Memory(bytes),
            Source::File(path) if starts_like_a_scene(&path) => SceneSource::File(FileSource::open(&path)?),
            source => return Ok(Input::Stream(source)),
        };
        Ok(Input::Scene(Box::new(SceneReader::new(source, limits)?)))
    }
}

/// Whether a file does. What cannot be read is left to whoever reads it.
fn starts_like_a_scene(path: &std::path::Path) -> bool {
    let start = || -> std::io::Result<[u8; START]> {
        let mut start = [0; START];
        // What is no file is read once.
        if std::fs::metadata(path)?.is_file() {
            std::io::Read::read_exact(&mut std::fs::File::open(path)?, &mut start)?;
        }
        Ok(start)
    };
    start().is_ok_and(|start| SceneReader::is_scene(&start))
}

/// The lowest and the highest corner of a box in the world.
pub type PyBox = ([f64; 3], [f64; 3]);

/// The part of a scene that is asked for.
#[derive(Default)]
pub struct Part {
    pub within: Option<PyBox>,
    pub camera: Option<PyCamera>,
    /// Width in pixels that voxels of coarser levels may have in the picture.
    pub lod: f64,
}

impl Part {
    /// A part of one kind.
    pub fn new(py: Python<'_>, within: Option<PyBox>, camera: Option<PyCamera>, lod: f64) -> PyResult<Self> {
        if within.is_some() && camera.is_some() {
            return Err(errors::usage(
                py,
                "box and camera both name a part of a scene: give one of them",
            ));
        }
        if lod.is_nan() || lod < 0.0 || (lod > 0.0 && camera.is_none()) {
            let what = format!("lod is {lod}, expected a width in pixels, together with a camera");
            return Err(errors::usage(py, what));
        }
        Ok(Part { within, camera, lod })
    }

    /// Fails if a part is asked for of a stream of one frame.
    pub fn refuse(&self) -> Result<()> {
        match self.within.is_some() || self.camera.is_some() {
            true => Err(Error::Usage(
                "box and camera are for scenes of blocks, this is none".into(),
            )),
            false => Ok(()),
        }
    }

    /// What is to be decoded, camera aside.
    pub fn wanted(&self) -> Wanted {
        self.within.map_or(Wanted::All, |(low, high)| Wanted::Box(low, high))
    }
}

/// The axis that points up.
pub fn up(scene: &Scene) -> Option<Up> {
    scene.axes().ok().and_then(|axes| axes.up)
}

/// The Gaussians of a part of a scene.
pub fn gaussians(scene: &Scene, decoder: Decoder, part: &Part) -> Result<DecodedScene<Gaussians>> {
    let decoder = SceneDecoder::new(decoder);
    match &part.camera {
        None => decoder.gaussians(scene, &part.wanted()),
        Some(camera) => {
            let camera = resolved(scene, &decoder, camera, None)?;
            let options = ViewOptions::default().with_voxel_pixels(part.lod);
            decoder.visible(scene, &camera, options)
        }
    }
}

/// The renderer's camera.
pub fn resolved(scene: &Scene, decoder: &SceneDecoder, camera: &PyCamera, size: Option<(u32, u32)>) -> Result<Camera> {
    camera.resolve(&scene.frame(), &decoder.extent(scene)?, up(scene), size)
}

/// What was decoded, and what is to be said of blocks that were lost.
///
/// # Errors
/// Why a block was lost, unless `partial`.
pub fn checked<T>(decoded: DecodedScene<T>, partial: bool) -> Result<(T, Vec<String>)> {
    match partial {
        true => Ok((decoded.content, decoded.lost.iter().map(Error::to_string).collect())),
        false => Ok((decoded.whole()?, Vec::new())),
    }
}

/// Warns of blocks that were lost.
pub fn warn(py: Python<'_>, lost: &[String]) -> PyResult<()> {
    lost.iter().try_for_each(|what| errors::warn(py, what))
}

/// What a scene holds, as `b2p info --json` tells it.
pub fn description(scene: &Scene) -> Value {
    let header = scene.header();
    let axes = scene.axes().unwrap_or_default();
    let block = |block: &BlockEntry| {
        json!({
            "level": block.cube.level,
            "at": morton::decode(block.cube.key),
            "points": block.points,
            "voxels": block.voxels,
            "offset": block.offset,
            "bytes": block.bytes,
        })
    };
    json!({
        "version": header.format.version(),
        "bits": header.bits,
        "levels": [header.base, header.top],
        "points": header.points,
        "voxels": header.voxels,
        "total_bytes": scene.bytes(),
        "up": axes.up.map(|up| up.to_string()),
        "metres_per_unit": axes.metres_per_unit,
        "crs": axes.crs,
        "origin": header.placement.origin,
        "voxel_size": header.placement.voxel_size,
        "blocks": scene.blocks().iter().map(block).collect::<Vec<_>>(),
    })
}
