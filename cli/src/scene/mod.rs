//! Scenes of blocks: coding large clouds, decoding and drawing parts.

mod decode;
mod edit;
mod encode;
mod info;
mod render;
mod stream;

use std::path::Path;

use b2p::{Error, FileSource, Limits, SceneReader};

pub use decode::run as decode;
pub use edit::cut;
pub use encode::{is_wanted, run as encode};
pub use info::{check, run as info};
pub use render::run as render;
pub use stream::{pieces, run as encode_pieces};

use super::table::counted;
use super::{Failure, Result, manners};

/// A scene in a file.
pub type Reader = SceneReader<FileSource>;

/// Whether the file starts like a scene.
pub fn is_scene(path: &Path) -> bool {
    let start = || -> std::io::Result<[u8; 16]> {
        let mut start = [0; 16];
        std::io::Read::read_exact(&mut std::fs::File::open(path)?, &mut start)?;
        Ok(start)
    };
    !manners::is_pipe(path) && start().is_ok_and(|start| SceneReader::is_scene(&start))
}

/// Opens a scene. Its blocks are read when they are needed.
pub fn open(path: &Path, limits: &Limits) -> Result<Reader> {
    let opened = FileSource::open(path).and_then(|file| SceneReader::new(file, limits));
    opened.map_err(Failure::in_file(path))
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
