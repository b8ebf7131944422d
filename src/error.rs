//! What can go wrong, by whose fault it is.

use std::path::PathBuf;

mod clause;

pub(crate) use clause::feature;

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

    /// The same [`Error::Malformed`] as a breach of this clause of `docs/format.md`.
    pub(crate) fn breaks(mut self, rule: &'static str) -> Self {
        if let Error::Malformed { clause, .. } = &mut self {
            *clause = Some(rule);
        }
        self
    }
}
