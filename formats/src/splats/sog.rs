//! SOG of PlayCanvas, version 2: a ZIP archive of `meta.json` and lossless WebP pictures, one pixel per Gaussian.
//!
//! `means_l` and `means_u` hold the low and high bytes of 16 bits per coordinate, between bounds, of
//! `sign(x)·ln(1 + |x|)`; `quats` the three smallest components of the quaternion and the index of the largest;
//! `scales` and `sh0` indices into codebooks of 256 logarithms of scales and harmonics of degree 0, `sh0` also the
//! opacity; `shN_labels` indices into `shN_centroids`, a palette of harmonics whose numbers have a codebook, too.

mod codebook;
mod palette;
mod pictures;
mod webp;

use std::io::{self, Write};

use b2p::{Error, Limits, Result};
use serde_json::{Value, json};

use super::Parts;
use super::builder::{self, Builder};
use super::bytes::{malformed, to_byte};
use super::details::{Archive, ArchiveWriter, frame_from_json, frame_to_json, three, up_from_json};
use super::rows::{HARMONIC, Row, Rows};
use codebook::Codebook;
use pictures::{Picture, size_of_pictures};

/// Colour channels that hold the index of the largest component of a quaternion start here.
const LARGEST: u8 = 252;
/// Coefficients by degree.
const COEFFICIENTS: [usize; 4] = [0, 3, 8, 15];
/// Bytes that JSON takes in memory for each in the file, at most.
const JSON_FACTOR: u64 = 16;
/// Entries of the palette in a row of its picture.
const PER_ROW: usize = 64;
/// The model of Gaussians that were trained with opacity compensation.
const ANTIALIASED: &str = "antialiased";

pub(super) fn read(bytes: &[u8], limits: &Limits) -> Result<Parts> {
    let mut archive = Archive::open(bytes, limits)?;
    let meta = meta(&mut archive, limits)?;
    let count = meta["count"].as_u64();
    let count = count.ok_or_else(|| malformed("meta.json", "count", &meta["count"], "a number of Gaussians"))?;
    let bands = meta["shN"]["bands"].as_u64().unwrap_or(0) as usize;
    let &harmonics = COEFFICIENTS
        .get(bands)
        .ok_or_else(|| malformed("meta.json", "shN.bands", bands, "0 to 3"))?;
    builder::check(count, harmonics, limits)?;

    let mut builder = Builder::new(count, harmonics, limits)?;
    let (frame, offset) = frame_from_json(&meta["b2p"]);
    builder.offset = offset;
    let mut warnings = Vec::new();
    match meta["model"].as_str() {
        Some(ANTIALIASED) => builder.compensated = true,
        Some(mode) if mode != "default" => {
            warnings.push(format!("drawn as `default`, not in its render mode `{mode}`"));
        }
        _ => {}
    }
    let pictures = Pictures::read(&mut archive, &meta, count, harmonics, limits)?;
    let codes = Codes::read(&meta)?;
    let palette = Palette::read(&meta, harmonics, &pictures.rest)?;
    for i in 0..count as usize {
        builder.push(pictures.row(i, &codes)?);
        if let Some(palette) = &palette {
            builder.push_coefficients(palette.coefficients(i));
        }
    }
    Ok((builder.finish(frame), warnings, up_from_json(&meta["b2p"])))
}

/// The description of an archive of version 2.
fn meta(archive: &mut Archive, limits: &Limits) -> Result<Value> {
    let text = archive.need("meta.json")?;
    limits.check_bytes(
        "bytes of meta.json in memory",
        JSON_FACTOR.saturating_mul(text.len() as u64),
    )?;
    let meta: Value = serde_json::from_slice(&text).map_err(|e| malformed("meta.json", "JSON", e, "an object"))?;
    match meta["version"].as_u64() {
        Some(2) => Ok(meta),
        found => {
            let version = found.map_or("no version: it is version 1".into(), |v| format!("version {v}"));
            Err(Error::Unsupported {
                what: "this version of SOG",
                detail: format!("meta.json has {version}, expected version 2"),
            })
        }
    }
}

/// The pictures of an archive. A pixel of each belongs to a Gaussian.
struct Pictures {
    /// The low and the high bytes of positions.
    means: Vec<Picture>,
    quats: Vec<Picture>,
    scales: Vec<Picture>,
    sh0: Vec<Picture>,
    /// The palette of harmonics and its labels; empty without harmonics.
    rest: Vec<Picture>,
}

impl Pictures {
    fn read(archive: &mut Archive, meta: &Value, count: u64, harmonics: usize, limits: &Limits) -> Result<Self> {
        let mut pictures = |name: &str, files: usize| -> Result<Vec<Picture>> {
            let names = meta[name]["files"].as_array().map_or(&[][..], Vec::as_slice);
            let names: Vec<&str> = names.iter().filter_map(Value::as_str).collect();
            if names.len() != files {
                return Err(malformed("meta.json", format!("files of {name}"), names.len(), files));
            }
            let read = |name: &&str| Picture::read(name, &archive.need(name)?, limits);
            names.iter().map(read).collect()
        };
        let read = Pictures {
            means: pictures("means", 2)?,
            quats: pictures("quats", 1)?,
            scales: pictures("scales", 1)?,
            sh0: pictures("sh0", 1)?,
            rest: if harmonics > 0 { pictures("shN", 2)? } else { Vec::new() },
        };
        let each = read
            .means
            .iter()
            .chain(&read.quats)
            .chain(&read.scales)
            .chain(&read.sh0);
        for picture in each.chain(read.rest.get(1)) {
            picture.check_pixels(count)?;
        }
        Ok(read)
    }

    fn row(&self, i: usize, codes: &Codes) -> Result<Row> {
        let (lower, upper) = (self.means[0].pixel(i), self.means[1].pixel(i));
        let (scale, colour) = (self.scales[0].pixel(i), self.sh0[0].pixel(i));
        Ok(Row {
            position: std::array::from_fn(|k| {
                let t = f64::from(u16::from_le_bytes([lower[k], upper[k]])) / 65535.0;
                inverse_log(codes.low[k] + (codes.high[k] - codes.low[k]) * t)
            }),
            scale: std::array::from_fn(|k| codes.scales[usize::from(scale[k])].exp()),
            rotation: rotation(self.quats[0].pixel(i), i)?,
            opacity: f64::from(colour[3]) / 255.0,
            colour: std::array::from_fn(|k| 0.5 + HARMONIC * codes.colours[usize::from(colour[k])]),
        })
    }
}

/// What the bytes of pictures stand for.
struct Codes {
    /// Bounds of positions, in symmetric logarithms.
    low: [f64; 3],
    high: [f64; 3],
    scales: Vec<f64>,
    colours: Vec<f64>,
}

impl Codes {
    fn read(meta: &Value) -> Result<Self> {
        let bounds = |name: &str| {
            let found = &meta["means"][name];
            three(found).ok_or_else(|| malformed("meta.json", format!("means.{name}"), found, "three numbers"))
        };
        Ok(Codes {
            low: bounds("mins")?,
            high: bounds("maxs")?,
            scales: numbers(meta, "scales")?,
            colours: numbers(meta, "sh0")?,
        })
    }
}

/// A codebook of 256 numbers. The first may be null, as some early files have it.
fn numbers(meta: &Value, name: &str) -> Result<Vec<f64>> {
    let wrong =
        |found: &dyn std::fmt::Display| malformed("meta.json", format!("codebook of {name}"), found, "256 numbers");
    let book = meta[name]["codebook"].as_array().ok_or_else(|| wrong(&"absent"))?;
    if book.len() != 256 {
        return Err(wrong(&format!("{} long", book.len())));
    }
    let number = |value: &Value| value.as_f64().filter(|x| x.is_finite());
    let book: Option<Vec<f64>> = book.iter().map(number).collect();
    book.ok_or_else(|| wrong(&"not of numbers"))
}

/// The harmonics of a file.
struct Palette<'a> {
    count: usize,
    harmonics: usize,
    book: Vec<f64>,
    centroids: &'a Picture,
    labels: &'a Picture,
}

impl<'a> Palette<'a> {
    fn read(meta: &Value, harmonics: usize, rest: &'a [Picture]) -> Result<Option<Self>> {
        let [centroids, labels] = rest else { return Ok(None) };
        let count = meta["shN"]["count"].as_u64().unwrap_or(0);
        let rows = count.div_ceil(PER_ROW as u64);
        let (width, height) = (PER_ROW * harmonics, u64::from(centroids.height));
        if centroids.width as usize != width || height < rows {
            let found = format!("{}×{height}", centroids.width);
            let field = "size of the palette's picture";
            return Err(malformed(
                &centroids.name,
                field,
                found,
                format!("{width}×{rows} for {count} entries"),
            ));
        }
        Ok(Some(Palette {
            count: count as usize,
            harmonics,
            book: numbers(meta, "shN")?,
            centroids,
            labels,
        }))
    }

    /// Of Gaussian `i`; zeros if its label is outside the palette, as in other readers.
    fn coefficients(&self, i: usize) -> impl Iterator<Item = [f64; 3]> + '_ {
        let [low, high, ..] = self.labels.pixel(i);
        let label = usize::from(u16::from_le_bytes([low, high]));
        (0..self.harmonics).map(move |k| {
            if label >= self.count {
                return [0.0; 3];
            }
            // The rows of the picture are exactly those of the palette.
            let pixel = self.centroids.pixel(label * self.harmonics + k);
            std::array::from_fn(|channel| self.book[usize::from(pixel[channel])])
        })
    }
}

fn log(x: f64) -> f64 {
    x.signum() * x.abs().ln_1p()
}

fn inverse_log(x: f64) -> f64 {
    x.signum() * x.abs().exp_m1()
}

fn rotation([a, b, c, tag]: [u8; 4], i: usize) -> Result<[f64; 4]> {
    let Some(largest) = tag.checked_sub(LARGEST) else {
        return Err(malformed(
            format!("Gaussian {i}"),
            "largest component of the rotation",
            tag,
            "252 to 255",
        ));
    };
    let mut q = [0.0; 4];
    let others = (0..4).filter(|&k| k != usize::from(largest));
    for (k, byte) in others.zip([a, b, c]) {
        q[k] = (f64::from(byte) / 255.0 * 2.0 - 1.0) * std::f64::consts::FRAC_1_SQRT_2;
    }
    q[usize::from(largest)] = (1.0 - q.iter().map(|x| x * x).sum::<f64>()).max(0.0).sqrt();
    Ok(q)
}

pub(super) fn write(rows: &mut Rows, to: &mut dyn Write, io: &dyn Fn(io::Error) -> Error) -> Result<()> {
    rows.sort_in_space();
    let (width, height) = size_of_pictures(rows.len())?;
    let mut meta = json!({
        "version": 2,
        "asset": { "generator": concat!("b2p ", env!("CARGO_PKG_VERSION")) },
        "count": rows.len(),
    });
    if rows.gaussians.compensated {
        meta["model"] = ANTIALIASED.into();
    }
    meta["b2p"] = frame_to_json(rows.frame(), rows.up);
    let mut archive = ArchiveWriter::new(to);
    let mut add = |name: &str, bytes: &[u8]| archive.start(name, bytes.len() as u64)?.write_all(bytes);
    let mut picture = |name: &str, pixels: &[[u8; 4]]| {
        let mut pixels = pixels.to_vec();
        pixels.resize((width * height) as usize, [0; 4]);
        add(name, &webp::encode(&pixels, width, height))
    };

    let means = Means::of(rows);
    picture("means_l.webp", &means.pixels(rows, |x| x as u8)).map_err(io)?;
    picture("means_u.webp", &means.pixels(rows, |x| (x >> 8) as u8)).map_err(io)?;
    let (low, high) = (means.low, means.high);
    meta["means"] = json!({ "mins": low, "maxs": high, "files": ["means_l.webp", "means_u.webp"] });

    let quats: Vec<[u8; 4]> = rows.iter().map(|row| pack_rotation(row.rotation)).collect();
    picture("quats.webp", &quats).map_err(io)?;
    meta["quats"] = json!({ "files": ["quats.webp"] });

    let book = Codebook::of(rows.iter().flat_map(|row| row.log_scale()));
    let scales: Vec<[u8; 4]> = rows.iter().map(|row| book.pixel(row.log_scale(), 255)).collect();
    picture("scales.webp", &scales).map_err(io)?;
    meta["scales"] = json!({ "codebook": book.numbers(), "files": ["scales.webp"] });

    let book = Codebook::of(rows.iter().flat_map(|row| row.dc()));
    let colours: Vec<[u8; 4]> = rows
        .iter()
        .map(|row| book.pixel(row.dc(), to_byte(row.opacity)))
        .collect();
    picture("sh0.webp", &colours).map_err(io)?;
    meta["sh0"] = json!({ "codebook": book.numbers(), "files": ["sh0.webp"] });

    if rows.harmonics() > 0 && rows.len() > 0 {
        let palette = palette::Palette::of(rows);
        let labels: Vec<[u8; 4]> = palette
            .labels
            .iter()
            .map(|&l| [l as u8, (l >> 8) as u8, 0, 255])
            .collect();
        picture("shN_labels.webp", &labels).map_err(io)?;
        let (centroids, meta_of) = pictures_of(&palette, rows.harmonics());
        add("shN_centroids.webp", &centroids).map_err(io)?;
        meta["shN"] = meta_of;
    }
    add("meta.json", meta.to_string().as_bytes()).map_err(io)?;
    archive.finish().map_err(io)
}

/// The picture of a palette, and its part of `meta.json`.
fn pictures_of(palette: &palette::Palette, harmonics: usize) -> (Vec<u8>, Value) {
    let book = Codebook::of(palette.entries.iter().flatten().map(|&x| x.into()));
    let count = palette.entries.len() / harmonics;
    let (width, height) = (PER_ROW * harmonics, count.div_ceil(PER_ROW));
    let mut pixels: Vec<[u8; 4]> = palette
        .entries
        .iter()
        .map(|c| book.pixel(c.map(f64::from), 255))
        .collect();
    pixels.resize(width * height, [0; 4]);
    let bands = COEFFICIENTS.iter().position(|&c| c == harmonics);
    let files = ["shN_centroids.webp", "shN_labels.webp"];
    let meta = json!({ "count": count, "bands": bands, "codebook": book.numbers(), "files": files });
    (webp::encode(&pixels, width as u32, height as u32), meta)
}

/// Bounds of the logarithms of the coordinates.
struct Means {
    low: [f64; 3],
    high: [f64; 3],
}

impl Means {
    fn of(rows: &Rows) -> Self {
        let (low, high) = rows.bounds();
        Means {
            low: low.map(log),
            high: high.map(log),
        }
    }

    /// One byte of each coordinate.
    fn pixels(&self, rows: &Rows, byte: impl Fn(u16) -> u8) -> Vec<[u8; 4]> {
        let level = |row: &Row, k: usize| {
            let range = self.high[k] - self.low[k];
            let t = if range > 0.0 {
                (log(row.position[k]) - self.low[k]) / range
            } else {
                0.0
            };
            byte((t * 65535.0).round().clamp(0.0, 65535.0) as u16)
        };
        rows.iter()
            .map(|row| [level(&row, 0), level(&row, 1), level(&row, 2), 255])
            .collect()
    }
}

fn pack_rotation(q: [f64; 4]) -> [u8; 4] {
    let largest = (1..4).fold(0, |best, k| if q[k].abs() > q[best].abs() { k } else { best });
    // −q is the same rotation: the largest component becomes positive.
    let sign = if q[largest] < 0.0 { -1.0 } else { 1.0 };
    let mut pixel = [LARGEST + largest as u8; 4];
    let others = (0..4).filter(|&k| k != largest);
    for (to, k) in pixel.iter_mut().zip(others) {
        *to = to_byte(sign * q[k] * std::f64::consts::FRAC_1_SQRT_2 + 0.5);
    }
    pixel
}

#[cfg(test)]
mod tests;
