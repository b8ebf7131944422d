//! Files of a wrong kind: what they are, and what to do with them.

use std::path::Path;

use b2p::container::MAGIC;

use super::{Failure, Result};

/// What a file of a wrong kind is, from its first bytes, and what to do with it.
fn told(bytes: &[u8]) -> Option<String> {
    let text = |what: &str| Some(what.to_owned());
    let is = |magic: &[u8]| bytes.starts_with(magic);
    if is(b"LASF") {
        let version = match (bytes.get(24), bytes.get(25)) {
            (Some(major), Some(minor)) => format!(" {major}.{minor}"),
            _ => String::new(),
        };
        return Some(format!("this is LAS{version}, a point cloud: `b2p encode` codes it"));
    }
    if is(b"\x89PNG") || is(b"\xff\xd8\xff") || is(b"GIF8") || is(b"P6\n") {
        return text("this is a picture");
    }
    if is(b"glTF") {
        return text(
            "this is binary glTF: a mesh is sampled to a point cloud first, cameras are for `render --camera`",
        );
    }
    if is(b"ASTM-E57") {
        return text("this is E57, a point cloud: `b2p encode` codes it");
    }
    if is(b"# .PCD") || is(b"VERSION .7") || is(b"VERSION 0.7") {
        return text("this is PCD, a point cloud: `b2p encode` codes it");
    }
    if is(b"\x1f\x8b") {
        return text("this is compressed with gzip: SPZ files of Gaussians are, or decompress it first");
    }
    if is(b"PK\x03\x04") {
        return text("this is a ZIP archive: unpack it first");
    }
    if is(b"solid ") || is(b"v ") || is(b"# Blender") {
        return text("this is a mesh: sample it to a coloured point cloud first, such as with CloudCompare");
    }
    if is(&MAGIC) {
        return text("this is a stream of b2p: `b2p decode` and `b2p render` take it");
    }
    None
}

/// The names of the elements and properties in a PLY header.
fn ply_words(bytes: &[u8]) -> Option<Vec<String>> {
    let start = &bytes[..bytes.len().min(1 << 16)];
    let end = start.windows(10).position(|w| w == b"end_header")?;
    let header = String::from_utf8_lossy(&start[..end]);
    let lines = header.lines().map(str::trim);
    let named = lines.filter_map(|line| {
        let mut words = line.split_whitespace();
        match words.next()? {
            "element" => words.next().map(|name| format!("element {name}")),
            "property" => words.last().map(str::to_owned),
            _ => None,
        }
    });
    Some(named.collect())
}

fn wrong(path: &Path, what: &str) -> Failure {
    Failure(format!("{}: {what}", path.display()))
}

/// Fails with what to do if these bytes are plainly no stream. What looks like nothing known is left to the reader,
/// which says where it is wrong.
pub fn check_stream(path: &Path, bytes: &[u8]) -> Result<()> {
    if bytes.starts_with(&MAGIC) {
        return Ok(());
    }
    if bytes.starts_with(b"ply") {
        let words = ply_words(bytes).unwrap_or_default();
        let has = |word: &str| words.iter().any(|w| w == word);
        let what = match has("f_dc_0") {
            true => "this is a PLY of Gaussians, no b2p stream: draw it with `b2p render`",
            false => "this is a PLY, no b2p stream: `b2p encode` codes a point cloud",
        };
        return Err(wrong(path, what));
    }
    match told(bytes) {
        Some(what) => Err(wrong(path, &format!("no b2p stream: {what}"))),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(result: Result<()>) -> String {
        result.err().map(|Failure(text)| text).unwrap_or_default()
    }

    #[test]
    fn each_kind_is_named_with_what_to_do() {
        let path = Path::new("f");
        let mut las = b"LASF".to_vec();
        las.resize(24, 0);
        las.extend([1, 2]);
        assert!(said(check_stream(path, &las)).contains("this is LAS 1.2"));
        let ply = |lines: &str| format!("ply\nformat ascii 1.0\n{lines}end_header\n").into_bytes();
        let splats = ply("element vertex 1\nproperty float x\nproperty float f_dc_0\n");
        assert!(said(check_stream(path, &splats)).contains("b2p render"));
        assert!(said(check_stream(path, b"\x89PNG\r\n")).contains("picture"));
        assert!(check_stream(path, &MAGIC).is_ok());
    }

    #[test]
    fn what_looks_like_nothing_known_is_left_to_its_reader() {
        for bytes in [&b""[..], b"x", b"\0\0\0\0"] {
            assert!(check_stream(Path::new("f"), bytes).is_ok());
        }
    }
}
