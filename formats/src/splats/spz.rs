//! SPZ of Niantic: quantised columns, compressed.
//!
//! Versions 1 to 3 are one gzip stream of a header of 16 bytes and the columns; version 4 is a header of 32 bytes, a
//! table of sizes, and a Zstandard stream per column. Columns, in this order: positions (24-bit fixed point; half
//! floats in version 1), opacities, colours, scales, rotations (from version 3 the three smallest components of the
//! quaternion, before that x, y, z), and spherical harmonics.
//!
//! Coordinates are stored as they are, which is what Niantic's tools and splat-transform do by default.

use std::io::{self, Read, Write};

use b2p::gaussians::Gaussians;
use b2p::{Error, Limits, Result};
use flate2::read::GzDecoder;
use ruzstd::decoding::StreamingDecoder;
use ruzstd::encoding::{CompressionLevel, compress_to_vec};

use super::builder::{self, Builder};
use super::bytes::{Bytes, malformed, to_byte};
use super::rows::{HARMONIC, Row, Rows};

const MAGIC: &[u8] = b"NGSP";
const GZIP: [u8; 2] = [0x1f, 0x8b];
/// Colours are stored with this factor of the harmonics of degree 0, so that some are outside [0, 1].
const COLOUR_SCALE: f64 = 0.15;
const ANTIALIASED: u8 = 1;
const EXTENSIONS: u8 = 2;
/// The extension that names the axes of the file, and its values in order, from 1.
const AXES_EXTENSION: u32 = 0xADBE_0003;
const AXES: [&str; 16] = [
    "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU",
];
/// The axes of files without that extension.
const DEFAULT_AXES: u32 = 4;
/// Coefficients by degree.
const COEFFICIENTS: [usize; 5] = [0, 3, 8, 15, 24];
/// Most coefficients that Gaussians have in memory.
const KEPT: usize = 15;
/// Bits of the harmonics of degree 1, and of the others, as Niantic's writer has them.
const DEGREE_1_BITS: u32 = 5;
const REST_BITS: u32 = 4;
/// Bits after the point of a coordinate, where its size allows so many: what other writers have, and the most.
const LEAST_FRACTION: u32 = 12;
const MAX_FRACTION: u32 = 24;
/// The largest error of a coordinate, as a part of the size of a small Gaussian: one that few are smaller than.
const MOST_ERROR: f64 = 1.0 / 8.0;
const SMALL_SHARE: usize = 20;
/// 2^23: the first integer that a coordinate cannot hold.
const RANGE: f64 = 8_388_608.0;
const COLUMNS: [&str; 6] = ["positions", "opacities", "colours", "scales", "rotations", "harmonics"];

pub(super) fn is_spz(bytes: &[u8]) -> bool {
    if bytes.starts_with(MAGIC) {
        return true;
    }
    let mut magic = [0; 4];
    bytes.starts_with(&GZIP) && GzDecoder::new(bytes).read_exact(&mut magic).is_ok() && magic == MAGIC
}

/// What a header says.
#[derive(Debug, Clone, Copy)]
struct Header {
    version: u32,
    count: u64,
    degree: usize,
    fraction: u8,
    flags: u8,
}

impl Header {
    fn parse(from: &mut Bytes) -> Result<Self> {
        let magic = from.take(4, "magic")?;
        if magic != MAGIC {
            return Err(malformed("byte 0", "magic", format!("{magic:02x?}"), "\"NGSP\""));
        }
        let version = from.u32("version")?;
        if !(1..=4).contains(&version) {
            return Err(Error::Unsupported {
                what: "this version of SPZ",
                detail: format!("version {version}, expected 1 to 4"),
            });
        }
        let count = from.u32("number of Gaussians")?.into();
        let degree = from.u8("degree of the harmonics")?.into();
        if degree >= COEFFICIENTS.len() {
            return Err(malformed("byte 12", "degree of the harmonics", degree, "0 to 4"));
        }
        let fraction = from.u8("bits after the point")?;
        if fraction > 30 {
            return Err(malformed("byte 13", "bits after the point", fraction, "0 to 30"));
        }
        Ok(Header {
            version,
            count,
            degree,
            fraction,
            flags: from.u8("flags")?,
        })
    }

    /// Bytes per Gaussian of each column.
    fn widths(&self) -> [u64; 6] {
        let position = if self.version == 1 { 6 } else { 9 };
        let rotation = if self.version < 3 { 3 } else { 4 };
        [position, 1, 3, 3, rotation, 3 * COEFFICIENTS[self.degree] as u64]
    }

    fn check(&self, limits: &Limits) -> Result<()> {
        builder::check(self.count, COEFFICIENTS[self.degree].min(KEPT), limits)?;
        let bytes = self.widths().iter().sum::<u64>() * self.count;
        limits.check_bytes("bytes of the SPZ file's columns", bytes)
    }
}

/// The columns of a file, and what is known besides.
struct File {
    header: Header,
    columns: [Vec<u8>; 6],
    warnings: Vec<String>,
}

pub(super) fn read(bytes: &[u8], offset: [f64; 3], limits: &Limits) -> Result<(Gaussians, Vec<String>)> {
    let file = if bytes.starts_with(&GZIP) {
        read_gzip(bytes, limits)?
    } else {
        read_zstd(bytes, limits)?
    };
    let File {
        header,
        columns,
        mut warnings,
    } = file;
    let coefficients = COEFFICIENTS[header.degree];
    if coefficients > KEPT {
        warnings.push("view-dependent colour of degree 4 is ignored: degrees 1 to 3 are kept".into());
    }
    let kept = coefficients.min(KEPT);
    let mut builder = Builder::new(header.count, kept, limits)?;
    builder.offset = offset;
    builder.compensated = header.flags & ANTIALIASED != 0;
    let [positions, opacities, colours, scales, rotations, harmonics] = &columns;
    let [position_width, .., rotation_width, harmonics_width] = header.widths().map(|width| width as usize);
    for i in 0..header.count as usize {
        builder.push(Row {
            position: position(&positions[i * position_width..][..position_width], header.fraction),
            scale: std::array::from_fn(|k| (f64::from(scales[3 * i + k]) / 16.0 - 10.0).exp()),
            rotation: rotation(&rotations[i * rotation_width..][..rotation_width]),
            opacity: f64::from(opacities[i]) / 255.0,
            colour: std::array::from_fn(|k| {
                0.5 + HARMONIC * (f64::from(colours[3 * i + k]) / 255.0 - 0.5) / COLOUR_SCALE
            }),
        });
        let own = harmonics[i * harmonics_width..][..3 * kept].chunks_exact(3);
        builder.push_coefficients(own.map(|c| std::array::from_fn(|k| (f64::from(c[k]) - 128.0) / 128.0)));
    }
    Ok((builder.finish(None), warnings))
}

/// Versions 1 to 3. (A version 4 inside gzip has no streams and is read alike, as Niantic's reader does.)
fn read_gzip(bytes: &[u8], limits: &Limits) -> Result<File> {
    let mut from = GzDecoder::new(bytes);
    let mut start = Vec::new();
    inflate(from.by_ref(), 16, &mut start, "gzip stream")?;
    let mut fields = Bytes::new(&start);
    let header = Header::parse(&mut fields)?;
    header.check(limits)?;
    let mut columns: [Vec<u8>; 6] = Default::default();
    for ((column, width), name) in columns.iter_mut().zip(header.widths()).zip(COLUMNS) {
        let size = width * header.count;
        inflate(from.by_ref(), size, column, name)?;
        if (column.len() as u64) < size {
            let missing = size - column.len() as u64;
            return Err(malformed(
                "the gzip stream's end",
                name,
                "incomplete",
                format!("{missing} bytes more"),
            ));
        }
    }
    let mut warnings = Vec::new();
    if header.flags & EXTENSIONS != 0 {
        // At most as many bytes as extensions of other writers have.
        let mut records = Vec::new();
        inflate(from, 1 << 16, &mut records, "extensions")?;
        read_extensions(&records, &mut warnings);
    }
    Ok(File {
        header,
        columns,
        warnings,
    })
}

/// Reads at most `size` bytes.
fn inflate(from: impl Read, size: u64, to: &mut Vec<u8>, name: &'static str) -> Result<()> {
    let done = from.take(size).read_to_end(to);
    done.map_err(|e| malformed("the compressed data", name, format!("damaged ({e})"), "a whole stream"))?;
    Ok(())
}

/// Version 4.
fn read_zstd(bytes: &[u8], limits: &Limits) -> Result<File> {
    let mut fields = Bytes::new(bytes);
    let header = Header::parse(&mut fields)?;
    if header.version < 4 {
        let expected = "4; versions 1 to 3 are compressed with gzip as a whole";
        return Err(malformed(
            "byte 4",
            "version of a file that is not compressed",
            header.version,
            expected,
        ));
    }
    let streams = fields.u8("number of streams")?;
    let table: u64 = fields.u32("offset of the table")?.into();
    fields.take(12, "reserved bytes")?;
    header.check(limits)?;
    let sizes = header.widths().map(|width| width * header.count);
    let expected = sizes.iter().filter(|&&size| size > 0).count();
    if usize::from(streams) != expected {
        return Err(malformed("byte 15", "number of streams", streams, expected));
    }
    let Some(gap) = table.checked_sub(fields.at()) else {
        return Err(malformed("byte 16", "offset of the table", table, "32 or more"));
    };
    let records = fields.take(gap, "extensions before the table")?;
    let mut warnings = Vec::new();
    if header.flags & EXTENSIONS != 0 {
        read_extensions(records, &mut warnings);
    }
    let mut packed = [None; 6];
    for (k, size) in sizes.into_iter().enumerate().filter(|(_, size)| *size > 0) {
        let at = fields.at();
        let compressed = fields.u64("size of a stream")?;
        let whole = fields.u64("size of a stream")?;
        if whole != size {
            return Err(malformed(
                format!("byte {}", at + 8),
                format!("size of the {}", COLUMNS[k]),
                whole,
                size,
            ));
        }
        packed[k] = Some(compressed);
    }
    let mut columns: [Vec<u8>; 6] = Default::default();
    for k in 0..6 {
        let Some(compressed) = packed[k] else { continue };
        let at = fields.at();
        let stream = fields.take(compressed, "compressed column")?;
        columns[k] = decompress(stream, sizes[k], COLUMNS[k], at)?;
    }
    if fields.len() > 0 {
        let at = format!("byte {}", fields.at());
        return Err(malformed(at, "length after the streams", fields.len(), 0));
    }
    Ok(File {
        header,
        columns,
        warnings,
    })
}

/// A Zstandard stream of exactly `size` bytes.
fn decompress(stream: &[u8], size: u64, name: &'static str, at: u64) -> Result<Vec<u8>> {
    let damaged = |e: String| {
        malformed(
            format!("byte {at}"),
            format!("the {name}"),
            format!("damaged ({e})"),
            "Zstandard",
        )
    };
    let mut column = Vec::new();
    let from = StreamingDecoder::new(stream).map_err(|e| damaged(e.to_string()))?;
    from.take(size + 1)
        .read_to_end(&mut column)
        .map_err(|e| damaged(e.to_string()))?;
    if column.len() as u64 != size {
        let found = format!("{} bytes or more", column.len());
        return Err(malformed(
            format!("byte {at}"),
            format!("the {name}"),
            found,
            format!("{size} bytes"),
        ));
    }
    Ok(column)
}

/// Extensions are records of a type, a length, and as many bytes. What does not parse is ignored.
fn read_extensions(records: &[u8], warnings: &mut Vec<String>) {
    let mut fields = Bytes::new(records);
    while let (Ok(kind), Ok(length)) = (fields.u32("type"), fields.u32("length")) {
        let Ok(value) = fields.take(length.into(), "record") else {
            return;
        };
        let axes = value.first_chunk().map(|bytes| u32::from_le_bytes(*bytes));
        match axes.filter(|axes| kind == AXES_EXTENSION && !matches!(axes, 0 | &DEFAULT_AXES)) {
            Some(axes) => {
                let name = AXES.get((axes as usize).wrapping_sub(1)).copied().unwrap_or("unknown");
                warnings.push(format!(
                    "the file's axes are {name}, not RUB; they are read as they are"
                ));
            }
            None if kind != AXES_EXTENSION => warnings.push(format!("extension {kind:#010x} is ignored")),
            None => {}
        }
    }
}

fn position(bytes: &[u8], fraction: u8) -> [f64; 3] {
    match bytes.len() {
        6 => std::array::from_fn(|k| half(u16::from_le_bytes([bytes[2 * k], bytes[2 * k + 1]]))),
        _ => std::array::from_fn(|k| {
            let [a, b, c] = [bytes[3 * k], bytes[3 * k + 1], bytes[3 * k + 2]];
            // The sign is that of the highest byte.
            let fixed = i32::from_le_bytes([0, a, b, c]) >> 8;
            f64::from(fixed) / f64::from(1u32 << fraction)
        }),
    }
}

/// A half float.
fn half(bits: u16) -> f64 {
    let sign = if bits >> 15 == 1 { -1.0 } else { 1.0 };
    let (exponent, mantissa) = (i32::from(bits >> 10 & 31), f64::from(bits & 1023));
    sign * match exponent {
        0 => mantissa * 2f64.powi(-24),
        31 if mantissa == 0.0 => f64::INFINITY,
        31 => f64::NAN,
        _ => (1.0 + mantissa / 1024.0) * 2f64.powi(exponent - 15),
    }
}

fn rotation(bytes: &[u8]) -> [f64; 4] {
    let [x, y, z, w] = match *bytes {
        [a, b, c, d] => {
            let packed = u32::from_le_bytes([a, b, c, d]);
            let largest = (packed >> 30) as usize;
            let mut q = [0.0; 4];
            let others = (0..4).rev().filter(|&k| k != largest);
            for (place, k) in others.enumerate() {
                let bits = packed >> (10 * place);
                let magnitude = f64::from(bits & 511) / 511.0 * std::f64::consts::FRAC_1_SQRT_2;
                q[k] = if bits >> 9 & 1 == 1 { -magnitude } else { magnitude };
            }
            q[largest] = (1.0 - q.iter().map(|x| x * x).sum::<f64>()).max(0.0).sqrt();
            q
        }
        _ => {
            let q: [f64; 3] = std::array::from_fn(|k| f64::from(bytes[k]) / 127.5 - 1.0);
            let w = (1.0 - q.iter().map(|x| x * x).sum::<f64>()).max(0.0).sqrt();
            [q[0], q[1], q[2], w]
        }
    };
    [w, x, y, z]
}

/// Writes version 4.
pub(super) fn write(rows: &mut Rows, to: &mut dyn Write, io: &dyn Fn(io::Error) -> Error) -> Result<()> {
    rows.sort_in_space();
    let fraction = fraction(rows)?;
    let mut columns: [Vec<u8>; 6] = Default::default();
    let mut clamped = 0;
    for i in 0..rows.len() {
        let row = rows.row(i);
        let [positions, opacities, colours, scales, rotations, harmonics] = &mut columns;
        for x in row.position {
            let fixed = (x * f64::from(1u32 << fraction)).round() as i32;
            positions.extend_from_slice(&fixed.to_le_bytes()[..3]);
        }
        opacities.push(to_byte(row.opacity));
        colours.extend(row.dc().map(|c| to_byte(c * COLOUR_SCALE + 0.5)));
        let levels = row.log_scale().map(|s| ((s + 10.0) * 16.0).round());
        clamped += usize::from(levels.iter().any(|level| !(0.0..=255.0).contains(level)));
        scales.extend(levels.map(|level| level.clamp(0.0, 255.0) as u8));
        rotations.extend(pack_rotation(row.rotation));
        for (k, c) in rows.coefficients(i).iter().enumerate() {
            let bits = if k < 3 { DEGREE_1_BITS } else { REST_BITS };
            harmonics.extend(c.map(|x| pack_harmonic(x, 1 << (8 - bits))));
        }
    }
    if clamped > 0 {
        let what = "scales outside 0.000045 to 380 units, which SPZ cannot hold: they are clamped";
        rows.warn(format!("{clamped} Gaussians have {what}"));
    }
    let degree = COEFFICIENTS
        .iter()
        .position(|&count| count == rows.harmonics())
        .unwrap_or(0);
    let flags = if rows.gaussians.compensated { ANTIALIASED } else { 0 };
    write_columns(&columns, rows.len(), degree as u8, fraction as u8, flags, to).map_err(io)
}

fn write_columns(
    columns: &[Vec<u8>; 6],
    count: usize,
    degree: u8,
    fraction: u8,
    flags: u8,
    to: &mut dyn Write,
) -> io::Result<()> {
    use rayon::prelude::*;
    let compress = |column: &Vec<u8>| compress_to_vec(&column[..], CompressionLevel::Fastest);
    let streams: Vec<Vec<u8>> = columns.par_iter().map(compress).collect();
    let filled: Vec<_> = columns
        .iter()
        .zip(&streams)
        .filter(|(column, _)| !column.is_empty())
        .collect();
    to.write_all(MAGIC)?;
    to.write_all(&4u32.to_le_bytes())?;
    to.write_all(&(count as u32).to_le_bytes())?;
    to.write_all(&[degree, fraction, flags, filled.len() as u8])?;
    to.write_all(&32u32.to_le_bytes())?;
    to.write_all(&[0; 12])?;
    for (column, stream) in &filled {
        to.write_all(&(stream.len() as u64).to_le_bytes())?;
        to.write_all(&(column.len() as u64).to_le_bytes())?;
    }
    filled.iter().try_for_each(|(_, stream)| to.write_all(stream))
}

/// Bits after the point: as many as the Gaussians' sizes need, and as the coordinates leave. Bits below that are noise,
/// which does not compress.
fn fraction(rows: &Rows) -> Result<u32> {
    let (low, high) = rows.bounds();
    let farthest = low.iter().chain(&high).fold(0.0, |m: f64, x| m.max(x.abs()));
    let fits = |bits: u32| (farthest * f64::from(1u32 << bits)).round() < RANGE;
    let size = small_size(rows);
    let is_fine = |bits: &u32| 0.5 / f64::from(1u32 << bits) <= size * MOST_ERROR;
    let needed = (LEAST_FRACTION..MAX_FRACTION).find(is_fine).unwrap_or(MAX_FRACTION);
    (0..=needed).rev().find(|&bits| fits(bits)).ok_or_else(|| {
        Error::Usage(format!(
            "SPZ holds coordinates below 2²³, but there is one of {farthest}"
        ))
    })
}

/// The size that all but one Gaussian in twenty exceed. A Gaussian's size is its middle scale: discs have one of
/// almost zero, and needles two that are thin.
fn small_size(rows: &Rows) -> f64 {
    let middle = |row: Row| {
        let [a, b, c] = row.scale;
        a.max(b).min(a.min(b).max(c))
    };
    let mut sizes: Vec<f64> = rows.iter().map(middle).collect();
    if sizes.is_empty() {
        return 0.0;
    }
    let rank = sizes.len() / SMALL_SHARE;
    *sizes.select_nth_unstable_by(rank, f64::total_cmp).1
}

/// The index of the largest component, and of the others sign and 9 bits each; the order is x, y, z, w.
fn pack_rotation([w, x, y, z]: [f64; 4]) -> [u8; 4] {
    let q = [x, y, z, w];
    let largest = (1..4).fold(0, |best, k| if q[k].abs() > q[best].abs() { k } else { best });
    let mut packed = largest as u32;
    for k in (0..4).filter(|&k| k != largest) {
        // −q is the same rotation: the largest component becomes positive.
        let negative = (q[k] < 0.0) != (q[largest] < 0.0);
        let magnitude = (511.0 * q[k].abs() * std::f64::consts::SQRT_2 + 0.5).min(511.0) as u32;
        packed = packed << 10 | u32::from(negative) << 9 | magnitude;
    }
    packed.to_le_bytes()
}

fn pack_harmonic(value: f64, bucket: i32) -> u8 {
    let level = (value * 128.0).round().clamp(-256.0, 256.0) as i32 + 128;
    ((level + bucket / 2).div_euclid(bucket) * bucket).clamp(0, 255) as u8
}

#[cfg(test)]
mod tests;
