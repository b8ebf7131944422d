//! Point clouds of any format, recognised by content.
//!
//! ```no_run
//! use b2p::{Limits, cloud::ReadOptions};
//!
//! let options = ReadOptions { drop_outliers: true, ..ReadOptions::default() };
//! let read = b2p_formats::clouds::open("scan.laz".as_ref(), &Limits::default(), &options)?;
//! for note in &read.notes {
//!     eprintln!("{note}");
//! }
//! # Ok::<(), b2p::Error>(())
//! ```

mod e57;
mod gltf;
mod las;
mod obj;
mod pcd;
mod pieces;
mod splats;
pub(crate) mod text;
mod write;

pub use pieces::Pieces;
pub use write::{Encoded, PointFormat, WriteOptions, encode, encode_cloud};

use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use b2p::cloud::{Note, PointCloud, RawPoints, ReadOptions};
use b2p::error::Stage;
use b2p::{Error, Limits, Result, input};

use crate::detect::{Group, Kind};

/// The path that stands for standard input.
const PIPE: &str = "-";

/// A cloud that was read.
#[derive(Debug, Clone)]
pub struct Reading {
    /// The points.
    pub cloud: PointCloud,
    /// What the file is.
    pub kind: Kind,
    /// What was mended or guessed, for the user.
    pub notes: Vec<Note>,
}

/// Reads a point cloud from a file, or from standard input if the path is `-`. No more is read than `limits` allow.
///
/// # Errors
/// [`Error::Io`] and those of [`read`].
pub fn open(path: &Path, limits: &Limits, options: &ReadOptions) -> Result<Reading> {
    let bytes = read_file(path, limits)?;
    let folder = match path.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    };
    read(bytes, Some(folder), limits, options)
}

/// Reads a file, or standard input if the path is `-`, but no more than the limits allow.
///
/// # Errors
/// [`Error::Io`]; [`Error::LimitExceeded`] if there is more, before it is read where the length is known.
pub fn read_file(path: &Path, limits: &Limits) -> Result<Vec<u8>> {
    match path == Path::new(PIPE) {
        true => input::read_all(std::io::stdin().lock(), 0, path, limits),
        false => input::read_file(path, limits),
    }
}

/// Reads a point cloud from memory. `folder` is where files lie that it may name.
///
/// # Errors
/// [`Error::Unsupported`], with what to do, if it is something else than points; [`Error::Malformed`],
/// [`Error::Truncated`], [`Error::LimitExceeded`] and those of [`RawPoints::finish`].
pub fn read(bytes: Vec<u8>, folder: Option<&Path>, limits: &Limits, options: &ReadOptions) -> Result<Reading> {
    let kind = Kind::of(&bytes);
    limits.check_bytes("size of the input in bytes", bytes.len() as u64)?;
    let mut notes = Vec::new();
    let raw = match kind {
        Kind::Ply => {
            let (cloud, notes) = PointCloud::read_ply(&bytes, limits, options)?;
            return Ok(Reading { cloud, kind, notes });
        }
        Kind::Las => las::read(bytes, limits, &mut notes),
        Kind::Pcd => pcd::read(&bytes, limits),
        Kind::E57 => e57::read(&bytes, limits, &mut notes),
        Kind::Text => text::read(&bytes, limits, &mut notes),
        Kind::Obj => obj::read(&bytes, limits, options),
        Kind::Glb | Kind::Gltf => gltf::read(&bytes, folder, limits, options, &mut notes),
        Kind::GaussianPly => splats::read(&bytes, limits, &mut notes),
        _ => Err(no_cloud(kind)),
    }?;
    finish(raw, kind, notes, options)
}

fn finish(raw: RawPoints, kind: Kind, mut notes: Vec<Note>, options: &ReadOptions) -> Result<Reading> {
    let (cloud, more) = raw.finish(options)?;
    notes.extend(more);
    Ok(Reading { cloud, kind, notes })
}

/// What a file is if it is no point cloud, with what to do.
pub fn no_cloud(kind: Kind) -> Error {
    let advice = match (kind, kind.group()) {
        (_, Group::Stream) => "decode it with `b2p decode`, or draw it with `b2p render`",
        (_, Group::Splats) => "draw it with `b2p render`",
        (_, Group::Mesh) => "a mesh: sample it first with `b2p-lab voxelize`",
        (_, Group::Archive) => "unpack it first",
        (_, Group::Picture) => "a picture holds no points",
        (Kind::Npy | Kind::Npz | Kind::Hdf5, _) => "write its points as PLY, LAS, PCD, E57 or text first",
        _ => "points are read from PLY, LAS, LAZ, PCD, E57, XYZ, CSV, OBJ, glTF and GLB files",
    };
    Error::Unsupported {
        what: "this input as a point cloud",
        detail: format!("this is {kind}: {advice}"),
    }
}

/// What a file of points is, with its version where it has one.
pub fn describe(bytes: &[u8]) -> String {
    match Kind::of(bytes) {
        Kind::Las => las::describe(bytes),
        kind => kind.name().to_owned(),
    }
}

thread_local! {
    static GUARDED: Cell<bool> = const { Cell::new(false) };
}

/// Whether this thread runs a reader of another crate, a panic of which is caught and becomes an error in the file.
/// Programs may ask in their panic hook, and say nothing.
pub fn is_guarded() -> bool {
    GUARDED.get()
}

/// Runs a reader of another crate. Should it panic on a damaged file, that is an error in the file.
pub(crate) fn guarded<T>(name: &'static str, read: impl FnOnce() -> Result<T>) -> Result<T> {
    let outer = GUARDED.replace(true);
    let done = catch_unwind(AssertUnwindSafe(read));
    GUARDED.set(outer);
    done.unwrap_or_else(|_| {
        let field = format!("{name} data");
        Err(malformed("the file", field, "damaged", "what its reader can read"))
    })
}

fn malformed(at: impl ToString, field: impl ToString, value: impl ToString, expected: impl ToString) -> Error {
    Error::malformed(Stage::Cloud, at, field, value, expected)
}

fn truncated(offset: usize, field: &'static str, needed: usize) -> Error {
    Error::Truncated {
        stage: Stage::Cloud,
        offset: offset as u64,
        field,
        needed: needed as u64,
    }
}

/// Escaped bytes of a file for an error message.
fn shown(bytes: &[u8]) -> String {
    let text = String::from_utf8_lossy(&bytes[..bytes.len().min(40)]);
    format!("{text:?}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(bytes: &[u8]) -> String {
        let result = read(bytes.to_vec(), None, &Limits::default(), &ReadOptions::default());
        result.unwrap_err().to_string()
    }

    #[test]
    fn a_file_of_the_wrong_kind_says_what_it_is_and_what_to_do() {
        for (bytes, what, advice) in [
            (&b2p::container::MAGIC[..], "a stream of b2p", "decode"),
            (b"NGSP\x04\0\0\0", "an SPZ file", "render"),
            (
                b"solid cube\n",
                "an STL mesh",
                "sample it first with `b2p-lab voxelize`",
            ),
            (b"\x89PNG\r\n\x1a\n", "a PNG picture", "no points"),
            (b"PK\x03\x04", "a ZIP archive", "unpack"),
            (b"\x93NUMPY\x01", "a numpy array", "PLY"),
            (b"", "an empty file", "PLY"),
            (b"hello there\n", "unknown kind", "PLY"),
        ] {
            let text = refusal(bytes);
            assert!(text.contains(what) && text.contains(advice), "{text}");
        }
    }

    #[test]
    fn a_panic_of_another_crate_is_an_error_and_known_to_the_panic_hook() {
        let panicked = guarded::<()>("X", || {
            assert!(is_guarded());
            std::panic::resume_unwind(Box::new("a panic without a message"))
        });
        assert!(panicked.unwrap_err().to_string().contains("X data is damaged"));
        assert!(!is_guarded());
    }

    #[test]
    fn a_mesh_in_a_ply_file_is_refused_unless_its_vertices_are_asked_for() {
        let text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
                    property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\n\
                    property list uchar int vertex_indices\nend_header\n0 0 0 1 2 3\n1 0 0 4 5 6\n0 1 0 7 8 9\n3 0 1 2\n";
        let error = refusal(text.as_bytes());
        assert!(
            error.contains("this is a mesh of 1 face:") && error.contains("voxelize"),
            "{error}"
        );
        let options = ReadOptions {
            vertices: true,
            ..ReadOptions::default()
        };
        let read = read(text.into(), None, &Limits::default(), &options).unwrap();
        assert_eq!(read.cloud.colours, [[1, 2, 3], [4, 5, 6], [7, 8, 9]]);
        // A file without faces may declare them.
        let none = text.replace("face 1", "face 0").replace("3 0 1 2\n", "");
        assert!(super::read(none.into(), None, &Limits::default(), &ReadOptions::default()).is_ok());
    }

    #[test]
    fn a_file_larger_than_the_limit_is_refused_before_it_is_read() {
        let limits = Limits::default().with_max_bytes(1000);
        let file = tempfile::NamedTempFile::new().unwrap();
        file.as_file().set_len(1 << 40).unwrap();
        let result = open(file.path(), &limits, &ReadOptions::default());
        assert!(matches!(result, Err(Error::LimitExceeded { needed, .. }) if needed == 1 << 40));
        // A device has no length.
        let endless = open(Path::new("/dev/zero"), &limits, &ReadOptions::default());
        assert!(matches!(endless, Err(Error::LimitExceeded { needed: 1001, .. })));
    }
}
