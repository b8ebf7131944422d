//! Files that appear whole or not at all.
//!
//! A file is written beside its destination under a temporary name and renamed when complete. Temporary files of writes under
//! way are listed, so that a program that is interrupted can remove them before it exits ([`remove_unfinished`]).

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use crate::error::{Error, Result};

static UNFINISHED: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Writes `path` through `fill`: whole, or not at all.
///
/// # Errors
/// [`Error::Io`] naming `path`, or whatever `fill` fails with; the destination is then as it was.
pub fn write_file(path: &Path, fill: impl FnOnce(&mut dyn Write) -> Result<()>) -> Result<()> {
    let temporary = Temporary::beside(path);
    let io = |source| Error::Io {
        path: path.to_owned(),
        source,
    };
    let file = File::create(&temporary.path).map_err(io)?;
    let mut writer = BufWriter::with_capacity(1 << 16, file);
    fill(&mut writer)?;
    let file = writer.into_inner().map_err(|e| io(e.into_error()))?;
    file.sync_all().map_err(io)?;
    drop(file);
    std::fs::rename(&temporary.path, path).map_err(io)
}

/// Removes the temporary files of all writes under way; for a handler that ends the process.
pub fn remove_unfinished() {
    for path in lock().iter() {
        // The file may not exist yet, and the process is ending: there is nobody left to tell.
        let _ = std::fs::remove_file(path);
    }
}

struct Temporary {
    path: PathBuf,
}

impl Temporary {
    fn beside(destination: &Path) -> Self {
        let mut name = std::ffi::OsString::from(".");
        name.push(destination.file_name().unwrap_or_default());
        name.push(format!(".{}.tmp", std::process::id()));
        let path = destination.with_file_name(name);
        lock().push(path.clone());
        Temporary { path }
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.path);
        lock().retain(|p| *p != self.path);
    }
}

fn lock() -> std::sync::MutexGuard<'static, Vec<PathBuf>> {
    UNFINISHED
        .lock()
        .unwrap_or_else(|poisoned| poisoned.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_leaves_the_old_file_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.txt");
        std::fs::write(&path, b"old").unwrap();
        let failed = write_file(&path, |w| {
            w.write_all(b"half").unwrap();
            Err(Error::Usage("stop".into()))
        });
        assert!(failed.is_err());
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_missing_folder_is_named_in_the_error() {
        let error = write_file(Path::new("/no/such/folder/x"), |_| Ok(())).unwrap_err();
        assert!(error.to_string().contains("/no/such/folder/x"));
    }
}
