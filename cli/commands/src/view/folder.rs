//! Which files a viewer goes through.

use std::io::Read;
use std::path::{Path, PathBuf};

use b2p::container::MAGIC;

use crate::{Failure, Result, cloud, convert, manners};

/// Bytes of a file that tell what it is.
const START: u64 = 1 << 12;

/// The files, and those in folders that can be shown, sorted by name.
///
/// Files that are named are not looked into: what is wrong with them is said when they are opened.
pub fn files_in(paths: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for path in paths {
        if manners::is_pipe(path) {
            if paths.len() > 1 {
                return Err(Failure("standard input is shown alone, not with other files".into()));
            }
            return Ok(vec![path.clone()]);
        }
        let failed = |e| Failure(format!("{}: {e}", path.display()));
        if !std::fs::metadata(path).map_err(failed)?.is_dir() {
            files.push(path.clone());
            continue;
        }
        let mut found = Vec::new();
        for entry in std::fs::read_dir(path).map_err(failed)? {
            let file = entry.map_err(failed)?.path();
            if can_be_shown(&file) {
                found.push(file);
            }
        }
        if found.is_empty() {
            let what = "no streams, Gaussians or point clouds are in this folder";
            return Err(Failure(format!("{}: {what}", path.display())));
        }
        found.sort();
        files.append(&mut found);
    }
    Ok(files)
}

/// Whether a file is one of those that can be shown, as its first bytes tell.
fn can_be_shown(path: &Path) -> bool {
    let is_file = std::fs::metadata(path).is_ok_and(|found| found.is_file());
    let Some(file) = std::fs::File::open(path).ok().filter(|_| is_file) else {
        return false;
    };
    let mut start = Vec::new();
    if file.take(START).read_to_end(&mut start).is_err() {
        return false;
    }
    start.starts_with(&MAGIC) || cloud::is_cloud(&start) || convert::format_of(path, &start, None).is_some()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_its_streams_and_gaussians_in_order() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).unwrap();
        write("b.b2p", &[&MAGIC[..], &[3, 0]].concat());
        let axes = ["x", "y", "z"].map(|axis| format!("property float {axis}\n")).concat();
        let ply = format!("ply\nformat ascii 1.0\nelement vertex 1\n{axes}end_header\n0 0 0\n");
        write("a.ply", ply.as_bytes());
        write("c.txt", b"# notes: nothing to see");
        write("d.png", b"\x89PNG\r\n\x1a\n");
        std::fs::create_dir(folder.path().join("e.b2p")).unwrap();
        let found = files_in(&[folder.path().to_owned()]).unwrap();
        let names: Vec<_> = found.iter().map(|path| path.file_name().unwrap().to_owned()).collect();
        assert_eq!(names, ["a.ply", "b.b2p"]);
    }

    #[test]
    fn folders_without_anything_and_missing_files_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let Failure(text) = files_in(&[folder.path().to_owned()]).unwrap_err();
        assert!(text.contains("no streams"), "{text}");
        let missing = folder.path().join("missing.b2p");
        let Failure(text) = files_in(&[missing]).unwrap_err();
        assert!(text.contains("missing.b2p"), "{text}");
        assert!(files_in(&["-".into(), "a".into()]).is_err());
    }
}
