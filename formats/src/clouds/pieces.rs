//! Large clouds piece by piece: files whose points are rows of one length, so that some of them are a small file of the
//! same format.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use b2p::cloud::ColourRange;
use b2p::{Error, Result};

use crate::detect::Kind;

/// Bytes that a header may have.
const MOST_HEADER: usize = 1 << 24;
/// Bytes of the public header of LAS 1.4, and where it counts points.
const LAS_COUNT: usize = 107;
const LAS_RETURNS: usize = 20;
const LAS_COUNT_14: usize = 247;
const LAS_RETURNS_14: usize = 120;
const LAS_EVLRS_14: usize = 235;

/// A file of points that is read piece by piece.
#[derive(Debug)]
pub struct Pieces {
    path: PathBuf,
    file: BufReader<File>,
    form: Form,
    /// Where the first row is.
    start: u64,
    /// Bytes of a row.
    row: usize,
    points: u64,
}

/// What stands before the rows of a piece.
#[derive(Debug)]
enum Form {
    /// The lines before and after the number of points.
    Ply { before: String, after: String },
    /// The header, and where a row has its colours.
    Las { header: Vec<u8>, colour: Option<usize> },
}

impl Pieces {
    /// Opens a file. `None` if it cannot be read in pieces: it is no binary PLY that starts with its points, and no LAS
    /// file without compression.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn open(path: &Path) -> Result<Option<Self>> {
        let failed = |source| Error::Io {
            path: path.to_path_buf(),
            source,
        };
        let mut file = BufReader::new(File::open(path).map_err(failed)?);
        let length = file.get_ref().metadata().map_err(failed)?.len();
        let mut start = Vec::new();
        file.by_ref()
            .take(MOST_HEADER as u64)
            .read_to_end(&mut start)
            .map_err(failed)?;
        let found = match Kind::of(&start) {
            Kind::Ply => ply(&start),
            Kind::Las => las(&start),
            _ => None,
        };
        let Some((form, start, row, points)) = found else {
            return Ok(None);
        };
        let whole = points.checked_mul(row as u64).and_then(|rows| rows.checked_add(start));
        let path = path.to_path_buf();
        Ok(whole.filter(|end| row > 0 && *end <= length).map(|_| Pieces {
            path,
            file,
            form,
            start,
            row,
            points,
        }))
    }

    /// Number of points.
    pub fn points(&self) -> u64 {
        self.points
    }

    /// A file of the points from `first` on, at most `count`.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn read(&mut self, first: u64, count: u64) -> Result<Vec<u8>> {
        let count = count.min(self.points.saturating_sub(first));
        let mut bytes = match &self.form {
            Form::Ply { before, after } => format!("{before}{count}{after}").into_bytes(),
            Form::Las { header, .. } => las_header(header, count),
        };
        let head = bytes.len();
        bytes.resize(head + count as usize * self.row, 0);
        let at = self.start + first * self.row as u64;
        let read = self.file.seek(SeekFrom::Start(at));
        let read = read.and_then(|_| self.file.read_exact(&mut bytes[head..]));
        read.map_err(|source| Error::Io {
            path: self.path.clone(),
            source,
        })?;
        Ok(bytes)
    }

    /// What white is in a piece with this file's own points, where that is not known from their type; a larger value in
    /// another piece changes it.
    pub fn colour_range(&self, piece: &[u8]) -> Option<ColourRange> {
        let Form::Las {
            header,
            colour: Some(at),
        } = &self.form
        else {
            return None;
        };
        let rows = piece.get(header.len()..)?.chunks_exact(self.row);
        let is_large = |row: &[u8]| row[*at..at + 6].chunks_exact(2).any(|value| value[1] > 0);
        let mut rows = rows;
        Some(match rows.any(is_large) {
            true => ColourRange::Shorts,
            false => ColourRange::Bytes,
        })
    }
}

/// Form, start, bytes of a row and points of a binary PLY whose first element are its vertices.
fn ply(start: &[u8]) -> Option<(Form, u64, usize, u64)> {
    const END: &[u8] = b"end_header\n";
    let end = start.windows(END.len()).position(|window| window == END)? + END.len();
    let text = std::str::from_utf8(&start[..end]).ok()?;
    if !text.lines().any(|line| line.trim_end().starts_with("format binary_")) {
        return None;
    }
    let (before, rest) = text.split_once("element vertex ")?;
    let count = rest.split_whitespace().next()?;
    let after = &rest[count.len()..];
    let mut row = 0;
    for line in after.lines() {
        let mut words = line.split_whitespace();
        match words.next() {
            // The rows of other elements come after those of the points, or before.
            Some("element") => return None,
            Some("property") => row += ply_bytes(words.next()?)?,
            _ => {}
        }
    }
    if before.contains("element ") {
        return None;
    }
    let form = Form::Ply {
        before: format!("{before}element vertex "),
        after: after.to_owned(),
    };
    Some((form, end as u64, row, count.parse().ok()?))
}

/// Bytes of a number of a PLY file. `None` for a list.
fn ply_bytes(name: &str) -> Option<usize> {
    match name {
        "char" | "uchar" | "int8" | "uint8" => Some(1),
        "short" | "ushort" | "int16" | "uint16" => Some(2),
        "int" | "uint" | "int32" | "uint32" | "float" | "float32" => Some(4),
        "double" | "float64" => Some(8),
        _ => None,
    }
}

/// The same of a LAS file without compression.
fn las(start: &[u8]) -> Option<(Form, u64, usize, u64)> {
    let number = |at: usize, bytes: usize| {
        let bytes = start.get(at..at + bytes)?;
        Some(
            bytes
                .iter()
                .rev()
                .fold(0u64, |number, byte| number << 8 | u64::from(*byte)),
        )
    };
    let (minor, format) = (number(25, 1)?, number(104, 1)?);
    let (offset, row) = (number(96, 4)?, number(105, 2)? as usize);
    let points = match (minor, number(LAS_COUNT, 4)?) {
        (4.., _) => number(LAS_COUNT_14, 8)?,
        (_, points) => points,
    };
    // The highest bits tell of compression.
    let colour = match format {
        2 => Some(20),
        3 | 5 => Some(28),
        7 | 8 | 10 => Some(30),
        0 | 1 | 4 | 6 | 9 => None,
        _ => return None,
    };
    if colour.is_some_and(|at| at + 6 > row) {
        return None;
    }
    let header = start.get(..usize::try_from(offset).ok()?)?.to_vec();
    Some((Form::Las { header, colour }, offset, row, points))
}

/// The header of a LAS file with another number of points and nothing behind them.
fn las_header(header: &[u8], count: u64) -> Vec<u8> {
    let mut header = header.to_vec();
    let small = u32::try_from(count).unwrap_or(0).to_le_bytes();
    let mut changes: Vec<(usize, &[u8])> = vec![(LAS_COUNT, &small), (LAS_COUNT + 4, &[0; LAS_RETURNS])];
    let count = count.to_le_bytes();
    if header.get(25).is_some_and(|minor| *minor >= 4) {
        changes.extend([
            (LAS_EVLRS_14, &[0; 12][..]),
            (LAS_COUNT_14, &count),
            (LAS_COUNT_14 + 8, &[0; LAS_RETURNS_14]),
        ]);
    }
    for (at, bytes) in changes {
        if let Some(place) = header.get_mut(at..at + bytes.len()) {
            place.copy_from_slice(bytes);
        }
    }
    header
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clouds::{PointFormat, WriteOptions, encode, read};
    use b2p::cloud::{ColouredVoxels, ReadOptions};
    use b2p::geometry::Voxels;
    use b2p::{Axes, Limits, Placement};

    fn cloud() -> ColouredVoxels {
        ColouredVoxels {
            voxels: Voxels::new(6, (0..1000).map(|i| i * 7).collect()),
            colours: (0..1000).map(|i| [i as u8, (i / 3) as u8, 250]).collect(),
            placement: Placement {
                origin: [10.0, -3.0, 2.0],
                voxel_size: 0.25,
            },
        }
    }

    #[test]
    fn the_pieces_of_a_file_are_its_points() {
        let folder = tempfile::tempdir().unwrap();
        let (limits, options) = (Limits::default(), ReadOptions::default());
        for (format, name) in [(PointFormat::Ply, "a.ply"), (PointFormat::Las, "a.las")] {
            let written = encode(&cloud(), &Axes::default(), format, WriteOptions::default()).unwrap();
            let path = folder.path().join(name);
            std::fs::write(&path, &written.bytes).unwrap();
            let whole = read(written.bytes, None, &limits, &options).unwrap().cloud;
            let mut pieces = Pieces::open(&path).unwrap().expect("it can be cut");
            assert_eq!(pieces.points(), 1000);
            let (mut positions, mut colours) = (Vec::new(), Vec::new());
            for first in (0..1000).step_by(300) {
                let bytes = pieces.read(first, 300).unwrap();
                let options = ReadOptions {
                    colour_range: pieces.colour_range(&bytes),
                    ..options.clone()
                };
                let piece = read(bytes, None, &limits, &options).unwrap().cloud;
                positions.extend(piece.positions);
                colours.extend(piece.colours);
            }
            assert!(positions == whole.positions && colours == whole.colours, "{name}");
        }
    }

    #[test]
    fn files_that_are_cut_short_or_have_other_rows_are_not_read_in_pieces() {
        let folder = tempfile::tempdir().unwrap();
        let written = encode(&cloud(), &Axes::default(), PointFormat::Ply, WriteOptions::default()).unwrap();
        let text = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n".to_vec();
        let cut = written.bytes[..written.bytes.len() - 1].to_vec();
        let xyz = encode(&cloud(), &Axes::default(), PointFormat::Xyz, WriteOptions::default()).unwrap();
        for bytes in [text, cut, xyz.bytes, Vec::new()] {
            let path = folder.path().join("a");
            std::fs::write(&path, bytes).unwrap();
            assert!(Pieces::open(&path).unwrap().is_none());
        }
    }
}
