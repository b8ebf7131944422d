//! Arrays for NumPy: a ZIP archive of `.npy` files, for `numpy.load`.
//!
//! Of n Gaussians `positions` (n × 3), `scales` (n × 3, linear), `rotations` (n × 4: w, x, y, z), `opacities` (n, in
//! [0, 1]), `colours` (n × 3, sRGB), and `harmonics` (n × k × 3) if there are any, all single precision; `offset` (3
//! doubles), which is to be added to the positions; `antialiased` (one byte); `cube`: bits, origin and voxel size (5
//! doubles); and `turned_from` (3 doubles), the direction that pointed up before the scene was turned, if that is
//! known.

use std::io::{self, Write};

use b2p::gaussians::Frame;
use b2p::{Error, Limits, Placement, Result, Up};

use super::Parts;
use super::builder::{self, Builder};
use super::bytes::{Bytes, malformed};
use super::details::{Archive, ArchiveWriter};
use super::rows::{Row, Rows};

const MAGIC: &[u8] = b"\x93NUMPY";
/// Headers are padded to multiples of this.
const ALIGN: usize = 64;
const UPS: [Up; 6] = [Up::X, Up::MinusX, Up::Y, Up::MinusY, Up::Z, Up::MinusZ];

/// An array of numbers.
struct Array {
    shape: Vec<u64>,
    wide: bool,
    bytes: Vec<u8>,
    start: usize,
}

impl Array {
    /// Reads a `.npy` file of little-endian floats or bytes in C order.
    fn read(name: &'static str, bytes: Vec<u8>) -> Result<Self> {
        let mut fields = Bytes::new(&bytes);
        let magic = fields.take(6, "magic")?;
        if magic != MAGIC {
            return Err(malformed(name, "magic", format!("{magic:02x?}"), "\"\\x93NUMPY\""));
        }
        let version = fields.u8("version")?;
        fields.u8("version")?;
        let length = if version == 1 {
            fields.u16("header")?.into()
        } else {
            fields.u32("header")?
        };
        let header = String::from_utf8_lossy(fields.take(length.into(), "header")?).into_owned();
        let start = fields.at() as usize;
        let wide = match value_of(&header, "descr") {
            Some("'<f4'") => false,
            Some("'<f8'") => true,
            found => return Err(malformed(name, "descr", found.unwrap_or("absent"), "'<f4' or '<f8'")),
        };
        if value_of(&header, "fortran_order") != Some("False") {
            return Err(malformed(name, "fortran_order", "not False", "False"));
        }
        let shape = value_of(&header, "shape").and_then(|shape| {
            let inside = shape.strip_prefix('(')?.strip_suffix(')')?;
            let sizes = inside.split(',').map(str::trim).filter(|size| !size.is_empty());
            sizes.map(|size| size.parse().ok()).collect::<Option<Vec<u64>>>()
        });
        let shape = shape.ok_or_else(|| malformed(name, "shape", &header, "a tuple of sizes"))?;
        let count = shape.iter().try_fold(1u64, |count, &size| count.checked_mul(size));
        let size = count.and_then(|count| count.checked_mul(if wide { 8 } else { 4 }));
        if size != Some((bytes.len() - start) as u64) {
            let found = bytes.len() - start;
            return Err(malformed(
                name,
                "bytes of the array",
                found,
                format!("as many as {shape:?} numbers have"),
            ));
        }
        Ok(Array {
            shape,
            wide,
            bytes,
            start,
        })
    }

    fn get(&self, i: usize) -> f64 {
        let bytes = &self.bytes[self.start..];
        match self.wide {
            true => f64::from_le_bytes(std::array::from_fn(|k| bytes[8 * i + k])),
            false => f32::from_le_bytes(std::array::from_fn(|k| bytes[4 * i + k])).into(),
        }
    }
}

/// The value of a key in the text of a Python dictionary.
fn value_of<'t>(header: &'t str, key: &str) -> Option<&'t str> {
    let (_, rest) = header.split_once(&format!("'{key}':"))?;
    let rest = rest.trim_start();
    let end = match rest.starts_with('(') {
        true => rest.find(')')? + 1,
        false => rest.find([',', '}'])?,
    };
    Some(rest[..end].trim())
}

pub(super) fn read(bytes: &[u8], limits: &Limits) -> Result<Parts> {
    let mut archive = Archive::open(bytes, limits)?;
    let mut get = |name: &'static str, count: Option<u64>, widths: &[u64]| -> Result<Array> {
        let array = Array::read(name, archive.need(&format!("{name}.npy"))?)?;
        let count = count.unwrap_or(array.shape.first().copied().unwrap_or(0));
        let expected: Vec<u64> = std::iter::once(count).chain(widths.iter().copied()).collect();
        if array.shape != expected {
            return Err(malformed(
                name,
                "shape",
                format!("{:?}", array.shape),
                format!("{expected:?}"),
            ));
        }
        Ok(array)
    };
    let positions = get("positions", None, &[3])?;
    let count = Some(positions.shape[0]);
    let scales = get("scales", count, &[3])?;
    let rotations = get("rotations", count, &[4])?;
    let opacities = get("opacities", count, &[])?;
    let colours = get("colours", count, &[3])?;
    let mut optional = |name: &'static str| archive.get(&format!("{name}.npy"));
    let array = |name, bytes: Option<Vec<u8>>| bytes.map(|bytes| Array::read(name, bytes)).transpose();
    let harmonics = array("harmonics", optional("harmonics")?)?;
    let offset = array("offset", optional("offset")?)?;
    let cube = array("cube", optional("cube")?)?;
    let up = array("turned_from", optional("turned_from")?)?;
    let antialiased = optional("antialiased")?;

    let each = harmonics
        .as_ref()
        .map_or(Ok(0), |array| coefficients(array, positions.shape[0]))?;
    builder::check(positions.shape[0], each, limits)?;
    let mut builder = Builder::new(positions.shape[0], each, limits)?;
    builder.compensated = antialiased.is_some_and(|file| file.last() == Some(&1));
    if let Some(offset) = offset.filter(|offset| offset.shape == [3]) {
        builder.offset = std::array::from_fn(|k| offset.get(k));
    }
    for i in 0..positions.shape[0] as usize {
        builder.push(Row {
            position: std::array::from_fn(|k| positions.get(3 * i + k)),
            scale: std::array::from_fn(|k| scales.get(3 * i + k)),
            rotation: std::array::from_fn(|k| rotations.get(4 * i + k)),
            opacity: opacities.get(i),
            colour: std::array::from_fn(|k| colours.get(3 * i + k)),
        });
        if let Some(harmonics) = &harmonics {
            let at = |k: usize, channel: usize| harmonics.get((i * each + k) * 3 + channel);
            builder.push_coefficients((0..each).map(|k| std::array::from_fn(|channel| at(k, channel))));
        }
    }
    let frame = cube.as_ref().and_then(frame).filter(Frame::is_valid);
    Ok((builder.finish(frame), Vec::new(), up.as_ref().and_then(known_up)))
}

/// Coefficients of each of `count` Gaussians.
fn coefficients(harmonics: &Array, count: u64) -> Result<usize> {
    match harmonics.shape[..] {
        [n, each @ (0 | 3 | 8 | 15), 3] if n == count => Ok(each as usize),
        _ => Err(malformed(
            "harmonics",
            "shape",
            format!("{:?}", harmonics.shape),
            "n × 3, 8 or 15 × 3",
        )),
    }
}

fn frame(cube: &Array) -> Option<Frame> {
    (cube.shape == [5]).then(|| Frame {
        bits: cube.get(0) as u8,
        placement: Placement {
            origin: [cube.get(1), cube.get(2), cube.get(3)],
            voxel_size: cube.get(4),
        },
    })
}

fn known_up(up: &Array) -> Option<Up> {
    let is = |known: &Up| (0..3).all(|k| up.get(k) == direction(*known)[k]);
    UPS.into_iter().find(|known| up.shape == [3] && is(known))
}

pub(super) fn write(rows: &Rows, to: &mut dyn Write, io: &dyn Fn(io::Error) -> Error) -> Result<()> {
    write_archive(rows, to).map_err(io)
}

fn write_archive(rows: &Rows, to: &mut dyn Write) -> io::Result<()> {
    let mut archive = ArchiveWriter::new(to);
    let count = rows.len();
    let mut add = |name: &str, shape: &[usize], row: &dyn Fn(usize) -> Vec<f64>| {
        let size = 4 * shape.iter().product::<usize>() as u64;
        let to = archive.start(&format!("{name}.npy"), size)?;
        to.write_all(&header("<f4", shape))?;
        for i in 0..count {
            let bytes: Vec<u8> = row(i).into_iter().flat_map(|x| (x as f32).to_le_bytes()).collect();
            to.write_all(&bytes)?;
        }
        Ok::<(), io::Error>(())
    };
    add("positions", &[count, 3], &|i| rows.row(i).position.to_vec())?;
    add("scales", &[count, 3], &|i| rows.row(i).scale.to_vec())?;
    add("rotations", &[count, 4], &|i| rows.row(i).rotation.to_vec())?;
    add("opacities", &[count], &|i| vec![rows.row(i).opacity])?;
    add("colours", &[count, 3], &|i| rows.row(i).colour.to_vec())?;
    if rows.harmonics() > 0 {
        add("harmonics", &[count, rows.harmonics(), 3], &|i| {
            rows.coefficients(i).as_flattened().to_vec()
        })?;
    }
    let mut doubles = |name: &str, numbers: &[f64]| {
        let to = archive.start(&format!("{name}.npy"), 0)?;
        to.write_all(&header("<f8", &[numbers.len()]))?;
        to.write_all(&numbers.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>())
    };
    doubles("offset", &rows.offset())?;
    let Frame { bits, placement } = rows.frame();
    let [x, y, z] = placement.origin;
    doubles("cube", &[f64::from(bits), x, y, z, placement.voxel_size])?;
    if let Some(up) = rows.up {
        doubles("turned_from", &direction(up))?;
    }
    let to = archive.start("antialiased.npy", 0)?;
    to.write_all(&header("|b1", &[]))?;
    to.write_all(&[u8::from(rows.gaussians.compensated)])?;
    archive.finish()
}

/// The unit vector of an axis.
fn direction(up: Up) -> [f64; 3] {
    let (axis, negative) = up.axis();
    let mut direction = [0.0; 3];
    direction[axis] = if negative { -1.0 } else { 1.0 };
    direction
}

/// The header of a `.npy` file.
fn header(kind: &str, shape: &[usize]) -> Vec<u8> {
    let sizes: String = shape.iter().map(|size| format!("{size},")).collect();
    let mut text = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({sizes}), }}");
    let before = MAGIC.len() + 4;
    let padding = (before + text.len() + 1).next_multiple_of(ALIGN) - before - text.len() - 1;
    text += &" ".repeat(padding);
    text.push('\n');
    let mut bytes = MAGIC.to_vec();
    bytes.extend([1, 0]);
    bytes.extend((text.len() as u16).to_le_bytes());
    bytes.extend(text.into_bytes());
    bytes
}
