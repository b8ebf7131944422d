//! Output files that appear whole or not at all.
//!
//! A regular file is written under a temporary name in the same folder, synchronised, and renamed when complete. A
//! symbolic link stays: the file that it points to is replaced. Devices, FIFOs and other files that are not regular are
//! written into directly, because a rename would put a regular file in their place. Temporary files of writes in
//! progress are listed, so that an interrupted program can remove them before it exits ([`remove_unfinished`]).

use std::ffi::{OsStr, OsString};
use std::fs::{File, Metadata, OpenOptions};
use std::hash::{BuildHasher, Hasher, RandomState};
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use crate::error::{Error, Result};

static UNFINISHED: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Symbolic links that are followed, one after the other; Linux has the same limit.
const MAX_LINKS: usize = 40;
/// Random names that are tried before giving up.
const MAX_NAMES: usize = 16;

/// Writes `path` through `fill`. A regular file, or one that does not exist yet, appears whole or not at all; what is
/// written into a device or a FIFO cannot be taken back.
///
/// # Errors
/// [`Error::Io`] naming `path`, or whatever `fill` fails with; a regular file is then as it was.
pub fn write_file(path: &Path, fill: impl FnOnce(&mut dyn Write) -> Result<()>) -> Result<()> {
    let io = |source| Error::Io {
        path: path.to_owned(),
        source,
    };
    match Target::of(path).map_err(io)? {
        Target::Open(file) => write_all(file, fill, io).map(drop),
        Target::Replace { path: to, existing } => {
            let (mut temporary, file) = Temporary::beside(&to).map_err(io)?;
            let file = write_all(file, fill, io)?;
            if let Some(existing) = existing {
                // The contents matter more than the mode, which some file systems do not have.
                let _ = file.set_permissions(existing.permissions());
            }
            file.sync_all().map_err(io)?;
            drop(file);
            temporary.rename(&to).map_err(io)
        }
    }
}

/// The regular file whose contents [`write_file`] would replace, if there is one: behind symbolic links, but not behind
/// the redirection of a shell, such as `/dev/stdout` leads to.
pub fn replaced(path: &Path) -> Option<PathBuf> {
    let found = std::fs::metadata(path).ok()?;
    match resolve(path, true) {
        Ok(Resolved::File(file)) if found.is_file() => Some(file),
        _ => None,
    }
}

/// Removes the temporary files of all writes in progress; for a handler that ends the process. No other is begun after it:
/// threads that try wait for the end.
pub fn remove_unfinished() {
    let unfinished = lock();
    for path in unfinished.iter() {
        // The process is ending: there is nobody left to tell.
        let _ = std::fs::remove_file(path);
    }
    std::mem::forget(unfinished);
}

fn write_all(
    file: File,
    fill: impl FnOnce(&mut dyn Write) -> Result<()>,
    io: impl Fn(io::Error) -> Error,
) -> Result<File> {
    let mut writer = BufWriter::with_capacity(1 << 16, file);
    fill(&mut writer)?;
    writer.into_inner().map_err(|e| io(e.into_error()))
}

/// How an output path is written.
enum Target {
    /// Directly: it exists and is no regular file.
    Open(File),
    /// By a rename over `path`, which is no symbolic link.
    Replace { path: PathBuf, existing: Option<Metadata> },
}

impl Target {
    fn of(path: &Path) -> io::Result<Target> {
        let existing = match std::fs::metadata(path) {
            Ok(found) if !found.is_file() => {
                return OpenOptions::new().write(true).open(path).map(Target::Open);
            }
            Ok(found) => Some(found),
            Err(error) if error.kind() == ErrorKind::NotFound => None,
            Err(error) => return Err(error),
        };
        match resolve(path, existing.is_some())? {
            Resolved::File(path) => Ok(Target::Replace { path, existing }),
            // Whoever made the redirection decided what becomes of earlier contents.
            Resolved::Descriptor(path) => OpenOptions::new().append(true).open(path).map(Target::Open),
        }
    }
}

/// What is behind symbolic links.
enum Resolved {
    /// A path that is no link.
    File(PathBuf),
    /// A link to an open file: the redirection of a shell.
    Descriptor(PathBuf),
}

/// Follows symbolic links; `exists` tells whether there is a file behind them.
fn resolve(path: &Path, exists: bool) -> io::Result<Resolved> {
    let mut path = path.to_owned();
    for _ in 0..MAX_LINKS {
        let is_link = |found: Metadata| found.is_symlink();
        if !std::fs::symlink_metadata(&path).is_ok_and(is_link) {
            return Ok(Resolved::File(path));
        }
        if exists && is_descriptor(&path) {
            return Ok(Resolved::Descriptor(path));
        }
        // An absolute link replaces the folder.
        path = folder_of(&path).join(std::fs::read_link(&path)?);
    }
    Err(io::Error::other("too many symbolic links"))
}

/// Whether a link is one of the kernel's links to open files, such as `/dev/stdout` leads to.
fn is_descriptor(link: &Path) -> bool {
    std::fs::canonicalize(folder_of(link)).is_ok_and(|folder| folder.starts_with("/proc"))
}

fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    }
}

/// A file that is removed unless it is renamed; for outputs that another program writes.
#[derive(Debug)]
pub struct Temporary {
    path: PathBuf,
    renamed: bool,
}

impl Temporary {
    /// An empty file of that ending in `folder`.
    ///
    /// # Errors
    /// What the system says.
    pub fn in_folder(folder: &Path, ending: &OsStr) -> io::Result<Self> {
        let (temporary, _) = Self::create(&folder.join("name"), ending)?;
        Ok(temporary)
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Synchronises the file and gives it its name: a symbolic link stays, and its target is replaced.
    ///
    /// # Errors
    /// What the system says; the file is then removed.
    pub fn keep_as(mut self, destination: &Path) -> io::Result<()> {
        File::open(&self.path)?.sync_all()?;
        let existing = std::fs::metadata(destination).ok();
        match resolve(destination, existing.is_some())? {
            Resolved::File(file) if existing.as_ref().is_none_or(Metadata::is_file) => {
                if let Some(existing) = existing {
                    // As in `write_file`.
                    let _ = std::fs::set_permissions(&self.path, existing.permissions());
                }
                self.rename(&file)
            }
            Resolved::File(direct) | Resolved::Descriptor(direct) => {
                let mut to = OpenOptions::new().append(true).open(direct)?;
                io::copy(&mut File::open(&self.path)?, &mut to).map(drop)
            }
        }
    }

    /// Creates a file that did not exist, under a name that cannot be guessed. It is short, whatever the destination's
    /// is.
    fn beside(destination: &Path) -> io::Result<(Self, File)> {
        Self::create(destination, OsStr::new("tmp"))
    }

    fn create(destination: &Path, ending: &OsStr) -> io::Result<(Self, File)> {
        // Held over the creation, so that the list names every temporary file and no other file.
        let mut unfinished = lock();
        let mut last = None;
        for _ in 0..MAX_NAMES {
            // Each `RandomState` has keys of its own, from the system's random numbers.
            let mut name = OsString::from(format!(".b2p-{:016x}.", RandomState::new().build_hasher().finish()));
            name.push(ending);
            let path = destination.with_file_name(name);
            match OpenOptions::new().write(true).create_new(true).open(&path) {
                Ok(file) => {
                    unfinished.push(path.clone());
                    let renamed = false;
                    return Ok((Temporary { path, renamed }, file));
                }
                Err(error) if error.kind() == ErrorKind::AlreadyExists => last = Some(error),
                Err(error) => return Err(error),
            }
        }
        Err(last.unwrap_or_else(|| ErrorKind::AlreadyExists.into()))
    }

    fn rename(&mut self, destination: &Path) -> io::Result<()> {
        std::fs::rename(&self.path, destination)?;
        self.renamed = true;
        Ok(())
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        if !self.renamed {
            let _ = std::fs::remove_file(&self.path);
        }
        lock().retain(|p| *p != self.path);
    }
}

fn lock() -> std::sync::MutexGuard<'static, Vec<PathBuf>> {
    UNFINISHED.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

#[cfg(test)]
mod tests;
