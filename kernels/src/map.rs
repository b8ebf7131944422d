//! Files as memory.

use std::fs::File;
use std::io;
use std::ops::Deref;
use std::path::Path;

/// A file's bytes, read by the system as they are touched.
pub struct MappedFile(memmap2::Mmap);

impl Deref for MappedFile {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.0
    }
}

/// Maps a whole file for reading. It pays for large ones, of which only a part is read.
///
/// # Safety
/// While it is mapped, no program may shorten or overwrite the file: its bytes would change under the reader, and
/// reading beyond a new end kills the process (SIGBUS). Files that others may touch are to be read into memory instead.
///
/// # Errors
/// What the system says, as an [`io::Error`]: no such file, no permission, not a regular file.
pub unsafe fn map_file(path: &Path) -> io::Result<MappedFile> {
    let file = File::open(path)?;
    // SAFETY: the mapping is private and read-only, so nothing that this process does through it changes it; of other
    // programs, the caller promises it.
    let map = unsafe { memmap2::MmapOptions::new().map_copy_read_only(&file)? };
    Ok(MappedFile(map))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg_attr(miri, ignore = "Miri maps no files")]
    fn a_mapped_file_holds_the_file_s_bytes() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml");
        // SAFETY: nothing writes to the manifest while tests run.
        let mapped = unsafe { map_file(&path) }.unwrap();
        assert_eq!(&mapped[..], &std::fs::read(&path).unwrap());
    }

    #[test]
    fn a_missing_file_is_an_error() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("no such file");
        // SAFETY: there is no file to shorten.
        let missing = unsafe { map_file(&path) };
        assert!(missing.is_err_and(|e| e.kind() == io::ErrorKind::NotFound));
    }
}
