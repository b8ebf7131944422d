//! PCD files of the Point Cloud Library: ascii, binary and binary_compressed.

mod lzf;

use b2p::cloud::{PointCloud, RawColours, RawPoints, Stored};
use b2p::{Limits, Result};

use super::{malformed, shown, truncated};

/// Bytes of a header at most.
const LONGEST_HEADER: usize = 1 << 16;
/// Values per field at most: descriptors have some hundred.
const MOST_VALUES: usize = 1 << 16;

/// One field of every point.
#[derive(Debug, Clone)]
struct Field {
    name: String,
    /// Bytes of a value.
    size: usize,
    kind: Type,
    count: usize,
    /// Offset in a point of a binary file.
    offset: usize,
    /// Values in a row before this field.
    column: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Type {
    Signed,
    Unsigned,
    Float,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Data {
    Ascii,
    Binary,
    Compressed,
}

struct Header {
    fields: Vec<Field>,
    points: usize,
    data: Data,
    /// Where the data starts.
    body: usize,
    /// Lines before it.
    lines: usize,
    /// Bytes of a point.
    stride: usize,
}

/// Reads a PCD file with the fields `x y z`, and `rgb`, `rgba`, `r g b` or `intensity`, and `normal_x` and the others.
///
/// # Errors
/// [`b2p::Error::Malformed`], [`b2p::Error::Truncated`], [`b2p::Error::LimitExceeded`].
pub(super) fn read(bytes: &[u8], limits: &Limits) -> Result<RawPoints> {
    let header = Header::parse(bytes)?;
    limits.check_points("number of points", header.points as u64)?;
    let mut columns = Selection::of(&header.fields)?;
    if header.data != Data::Ascii
        && let Some(packed) = &mut columns.packed
    {
        // Converting floats would change bits of those that are NaN.
        packed.kind = Type::Unsigned;
    }
    let memory = header.points as u64 * 4 * (6 + columns.others() as u64);
    let body = &bytes[header.body..];
    match header.data {
        Data::Ascii => {
            limits.check_bytes("bytes of the point cloud", memory)?;
            ascii(body, &header, &columns)
        }
        Data::Binary => {
            limits.check_bytes("bytes of the point cloud", memory)?;
            let needed = header.points.saturating_mul(header.stride);
            let Some(rows) = body.get(..needed) else {
                return Err(truncated(bytes.len(), "points of the PCD file", needed - body.len()));
            };
            let stride = header.stride;
            binary(&header, &columns, |field, i| &rows[i * stride + field.offset..])
        }
        Data::Compressed => {
            let unpacked = unpack(body, &header, memory, limits)?;
            let points = header.points;
            binary(&header, &columns, |field, i| {
                &unpacked[field.offset * points + i * field.size * field.count..]
            })
        }
    }
}

/// The data of a compressed file: field after field.
fn unpack(body: &[u8], header: &Header, memory: u64, limits: &Limits) -> Result<Vec<u8>> {
    let size = |at: usize| {
        let bytes = body
            .get(at..at + 4)
            .ok_or_else(|| truncated(header.body + body.len(), "sizes of the PCD data", 4))?;
        Ok(u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]) as usize)
    };
    let (packed, unpacked) = (size(0)?, size(4)?);
    let expected = header.points.saturating_mul(header.stride);
    if unpacked != expected {
        let at = format!("byte {}", header.body + 4);
        return Err(malformed(
            at,
            "unpacked size of the data",
            unpacked,
            format!("{expected}, as the header has it"),
        ));
    }
    limits.check_bytes("bytes of the point cloud", memory + unpacked as u64)?;
    let Some(code) = body[8..].get(..packed) else {
        let missing = packed - (body.len() - 8);
        return Err(truncated(header.body + body.len(), "packed PCD data", missing));
    };
    lzf::unpack(code, unpacked).ok_or_else(|| {
        let at = format!("byte {}", header.body + 8);
        malformed(at, "packed data", "damaged", format!("LZF of {unpacked} bytes"))
    })
}

impl Header {
    fn parse(bytes: &[u8]) -> Result<Header> {
        let mut at = 0;
        let mut lines = 0;
        let (mut names, mut sizes, mut types, mut counts) = (vec![], vec![], vec![], vec![]);
        let (mut width, mut height, mut points) = (None, None, None);
        let data = loop {
            let rest = &bytes[at..bytes.len().min(LONGEST_HEADER)];
            let Some(length) = rest.iter().position(|b| *b == b'\n') else {
                return Err(truncated(bytes.len(), "PCD header", "DATA binary\n".len()));
            };
            at += length + 1;
            lines += 1;
            let line = String::from_utf8_lossy(&rest[..length]);
            let mut words = line.split_ascii_whitespace();
            let key = words.next().unwrap_or_default();
            let values: Vec<String> = words.map(str::to_owned).collect();
            let numbers = || {
                let number = |word: &String| {
                    let parsed: Option<usize> = word.parse().ok();
                    parsed.ok_or_else(|| {
                        malformed(format!("line {lines}"), key, shown(word.as_bytes()), "a whole number")
                    })
                };
                values.iter().map(number).collect::<Result<Vec<usize>>>()
            };
            match key {
                "FIELDS" | "COLUMNS" => names = values,
                "SIZE" => sizes = numbers()?,
                "TYPE" => types = values,
                "COUNT" => counts = numbers()?,
                "WIDTH" => width = numbers()?.first().copied(),
                "HEIGHT" => height = numbers()?.first().copied(),
                "POINTS" => points = numbers()?.first().copied(),
                "DATA" => match values.first().map(String::as_str) {
                    Some("ascii") => break Data::Ascii,
                    Some("binary") => break Data::Binary,
                    Some("binary_compressed") => break Data::Compressed,
                    other => {
                        let found = shown(other.unwrap_or_default().as_bytes());
                        return Err(malformed(
                            format!("line {lines}"),
                            "DATA",
                            found,
                            "ascii, binary or binary_compressed",
                        ));
                    }
                },
                _ => {} // Comments, the version, and the viewpoint.
            }
        };
        if counts.is_empty() {
            counts = vec![1; names.len()];
        }
        let fields = fields(&names, &sizes, &types, &counts)?;
        let organised = width.and_then(|w| w.checked_mul(height.unwrap_or(1)));
        let Some(points) = points.or(organised) else {
            return Err(malformed("header", "POINTS", "absent", "the number of points"));
        };
        let stride = fields.iter().map(|field| field.size * field.count).sum();
        Ok(Header {
            fields,
            points,
            data,
            body: at,
            lines,
            stride,
        })
    }
}

fn fields(names: &[String], sizes: &[usize], types: &[String], counts: &[usize]) -> Result<Vec<Field>> {
    let lengths = [sizes.len(), types.len(), counts.len()];
    if names.is_empty() || lengths != [names.len(); 3] {
        let value = format!("{lengths:?} for {} fields", names.len());
        return Err(malformed(
            "header",
            "numbers of SIZE, TYPE and COUNT",
            value,
            "one per field",
        ));
    }
    let (mut offset, mut column) = (0, 0);
    let mut fields = Vec::new();
    for (i, name) in names.iter().enumerate() {
        let kind = match (types[i].as_str(), sizes[i]) {
            ("F", 4 | 8) => Type::Float,
            ("U", 1 | 2 | 4 | 8) => Type::Unsigned,
            ("I", 1 | 2 | 4 | 8) => Type::Signed,
            (kind, size) => {
                let field = format!("type of field {name:.40}");
                return Err(malformed(
                    "header",
                    field,
                    format!("{kind:.8}{size}"),
                    "F4, F8, or U or I of 1, 2, 4 or 8",
                ));
            }
        };
        if counts[i] > MOST_VALUES {
            let field = format!("COUNT of field {name:.40}");
            return Err(malformed("header", field, counts[i], format!("at most {MOST_VALUES}")));
        }
        fields.push(Field {
            name: name.to_ascii_lowercase(),
            size: sizes[i],
            kind,
            count: counts[i],
            offset,
            column,
        });
        offset += sizes[i] * counts[i];
        column += counts[i];
    }
    Ok(fields)
}

/// The fields that are read.
struct Selection {
    axes: [Field; 3],
    packed: Option<Field>,
    channels: Option<[Field; 3]>,
    grey: Option<Field>,
    normals: Option<[Field; 3]>,
}

impl Selection {
    fn of(fields: &[Field]) -> Result<Selection> {
        let find = |names: &[&str]| {
            let named = |name: &&str| fields.iter().find(|f| f.name == *name && f.count >= 1).cloned();
            names.iter().find_map(named)
        };
        let three = |names: [&[&str]; 3]| Some([find(names[0])?, find(names[1])?, find(names[2])?]);
        let Some(axes) = three([&["x"], &["y"], &["z"]]) else {
            let names: Vec<&str> = fields.iter().map(|f| f.name.as_str()).collect();
            return Err(malformed(
                "header",
                "FIELDS",
                shown(names.join(" ").as_bytes()),
                "x, y and z among them",
            ));
        };
        Ok(Selection {
            axes,
            packed: find(&["rgb", "rgba"]).filter(|field| field.size == 4),
            channels: three([&["r", "red"], &["g", "green"], &["b", "blue"]]),
            grey: find(&["intensity", "i", "grey", "gray", "reflectivity"]),
            normals: three([&["normal_x", "nx"], &["normal_y", "ny"], &["normal_z", "nz"]]),
        })
    }

    /// Numbers per point beside its coordinates, each of four bytes.
    fn others(&self) -> usize {
        let colour = if self.packed.is_some() || self.grey.is_some() {
            1
        } else {
            0
        };
        colour + [&self.channels, &self.normals].into_iter().flatten().count() * 3
    }

    /// Reads all points with a function that gives a field of a point.
    fn read(&self, count: usize, value: impl Fn(&Field, usize) -> f64) -> RawPoints {
        let three = |fields: &[Field; 3], i: usize| -> [f64; 3] { std::array::from_fn(|k| value(&fields[k], i)) };
        let single = |fields: &[Field; 3]| {
            (0..count)
                .map(|i| three(fields, i).map(|x| x as f32))
                .collect::<Vec<[f32; 3]>>()
        };
        let stored = |field: &Field| match (field.kind, field.size) {
            (Type::Float, _) => Stored::Float,
            (Type::Unsigned, 1) => Stored::Byte,
            (Type::Unsigned, 2) => Stored::Short,
            _ => Stored::Integer,
        };
        let colours = match (&self.packed, &self.channels, &self.grey) {
            (Some(field), ..) => {
                let rgb = |i| {
                    let value = value(field, i);
                    // Three bytes, as an integer or in the place of a float.
                    let packed = match field.kind {
                        Type::Float => (value as f32).to_bits(),
                        Type::Unsigned => value as u32,
                        Type::Signed => value as i32 as u32,
                    };
                    let [b, g, r, _] = packed.to_le_bytes();
                    [r, g, b]
                };
                RawColours::Bytes((0..count).map(rgb).collect())
            }
            (_, Some(fields), _) => RawColours::Rgb(single(fields), stored(&fields[0])),
            (_, _, Some(field)) => {
                let values = (0..count).map(|i| value(field, i) as f32);
                RawColours::Grey(values.collect(), stored(field), field.name.clone())
            }
            _ => RawColours::None,
        };
        RawPoints {
            positions: (0..count).map(|i| three(&self.axes, i)).collect(),
            colours,
            normals: self.normals.as_ref().map(single).unwrap_or_default(),
            ..RawPoints::default()
        }
    }
}

fn binary<'a>(header: &Header, wanted: &Selection, bytes: impl Fn(&Field, usize) -> &'a [u8]) -> Result<RawPoints> {
    Ok(wanted.read(header.points, |field, i| number(bytes(field, i), field)))
}

/// The first value of a field. `bytes` has at least its size.
fn number(bytes: &[u8], field: &Field) -> f64 {
    let mut eight = [0; 8];
    eight[..field.size].copy_from_slice(&bytes[..field.size]);
    let unsigned = u64::from_le_bytes(eight);
    let shift = 64 - 8 * field.size as u32;
    match (field.kind, field.size) {
        (Type::Float, 4) => f32::from_bits(unsigned as u32).into(),
        (Type::Float, _) => f64::from_bits(unsigned),
        (Type::Unsigned, _) => unsigned as f64,
        (Type::Signed, _) => ((unsigned << shift) as i64 >> shift) as f64,
    }
}

fn ascii(body: &[u8], header: &Header, wanted: &Selection) -> Result<RawPoints> {
    let columns: usize = header.fields.iter().map(|field| field.count).sum();
    // A value takes a digit and a separator.
    let needed = header.points.saturating_mul(2 * columns).saturating_sub(1);
    if needed > body.len() {
        return Err(truncated(
            header.body + body.len(),
            "points of the PCD file",
            needed - body.len(),
        ));
    }
    let mut named: Vec<&Field> = wanted.axes.iter().collect();
    named.extend(wanted.packed.iter().chain(&wanted.grey));
    named.extend([&wanted.channels, &wanted.normals].into_iter().flatten().flatten());
    let mut slots = vec![None; columns];
    for (slot, field) in named.iter().enumerate() {
        slots[field.column] = Some(slot);
    }
    let mut values = vec![Vec::with_capacity(header.points); named.len()];
    let mut rows = body
        .split(|b| *b == b'\n')
        .enumerate()
        .filter(|(_, row)| !row.trim_ascii().is_empty());
    for _ in 0..header.points {
        let Some((line, row)) = rows.next() else {
            return Err(truncated(header.body + body.len(), "points of the PCD file", 1));
        };
        let at = || format!("line {}", header.lines + line + 1);
        let mut words = row.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        for (column, slot) in slots.iter().enumerate() {
            let word = words.next().unwrap_or_default();
            let parsed: Option<f64> = std::str::from_utf8(word).ok().and_then(|word| word.parse().ok());
            let value =
                parsed.ok_or_else(|| malformed(at(), format!("value {}", column + 1), shown(word), "a number"))?;
            if let Some(slot) = slot {
                values[*slot].push(value);
            }
        }
    }
    let slot = |field: &Field| slots[field.column].unwrap_or_default();
    Ok(wanted.read(header.points, |field, i| values[slot(field)][i]))
}

/// Encodes a cloud as a binary PCD file: `x y z` as floats, or doubles if `double`, and `rgb`.
pub(super) fn write(cloud: &PointCloud, double: bool) -> Vec<u8> {
    let (size, count) = (if double { 8 } else { 4 }, cloud.positions.len());
    let mut bytes = format!(
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE {size} {size} {size} 4\n\
         TYPE F F F U\nCOUNT 1 1 1 1\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
    )
    .into_bytes();
    bytes.reserve(count * (3 * size + 4));
    for (position, [r, g, b]) in cloud.positions.iter().zip(&cloud.colours) {
        for x in position {
            match double {
                true => bytes.extend(x.to_le_bytes()),
                false => bytes.extend((*x as f32).to_le_bytes()),
            }
        }
        bytes.extend([*b, *g, *r, 0]);
    }
    bytes
}

#[cfg(test)]
mod tests;
