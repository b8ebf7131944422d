//! Files in: models, streams, Gaussians.

use std::io::Read;
use std::path::Path;
use std::sync::Arc;

use b2p::container::version;
use b2p::decoder::StreamDecoder;
use b2p::gaussians::HeadSet;
use b2p::gaussians::learned::HeadsModel;
use b2p::gaussians::{Frame, Gaussians, ply};
use b2p::latents::network::Model;
use b2p::log::Log;
use b2p::renderer::Explanation;
use b2p::renderer::camera::Camera;
use b2p::{Error, Isa, Limits, UnknownIsa};

use super::args::{DetailArg, ModelArg};
use super::{Failure, Result, cloud, pipe};

/// A stream or Gaussians, told apart by their first bytes.
pub const PLY_MAGIC: &[u8] = b"ply";

/// The environment variable that says which instructions to use when the arguments don't.
const ISA: &str = "B2P_ISA";

/// The model in a file, or the one inside the program.
pub fn from_file(path: Option<&Path>) -> Result<Model> {
    match path {
        Some(path) => Model::open(path).map_err(Failure::in_file(path)),
        None => Ok(Model::from_bytes(b2p::embedded::MODEL)?),
    }
}

/// The heads in a file, or those inside the program.
pub fn heads(path: Option<&Path>) -> Result<HeadsModel> {
    match path {
        Some(path) => HeadsModel::open(path).map_err(Failure::in_file(path)),
        None => Ok(HeadsModel::from_bytes(b2p::embedded::HEADS)?),
    }
}

/// The model in a file, or the one inside the program, set to the instructions and the precision asked for.
pub fn model(arg: &ModelArg) -> Result<Model> {
    let model = from_file(arg.model.as_deref())?;
    let model = model.with_isa(isa(arg.isa.as_deref())?);
    match &arg.precision {
        Some(name) => Ok(model.with_precision(name.parse()?)?),
        None => Ok(model),
    }
}

/// What decodes the stream that starts with these bytes, with the heads asked for. A model is loaded only if it takes one.
pub fn decoder(bytes: &[u8], detail: &DetailArg, model_arg: &ModelArg, limits: &Limits) -> Result<StreamDecoder> {
    let mut decoder = StreamDecoder::new()
        .with_isa(isa(model_arg.isa.as_deref())?)
        .with_limits(limits.clone());
    if let Some(heads) = detail.heads {
        decoder = decoder.with_heads(heads);
    }
    if let Some(count) = detail.per_voxel {
        decoder = decoder.with_per_voxel(count);
    }
    if version(bytes) == Some(2) {
        return Ok(decoder.with_model(Arc::new(model(model_arg)?)));
    }
    if let Some(name) = &model_arg.precision {
        decoder = decoder.with_precision(name.parse()?);
    }
    if detail.heads != Some(HeadSet::Surfels) {
        decoder = decoder.with_heads_model(Arc::new(heads(model_arg.model.as_deref())?));
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

/// The bytes of a file, or of standard input.
pub fn bytes(path: &Path) -> Result<Vec<u8>> {
    let bytes = match path == Path::new(pipe::PIPE) {
        true => {
            let mut bytes = Vec::new();
            let mut input = std::io::stdin().lock();
            input.read_to_end(&mut bytes).map(|_| bytes)
        }
        false => std::fs::read(path),
    };
    bytes.map_err(|source| {
        Failure::from(Error::Io {
            path: path.to_owned(),
            source,
        })
    })
}

/// Gaussians from a stream, or as they stand in a PLY.
pub fn gaussians(
    path: &Path,
    detail: &DetailArg,
    model_arg: &ModelArg,
    limits: &Limits,
    log: &mut Log,
) -> Result<Gaussians> {
    let bytes = bytes(path)?;
    if bytes.starts_with(PLY_MAGIC) || cloud::is_cloud(&bytes) {
        return ply(path, &bytes, detail, limits, log);
    }
    let decoder = decoder(&bytes, detail, model_arg, limits)?;
    let gaussians = decoder.decode(&bytes, detail.level, log);
    gaussians.map_err(Failure::in_file(path))
}

/// Where Gaussians come from.
pub enum Source<'p> {
    /// A PLY that has been read.
    Gaussians(Gaussians),
    /// A stream, and what decodes it.
    Stream {
        path: &'p Path,
        bytes: Vec<u8>,
        decoder: Box<StreamDecoder>,
    },
}

impl<'p> Source<'p> {
    /// Reads a file.
    pub fn open(
        path: &'p Path,
        detail: &DetailArg,
        model_arg: &ModelArg,
        limits: &Limits,
        log: &mut Log,
    ) -> Result<Self> {
        let bytes = bytes(path)?;
        if bytes.starts_with(PLY_MAGIC) || cloud::is_cloud(&bytes) {
            return Ok(Source::Gaussians(ply(path, &bytes, detail, limits, log)?));
        }
        let decoder = Box::new(decoder(&bytes, detail, model_arg, limits)?);
        Ok(Source::Stream { path, bytes, decoder })
    }

    /// The cube that they refer to.
    pub fn frame(&self) -> Result<Frame> {
        match self {
            Source::Gaussians(gaussians) => Ok(gaussians.frame),
            Source::Stream { path, bytes, decoder } => decoder.frame(bytes).map_err(Failure::in_file(path)),
        }
    }

    /// The Gaussians of `level`; without one, of what `cameras` can show, and why that level.
    pub fn gaussians(self, detail: &DetailArg, cameras: &[Camera], log: &mut Log) -> Result<(Gaussians, Explanation)> {
        let explain = |on, why| Explanation {
            name: "detail",
            on,
            why,
        };
        let (path, bytes, decoder) = match self {
            Source::Gaussians(gaussians) => {
                return Ok((gaussians, explain(false, "a PLY has no levels".into())));
            }
            Source::Stream { path, bytes, decoder } => (path, bytes, decoder),
        };
        let fail = Failure::in_file(path);
        let seen = match detail.level {
            Some(_) => None,
            None => {
                let pixels = cameras.iter().map(Camera::pixels_per_unit).fold(0.0, f64::max);
                decoder.level_for(&bytes, pixels).map_err(&fail)?
            }
        };
        let why = match (detail.level, seen) {
            (Some(level), _) => format!("level {level}, forced"),
            (None, Some(level)) => format!("level {level}: its voxels already fall under a pixel"),
            (None, None) => "as fine as there is".into(),
        };
        let gaussians = decoder.decode(&bytes, detail.level.or(seen), log);
        Ok((gaussians.map_err(&fail)?, explain(seen.is_some(), why)))
    }
}

/// Gaussians as they stand in the PLY `bytes`, which came from `path`; those of a point cloud are surfels.
pub fn ply(path: &Path, bytes: &[u8], detail: &DetailArg, limits: &Limits, log: &mut Log) -> Result<Gaussians> {
    let asked = [("--level", detail.level.is_some()), ("--heads", detail.heads.is_some())];
    if let Some((name, _)) = asked.iter().find(|(_, asked)| *asked) {
        return Err(Failure(format!(
            "{}: {name} is for streams, this is a PLY",
            path.display()
        )));
    }
    if let Some(surfels) = cloud::drawable(path, bytes, isa(None)?, limits, log)? {
        return Ok(surfels);
    }
    let (gaussians, notes) = log
        .step("read Gaussians", 1, "file", || ply::read(bytes, limits))
        .map_err(Failure::in_file(path))?;
    for warning in notes.warnings() {
        eprintln!("b2p: {}: {warning}", path.display());
    }
    Ok(gaussians)
}
