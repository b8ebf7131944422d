//! What can go wrong, by whose fault it is.

use std::path::PathBuf;

/// The result of everything in this crate that can fail.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// The stage of the pipeline that found a fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Stage {
    /// The container: header, chunks, checksums.
    Bitstream,
    /// The octree.
    Geometry,
    /// The colours of voxels.
    Colour,
    /// The latents.
    Entropy,
    /// The model file and the layers.
    Network,
    /// Gaussians in memory or in a PLY file.
    Gaussians,
    /// A point-cloud file.
    Cloud,
}

impl std::fmt::Display for Stage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Stage::Bitstream => "bitstream",
            Stage::Geometry => "geometry",
            Stage::Colour => "colour",
            Stage::Entropy => "entropy",
            Stage::Network => "network",
            Stage::Gaussians => "gaussians",
            Stage::Cloud => "cloud",
        })
    }
}

/// Every error of the library.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The operating system failed to read or write.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The input ends before it is complete.
    #[error("{stage}: truncated at byte {offset}: {field} needs {needed} more bytes")]
    Truncated {
        /// Where it was noticed.
        stage: Stage,
        /// Byte offset from the start of the input.
        offset: u64,
        /// What was being read.
        field: &'static str,
        /// How many bytes are missing at least.
        needed: u64,
    },
    /// The bytes are not what was written.
    #[error(
        "bitstream: checksum of {what} at byte {offset} is {found:#010x}, expected {expected:#010x}: the data is damaged"
    )]
    ChecksumMismatch {
        /// The header or which chunk.
        what: String,
        /// Byte offset of the damaged part.
        offset: u64,
        /// The checksum that the stream declares.
        expected: u32,
        /// The checksum of the bytes.
        found: u32,
        /// The clause of `docs/format.md`.
        clause: &'static str,
    },
    /// The stream was made with another model.
    #[error("the stream was coded with model {expected}, but model {found} is loaded")]
    ModelMismatch {
        /// The id in the stream, hexadecimal.
        expected: String,
        /// The id of the loaded model, hexadecimal.
        found: String,
    },
    /// A stream of version 2 was to be decoded without a model.
    #[error("the stream was coded with model {expected}, and no model is loaded")]
    ModelMissing {
        /// The id in the stream, hexadecimal.
        expected: String,
    },
    /// Checksums and model agree, yet what was decoded does not: encoder or decoder did not compute exactly.
    #[error(
        "{what} of level {level} hash to {found:#018x}, the stream says {expected:#018x}: encoder and decoder did not compute the same"
    )]
    DeterminismMismatch {
        /// What was decoded: latents or colours.
        what: &'static str,
        /// The octree level.
        level: u8,
        /// The hash in the stream.
        expected: u64,
        /// The hash of what was decoded.
        found: u64,
    },
    /// The input asks for more than the caller allows.
    #[error("{what} is {needed}, over the limit of {limit}; raise `{option}` if you trust the input")]
    LimitExceeded {
        /// The quantity.
        what: &'static str,
        /// What the input asks for.
        needed: u64,
        /// What is allowed.
        limit: u64,
        /// The field of `Limits` that rules it.
        option: &'static str,
    },
    /// The machine has no memory for what the limits allow.
    #[error("no memory for {what}: {bytes} bytes are not to be had")]
    OutOfMemory {
        /// What takes it.
        what: &'static str,
        /// How many bytes were asked for at once.
        bytes: u64,
    },
    /// Well-formed, but this decoder cannot do it.
    #[error("{what} is not supported: {detail}")]
    Unsupported {
        /// The feature.
        what: &'static str,
        /// What was found and what would do.
        detail: String,
    },
    /// The input breaks the format.
    #[error("{stage}: at {at}: {field} is {value}, expected {expected}")]
    Malformed {
        /// Who noticed.
        stage: Stage,
        /// A byte offset, a line, or a tensor's name.
        at: String,
        /// The field.
        field: String,
        /// What it holds.
        value: String,
        /// What it may hold.
        expected: String,
        /// The clause of `docs/format.md`; `None` unless it is a stream.
        clause: Option<&'static str>,
    },
    /// Of the streams that the encoder may choose from, none is as small as was asked for. Coarser levels take less,
    /// and so does, of learned streams, a model that was trained for fewer bits.
    #[error(
        "{asked} bits per point are too few: the smallest stream of these levels has {:.4}",
        (least * 1e4).ceil() / 1e4
    )]
    TooFewBits {
        /// Bits per point that were asked for.
        asked: f64,
        /// Bits per point of the smallest stream that was tried.
        least: f64,
    },
    /// A frame of a sequence cannot be decoded.
    #[error("frame {frame}: {source}")]
    Frame {
        /// Its number, from 0.
        frame: u64,
        /// Why.
        source: Box<Error>,
    },
    /// A block of a scene cannot be decoded.
    #[error("block {block}: {source}")]
    Block {
        /// Its number, from 0.
        block: usize,
        /// Why.
        source: Box<Error>,
    },
    /// The caller threw the [`Cancel`](crate::Cancel) switch.
    #[error("cancelled")]
    Cancelled,
    /// The caller asked for something that makes no sense.
    #[error("{0}")]
    Usage(String),
}

impl Error {
    /// A [`Error::Malformed`].
    #[doc(hidden)]
    pub fn malformed(
        stage: Stage,
        at: impl ToString,
        field: impl ToString,
        value: impl ToString,
        expected: impl ToString,
    ) -> Self {
        Error::Malformed {
            stage,
            at: at.to_string(),
            field: field.to_string(),
            value: value.to_string(),
            expected: expected.to_string(),
            clause: None,
        }
    }

    /// The byte of the input that the error names, if it names one.
    pub fn offset(&self) -> Option<u64> {
        match self {
            Error::Truncated { offset, .. } | Error::ChecksumMismatch { offset, .. } => Some(*offset),
            Error::Malformed { at: text, .. } | Error::Unsupported { detail: text, .. } => Some(named_byte(text)?.0),
            Error::Frame { source, .. } | Error::Block { source, .. } => source.offset(),
            _ => None,
        }
    }

    /// The same error of a part of a file, as one of the file: `place` is where a byte of the part lies.
    pub(crate) fn moved(mut self, place: impl Fn(u64) -> u64) -> Self {
        match &mut self {
            // The end of what is there.
            Error::Truncated { offset, .. } if *offset > 0 => *offset = place(*offset - 1) + 1,
            Error::Truncated { offset, .. } | Error::ChecksumMismatch { offset, .. } => *offset = place(*offset),
            Error::Malformed { at: text, .. } | Error::Unsupported { detail: text, .. } => {
                if let Some((byte, rest)) = named_byte(text) {
                    *text = format!("byte {}{rest}", place(byte));
                }
            }
            _ => {}
        }
        self
    }

    /// The same [`Error::Malformed`] as a breach of this clause of `docs/format.md`.
    pub(crate) fn breaks(mut self, rule: &'static str) -> Self {
        if let Error::Malformed { clause, .. } = &mut self {
            *clause = Some(rule);
        }
        self
    }
}

/// The byte that a place such as `byte 12, level 3` names, and what follows.
fn named_byte(text: &str) -> Option<(u64, &str)> {
    let text = text.strip_prefix("byte ")?;
    let end = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let (digits, rest) = text.split_at(end);
    Some((digits.parse().ok()?, rest))
}

/// Features of streams that a decoder may lack, as [`Error::Unsupported`] names them.
pub(crate) mod feature {
    pub const VERSION: &str = "this stream version";
    pub const FLAGS: &str = "a critical feature of this stream";
    pub const CHUNK: &str = "this chunk type";
    pub const CHUNK_OF_VERSION_2: &str = "this chunk type of version 2";
    pub const UNITS_OF_SCENE: &str = "the index of this scene";
    pub const UNITS_OF_SEQUENCE: &str = "the index of this sequence";
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
            Error::Frame { source, .. } | Error::Block { source, .. } => source.clause(),
            Error::Unsupported { what, .. } => match *what {
                feature::VERSION | feature::FLAGS => Some("2.2.1"),
                feature::CHUNK => Some("3.1.2"),
                feature::CHUNK_OF_VERSION_2 => Some("8.1.2"),
                feature::UNITS_OF_SCENE => Some("18.2.2"),
                feature::UNITS_OF_SEQUENCE => Some("17.2.2"),
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
        Stage::Bitstream if field == "index of the sequence" => Some("17.1.1"),
        Stage::Bitstream if field == "group of frames" => Some("17.2.3"),
        Stage::Bitstream if field == "frame table" => Some("17.3.1"),
        Stage::Bitstream if field == "index of the scene" => Some("18.1.1"),
        Stage::Bitstream if field == "block" => Some("18.2.4"),
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
    fn an_error_of_a_part_of_a_file_becomes_one_of_the_file() {
        // Ten bytes of something else lie after the first hundred of the part, which starts at byte 1000.
        let place = |byte: u64| 1000 + byte + if byte < 100 { 0 } else { 10 };
        let at = |at: &str| Error::malformed(Stage::Colour, at, "steps", 1, 2);
        let text = |error: Error| (error.offset(), error.moved(place).to_string());
        assert_eq!(
            text(at("byte 12, level 3")),
            (Some(12), "colour: at byte 1012, level 3: steps is 1, expected 2".into())
        );
        assert_eq!(text(at("byte 100")).1, "colour: at byte 1110: steps is 1, expected 2");
        assert_eq!(
            text(at("level 3")),
            (None, "colour: at level 3: steps is 1, expected 2".into())
        );
        assert_eq!(text(at("byte x")).0, None);
        // What is cut ends where its last byte is.
        let cut = |offset| Error::Truncated {
            stage: Stage::Bitstream,
            offset,
            field: "chunk",
            needed: 1,
        };
        assert_eq!(
            [0, 1, 100, 101].map(|offset| cut(offset).moved(place).offset()),
            [1000, 1001, 1100, 1111].map(Some)
        );
        let sum = Error::ChecksumMismatch {
            what: String::new(),
            offset: 100,
            expected: 1,
            found: 2,
            clause: "3.1.1",
        };
        assert_eq!(sum.moved(place).offset(), Some(1110));
        let detail = "byte 5 has the critical type 9".to_owned();
        let what = feature::CHUNK;
        let unknown = Error::Unsupported { what, detail }.moved(place);
        assert_eq!(unknown.offset(), Some(1005));
        assert!(
            unknown.to_string().ends_with("byte 1005 has the critical type 9"),
            "{unknown}"
        );
        let source = Box::new(unknown);
        assert_eq!(Error::Frame { frame: 3, source }.offset(), Some(1005));
        assert_eq!(lacking("a level").moved(place).offset(), None);
    }

    #[test]
    fn a_stream_that_lacks_something_or_has_something_unknown_breaks_a_clause_of_the_format() {
        let [expected, found] = [1, 2].map(|id: u8| id.to_string());
        let cases = [
            (missing(Stage::Bitstream, "geometry section"), "2.1.1"),
            (missing(Stage::Bitstream, "feature section"), "2.1.1"),
            (missing(Stage::Bitstream, "chunk payload"), "2.1.2"),
            (missing(Stage::Bitstream, "magic"), "2.2.1"),
            (missing(Stage::Bitstream, "index of the sequence"), "17.1.1"),
            (missing(Stage::Bitstream, "group of frames"), "17.2.3"),
            (missing(Stage::Bitstream, "frame table"), "17.3.1"),
            (missing(Stage::Bitstream, "index of the scene"), "18.1.1"),
            (missing(Stage::Bitstream, "block"), "18.2.4"),
            (missing(Stage::Geometry, "occupancy"), "4.2.3"),
            (missing(Stage::Colour, "steps of colours"), "5.3"),
            (lacking(feature::VERSION), "2.2.1"),
            (lacking(feature::FLAGS), "2.2.1"),
            (lacking(feature::CHUNK), "3.1.2"),
            (lacking(feature::CHUNK_OF_VERSION_2), "8.1.2"),
            (lacking(feature::UNITS_OF_SCENE), "18.2.2"),
            (lacking(feature::UNITS_OF_SEQUENCE), "17.2.2"),
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
