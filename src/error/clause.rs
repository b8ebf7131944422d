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

#[cfg(test)]
mod tests {
    use super::*;

    fn missing(stage: Stage, field: &'static str) -> Error {
        Error::Truncated {
            stage,
            offset: 1,
            field,
            needed: 1,
        }
    }

    fn lacking(what: &'static str) -> Error {
        let detail = String::new();
        Error::Unsupported { what, detail }
    }

    fn hashes(what: &'static str) -> Error {
        Error::DeterminismMismatch {
            what,
            level: 1,
            expected: 1,
            found: 2,
        }
    }

    #[test]
    fn what_is_missing_unknown_or_another_value_is_told_by_a_clause_of_the_format() {
        let [expected, found] = [1, 2].map(|id: u8| id.to_string());
        let cases = [
            (missing(Stage::Bitstream, "geometry section"), "2.1.1"),
            (missing(Stage::Bitstream, "feature section"), "2.1.1"),
            (missing(Stage::Bitstream, "chunk payload"), "2.1.2"),
            (missing(Stage::Bitstream, "magic"), "2.2.1"),
            (missing(Stage::Geometry, "occupancy"), "4.2.3"),
            (missing(Stage::Colour, "steps of colours"), "5.3"),
            (lacking(feature::VERSION), "2.2.1"),
            (lacking(feature::FLAGS), "2.2.1"),
            (lacking(feature::CHUNK), "3.1.2"),
            (lacking(feature::CHUNK_OF_VERSION_2), "8.1.2"),
            (hashes("colours"), "5.10.1"),
            (hashes("latents"), "8.2.2"),
            (Error::ModelMismatch { expected, found }, "9.5.2"),
        ];
        let format = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/format.md");
        let format = std::fs::read_to_string(format).expect("the format is there");
        for (error, clause) in cases {
            assert_eq!(error.clause(), Some(clause), "{error}");
            let numbered = |line: &str| line.trim_start_matches(['#', ' ']).starts_with(&format!("{clause} "));
            assert!(format.lines().any(numbered), "docs/format.md has no clause {clause}");
        }
    }

    #[test]
    fn faults_of_the_caller_and_of_other_files_break_no_clause() {
        let file = Error::malformed(Stage::Cloud, "line 3", "vertex", "x", "a number");
        for error in [
            file,
            Error::Cancelled,
            Error::Usage(String::new()),
            missing(Stage::Cloud, "points"),
        ] {
            assert_eq!(error.clause(), None, "{error}");
        }
    }
}
