//! Bytes that are read where they are needed.

use std::borrow::Cow;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use crate::error::{Error, Result, Stage};

/// Bytes of which parts can be read, from several threads at a time.
pub trait Source: Send + Sync {
    /// Their number.
    fn length(&self) -> u64;

    /// Reads `count` bytes from `offset` on.
    ///
    /// # Errors
    /// [`Error::Truncated`] if they are not all there, [`Error::Io`].
    fn read(&self, offset: u64, count: usize) -> Result<Cow<'_, [u8]>>;
}

impl<T: AsRef<[u8]> + Send + Sync> Source for T {
    fn length(&self) -> u64 {
        self.as_ref().len() as u64
    }

    fn read(&self, offset: u64, count: usize) -> Result<Cow<'_, [u8]>> {
        let bytes = self.as_ref();
        let rest = usize::try_from(offset).ok().and_then(|offset| bytes.get(offset..));
        match rest.and_then(|rest| rest.get(..count)) {
            Some(bytes) => Ok(Cow::Borrowed(bytes)),
            None => Err(missing(self.length(), offset, count)),
        }
    }
}

/// A file that is read part by part. It is not mapped into memory: a file that another program shortens would end this
/// one.
#[derive(Debug)]
pub struct FileSource {
    path: PathBuf,
    length: u64,
    #[cfg(unix)]
    file: File,
    #[cfg(not(unix))]
    file: std::sync::Mutex<File>,
}

impl FileSource {
    /// Opens a file.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn open(path: &Path) -> Result<Self> {
        let opened = || -> io::Result<(File, u64)> {
            let file = File::open(path)?;
            let length = file.metadata()?.len();
            Ok((file, length))
        };
        let (file, length) = opened().map_err(|source| io_error(path, source))?;
        Ok(FileSource {
            path: path.to_path_buf(),
            length,
            #[cfg(unix)]
            file,
            #[cfg(not(unix))]
            file: std::sync::Mutex::new(file),
        })
    }

    #[cfg(unix)]
    fn read_exact(&self, offset: u64, bytes: &mut [u8]) -> io::Result<()> {
        std::os::unix::fs::FileExt::read_exact_at(&self.file, bytes, offset)
    }

    #[cfg(not(unix))]
    fn read_exact(&self, offset: u64, bytes: &mut [u8]) -> io::Result<()> {
        use std::io::{Read, Seek};
        let mut file = self
            .file
            .lock()
            .map_err(|_| io::Error::other("another thread failed"))?;
        file.seek(io::SeekFrom::Start(offset))?;
        file.read_exact(bytes)
    }
}

impl Source for FileSource {
    fn length(&self) -> u64 {
        self.length
    }

    fn read(&self, offset: u64, count: usize) -> Result<Cow<'_, [u8]>> {
        if offset.checked_add(count as u64).is_none_or(|end| end > self.length) {
            return Err(missing(self.length, offset, count));
        }
        let mut bytes = vec![0; count];
        match self.read_exact(offset, &mut bytes) {
            Ok(()) => Ok(Cow::Owned(bytes)),
            // The file has become shorter.
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Err(missing(offset, offset, count)),
            Err(source) => Err(io_error(&self.path, source)),
        }
    }
}

fn io_error(path: &Path, source: io::Error) -> Error {
    let path = path.to_path_buf();
    Error::Io { path, source }
}

/// The error for bytes that lie beyond the end.
fn missing(length: u64, offset: u64, count: usize) -> Error {
    Error::Truncated {
        stage: Stage::Bitstream,
        offset: length,
        field: "block",
        needed: offset.saturating_add(count as u64).saturating_sub(length),
    }
}
