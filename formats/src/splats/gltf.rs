//! glTF 2.0 with `KHR_gaussian_splatting` (release candidate of July 2026).
//!
//! A primitive of points with the attributes POSITION, SCALE (linear), ROTATION (x, y, z, w), OPACITY (linear) and
//! harmonics, all of floats, and COLOR_0 for programs that draw points. The offset of the coordinates is the
//! translation of the node, in double precision.

mod read;

use std::io::{self, Write};

use b2p::{Error, Result};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};

pub(super) use read::{has_splats, read};

use super::Format;
use super::details::frame_to_json;
use super::rows::{Row, Rows};

/// The extension, and the start of its attributes' names.
const EXTENSION: &str = "KHR_gaussian_splatting";
const FLOAT: u64 = 5126;
const UNSIGNED_BYTE: u64 = 5121;
const MAGIC: &[u8] = b"glTF";
const JSON_CHUNK: &[u8] = b"JSON";
const BINARY_CHUNK: &[u8] = b"BIN\0";
/// Where data inside JSON begin.
const DATA_URI: &str = "data:application/octet-stream;base64,";
/// Names of the coefficients by degree.
const DEGREES: [(usize, usize); 3] = [(1, 3), (2, 5), (3, 7)];

/// The bytes of a row, of which number and values are given.
type Bytes<'r> = Box<dyn Fn(usize, &Row) -> Vec<u8> + 'r>;

/// An attribute: name, type and number of components, and its bytes of a row.
struct Attribute<'r> {
    name: String,
    kind: &'static str,
    width: usize,
    bytes: Bytes<'r>,
}

impl<'r> Attribute<'r> {
    fn new(name: &str, kind: &'static str, width: usize, bytes: impl Fn(usize, &Row) -> Vec<u8> + 'r) -> Self {
        Attribute {
            name: name.to_owned(),
            kind,
            width,
            bytes: Box::new(bytes),
        }
    }
}

fn floats(numbers: &[f64]) -> Vec<u8> {
    numbers.iter().flat_map(|&x| (x as f32).to_le_bytes()).collect()
}

/// A sRGB colour in linear light.
fn linear(c: f64) -> f64 {
    let c = c.clamp(0.0, 1.0);
    if c <= 0.040_45 {
        c / 12.92
    } else {
        ((c + 0.055) / 1.055).powf(2.4)
    }
}

fn attributes<'r>(rows: &'r Rows) -> Vec<Attribute<'r>> {
    let splat = |name: &str| format!("{EXTENSION}:{name}");
    let mut all = vec![
        Attribute::new("POSITION", "VEC3", 12, |_, row| floats(&row.position)),
        Attribute::new("COLOR_0", "VEC4", 4, |_, row| {
            let [r, g, b] = row.colour.map(linear);
            [r, g, b, row.opacity].map(super::bytes::to_byte).to_vec()
        }),
        Attribute::new(&splat("ROTATION"), "VEC4", 16, |_, row| {
            let [w, x, y, z] = row.rotation;
            floats(&[x, y, z, w])
        }),
        Attribute::new(&splat("SCALE"), "VEC3", 12, |_, row| floats(&row.scale)),
        Attribute::new(&splat("OPACITY"), "SCALAR", 4, |_, row| floats(&[row.opacity])),
        Attribute::new(&splat("SH_DEGREE_0_COEF_0"), "VEC3", 12, |_, row| floats(&row.dc())),
    ];
    let names = DEGREES
        .into_iter()
        .flat_map(|(degree, count)| (0..count).map(move |k| (degree, k)));
    for (i, (degree, k)) in names.take(rows.harmonics()).enumerate() {
        let name = splat(&format!("SH_DEGREE_{degree}_COEF_{k}"));
        all.push(Attribute::new(&name, "VEC3", 12, move |row, _| {
            floats(&rows.coefficients(row)[i])
        }));
    }
    all
}

pub(super) fn write(rows: &Rows, format: Format, to: &mut dyn Write, io: &dyn Fn(io::Error) -> Error) -> Result<()> {
    let attributes = attributes(rows);
    let size: u64 = attributes.iter().map(|a| (a.width * rows.len()) as u64).sum();
    let data = |to: &mut dyn Write| -> io::Result<()> {
        for attribute in &attributes {
            for (i, row) in rows.iter().enumerate() {
                to.write_all(&(attribute.bytes)(i, &row))?;
            }
        }
        Ok(())
    };
    if format == Format::Gltf {
        let mut binary = Vec::new();
        data(&mut binary).map_err(io)?;
        let uri = format!("{DATA_URI}{}", STANDARD.encode(&binary));
        return to
            .write_all(document(rows, &attributes, size, Some(uri)).to_string().as_bytes())
            .map_err(io);
    }
    let mut text = document(rows, &attributes, size, None).to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    // Every width is a multiple of 4, and so is their sum.
    let total = 12 + 8 + text.len() as u64 + 8 + size;
    let lengths = (u32::try_from(total), u32::try_from(size));
    let (Ok(total), Ok(size)) = lengths else {
        return Err(Error::Usage(format!(
            "{total} bytes are more than the 4 GiB of a GLB file"
        )));
    };
    let mut start = Vec::new();
    start.extend(MAGIC);
    start.extend(2u32.to_le_bytes());
    start.extend(total.to_le_bytes());
    start.extend((text.len() as u32).to_le_bytes());
    start.extend(JSON_CHUNK);
    start.extend(&text);
    start.extend(size.to_le_bytes());
    start.extend(BINARY_CHUNK);
    to.write_all(&start).map_err(io)?;
    data(to).map_err(io)
}

fn document(rows: &Rows, attributes: &[Attribute], size: u64, uri: Option<String>) -> Value {
    let count = rows.len();
    let (low, high) = rows.bounds();
    let mut names = serde_json::Map::new();
    let (mut views, mut accessors) = (Vec::new(), Vec::new());
    let mut offset = 0;
    for (i, attribute) in attributes.iter().enumerate() {
        names.insert(attribute.name.clone(), i.into());
        let length = attribute.width * count;
        views.push(json!({ "buffer": 0, "byteOffset": offset, "byteLength": length, "target": 34962 }));
        let colour = attribute.name == "COLOR_0";
        let mut accessor = json!({
            "bufferView": i,
            "componentType": if colour { UNSIGNED_BYTE } else { FLOAT },
            "count": count,
            "type": attribute.kind,
        });
        if colour {
            accessor["normalized"] = true.into();
        }
        if i == 0 {
            accessor["min"] = json!(low.map(|x| x as f32));
            accessor["max"] = json!(high.map(|x| x as f32));
        }
        accessors.push(accessor);
        offset += length;
    }
    let extension = json!({
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    });
    let mut node = json!({ "mesh": 0 });
    if rows.offset() != [0.0; 3] {
        node["translation"] = json!(rows.offset());
    }
    let mut buffer = json!({ "byteLength": size });
    if let Some(uri) = uri {
        buffer["uri"] = uri.into();
    }
    let mut asset = json!({ "version": "2.0", "generator": concat!("b2p ", env!("CARGO_PKG_VERSION")) });
    let details = json!({ "antialiased": rows.gaussians.compensated, "cube": frame_to_json(rows.frame(), rows.up) });
    asset["extras"] = json!({ "b2p": details });
    json!({
        "asset": asset,
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [node],
        "meshes": [{ "primitives": [{ "mode": 0, "attributes": names, "extensions": { EXTENSION: extension } }] }],
        "buffers": [buffer],
        "bufferViews": views,
        "accessors": accessors,
    })
}

#[cfg(test)]
mod tests;
