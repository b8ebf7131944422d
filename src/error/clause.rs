//! Which clause of `docs/format.md` a stream breaks.

use super::{Error, Stage};

/// Features of streams that a decoder may lack, as [`Error::Unsupported`] names them.
pub(crate) mod feature {
    pub const VERSION: &str = "this stream version";
    pub const FLAGS: &str = "a critical feature of this stream";
    pub const CHUNK: &str = "this chunk type";
    pub const CHUNK_OF_VERSION_2: &str = "this chunk type of version 2";
}

impl Error {
    /// The clause of `docs/format.md` that a stream breaks. `None` if the stream is not to blame.
    pub fn clause(&self) -> Option<&'static str> {
        match self {
            Error::ChecksumMismatch { clause, .. } => Some(clause),
            Error::Malformed { clause, .. } => *clause,
            Error::Truncated { stage, field, .. } => of_missing(*stage, field),
            Error::DeterminismMismatch { what: "colours", .. } => Some("5.10.1"),
            Error::DeterminismMismatch { .. } => Some("8.2.2"),
            Error::ModelMismatch { .. } => Some("9.5.2"),
            Error::Unsupported { what, .. } => match *what {
                feature::VERSION | feature::FLAGS => Some("2.2.1"),
                feature::CHUNK => Some("3.1.2"),
                feature::CHUNK_OF_VERSION_2 => Some("8.1.2"),
                _ => None,
            },
            _ => None,
        }
    }
}

/// The clause that says how much there must be of `field`.
fn of_missing(stage: Stage, field: &str) -> Option<&'static str> {
    match stage {
        Stage::Bitstream if field.ends_with("section") => Some("2.1.1"),
        // A section is whole before its chunks are read.
        Stage::Bitstream if field.starts_with("chunk ") => Some("2.1.2"),
        Stage::Bitstream => Some("2.2.1"),
        Stage::Geometry => Some("4.2.3"),
        Stage::Colour => Some("5.3"),
        _ => None,
    }
}
