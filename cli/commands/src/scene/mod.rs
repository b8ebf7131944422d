//! Scenes of blocks: coding large clouds, decoding and drawing parts.

mod decode;
mod edit;
mod encode;
mod info;
mod render;
mod stream;

use std::borrow::Cow;
use std::path::Path;

use b2p::{Error, FileSource, Limits, SceneDecoder, SceneReader, Source, Wanted};

pub use decode::run as decode;
pub use edit::cut;
pub use encode::{is_wanted, run as encode};
pub use info::{check, run as info};
pub use render::run as render;
pub use stream::{pieces, run as encode_pieces};

use super::table::counted;
use super::{Failure, Result, load, manners, pipe};

/// Bytes that tell a scene from a stream.
const START: usize = 16;

/// A scene in a file, or one that came on standard input.
pub type Reader = SceneReader<SceneSource>;

/// What a scene is read from.
#[derive(Debug)]
pub enum SceneSource {
    /// A file, of which parts are read when they are needed.
    File(FileSource),
    /// All of what standard input had.
    Memory(Vec<u8>),
}

impl Source for SceneSource {
    fn length(&self) -> u64 {
        match self {
            SceneSource::File(file) => file.length(),
            SceneSource::Memory(bytes) => bytes.length(),
        }
    }

    fn read(&self, offset: u64, count: usize) -> b2p::Result<Cow<'_, [u8]>> {
        match self {
            SceneSource::File(file) => file.read(offset, count),
            SceneSource::Memory(bytes) => bytes.read(offset, count),
        }
    }
}

/// Whether the file, or standard input, starts like a scene. What was read of standard input stays to be read.
pub fn is_scene(path: &Path) -> bool {
    pipe::start_of(path, START).is_ok_and(|start| SceneReader::is_scene(&start))
}

/// Opens a scene. Blocks of a file are read when they are needed; standard input is read to its end first.
pub fn open(path: &Path, limits: &Limits) -> Result<Reader> {
    SceneReader::new(source(path, limits)?, limits).map_err(Failure::in_file(path))
}

/// The bytes of a scene.
fn source(path: &Path, limits: &Limits) -> Result<SceneSource> {
    Ok(match manners::is_pipe(path) {
        true => SceneSource::Memory(load::bytes(path, limits)?),
        false => SceneSource::File(FileSource::open(path).map_err(Failure::in_file(path))?),
    })
}

/// Fails, before anything is begun, unless the machine has the memory that decoding a part of a scene takes.
fn reserve(path: &Path, scene: &Reader, decoder: &SceneDecoder, wanted: &Wanted, limits: &Limits) -> Result<()> {
    match decoder.memory(scene, wanted) {
        Ok(memory) if limits.check_bytes("", memory).is_ok() => {
            load::reserve("decoding", memory).map_err(|Failure(text)| Failure(format!("{}: {text}", path.display())))
        }
        // What is wrong is said when it is decoded.
        _ => Ok(()),
    }
}

/// Says which blocks could not be decoded, and fails if there are some.
fn complain(path: &Path, lost: &[Error], blocks: usize) -> Result<()> {
    for error in lost {
        manners::warn(&format!("{}: {error}", path.display()));
    }
    match lost.len() {
        0 => Ok(()),
        n => {
            let lost = counted(n as u64, "block");
            let all = counted((n + blocks) as u64, "block");
            Err(Failure(format!(
                "{}: {lost} of {all} cannot be decoded",
                path.display()
            )))
        }
    }
}
