//! Files in: models, streams, Gaussians.

use std::path::Path;

use b2p::container::{Header, Stream, version};
use b2p::gaussians::HeadSet;
use b2p::gaussians::learned::HeadsModel;
use b2p::gaussians::{Frame, Gaussians};
use b2p::latents::network::Model;
use b2p::log::Log;
use b2p::renderer::Explanation;
use b2p::renderer::camera::Extent;
use b2p::{Axes, Decoder, Error, Isa, Limits, UnknownIsa, input};

use super::args::{DetailArg, ModelArg};
use super::cloud::ReadArgs;
use super::views::Shot;
use super::{Failure, Result, cloud, convert, data, kinds, manners, pipe};

/// A stream or Gaussians, told apart by their first bytes.
pub const PLY_MAGIC: &[u8] = b"ply";

/// The environment variable that says which instructions to use when the arguments don't.
const ISA: &str = "B2P_ISA";

/// The model in a file, or the program's own.
pub fn from_file(path: Option<&Path>) -> Result<Model> {
    match path {
        Some(path) => Model::open(path).map_err(Failure::in_file(path)),
        None => Ok(Model::from_bytes(&data::model()?)?),
    }
}

/// The heads in a file, or those inside the program.
pub fn heads(path: Option<&Path>) -> Result<HeadsModel> {
    match path {
        Some(path) => HeadsModel::open(path).map_err(Failure::in_file(path)),
        None => Ok(HeadsModel::from_bytes(b2p::embedded::HEADS)?),
    }
}

/// The model in a file, or the program's own, set to the instructions and the precision asked for.
pub fn model(arg: &ModelArg) -> Result<Model> {
    let model = from_file(arg.model.as_deref())?;
    let model = model.with_isa(isa(arg.isa.as_deref())?);
    match &arg.precision {
        Some(name) => Ok(model.with_precision(name.parse()?)?),
        None => Ok(model),
    }
}

/// What decodes the stream that starts with these bytes, with the heads asked for. A model is loaded only if it takes
/// one.
pub fn decoder(bytes: &[u8], detail: &DetailArg, model_arg: &ModelArg, limits: &Limits) -> Result<Decoder> {
    let mut decoder = Decoder::new()
        .with_isa(isa(model_arg.isa.as_deref())?)
        .with_limits(limits.clone())
        .with_level(detail.level);
    if let Some(heads) = detail.heads {
        decoder = decoder.with_heads(heads);
    }
    if let Some(count) = detail.per_voxel {
        decoder = decoder.with_per_voxel(count);
    }
    if version(bytes) == Some(2) {
        return Ok(decoder.with_model(model(model_arg)?));
    }
    if let Some(name) = &model_arg.precision {
        decoder = decoder.with_precision(name.parse()?);
    }
    if detail.heads != Some(HeadSet::Surfels) {
        decoder = decoder.with_heads_model(heads(model_arg.model.as_deref())?);
    }
    Ok(decoder)
}

/// The instructions of that name; without one, what the environment names, or the best of this machine.
pub fn isa(name: Option<&str>) -> Result<Isa> {
    let parse = |name: &str| name.parse().map_err(|e: UnknownIsa| Failure(e.to_string()));
    match (name, std::env::var(ISA)) {
        (Some(name), _) => parse(name),
        (None, Ok(name)) => parse(&name),
        (None, Err(_)) => Ok(Isa::detect()),
    }
}

/// The bytes of a file, or of standard input, no more than the limits allow.
pub fn bytes(path: &Path, limits: &Limits) -> Result<Vec<u8>> {
    let bytes = match manners::is_pipe(path) {
        true => input::read_all(pipe::stdin(), 0, path, limits),
        false => input::read_file(path, limits),
    };
    bytes.map_err(Failure::in_file(path))
}

/// Fails, before anything is begun, unless the machine has this much memory to give, and what everything else takes.
pub fn reserve(what: &'static str, bytes: u64) -> Result<()> {
    let mut trial = Vec::<u8>::new();
    let bytes = bytes.saturating_add(Limits::OVERHEAD);
    let bytes_here = usize::try_from(bytes).unwrap_or(usize::MAX);
    let had = trial.try_reserve_exact(bytes_here);
    had.map_err(|_| Failure::from(Error::OutOfMemory { what, bytes }))
}

/// The same for a stream, decoded down to `level` or as far as it goes.
pub fn reserve_for(path: &Path, bytes: &[u8], decoder: &Decoder, level: Option<u8>, limits: &Limits) -> Result<()> {
    let Ok(header) = Header::parse(bytes, limits) else {
        // What is wrong is said when it is decoded.
        return Ok(());
    };
    let memory = decoder.memory(&header, level.unwrap_or(header.top));
    match memory {
        Ok(memory) if limits.check_bytes("", memory).is_ok() => {
            reserve("decoding", memory).map_err(|Failure(text)| Failure(format!("{}: {text}", path.display())))
        }
        _ => Ok(()),
    }
}

/// The bytes of a stream's file. If it is cut within a level and none was named, those up to the finest complete level,
/// with a warning.
pub fn whole_levels(path: &Path, mut bytes: Vec<u8>, detail: &DetailArg, limits: &Limits) -> Result<Vec<u8>> {
    if detail.level.is_some() {
        return Ok(bytes);
    }
    let Ok(stream) = Stream::parse(&bytes, limits) else {
        return Ok(bytes);
    };
    let (Some(error @ Error::Truncated { .. }), Some(finest)) = (stream.damage(), stream.deepest()) else {
        return Ok(bytes);
    };
    let end = stream.header().prefix_bytes(finest).map_err(Failure::in_file(path))?;
    if end < bytes.len() as u64 {
        let what = format!("what follows is level {finest}, the finest that is complete");
        manners::warn(&format!("{}: {error}; {what}", path.display()));
    }
    let end = end as usize;
    bytes.truncate(end);
    Ok(bytes)
}

/// The part of the cube that a stream's object takes, as its base level tells; the whole cube if that cannot be known.
pub fn extent(bytes: &[u8], decoder: &Decoder, limits: &Limits) -> Extent {
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

/// Gaussians, and what is known of the coordinates of the cloud that they show.
pub struct Loaded {
    pub gaussians: Gaussians,
    pub axes: Axes,
}

/// Where Gaussians come from.
pub enum Source<'p> {
    /// A file of them, or of points, that has been read.
    Loaded(Loaded),
    /// A stream, and what decodes it.
    Stream {
        path: &'p Path,
        bytes: Vec<u8>,
        decoder: Box<Decoder>,
    },
}

impl<'p> Source<'p> {
    /// Reads a file.
    pub fn open(path: &'p Path, detail: &DetailArg, model_arg: &ModelArg, limits: &Limits, log: &Log) -> Result<Self> {
        let bytes = bytes(path, limits)?;
        if let Some(loaded) = other(path, &bytes, detail, limits, log)? {
            return Ok(Source::Loaded(loaded));
        }
        kinds::check_stream(path, &bytes)?;
        let bytes = whole_levels(path, bytes, detail, limits)?;
        let decoder = Box::new(decoder(&bytes, detail, model_arg, limits)?);
        reserve_for(path, &bytes, &decoder, detail.level, limits)?;
        Ok(Source::Stream { path, bytes, decoder })
    }

    /// The cube that they refer to.
    pub fn frame(&self) -> Result<Frame> {
        match self {
            Source::Loaded(loaded) => Ok(loaded.gaussians.frame),
            Source::Stream { path, bytes, decoder } => decoder.frame(bytes).map_err(Failure::in_file(path)),
        }
    }

    /// What is known of the coordinates of the cloud.
    pub fn axes(&self) -> Axes {
        match self {
            Source::Loaded(loaded) => loaded.axes.clone(),
            Source::Stream { bytes, .. } => cloud::axes(bytes),
        }
    }

    /// The part of the cube that the object takes, if that can be known before it is decoded.
    pub fn extent(&self, limits: &Limits) -> Extent {
        match self {
            Source::Loaded(loaded) => Extent::of_gaussians(&loaded.gaussians),
            Source::Stream { bytes, decoder, .. } => extent(bytes, decoder, limits),
        }
    }

    /// The level that has all that `cameras` can show, if there are finer ones.
    pub fn level_for(&self, cameras: &[Shot]) -> Result<Option<u8>> {
        let Source::Stream { path, bytes, decoder } = self else {
            return Ok(None);
        };
        let pixels = cameras.iter().map(|shot| shot.camera.pixels_per_unit());
        let level = decoder.level_for(bytes, pixels.fold(0.0, f64::max));
        level.map_err(Failure::in_file(path))
    }

    /// The Gaussians of `level`; without one, of what `cameras` can show, and why that level.
    pub fn gaussians(self, detail: &DetailArg, cameras: &[Shot], log: &Log) -> Result<(Gaussians, Explanation)> {
        let seen = match detail.level {
            Some(_) => None,
            None => self.level_for(cameras)?,
        };
        let explain = |on, why| Explanation {
            name: "detail",
            on,
            why,
        };
        let (path, bytes, decoder) = match self {
            Source::Loaded(Loaded { gaussians, .. }) => {
                return Ok((gaussians, explain(false, "files of Gaussians have no levels".into())));
            }
            Source::Stream { path, bytes, decoder } => (path, bytes, decoder),
        };
        let fail = Failure::in_file(path);
        let why = match (detail.level, seen) {
            (Some(level), _) => format!("level {level}, forced"),
            (None, Some(level)) => format!("level {level}: its voxels already fall under a pixel"),
            (None, None) => "as fine as there is".into(),
        };
        let decoder = decoder.with_level(detail.level.or(seen)).with_log(log);
        let gaussians = decoder.decode(&bytes);
        Ok((gaussians.map_err(&fail)?, explain(seen.is_some(), why)))
    }
}

/// Gaussians as they stand in the file `bytes`, which came from `path`, or surfels of its points. `None` if it has
/// neither.
pub fn other(path: &Path, bytes: &[u8], detail: &DetailArg, limits: &Limits, log: &Log) -> Result<Option<Loaded>> {
    let format = convert::format_of(path, bytes, None);
    if format.is_none() && !cloud::is_cloud(bytes) {
        return Ok(None);
    }
    let asked = [("--level", detail.level.is_some()), ("--heads", detail.heads.is_some())];
    if let Some((name, _)) = asked.iter().find(|(_, asked)| *asked) {
        return Err(Failure(format!(
            "{}: {name} is for streams, these are Gaussians",
            path.display()
        )));
    }
    let Some(format) = format else {
        let read = ReadArgs::default();
        let (gaussians, axes) = cloud::surfels_of(path, bytes.to_vec(), &read, isa(None)?, limits, log)?;
        return Ok(Some(Loaded { gaussians, axes }));
    };
    let splats = convert::read(path, bytes, format, limits, log)?;
    let axes = convert::cloud_axes(path, &splats);
    let gaussians = splats.into_cloud();
    Ok(Some(Loaded { gaussians, axes }))
}
