//! Reading of glTF: the splats of all nodes of the scene.

use std::borrow::Cow;

use b2p::{Error, Limits, Result};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::Value;

use super::{BINARY_CHUNK, DEGREES, EXTENSION, JSON_CHUNK, MAGIC};
use crate::splats::Parts;
use crate::splats::builder::{self, Builder};
use crate::splats::bytes::{Bytes, malformed};
use crate::splats::details::{frame_from_json, three, up_from_json};
use crate::splats::rows::{HARMONIC, Row};
use crate::splats::turn::{Turn, matrix, product, unit};

/// Nodes that are visited at most: more are a graph that shares nodes or never ends.
const MOST_NODES: usize = 100_000;
/// Bytes that JSON takes in memory for each in the file, at most.
const JSON_FACTOR: u64 = 16;
/// By how much the axes of a node may differ in length, relatively.
const TOLERANCE: f64 = 1e-4;

/// Whether a document names the extension: meshes and points do not.
pub(in crate::splats) fn has_splats(bytes: &[u8]) -> bool {
    let text = if bytes.starts_with(MAGIC) {
        chunks(bytes).map_or(&[][..], |(text, _)| text)
    } else {
        bytes
    };
    text.windows(EXTENSION.len())
        .any(|window| window == EXTENSION.as_bytes())
}

/// A document with its buffers.
struct Document<'a> {
    root: Value,
    buffers: Vec<Cow<'a, [u8]>>,
    limits: Limits,
}

/// The transform of a node: rotation, uniform scale, translation.
#[derive(Debug, Clone, Copy)]
struct Transform {
    rotation: [f64; 4],
    scale: f64,
    translation: [f64; 3],
}

const IDENTITY: Transform = Transform {
    rotation: [1.0, 0.0, 0.0, 0.0],
    scale: 1.0,
    translation: [0.0; 3],
};

impl Transform {
    fn point(&self, p: [f64; 3]) -> [f64; 3] {
        let m = matrix(self.rotation);
        std::array::from_fn(|r| self.translation[r] + self.scale * (0..3).map(|c| m[r][c] * p[c]).sum::<f64>())
    }

    fn then(&self, inner: &Transform) -> Transform {
        Transform {
            rotation: product(self.rotation, inner.rotation),
            scale: self.scale * inner.scale,
            translation: self.point(inner.translation),
        }
    }

    /// Of a node.
    fn of(node: &Value, at: &str) -> Result<Self> {
        if let Some(numbers) = node["matrix"].as_array() {
            let numbers: Vec<f64> = numbers.iter().filter_map(Value::as_f64).collect();
            let Ok(m) = <[f64; 16]>::try_from(numbers) else {
                return Err(malformed(at, "matrix", &node["matrix"], "16 numbers"));
            };
            return Transform::of_matrix(m, at);
        }
        let optional = |name: &str| match node.get(name) {
            None => Ok(None),
            Some(value) => three(value)
                .map(Some)
                .ok_or_else(|| malformed(at, name, value, "three numbers")),
        };
        let scale = optional("scale")?.unwrap_or([1.0; 3]);
        let rotation = match node.get("rotation") {
            None => IDENTITY.rotation,
            Some(value) => {
                let q: Option<Vec<f64>> = value.as_array().and_then(|q| q.iter().map(Value::as_f64).collect());
                match q.as_deref() {
                    Some([x, y, z, w]) if [x, y, z, w].iter().any(|q| **q != 0.0) => unit([*w, *x, *y, *z]),
                    _ => return Err(malformed(at, "rotation", value, "a quaternion")),
                }
            }
        };
        Ok(Transform {
            rotation,
            scale: uniform(scale, at)?,
            translation: optional("translation")?.unwrap_or_default(),
        })
    }

    /// Of a matrix in columns.
    fn of_matrix(m: [f64; 16], at: &str) -> Result<Self> {
        let column = |c: usize| [m[4 * c], m[4 * c + 1], m[4 * c + 2]];
        let length = |v: [f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
        let scale = uniform([0, 1, 2].map(|c| length(column(c))), at)?;
        let [x, y, z] = [0, 1, 2].map(|c| column(c).map(|v| v / scale));
        let dot = |a: [f64; 3], b: [f64; 3]| (0..3).map(|k| a[k] * b[k]).sum::<f64>();
        let cross = [
            x[1] * y[2] - x[2] * y[1],
            x[2] * y[0] - x[0] * y[2],
            x[0] * y[1] - x[1] * y[0],
        ];
        if dot(x, y).abs() > TOLERANCE || dot(cross, z) < 1.0 - TOLERANCE {
            return Err(unsupported(at, "a matrix that shears or mirrors"));
        }
        // From the largest of the four, so that nothing is divided by a small number.
        let traces = [
            1.0 + x[0] + y[1] + z[2],
            1.0 + x[0] - y[1] - z[2],
            1.0 - x[0] + y[1] - z[2],
            1.0 - x[0] - y[1] + z[2],
        ];
        let largest = (1..4).fold(0, |best, k| if traces[k] > traces[best] { k } else { best });
        let t = traces[largest];
        let q = match largest {
            0 => [t, y[2] - z[1], z[0] - x[2], x[1] - y[0]],
            1 => [y[2] - z[1], t, x[1] + y[0], z[0] + x[2]],
            2 => [z[0] - x[2], x[1] + y[0], t, y[2] + z[1]],
            _ => [x[1] - y[0], z[0] + x[2], y[2] + z[1], t],
        };
        Ok(Transform {
            rotation: unit(q),
            scale,
            translation: [m[12], m[13], m[14]],
        })
    }
}

/// The one scale of three that are equal.
fn uniform([x, y, z]: [f64; 3], at: &str) -> Result<f64> {
    let mean = (x + y + z) / 3.0;
    let equal = [x, y, z].iter().all(|s| (s - mean).abs() <= TOLERANCE * mean);
    if !(mean > 0.0 && mean.is_finite() && equal) {
        return Err(unsupported(at, &format!("scale {x} × {y} × {z}")));
    }
    Ok(mean)
}

fn unsupported(at: &str, found: &str) -> Error {
    Error::Unsupported {
        what: "this transform of splats",
        detail: format!("{at} has {found}, expected a rotation with one scale above 0"),
    }
}

/// Splats of a node.
struct Part<'d> {
    attributes: &'d Value,
    transform: Transform,
    count: u64,
    harmonics: usize,
}

pub(in crate::splats) fn read(bytes: &[u8], limits: &Limits) -> Result<Parts> {
    let document = Document::open(bytes, limits)?;
    let mut warnings = Vec::new();
    let parts = document.parts(&mut warnings)?;
    if parts.is_empty() {
        let expected = format!("a primitive with {EXTENSION}");
        return Err(malformed("glTF", "splats", "none in the scene", expected));
    }
    let harmonics = parts.iter().map(|part| part.harmonics).min().unwrap_or(0);
    if parts.iter().any(|part| part.harmonics > harmonics) {
        warnings.push("parts of the scene have view-dependent colours of higher degree: ignored".into());
    }
    let count = parts.iter().fold(0u64, |sum, part| sum.saturating_add(part.count));
    builder::check(count, harmonics, limits)?;
    let mut builder = Builder::new(count, harmonics, limits)?;
    let details = &document.root["asset"]["extras"]["b2p"];
    builder.compensated = details["antialiased"].as_bool() == Some(true);
    // Coordinates are doubles from here on: the offset is that of the nodes.
    let (frame, _) = frame_from_json(&details["cube"]);
    for part in &parts {
        document.add(part, harmonics, &mut builder)?;
    }
    Ok((builder.finish(frame), warnings, up_from_json(&details["cube"])))
}

impl<'a> Document<'a> {
    fn open(bytes: &'a [u8], limits: &Limits) -> Result<Self> {
        let (text, binary) = if bytes.starts_with(MAGIC) {
            chunks(bytes)?
        } else {
            (bytes, None)
        };
        limits.check_bytes(
            "bytes of the JSON in memory",
            JSON_FACTOR.saturating_mul(text.len() as u64),
        )?;
        let root: Value = serde_json::from_slice(text).map_err(|e| malformed("glTF", "JSON", e, "an object"))?;
        let buffers = root["buffers"]
            .as_array()
            .map_or(&[][..], Vec::as_slice)
            .iter()
            .enumerate();
        Ok(Document {
            buffers: buffers
                .map(|(i, buffer)| bytes_of(buffer, i, binary))
                .collect::<Result<_>>()?,
            root,
            limits: limits.clone(),
        })
    }

    /// The splats of the scene's nodes; of all nodes without a scene.
    fn parts<'d>(&'d self, warnings: &mut Vec<String>) -> Result<Vec<Part<'d>>> {
        let array = |value: &'d Value| -> &'d [Value] { value.as_array().map_or(&[][..], Vec::as_slice) };
        let nodes = array(&self.root["nodes"]);
        let scene = self.root["scene"].as_u64().unwrap_or(0) as usize;
        let roots = self.root["scenes"][scene]["nodes"].as_array();
        let mut waiting: Vec<(usize, Transform)> = match roots {
            Some(roots) => roots
                .iter()
                .filter_map(|i| Some((i.as_u64()? as usize, IDENTITY)))
                .collect(),
            None => (0..nodes.len()).map(|i| (i, IDENTITY)).collect(),
        };
        let mut parts = Vec::new();
        let mut visited = 0;
        while let Some((i, outer)) = waiting.pop() {
            visited += 1;
            let at = format!("node {i}");
            let node = nodes
                .get(i)
                .ok_or_else(|| malformed(&at, "index of a node", i, format!("below {}", nodes.len())))?;
            if visited > MOST_NODES {
                return Err(malformed(at, "nodes of the scene", "a cycle, or too many", MOST_NODES));
            }
            let children = array(&node["children"]);
            let mesh = node["mesh"]
                .as_u64()
                .map_or(&Value::Null, |mesh| &self.root["meshes"][mesh as usize]);
            let primitives = array(&mesh["primitives"]);
            if children.is_empty() && primitives.is_empty() {
                continue;
            }
            let transform = outer.then(&Transform::of(node, &at)?);
            waiting.extend(children.iter().filter_map(|i| Some((i.as_u64()? as usize, transform))));
            for primitive in primitives {
                match primitive["extensions"].get(EXTENSION) {
                    Some(extension) => parts.push(self.part(primitive, extension, transform, warnings)?),
                    None => warnings.push(format!("{at} has a mesh or points: ignored")),
                }
            }
        }
        Ok(parts)
    }

    fn part<'d>(
        &'d self,
        primitive: &'d Value,
        extension: &Value,
        transform: Transform,
        warnings: &mut Vec<String>,
    ) -> Result<Part<'d>> {
        if let Some((name, _)) = extension["extensions"]
            .as_object()
            .and_then(|inner| inner.iter().next())
        {
            return Err(Error::Unsupported {
                what: "this extension of splats in glTF",
                detail: format!("{name}, expected {EXTENSION} without extensions"),
            });
        }
        for (name, usual) in [("kernel", "ellipse"), ("colorSpace", "srgb_rec709_display")] {
            match extension[name].as_str() {
                Some(value) if value != usual => warnings.push(format!("{name} {value} is read as {usual}")),
                _ => {}
            }
        }
        let attributes = &primitive["attributes"];
        let position = self.accessor_of(attributes, "POSITION")?;
        let count = self.root["accessors"][position]["count"].as_u64().unwrap_or(0);
        let has = |degree: usize, k: usize| {
            attributes
                .get(format!("{EXTENSION}:SH_DEGREE_{degree}_COEF_{k}"))
                .is_some()
        };
        let degrees = DEGREES
            .iter()
            .take_while(|&&(degree, count)| (0..count).all(|k| has(degree, k)));
        Ok(Part {
            attributes,
            transform,
            count,
            harmonics: degrees.map(|(_, count)| count).sum(),
        })
    }

    fn add(&self, part: &Part, harmonics: usize, builder: &mut Builder) -> Result<()> {
        let get = |name: &str, width| self.numbers(part, name, width);
        let splat = |name: &str, width| self.numbers(part, &format!("{EXTENSION}:{name}"), width);
        let positions = get("POSITION", 3)?;
        let rotations = splat("ROTATION", 4)?;
        let scales = splat("SCALE", 3)?;
        let opacities = splat("OPACITY", 1)?;
        let colours = splat("SH_DEGREE_0_COEF_0", 3)?;
        let names = DEGREES
            .into_iter()
            .flat_map(|(degree, count)| (0..count).map(move |k| (degree, k)));
        let rest: Vec<Vec<f32>> = names
            .take(harmonics)
            .map(|(degree, k)| splat(&format!("SH_DEGREE_{degree}_COEF_{k}"), 3))
            .collect::<Result<_>>()?;
        let turn = (part.transform.rotation != IDENTITY.rotation).then(|| Turn::new(part.transform.rotation));
        for i in 0..part.count as usize {
            let three = |from: &[f32]| -> [f64; 3] { std::array::from_fn(|k| from[3 * i + k].into()) };
            let [x, y, z, w] = std::array::from_fn(|k| f64::from(rotations[4 * i + k]));
            builder.push(Row {
                position: part.transform.point(three(&positions)),
                scale: three(&scales).map(|s| s * part.transform.scale),
                rotation: turn.as_ref().map_or([w, x, y, z], |turn| turn.rotation([w, x, y, z])),
                opacity: opacities[i].into(),
                colour: three(&colours).map(|c| 0.5 + HARMONIC * c),
            });
            let mut own: Vec<[f64; 3]> = rest.iter().map(|coefficient| three(coefficient)).collect();
            if let Some(turn) = &turn {
                turn.coefficients(&mut own);
            }
            builder.push_coefficients(own);
        }
        Ok(())
    }

    fn accessor_of(&self, attributes: &Value, name: &str) -> Result<usize> {
        let index = attributes[name].as_u64();
        let index = index.ok_or_else(|| malformed("glTF", format!("attribute {name}"), "absent", "an accessor"))?;
        Ok(index as usize)
    }

    /// The numbers of an attribute, `width` per Gaussian.
    fn numbers(&self, part: &Part, name: &str, width: usize) -> Result<Vec<f32>> {
        let index = self.accessor_of(part.attributes, name)?;
        let (accessor, at) = (&self.root["accessors"][index], format!("accessor {index} ({name})"));
        let wrong = |field: &str, expected: &str| malformed(&at, field, &accessor[field], expected);
        let kind = ["SCALAR", "VEC2", "VEC3", "VEC4"][width - 1];
        if accessor["type"].as_str() != Some(kind) {
            return Err(wrong("type", kind));
        }
        if accessor["count"].as_u64() != Some(part.count) {
            return Err(wrong("count", &part.count.to_string()));
        }
        if accessor.get("sparse").is_some() {
            return Err(wrong("sparse", "no sparse accessor"));
        }
        let normalised = accessor["normalized"].as_bool() == Some(true);
        let component = accessor["componentType"].as_u64().unwrap_or(0);
        let (size, scale) = match component {
            5126 => (4, 1.0),
            5120 | 5121 => (1, if component == 5120 { 127.0 } else { 255.0 }),
            5122 | 5123 => (2, if component == 5122 { 32767.0 } else { 65535.0 }),
            _ => return Err(wrong("componentType", "5120 to 5123 or 5126")),
        };
        let scale = if normalised { scale } else { 1.0 };
        let view_index = accessor["bufferView"]
            .as_u64()
            .ok_or_else(|| wrong("bufferView", "an index"))? as usize;
        let view = &self.root["bufferViews"][view_index];
        let bytes = self.view(view, view_index)?;
        let start = accessor["byteOffset"].as_u64().unwrap_or(0);
        let own = (width * size) as u64;
        let stride = view["byteStride"].as_u64().unwrap_or(own);
        let needed = match part.count {
            0 => Some(0),
            count => (count - 1)
                .checked_mul(stride)
                .and_then(|n| n.checked_add(own)?.checked_add(start)),
        };
        if stride < own || needed.is_none_or(|needed| needed > bytes.len() as u64) {
            let expected = format!("{} rows within the {} bytes of the view", part.count, bytes.len());
            return Err(malformed(
                &at,
                "extent",
                format!("{start} + {stride} bytes a row"),
                expected,
            ));
        }
        self.limits
            .check_bytes("bytes of an attribute", part.count * 4 * width as u64)?;
        let value = |bytes: &[u8]| match component {
            5120 => f32::from(bytes[0] as i8),
            5121 => f32::from(bytes[0]),
            5122 => f32::from(i16::from_le_bytes([bytes[0], bytes[1]])),
            5123 => f32::from(u16::from_le_bytes([bytes[0], bytes[1]])),
            _ => f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]),
        };
        let mut numbers = Vec::with_capacity(part.count as usize * width);
        for i in 0..part.count as usize {
            let row = &bytes[start as usize + i * stride as usize..][..own as usize];
            // A signed integer may be one below the range of its type's floats.
            numbers.extend(
                row.chunks_exact(size)
                    .map(|c| (value(c) / scale).max(if normalised { -1.0 } else { f32::MIN })),
            );
        }
        Ok(numbers)
    }

    fn view(&self, view: &Value, index: usize) -> Result<&[u8]> {
        let at = format!("bufferView {index}");
        let buffer = view["buffer"].as_u64().and_then(|i| self.buffers.get(i as usize));
        let expected = || format!("below {}", self.buffers.len());
        let buffer = buffer.ok_or_else(|| malformed(&at, "buffer", &view["buffer"], expected()))?;
        let start = view["byteOffset"].as_u64().unwrap_or(0);
        let length = view["byteLength"].as_u64().unwrap_or(0);
        let end = start.checked_add(length).filter(|&end| end <= buffer.len() as u64);
        let Some(end) = end else {
            let expected = format!("within the {} bytes of the buffer", buffer.len());
            return Err(malformed(at, "extent", format!("{start} + {length}"), expected));
        };
        Ok(&buffer[start as usize..end as usize])
    }
}

/// The bytes of buffer `index`: of the binary chunk, or of its URI.
fn bytes_of<'a>(buffer: &Value, index: usize, binary: Option<&'a [u8]>) -> Result<Cow<'a, [u8]>> {
    match (buffer["uri"].as_str(), binary) {
        (None, Some(binary)) if index == 0 => Ok(binary.into()),
        (Some(uri), _) if uri.starts_with("data:") => {
            let data = uri.split_once(";base64,").map_or("", |(_, data)| data);
            let decoded = STANDARD.decode(data);
            Ok(decoded
                .map_err(|e| malformed(format!("buffer {index}"), "data URI", e, "base64"))?
                .into())
        }
        _ => Err(Error::Unsupported {
            what: "a buffer in another file",
            detail: format!("buffer {index} is not in the file, expected GLB or a data URI"),
        }),
    }
}

/// The chunks of a GLB file: JSON and binary data.
fn chunks(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>)> {
    let mut fields = Bytes::new(bytes);
    fields.take(4, "magic")?;
    let version = fields.u32("version")?;
    if version != 2 {
        return Err(malformed("byte 4", "version of GLB", version, 2));
    }
    fields.u32("length")?;
    let text = chunk(&mut fields, JSON_CHUNK, "JSON chunk")?;
    let binary = match fields.len() {
        0 => None,
        _ => Some(chunk(&mut fields, BINARY_CHUNK, "binary chunk")?),
    };
    Ok((text, binary))
}

fn chunk<'a>(fields: &mut Bytes<'a>, name: &[u8], field: &'static str) -> Result<&'a [u8]> {
    let length = fields.u32("length of a chunk")?;
    let at = fields.at();
    let kind = fields.take(4, "type of a chunk")?;
    if kind != name {
        let (found, name) = (String::from_utf8_lossy(kind), String::from_utf8_lossy(name));
        return Err(malformed(format!("byte {at}"), "type of a chunk", found, name));
    }
    fields.take(length.into(), field)
}
