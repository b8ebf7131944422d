//! LAS and LAZ files, through the crate `las`. A COPC file is a LAZ file with an index, which is not read.

use std::io::Cursor;

use b2p::cloud::{Note, PointCloud, RawColours, RawPoints, Stored};
use b2p::{Axes, Error, Limits, Placement, Result, Up};
use las::point::Format;
use las::{Color, Header, Reader, Transform, Vector, Version, Vlr};

use super::{guarded, malformed, truncated};

/// Points that are read at once.
const BLOCK: u64 = 1 << 16;
/// Bytes of a header at least.
const LEAST_HEADER: usize = 227;
/// The name that a coordinate system's records have.
const PROJECTION: &str = "LASF_Projection";
/// Version of the files that are written: the first with coordinate systems in WKT.
const WRITTEN: Version = Version { major: 1, minor: 4 };

/// Powers of ten that steps of coordinates have at most, and how far from a multiple of a step a coordinate may be, in
/// steps: doubles of decimals are not exact.
const COARSEST: i32 = 0;
const NEAR: f64 = 1e-3;

/// What of a header must be right before the file is read.
struct Start {
    compressed: bool,
    offset: usize,
    points: u64,
    record: usize,
    version: [u8; 2],
}

/// What the file is, in words: such as `LAS 1.2`.
pub(super) fn describe(bytes: &[u8]) -> String {
    match Start::parse(bytes) {
        Ok(start) => {
            let name = if start.compressed { "LAZ" } else { "LAS" };
            format!("{name} {}.{}", start.version[0], start.version[1])
        }
        Err(_) => "LAS".into(),
    }
}

/// Reads a file of LAS 1.0 to 1.4, compressed or not. Colours are those of the points, else their intensities.
///
/// # Errors
/// [`Error::Malformed`], [`Error::Truncated`], [`Error::LimitExceeded`].
pub(super) fn read(bytes: Vec<u8>, limits: &Limits, notes: &mut Vec<Note>) -> Result<RawPoints> {
    let start = Start::parse(&bytes)?;
    let chunks = start.check(&bytes, limits)?;
    let name = describe(&bytes);
    if start.points == 0 {
        return Err(malformed(
            format!("the header of {name}"),
            "number of points",
            0,
            "at least one",
        ));
    }
    let length = bytes.len();
    let mut raw = guarded("LAS", || {
        let failed = |e: las::Error| {
            malformed(
                format!("byte {} of {length}", start.offset),
                format!("{name} data"),
                e,
                "a valid file",
            )
        };
        let mut reader = Reader::new(Cursor::new(bytes)).map_err(failed)?;
        check_points(reader.header(), chunks)?;
        points(&mut reader, notes).map_err(failed)
    })?;
    // Colours that are all 0 were never set.
    let unset =
        matches!(&raw.0.colours, RawColours::Rgb(colours, _) if colours.as_flattened().iter().all(|c| *c == 0.0));
    if unset || raw.0.colours == RawColours::None {
        let has_intensity = raw.1.iter().any(|i| *i > 0.0);
        raw.0.colours = match has_intensity {
            true => RawColours::Grey(raw.1, Stored::Short, "intensity".into()),
            false => RawColours::None,
        };
    }
    Ok(raw.0)
}

/// Checks that so many chunks can hold the points of a LAZ file.
fn check_points(header: &Header, chunks: Option<u64>) -> Result<()> {
    let Some((chunks, vlr)) = chunks.zip(header.laz_vlr().ok()) else {
        return Ok(());
    };
    let most = chunks.saturating_mul(vlr.chunk_size().into());
    match vlr.uses_variable_size_chunks() || header.number_of_points() <= most {
        true => Ok(()),
        false => {
            let expected = format!("at most {most}, which its chunks hold");
            Err(malformed(
                "the file",
                "number of points",
                header.number_of_points(),
                expected,
            ))
        }
    }
}

/// The points, and their intensities unless all have colours.
fn points(reader: &mut Reader, notes: &mut Vec<Note>) -> las::Result<(RawPoints, Vec<f32>)> {
    let header = reader.header();
    let count = header.number_of_points();
    let axes = axes(header, notes);
    let has_colour = header.point_format().has_color;
    let mut positions = Vec::with_capacity(count as usize);
    let mut colours: Vec<[f32; 3]> = Vec::with_capacity(if has_colour { count as usize } else { 0 });
    let mut grey = Vec::new();
    let mut set = false;
    let mut block = reader.read_points(BLOCK.min(count))?;
    while !block.is_empty() {
        positions.extend(block.x().zip(block.y()).zip(block.z()).map(|((x, y), z)| [x, y, z]));
        if let Some(rgb) = block.rgb() {
            let from = colours.len();
            colours.extend(rgb.map(|(r, g, b)| [r, g, b].map(f32::from)));
            set |= colours[from..].iter().any(|c| *c != [0.0; 3]);
        }
        // Intensities serve where no colour was ever set.
        if !set {
            grey.extend(block.intensity().map(f32::from));
        }
        let left = count - positions.len() as u64;
        if left == 0 || reader.fill_points(BLOCK.min(left), &mut block)? == 0 {
            break;
        }
    }
    let colours = match has_colour {
        true => RawColours::Rgb(colours, Stored::Short),
        false => RawColours::None,
    };
    let raw = RawPoints {
        positions,
        colours,
        axes,
        ..RawPoints::default()
    };
    Ok((raw, grey))
}

/// LAS has z up. The coordinate system is WKT, or a code of the EPSG.
fn axes(header: &Header, notes: &mut Vec<Note>) -> Axes {
    let mut axes = Axes {
        up: Some(Up::Z),
        ..Axes::default()
    };
    let wkt = header
        .get_wkt_crs_bytes()
        .map(|bytes| String::from_utf8_lossy(bytes).trim_end_matches('\0').to_owned());
    let code = || {
        let keys = header.get_geotiff_crs().ok()??;
        keys.get_projected_crs_geo_key_value()
            .or_else(|| keys.get_geodetic_crs_geo_key_value())
    };
    let crs = wkt
        .or_else(|| code().map(|code| format!("EPSG:{code}")))
        .unwrap_or_default();
    if crs.len() > Axes::MAX_CRS {
        notes.push(Note::Other(format!(
            "left out the coordinate system: {} bytes are too many",
            crs.len()
        )));
    } else {
        axes.metres_per_unit = unit_of(&crs);
        axes.crs = crs;
    }
    axes
}

/// Metres per unit of a coordinate system in WKT: the last unit of length that it names. Degrees are none.
fn unit_of(wkt: &str) -> Option<f64> {
    let (_, last) = wkt.rsplit_once("UNIT[")?;
    let inner = last.split(']').next()?;
    let (name, size) = inner.split_once(',')?;
    let size: f64 = size
        .split(',')
        .next()?
        .trim_end_matches(",AUTHORITY[")
        .trim()
        .parse()
        .ok()?;
    let is_angle = name.to_ascii_lowercase().contains("degree");
    (!is_angle && size > 0.0 && size.is_finite()).then_some(size)
}

impl Start {
    fn parse(bytes: &[u8]) -> Result<Start> {
        if bytes.len() < LEAST_HEADER {
            return Err(truncated(bytes.len(), "LAS header", LEAST_HEADER - bytes.len()));
        }
        let u16_at = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]);
        let version = [bytes[24], bytes[25]];
        let format = bytes[104];
        let legacy = u64::from(u32_at(bytes, 107));
        // Readers differ in which of the two they prefer.
        let points = match version {
            [1, 4..=255] if bytes.len() >= 255 => legacy.max(u64_at(bytes, 247)),
            _ => legacy,
        };
        Ok(Start {
            compressed: format & 0xc0 != 0,
            offset: u32_at(bytes, 96) as usize,
            points,
            record: u16_at(105).into(),
            version,
        })
    }

    /// Checks the counts by which memory is allocated against the limits and the length of the file.
    /// Returns the number of chunks of a LAZ file.
    fn check(&self, bytes: &[u8], limits: &Limits) -> Result<Option<u64>> {
        limits.check_points("number of points", self.points)?;
        limits.check_bytes(
            "bytes of the point cloud",
            self.points.saturating_mul(40).saturating_add(bytes.len() as u64),
        )?;
        let room = bytes.len().saturating_sub(self.offset) as u64;
        if self.offset > bytes.len() {
            return Err(truncated(bytes.len(), "LAS header", self.offset - bytes.len()));
        }
        let needed = match self.compressed {
            true => 0,
            false => self.points.saturating_mul(self.record as u64),
        };
        if needed > room {
            return Err(truncated(
                bytes.len(),
                "points of the LAS file",
                (needed - room) as usize,
            ));
        }
        let chunks = match self.compressed {
            true => Some(self.check_chunks(bytes)?),
            false => None,
        };
        // The first extended record: its length is allocated at once.
        if self.version >= [1, 4] && bytes.len() >= 247 && u32_at(bytes, 243) > 0 {
            let at = u64_at(bytes, 235).saturating_add(20);
            let end = usize::try_from(at)
                .ok()
                .and_then(|at| bytes.get(at..at.checked_add(8)?));
            let length = end.map(|_| u64_at(bytes, at as usize));
            if length.is_none_or(|length| length > bytes.len() as u64) {
                let expected = "within the file";
                return Err(malformed(
                    "byte 235",
                    "extended records",
                    format!("at {at}, of {length:?} bytes"),
                    expected,
                ));
            }
        }
        Ok(chunks)
    }

    /// Checks the number of chunks of a LAZ file.
    fn check_chunks(&self, bytes: &[u8]) -> Result<u64> {
        let missing = |at: usize| {
            truncated(
                bytes.len(),
                "chunk table of the LAZ file",
                at.saturating_sub(bytes.len()),
            )
        };
        let at = self.offset;
        let pointer = bytes.get(at..at + 8).map(|_| u64_at(bytes, at) as i64);
        let table = match pointer {
            None => return Err(missing(at + 8)),
            // Written by a program that could not go back: the place is at the end of the file.
            Some(-1) => u64_at(bytes, bytes.len() - 8) as i64,
            Some(table) => table,
        };
        let table = usize::try_from(table).unwrap_or(usize::MAX);
        if table.checked_add(8).is_none_or(|end| end > bytes.len()) {
            return Err(missing(table.saturating_add(8)));
        }
        let chunks = u64::from(u32_at(bytes, table + 4));
        // A chunk has a point at least, and its point some bytes.
        let most = self.points.min(bytes.len() as u64) + 1;
        match chunks <= most {
            true => Ok(chunks),
            false => Err(malformed(
                format!("byte {}", table + 4),
                "number of LAZ chunks",
                chunks,
                format!("at most {most}"),
            )),
        }
    }
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from(u32_at(bytes, at)) | u64::from(u32_at(bytes, at + 4)) << 32
}

/// The integers that coordinates of a LAS file are.
#[derive(Debug, Clone, Copy)]
pub(super) struct Steps {
    pub scale: f64,
    offset: [f64; 3],
    /// Whether the coordinates are such integers.
    pub exact: bool,
}

impl Steps {
    /// Those of the centres of a grid's voxels.
    pub fn of_grid(grid: &Placement) -> Self {
        Steps {
            scale: grid.voxel_size,
            offset: grid.origin.map(|x| x + grid.voxel_size / 2.0),
            exact: true,
        }
    }

    /// The coarsest power of ten of which all coordinates are multiples, else the finest for which there is room.
    pub fn of(positions: &[[f64; 3]]) -> Self {
        let ends = (0..3).map(|axis| {
            let all = positions.iter().map(|p| p[axis]);
            (
                all.clone().fold(f64::INFINITY, f64::min),
                all.fold(f64::NEG_INFINITY, f64::max),
            )
        });
        let ends: Vec<(f64, f64)> = ends.collect();
        let middle = |axis: usize| (ends[axis].0 / 2.0 + ends[axis].1 / 2.0).round();
        let offset = [0, 1, 2].map(middle);
        let reach = (0..3).map(|axis| (ends[axis].1 - offset[axis]).max(offset[axis] - ends[axis].0));
        let reach = reach.fold(f64::MIN_POSITIVE, f64::max);
        // 32 bits with their sign, and some to spare.
        let finest = (reach / 2e9).log10().ceil().max(-300.0) as i32;
        let is_exact = |power: i32| {
            let per_unit = 10f64.powi(-power);
            let near = |p: &[f64; 3]| {
                (0..3).all(|axis| {
                    let at = (p[axis] - offset[axis]) * per_unit;
                    (at - at.round()).abs() <= NEAR
                })
            };
            positions.iter().all(near)
        };
        let coarsest = finest.max(COARSEST);
        let found = (finest..=coarsest).rev().find(|power| is_exact(*power));
        Steps {
            scale: 10f64.powi(found.unwrap_or(finest)),
            offset,
            exact: found.is_some(),
        }
    }
}

/// What a reader learns of a file that is written with these axes.
pub(super) fn told(axes: &Axes) -> Axes {
    let crs = if holds(&axes.crs) {
        axes.crs.clone()
    } else {
        String::new()
    };
    Axes {
        up: Some(Up::Z),
        metres_per_unit: unit_of(&crs),
        crs,
    }
}

/// Whether a file can hold a coordinate system: WKT alone belongs into LAS 1.4; a record holds 65,535 bytes.
fn holds(crs: &str) -> bool {
    crs.contains('[') && crs.len() < usize::from(u16::MAX)
}

/// Encodes a cloud as LAS 1.4, or LAZ if `compressed`.
///
/// # Errors
/// [`Error::Usage`] if the points lie too far from each other for these steps.
pub(super) fn write(cloud: &PointCloud, steps: &Steps, compressed: bool) -> Result<Vec<u8>> {
    let failed = |e: las::Error| Error::Usage(format!("these points cannot be written as LAS: {e}"));
    let mut builder = las::Builder::from((WRITTEN.major, WRITTEN.minor));
    builder.point_format = Format::new(7).map_err(failed)?;
    builder.point_format.is_compressed = compressed;
    let transform = |axis: usize| Transform {
        scale: steps.scale,
        offset: steps.offset[axis],
    };
    builder.transforms = Vector {
        x: transform(0),
        y: transform(1),
        z: transform(2),
    };
    builder.generating_software = "b2p".into();
    let crs = &cloud.axes.crs;
    if holds(crs) {
        builder.has_wkt_crs = true;
        builder.vlrs.push(Vlr {
            user_id: PROJECTION.into(),
            record_id: 2112,
            description: "coordinate system".into(),
            data: [crs.as_bytes(), b"\0"].concat(),
        });
    }
    let header = builder.into_header().map_err(failed)?;
    let mut writer = las::Writer::new(Cursor::new(Vec::new()), header).map_err(failed)?;
    for (position, colour) in cloud.positions.iter().zip(&cloud.colours) {
        let [red, green, blue] = colour.map(|c| u16::from(c) * 257);
        let point = las::Point {
            x: position[0],
            y: position[1],
            z: position[2],
            color: Some(Color { red, green, blue }),
            gps_time: Some(0.0),
            return_number: 1,
            number_of_returns: 1,
            ..las::Point::default()
        };
        writer.write_point(point).map_err(failed)?;
    }
    writer.close().map_err(failed)?;
    Ok(writer.into_inner().map_err(failed)?.into_inner())
}

#[cfg(test)]
mod tests;
