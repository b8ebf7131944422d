//! Files in: models, streams, Gaussians.

use std::path::Path;

use b2p::decoder::Decoder;
use b2p::gaussians::{Frame, Gaussians, ply};
use b2p::log::Log;
use b2p::network::Model;
use b2p::pixels::Explanation;
use b2p::projection::Camera;
use b2p::{Error, Isa, Limits, UnknownIsa};

use super::args::{LevelArg, ModelArg};
use super::{Failure, Result};

/// A stream or Gaussians, told apart by their first bytes.
const PLY_MAGIC: &[u8] = b"ply";

/// The environment variable that says which instructions to use when the arguments don't.
const ISA: &str = "B2P_ISA";

/// The model in a file, or the one inside the program, set to the instructions and the precision asked for.
pub fn model(arg: &ModelArg) -> Result<Model> {
    let model = match &arg.model {
        Some(path) => Model::open(path).map_err(Failure::in_file(path))?,
        None => Model::from_bytes(b2p::embedded::MODEL)?,
    };
    let model = model.with_isa(isa(arg.isa.as_deref())?);
    match &arg.precision {
        Some(name) => Ok(model.with_precision(name.parse()?)?),
        None => Ok(model),
    }
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

/// The bytes of a file.
pub fn bytes(path: &Path) -> Result<Vec<u8>> {
    std::fs::read(path).map_err(|source| {
        Failure::from(Error::Io {
            path: path.to_owned(),
            source,
        })
    })
}

/// Where Gaussians come from.
pub enum Source<'p> {
    /// A PLY that has been read.
    Gaussians(Gaussians),
    /// A stream, and what decodes it.
    Stream {
        path: &'p Path,
        bytes: Vec<u8>,
        model: Box<Model>,
    },
}

impl<'p> Source<'p> {
    /// Reads a file.
    pub fn open(path: &'p Path, model_arg: &ModelArg, log: &mut Log) -> Result<Self> {
        let bytes = bytes(path)?;
        if !bytes.starts_with(PLY_MAGIC) {
            let model = Box::new(model(model_arg)?);
            return Ok(Source::Stream { path, bytes, model });
        }
        let (gaussians, notes) = log
            .step("read Gaussians", 1, "file", || {
                ply::read(&bytes, &Limits::default())
            })
            .map_err(Failure::in_file(path))?;
        for warning in notes.warnings() {
            eprintln!("b2p: {}: {warning}", path.display());
        }
        Ok(Source::Gaussians(gaussians))
    }

    /// The cube that they refer to.
    pub fn frame(&self) -> Result<Frame> {
        match self {
            Source::Gaussians(gaussians) => Ok(gaussians.frame),
            Source::Stream { path, bytes, model } => Decoder::new(model)
                .frame(bytes)
                .map_err(Failure::in_file(path)),
        }
    }

    /// The Gaussians of `level`; without one, of what `cameras` can show, and why that level.
    pub fn gaussians(
        self,
        level: &LevelArg,
        cameras: &[Camera],
        log: &mut Log,
    ) -> Result<(Gaussians, Explanation)> {
        let explain = |on, why| Explanation {
            name: "detail",
            on,
            why,
        };
        match self {
            Source::Gaussians(_) if level.level.is_some() => {
                Err(Failure("--level is for streams, this is a PLY".into()))
            }
            Source::Gaussians(gaussians) => {
                Ok((gaussians, explain(false, "a PLY has no levels".into())))
            }
            Source::Stream { path, bytes, model } => {
                let decoder = Decoder::new(&model);
                let fail = Failure::in_file(path);
                let Some(chosen) = level.level else {
                    let finest = decoder.levels(&bytes).map_err(&fail)?.last().copied();
                    let seen = decoder.level_for(&bytes, cameras).map_err(&fail)?;
                    let coarser = finest.is_some_and(|finest| seen < finest);
                    let why = match coarser {
                        true => format!("level {seen}: its voxels already fall under a pixel"),
                        false => format!("level {seen}, as fine as there is"),
                    };
                    let gaussians = decoder.decode(&bytes, coarser.then_some(seen), log);
                    return Ok((gaussians.map_err(&fail)?, explain(coarser, why)));
                };
                let gaussians = decoder.decode(&bytes, Some(chosen), log).map_err(&fail)?;
                Ok((gaussians, explain(false, format!("level {chosen}, forced"))))
            }
        }
    }
}
