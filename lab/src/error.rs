//! What can go wrong in the laboratory.

use std::path::{Path, PathBuf};

/// The result of everything in the laboratory that can fail.
pub type Result<T, E = LabError> = std::result::Result<T, E>;

/// Every error of the laboratory.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LabError {
    /// The library failed.
    #[error(transparent)]
    Codec(#[from] b2p::Error),
    /// The operating system failed to read or write.
    #[error("{path}: {source}")]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A mesh file cannot be used.
    #[error("{path}: {detail}")]
    Mesh {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        detail: String,
    },
    /// A picture cannot be read.
    #[error("{path}: {source}")]
    Picture {
        /// The file.
        path: PathBuf,
        /// What the picture reader said.
        source: image::ImageError,
    },
    /// The caller asked for something that makes no sense.
    #[error("{0}")]
    Usage(String),
}

impl LabError {
    /// Adds the path to a system error.
    pub fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        |source| LabError::Io {
            path: path.to_owned(),
            source,
        }
    }
}
