//! Gaussian splats: files to and from [`Gaussians`].
//!
//! | format | extension | positions | scales | rotations | colours and opacity | harmonics |
//! |---|---|---|---|---|---|---|
//! | [`Format::Ply`] | `.ply` | float | float logarithm | float | float, logit | float |
//! | [`Format::CompressedPly`] | `.compressed.ply` | 11, 10, 11 bits in a block of 256 | 11, 10, 11 bits | 10 bits | 8 bits | 8 bits |
//! | [`Format::Spz`] | `.spz` | 24 bits, fixed point | 8 bits, logarithm | 10 bits | 8 bits | 5 and 4 bits |
//! | [`Format::Sog`] | `.sog` | 16 bits, logarithm | codebook of 256 | 8 bits | codebook of 256; 8 bits | palette of 65,536 |
//! | [`Format::Splat`] | `.splat` | float | float | 8 bits | 8 bits | none |
//! | [`Format::Glb`], [`Format::Gltf`] | `.glb`, `.gltf` | float | float | float | float | float |
//! | [`Format::Csv`] | `.csv` | decimal | decimal logarithm | decimal | decimal, logit | decimal |
//! | [`Format::Npz`] | `.npz` | float | float | float | float | float |
//!
//! Coordinates are those of the world. A cube far from the origin is written less an offset ([`offset`]), which SPZ and
//! `.splat` cannot state: [`Options::offset`] restores it.
//! All formats but glTF share the axes of PLY files, of which viewers take −y as up; glTF defines +y as up. [`write()`]
//! turns scenes to the axes of the format: those of which the axis that points up is known ([`Axes::Cloud`]), so that
//! they stand upright, and between PLY and glTF by 180° about z, as other programs do. Files say which axis pointed up
//! where they have a place for it, and [`read`] turns back.
//!
//! Only PLY states the [`blur`](Gaussians::blur); all other writers add it to the squared scales, which draws the same.
//! Gaussians with a number that is not finite, or without a rotation, are left out and counted.

mod builder;
mod bytes;
mod compressed_ply;
mod csv;
mod details;
mod gltf;
mod npz;
mod parts;
mod rows;
mod sog;
mod splat;
mod spz;
mod turn;

use std::borrow::Cow;
use std::io::Write;
use std::path::Path;

use b2p::cloud::ply::Ply;
use b2p::gaussians::{Frame, Gaussians, ply};
use b2p::{Error, Limits, Result, Up};

pub use parts::PartWriter;
use rows::Rows;
use turn::Turn;

/// How a comment starts that says which axis pointed up before the scene was turned.
const TURNED: &str = "b2p turned_from ";

/// A file format of splats.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Format {
    /// PLY in the convention of 3D Gaussian Splatting.
    Ply,
    /// PLY in blocks of 256 Gaussians, quantised to 16 bytes each, as SuperSplat writes it.
    CompressedPly,
    /// SPZ of Niantic: version 4 is written, versions 1 to 4 are read.
    Spz,
    /// SOG of PlayCanvas, version 2: a ZIP archive of WebP pictures.
    Sog,
    /// 32 bytes per Gaussian without a header, as antimatter15's viewer reads it.
    Splat,
    /// Binary glTF with `KHR_gaussian_splatting`.
    Glb,
    /// glTF with `KHR_gaussian_splatting` and its data inside the JSON.
    Gltf,
    /// Comma-separated values with the property names of PLY.
    Csv,
    /// Arrays for NumPy.
    Npz,
}

/// Every format, with its name and extension. The longest extension of a kind comes first.
const FORMATS: [(Format, &str, &str); 9] = [
    (Format::CompressedPly, "compressed-ply", ".compressed.ply"),
    (Format::Ply, "ply", ".ply"),
    (Format::Spz, "spz", ".spz"),
    (Format::Sog, "sog", ".sog"),
    (Format::Splat, "splat", ".splat"),
    (Format::Glb, "glb", ".glb"),
    (Format::Gltf, "gltf", ".gltf"),
    (Format::Csv, "csv", ".csv"),
    (Format::Npz, "npz", ".npz"),
];

impl Format {
    /// All formats.
    pub fn all() -> impl Iterator<Item = Format> {
        FORMATS.iter().map(|(format, ..)| *format)
    }

    /// The name, as [`FromStr`](std::str::FromStr) reads it.
    pub fn name(self) -> &'static str {
        self.entry().1
    }

    /// The extension of its files, with the dot.
    pub fn extension(self) -> &'static str {
        self.entry().2
    }

    /// The format that the extension of a path names, in any case.
    pub fn of_path(path: &Path) -> Option<Format> {
        let name = path.file_name()?.to_str()?.to_ascii_lowercase();
        FORMATS
            .iter()
            .find(|(.., end)| name.ends_with(end))
            .map(|(format, ..)| *format)
    }

    /// The format of a file's contents. `.splat` files and CSV files of other programs have nothing to know them by.
    pub fn of_bytes(bytes: &[u8]) -> Option<Format> {
        if bytes.starts_with(b"ply") {
            return Some(if compressed_ply::is_compressed(bytes) {
                Format::CompressedPly
            } else {
                Format::Ply
            });
        }
        if spz::is_spz(bytes) {
            return Some(Format::Spz);
        }
        if bytes.starts_with(b"PK\x03\x04") {
            return details::kind_of_archive(bytes);
        }
        if bytes.starts_with(b"glTF") {
            return gltf::has_splats(bytes).then_some(Format::Glb);
        }
        let first = bytes.iter().find(|byte| !byte.is_ascii_whitespace());
        if first == Some(&b'{') && gltf::has_splats(bytes) {
            return Some(Format::Gltf);
        }
        csv::is_csv(bytes).then_some(Format::Csv)
    }

    fn entry(self) -> &'static (Format, &'static str, &'static str) {
        let entry = FORMATS.iter().find(|(format, ..)| *format == self);
        // Every format is in the table: a test holds it to that.
        entry.unwrap_or(&FORMATS[1])
    }
}

impl std::str::FromStr for Format {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        let found = FORMATS.iter().find(|(_, known, _)| *known == name);
        found.map(|(format, ..)| *format).ok_or_else(|| {
            let names: Vec<_> = Format::all().map(Format::name).collect();
            Error::Usage(format!(
                "{name:?} is no format of splats, expected one of {}",
                names.join(", ")
            ))
        })
    }
}

impl std::fmt::Display for Format {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// Axes of coordinates: which files of one scene are alike and which are turned.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Axes {
    /// Those of PLY, SPZ, SOG, `.splat`, CSV and NumPy files. Viewers of splats take −y as up.
    #[default]
    Ply,
    /// Those of glTF, in which +y is up: turned by 180° about z.
    Gltf,
    /// Those of a cloud of which this axis points up. Files are turned to the axes of their format, and say so.
    Cloud(Up),
}

impl Axes {
    /// The axes of files of this format.
    pub fn of(format: Format) -> Self {
        match format {
            Format::Glb | Format::Gltf => Axes::Gltf,
            _ => Axes::Ply,
        }
    }

    /// The axis that pointed up before the scene is turned to the axes of a format.
    fn turned_from(self) -> Option<Up> {
        match self {
            Axes::Cloud(up) => Some(up),
            Axes::Ply | Axes::Gltf => None,
        }
    }
}

/// What a file holds.
#[derive(Debug, Clone, PartialEq)]
pub struct Splats {
    /// The Gaussians.
    pub gaussians: Gaussians,
    /// Their axes: those of the cloud that was turned when the file was written, if it states them; else those of the
    /// file.
    pub axes: Axes,
    /// What was ignored or guessed, a sentence each.
    pub warnings: Vec<String>,
}

impl Splats {
    /// The Gaussians in the axes of their cloud if they are known, else in those of PLY files.
    pub fn into_cloud(mut self) -> Gaussians {
        if self.axes == Axes::Gltf {
            turn(&mut self.gaussians, Axes::Gltf, Axes::Ply);
        }
        self.gaussians
    }
}

fn turn(gaussians: &mut Gaussians, from: Axes, to: Axes) {
    if let Some(turn) = Turn::between(from, to) {
        turn.apply(gaussians);
    }
}

/// What a file cannot say itself.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Options {
    /// What was subtracted from the coordinates of a file that does not state it (SPZ, `.splat`).
    pub offset: [f64; 3],
    /// The axis that pointed up before the scene was turned to the axes of the format, for a file that does not state
    /// it (SPZ, `.splat`, CSV).
    pub turned_from: Option<Up>,
}

/// Gaussians, warnings, and the axis that pointed up before the scene was turned.
type Parts = (Gaussians, Vec<String>, Option<Up>);

/// Reads splats from a whole file in memory.
///
/// The cube of files that name none is fitted to the centres. Values that are not finite are kept: the projection drops
/// and counts such Gaussians.
///
/// # Errors
/// [`Error::Malformed`], [`Error::Truncated`], [`Error::Unsupported`]; [`Error::LimitExceeded`] before more memory is
/// reserved than `limits` allow.
pub fn read(bytes: &[u8], format: Format, options: &Options, limits: &Limits) -> Result<Splats> {
    let unsaid = |(gaussians, warnings)| (gaussians, warnings, options.turned_from);
    let (mut gaussians, warnings, up) = match format {
        Format::Ply => {
            let (gaussians, notes) = ply::read(bytes, limits)?;
            (gaussians, notes.warnings(), up_in_comments(bytes))
        }
        Format::CompressedPly => {
            let (gaussians, warnings) = compressed_ply::read(bytes, limits)?;
            (gaussians, warnings, up_in_comments(bytes))
        }
        Format::Spz => unsaid(spz::read(bytes, options.offset, limits)?),
        Format::Sog => sog::read(bytes, limits)?,
        Format::Splat => unsaid(splat::read(bytes, options.offset, limits)?),
        Format::Glb | Format::Gltf => gltf::read(bytes, limits)?,
        Format::Csv => unsaid(csv::read(bytes, limits)?),
        Format::Npz => npz::read(bytes, limits)?,
    };
    let axes = up.map_or(Axes::of(format), Axes::Cloud);
    turn(&mut gaussians, Axes::of(format), axes);
    Ok(Splats {
        gaussians,
        axes,
        warnings,
    })
}

/// The comment of a PLY header that says which axis pointed up before the scene was turned.
fn up_comment(up: Option<Up>) -> String {
    up.map_or(String::new(), |up| format!("comment {TURNED} {up}\n"))
}

fn up_in_comments(bytes: &[u8]) -> Option<Up> {
    let ply = Ply::open(bytes).ok()?;
    let named = |comment: &String| comment.strip_prefix(TURNED)?.trim().parse().ok();
    ply.header.comments.iter().find_map(named)
}

/// What [`write()`] subtracts from the coordinates of Gaussians with this frame in a file of this format, in the axes of
/// the file. Zeros for formats that hold the coordinates of the world: CSV, whose numbers are decimal, and glTF, whose
/// node has the offset.
pub fn offset(frame: Frame, axes: Axes, format: Format) -> [f64; 3] {
    match format {
        Format::Csv | Format::Glb | Format::Gltf => [0.0; 3],
        _ => match Turn::between(axes, Axes::of(format)) {
            Some(turn) => turn.frame(frame).offset(),
            None => frame.offset(),
        },
    }
}

/// Writes Gaussians whose coordinates have the axes `axes`, turned to those of the format. Returns what the format
/// could not keep, a sentence each. `path` appears in error messages only.
///
/// # Errors
/// [`Error::Io`] if `to` fails; [`Error::Usage`] if the arrays differ in length, the frame is invalid, or the format
/// cannot hold so many Gaussians or such coordinates.
pub fn write(
    gaussians: &Gaussians,
    axes: Axes,
    format: Format,
    to: &mut dyn Write,
    path: &Path,
) -> Result<Vec<String>> {
    let io = |source| Error::Io {
        path: path.to_owned(),
        source,
    };
    if let Some(mut parts) = PartWriter::new(axes, format) {
        gaussians.check_lengths()?;
        let head = parts.head(gaussians, gaussians.len())?;
        to.write_all(&head).map_err(io)?;
        parts.write_rows(gaussians, to, path)?;
        return Ok(parts.warnings());
    }
    let turned = turned(gaussians, Turn::between(axes, Axes::of(format)).as_ref());
    let mut rows = Rows::new(&turned, axes.turned_from())?;
    match format {
        Format::CompressedPly => compressed_ply::write(&mut rows, to).map_err(io)?,
        Format::Spz => spz::write(&mut rows, to, &io)?,
        Format::Sog => sog::write(&mut rows, to, &io)?,
        Format::Glb | Format::Gltf => gltf::write(&rows, format, to, &io)?,
        Format::Ply | Format::Splat | Format::Csv | Format::Npz => npz::write(&rows, to, &io)?,
    }
    let lost = rows::loss(rows.lost());
    Ok(lost.into_iter().chain(rows.unsaid()).collect())
}

/// Gaussians after a rotation.
fn turned<'a>(gaussians: &'a Gaussians, turn: Option<&Turn>) -> Cow<'a, Gaussians> {
    let mut turned = Cow::Borrowed(gaussians);
    if let Some(turn) = turn {
        turn.apply(turned.to_mut());
    }
    turned
}

#[cfg(test)]
mod tests;
