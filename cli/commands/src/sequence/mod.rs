//! Sequences of frames: coding folders of clouds, decoding, cutting and joining.

mod bench;
mod decode;
mod edit;
mod encode;
mod info;
mod kept;
mod render;

use std::path::{Path, PathBuf};

use b2p::{Limits, SequenceReader};

pub use bench::run as bench;
pub use decode::run as decode;
pub use edit::{cut, join};
pub use encode::run as encode;
pub use info::{check, run as info};
pub use render::run as render;

use super::{Failure, Result};

/// Bytes of a stream that tell a sequence.
const START: usize = 16;

/// Whether the file, or standard input, starts like a sequence. What was read of standard input stays to be read.
pub fn is_sequence(path: &Path) -> bool {
    super::pipe::start_of(path, START).is_ok_and(|start| SequenceReader::is_sequence(&start))
}

/// Whether a path names many clouds by a number, such as `frame_%04d.ply`.
pub fn names_many(path: &Path) -> bool {
    Pattern::of(path).is_some()
}

/// A file name with a place for a number, as `printf` has it.
pub struct Pattern {
    before: String,
    width: usize,
    after: String,
}

impl Pattern {
    /// The pattern that a path is, if it has `%d` or `%04d`.
    pub fn of(path: &Path) -> Option<Self> {
        let text = path.to_str()?;
        let (before, rest) = text.split_once('%')?;
        let (width, after) = rest.split_once('d')?;
        let width = match width {
            "" => 0,
            _ => width
                .strip_prefix('0')
                .unwrap_or(width)
                .parse()
                .ok()
                .filter(|w| *w < 20)?,
        };
        Some(Pattern {
            before: before.into(),
            width,
            after: after.into(),
        })
    }

    /// The path with a number.
    pub fn path(&self, number: u64) -> PathBuf {
        let width = self.width;
        PathBuf::from(format!("{}{number:0width$}{}", self.before, self.after))
    }
}

/// The files that a pattern names, from number 0 or 1 on.
fn clouds(path: &Path) -> Result<Vec<PathBuf>> {
    let wrong = || {
        Failure(format!(
            "{}: there is no such file with the number 0 or 1",
            path.display()
        ))
    };
    let pattern = Pattern::of(path).ok_or_else(wrong)?;
    let first = (0..2).find(|number| pattern.path(*number).is_file());
    let numbers = first.ok_or_else(wrong)?..;
    let paths = numbers.map(|number| pattern.path(number));
    Ok(paths.take_while(|path| path.is_file()).collect())
}

/// Reads a sequence.
pub fn read(path: &Path, limits: &Limits) -> Result<SequenceReader<'static>> {
    let bytes = super::load::bytes(path, limits)?;
    SequenceReader::new(bytes, limits).map_err(Failure::in_file(path))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pattern_has_a_place_for_a_number() {
        let pattern = Pattern::of(Path::new("a/frame_%04d.ply")).expect("a pattern");
        assert_eq!(pattern.path(7), Path::new("a/frame_0007.ply"));
        let pattern = Pattern::of(Path::new("%d.ply")).expect("a pattern");
        assert_eq!(pattern.path(123), Path::new("123.ply"));
        for none in ["frame.ply", "100%.ply", "%s.ply", "%99d.ply"] {
            assert!(Pattern::of(Path::new(none)).is_none(), "{none}");
        }
    }
}
