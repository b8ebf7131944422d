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

/// Maps a whole file for reading.
///
/// Other programs must not shrink or overwrite the file meanwhile: its bytes would change under the reader.
///
/// # Errors
/// What the system says, as an [`io::Error`]: no such file, no permission, not a regular file.
pub fn map_file(path: &Path) -> io::Result<MappedFile> {
    let file = File::open(path)?;
    // SAFETY: the mapping is private and read-only, so nothing this process does can change it. Another process that truncates
    // the file can; that cannot be prevented on every system, and is the documented condition of this function.
    let map = unsafe { memmap2::MmapOptions::new().map_copy_read_only(&file)? };
    Ok(MappedFile(map))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mapped_file_holds_the_file_s_bytes() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml");
        assert_eq!(&map_file(&path).unwrap()[..], &std::fs::read(&path).unwrap());
    }

    #[test]
    fn a_missing_file_is_an_error() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("no such file");
        assert!(map_file(&path).is_err_and(|e| e.kind() == io::ErrorKind::NotFound));
    }
}
