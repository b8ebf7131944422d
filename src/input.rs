//! Input files, read under the limits: what is longer is refused when the limit is reached, not when the end is.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use crate::error::{Error, Result};
use crate::limits::Limits;

/// Bytes that memory grows by at least.
const PIECE: u64 = 1 << 16;

/// Reads a file of at most `max_bytes` of `limits`, of whatever kind: a device or a FIFO may have no end.
///
/// # Errors
/// [`Error::Io`] naming `path`, [`Error::OutOfMemory`], [`Error::LimitExceeded`] if the file is longer.
pub fn read_file(path: &Path, limits: &Limits) -> Result<Vec<u8>> {
    let io = |source| Error::Io {
        path: path.to_owned(),
        source,
    };
    let file = File::open(path).map_err(io)?;
    let length = file.metadata().map_err(io)?.len();
    limits.check_bytes("size of the file", length)?;
    read_all(file, length, path, limits)
}

/// Reads `from` to its end, at most `max_bytes` of `limits`. `expected` bytes are probably there; `path` appears in
/// error messages only.
///
/// # Errors
/// [`Error::Io`] naming `path`, [`Error::OutOfMemory`], [`Error::LimitExceeded`] if there are more bytes.
pub fn read_all(mut from: impl Read, expected: u64, path: &Path, limits: &Limits) -> Result<Vec<u8>> {
    let io = |source| Error::Io {
        path: path.to_owned(),
        source,
    };
    let most = limits.max_bytes.min(isize::MAX as u64 - 1);
    let mut bytes = Vec::new();
    let mut wanted = expected.max(PIECE);
    loop {
        // One byte over the limit tells that there are too many.
        let room = wanted.min(most + 1 - bytes.len() as u64);
        bytes.try_reserve_exact(room as usize).map_err(|_| Error::OutOfMemory {
            what: "the input",
            bytes: room,
        })?;
        let count = from.by_ref().take(room).read_to_end(&mut bytes).map_err(io)? as u64;
        limits.check_bytes("size of the input, as far as it was read,", bytes.len() as u64)?;
        if count < room {
            return Ok(bytes);
        }
        wanted = bytes.len() as u64;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn limits(max_bytes: u64) -> Limits {
        Limits {
            max_bytes,
            ..Limits::default()
        }
    }

    #[test]
    fn as_many_bytes_as_are_allowed_are_read_and_one_more_is_refused() {
        let read = |length: usize, expected: u64, max: u64| {
            let input = vec![7; length];
            read_all(&input[..], expected, Path::new("x"), &limits(max))
        };
        for expected in [0, 1, 300_000, 1 << 20] {
            for length in [0, 1, 65_536, 300_000] {
                assert_eq!(read(length, expected, 300_000).unwrap(), vec![7; length]);
            }
            let error = read(300_001, expected, 300_000).unwrap_err();
            assert!(matches!(error, Error::LimitExceeded { needed: 300_001, .. }), "{error}");
        }
    }

    #[test]
    fn what_has_no_end_is_refused_at_the_limit() {
        let error = read_all(std::io::repeat(0), 0, Path::new("-"), &limits(1 << 20)).unwrap_err();
        assert!(
            matches!(error, Error::LimitExceeded { limit: 1_048_576, .. }),
            "{error}"
        );
        if Path::new("/dev/zero").exists() {
            assert!(read_file(Path::new("/dev/zero"), &limits(1 << 20)).is_err());
        }
    }

    #[test]
    fn a_missing_file_is_named() {
        let error = read_file(Path::new("no/such/file"), &limits(9)).unwrap_err();
        assert!(error.to_string().starts_with("no/such/file: "), "{error}");
    }
}
