//! Compressed PLY as SuperSplat writes it: blocks of 256 Gaussians.
//!
//! The element `chunk` holds the bounds of each block; `vertex` four words of 32 bits per Gaussian: position and
//! logarithm of the scale with 11, 10 and 11 bits between the bounds, the rotation as index of the largest component of
//! the quaternion and 10 bits for each other one, and the colour with 8 bits between the bounds and the opacity with 8
//! bits; `sh`, if there is one, the harmonics with 8 bits in [−4, 4].

use std::io::{self, Write};

use b2p::cloud::ply::{Column, Ply};
use b2p::gaussians::Gaussians;
use b2p::gaussians::ply::{Comments, comments};
use b2p::{Limits, Result};

use super::builder::{self, Builder};
use super::bytes::malformed;
use super::rows::{Row, Rows};
use super::up_comment;

/// Gaussians of a block.
const BLOCK: usize = 256;
const BOUNDS: [&str; 18] = [
    "min_x",
    "min_y",
    "min_z",
    "max_x",
    "max_y",
    "max_z",
    "min_scale_x",
    "min_scale_y",
    "min_scale_z",
    "max_scale_x",
    "max_scale_y",
    "max_scale_z",
    "min_r",
    "min_g",
    "min_b",
    "max_r",
    "max_g",
    "max_b",
];
/// Bounds that files without bounds of colours have.
const FEW_BOUNDS: usize = 12;
const WORDS: [&str; 4] = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];
/// Logarithms of scales are clamped to ±20, as other writers do.
const SCALE_RANGE: f64 = 20.0;

/// Whether a PLY file has the elements of this format.
pub(super) fn is_compressed(bytes: &[u8]) -> bool {
    Ply::open(bytes).is_ok_and(|ply| {
        let has = |element, property: &str| ply.element(element).is_some_and(|e| e.has(property));
        has("chunk", BOUNDS[0]) && has("vertex", WORDS[0])
    })
}

pub(super) fn read(bytes: &[u8], limits: &Limits) -> Result<(Gaussians, Vec<String>)> {
    let ply = Ply::open(bytes)?;
    let told = Comments::of(&ply.header);
    let coloured = ply.element("chunk").is_some_and(|chunk| chunk.has(BOUNDS[FEW_BOUNDS]));
    let names = if coloured { &BOUNDS[..] } else { &BOUNDS[..FEW_BOUNDS] };
    let harmonics = ply.element("sh").map_or(0, |sh| sh.properties.len() / 3);
    if ![0, 3, 8, 15].contains(&harmonics) || ply.element("sh").is_some_and(|sh| sh.properties.len() % 3 != 0) {
        let found = ply.element("sh").map_or(0, |sh| sh.properties.len());
        return Err(malformed("header", "properties of element sh", found, "9, 24 or 45"));
    }
    let count = ply.element("vertex").map_or(0, |vertex| vertex.count);
    builder::check(count, harmonics, limits)?;
    let bounds = ply.columns("chunk", names, limits)?;
    let words = ply.columns("vertex", &WORDS, limits)?;
    let blocks = (count as usize).div_ceil(BLOCK);
    if bounds[0].len() != blocks {
        let expected = format!("{blocks} for {count} Gaussians");
        return Err(malformed("header", "count of element chunk", bounds[0].len(), expected));
    }
    let rest = match harmonics {
        0 => Vec::new(),
        _ => {
            let names: Vec<String> = (0..3 * harmonics).map(|k| format!("f_rest_{k}")).collect();
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            ply.columns("sh", &names, limits)?
        }
    };
    if rest.first().is_some_and(|column| column.len() as u64 != count) {
        return Err(malformed("header", "count of element sh", rest[0].len(), count));
    }
    let mut builder = Builder::new(count, harmonics, limits)?;
    builder.offset = told.offset;
    builder.compensated = told.compensated;
    for i in 0..count as usize {
        builder.push(unpack(&bounds, &words, coloured, i));
        builder.push_coefficients(
            (0..harmonics)
                .map(|k| std::array::from_fn(|channel| unpack_harmonic(rest[channel * harmonics + k].get(i)))),
        );
    }
    let mode = told
        .ignored_mode
        .map(|mode| format!("drawn as `default`, not in its render mode `{mode}`"));
    Ok((builder.finish(told.frame), mode.into_iter().collect()))
}

fn unpack(bounds: &[Column], words: &[Column], coloured: bool, i: usize) -> Row {
    let [position, rotation, scale, colour]: [u32; 4] = std::array::from_fn(|k| words[k].get(i) as u32);
    let between = |first: usize, t: [f64; 3]| -> [f64; 3] {
        std::array::from_fn(|k| {
            let (low, high) = (bounds[first + k].get(i / BLOCK), bounds[first + 3 + k].get(i / BLOCK));
            low * (1.0 - t[k]) + high * t[k]
        })
    };
    let three = |word: u32| [part(word, 21, 11), part(word, 11, 10), part(word, 0, 11)];
    let bytes = [24, 16, 8].map(|shift| part(colour, shift, 8));
    Row {
        position: between(0, three(position)),
        scale: between(6, three(scale)).map(f64::exp),
        rotation: unpack_rotation(rotation),
        opacity: part(colour, 0, 8),
        colour: if coloured { between(12, bytes) } else { bytes },
    }
}

/// So many bits of a word as a number in [0, 1].
fn part(word: u32, shift: u32, bits: u32) -> f64 {
    let most = (1 << bits) - 1;
    f64::from(word >> shift & most) / f64::from(most)
}

fn unpack_rotation(word: u32) -> [f64; 4] {
    let largest = (word >> 30) as usize;
    let mut q = [0.0; 4];
    for (place, k) in (0..4).filter(|&k| k != largest).enumerate() {
        q[k] = (part(word, 20 - 10 * place as u32, 10) - 0.5) * std::f64::consts::SQRT_2;
    }
    q[largest] = (1.0 - q.iter().map(|x| x * x).sum::<f64>()).max(0.0).sqrt();
    q
}

/// The ends of the range are exact, everything else is the middle of its interval.
fn unpack_harmonic(byte: f64) -> f64 {
    let t = match byte {
        0.0 => 0.0,
        255.0 => 1.0,
        _ => (byte + 0.5) / 256.0,
    };
    (t - 0.5) * 8.0
}

pub(super) fn write(rows: &mut Rows, to: &mut dyn Write) -> io::Result<()> {
    rows.sort_in_space();
    let blocks: Vec<Block> = (0..rows.len())
        .step_by(BLOCK)
        .map(|first| Block::of(rows, first))
        .collect();
    let coefficients = 3 * rows.harmonics();
    let told = comments(&rows.frame(), rows.gaussians.compensated, 0.0) + &up_comment(rows.up);
    let mut header = format!(
        "ply\nformat binary_little_endian 1.0\n{told}element chunk {}\n",
        blocks.len()
    );
    BOUNDS
        .iter()
        .for_each(|name| header += &format!("property float {name}\n"));
    header += &format!("element vertex {}\n", rows.len());
    WORDS
        .iter()
        .for_each(|name| header += &format!("property uint {name}\n"));
    if coefficients > 0 {
        header += &format!("element sh {}\n", rows.len());
        (0..coefficients).for_each(|k| header += &format!("property uchar f_rest_{k}\n"));
    }
    header += "end_header\n";
    to.write_all(header.as_bytes())?;
    for block in &blocks {
        let bounds: Vec<u8> = block.bounds.iter().flat_map(|x| x.to_le_bytes()).collect();
        to.write_all(&bounds)?;
    }
    for (block, first) in blocks.iter().zip((0..).step_by(BLOCK)) {
        let rows = (first..rows.len().min(first + BLOCK)).map(|i| block.pack(&rows.row(i)));
        let words: Vec<u8> = rows.flatten().flat_map(u32::to_le_bytes).collect();
        to.write_all(&words)?;
    }
    for i in 0..rows.len() * coefficients.min(1) {
        let own = rows.coefficients(i);
        let bytes: Vec<u8> = (0..3)
            .flat_map(|channel| own.iter().map(move |c| pack_harmonic(c[channel])))
            .collect();
        to.write_all(&bytes)?;
    }
    Ok(())
}

/// The bounds of 256 Gaussians, in the order of [`BOUNDS`].
struct Block {
    bounds: [f32; 18],
}

impl Block {
    fn of(rows: &Rows, first: usize) -> Self {
        let mut low = [f64::INFINITY; 9];
        let mut high = [f64::NEG_INFINITY; 9];
        for i in first..rows.len().min(first + BLOCK) {
            for (k, x) in values(&rows.row(i)).into_iter().enumerate() {
                low[k] = low[k].min(x);
                high[k] = high[k].max(x);
            }
        }
        let of = |k: usize| {
            if k % 6 < 3 {
                low[k / 6 * 3 + k % 3]
            } else {
                high[k / 6 * 3 + k % 3]
            }
        };
        Block {
            bounds: std::array::from_fn(|k| of(k) as f32),
        }
    }

    /// The words of a Gaussian.
    fn pack(&self, row: &Row) -> [u32; 4] {
        let values = values(row);
        let t: [f64; 9] = std::array::from_fn(|k| {
            let (low, high) = (self.bounds[k / 3 * 6 + k % 3], self.bounds[k / 3 * 6 + 3 + k % 3]);
            let (low, high) = (f64::from(low), f64::from(high));
            if high > low {
                ((values[k] - low) / (high - low)).clamp(0.0, 1.0)
            } else {
                0.0
            }
        });
        let three = |t: &[f64]| level(t[0], 11) << 21 | level(t[1], 10) << 11 | level(t[2], 11);
        let colour = t[6..].iter().chain([&row.opacity]);
        [
            three(&t[..3]),
            pack_rotation(row.rotation),
            three(&t[3..6]),
            colour.fold(0, |word, &t| word << 8 | level(t, 8)),
        ]
    }
}

/// What is stored between bounds.
fn values(row: &Row) -> [f64; 9] {
    let scale = row.log_scale().map(|s| s.clamp(-SCALE_RANGE, SCALE_RANGE));
    let all = [row.position, scale, row.colour];
    std::array::from_fn(|k| all[k / 3][k % 3])
}

/// A number in [0, 1] as a level of so many bits.
fn level(t: f64, bits: u32) -> u32 {
    let most = f64::from((1u32 << bits) - 1);
    (t * most).round().clamp(0.0, most) as u32
}

fn pack_rotation(q: [f64; 4]) -> u32 {
    let largest = (1..4).fold(0, |best, k| if q[k].abs() > q[best].abs() { k } else { best });
    // −q is the same rotation: the largest component becomes positive.
    let sign = if q[largest] < 0.0 { -1.0 } else { 1.0 };
    let others = (0..4).filter(|&k| k != largest);
    others.fold(largest as u32, |word, k| {
        word << 10 | level(sign * q[k] * std::f64::consts::FRAC_1_SQRT_2 + 0.5, 10)
    })
}

fn pack_harmonic(x: f64) -> u8 {
    ((x / 8.0 + 0.5) * 256.0).clamp(0.0, 255.0) as u8
}

#[cfg(test)]
mod tests;
