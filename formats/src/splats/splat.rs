//! `.splat`: 32 bytes per Gaussian and nothing else.
//!
//! Position and scale as floats, red, green, blue and opacity in 255ths, and the quaternion w, x, y, z as bytes
//! `128 + 128·q`.

use std::io::{self, Write};

use b2p::gaussians::Gaussians;
use b2p::{Limits, Result};

use super::builder::Builder;
use super::bytes::{f32_at, malformed, to_byte};
use super::rows::{Row, Rows};
use super::turn::unit;

const SIZE: usize = 32;

pub(super) fn read(bytes: &[u8], offset: [f64; 3], limits: &Limits) -> Result<(Gaussians, Vec<String>)> {
    if !bytes.len().is_multiple_of(SIZE) {
        let expected = "a multiple of 32 bytes, one Gaussian each";
        return Err(malformed("the end", "size of the .splat file", bytes.len(), expected));
    }
    let mut builder = Builder::new((bytes.len() / SIZE) as u64, 0, limits)?;
    builder.offset = offset;
    for row in bytes.chunks_exact(SIZE) {
        let rotation: [f64; 4] = std::array::from_fn(|k| (f64::from(row[28 + k]) - 128.0) / 128.0);
        builder.push(Row {
            position: std::array::from_fn(|k| f32_at(row, k)),
            scale: std::array::from_fn(|k| f32_at(row, 3 + k)),
            rotation: if rotation == [0.0; 4] {
                [1.0, 0.0, 0.0, 0.0]
            } else {
                unit(rotation)
            },
            opacity: f64::from(row[27]) / 255.0,
            colour: std::array::from_fn(|k| f64::from(row[24 + k]) / 255.0),
        });
    }
    Ok((builder.finish(None), Vec::new()))
}

pub(super) fn write_rows(rows: &mut Rows, to: &mut dyn Write) -> io::Result<()> {
    for row in rows.iter() {
        let floats = row.position.into_iter().chain(row.scale).map(|x| x as f32);
        let mut bytes: Vec<u8> = floats.flat_map(f32::to_le_bytes).collect();
        bytes.extend(row.colour.map(to_byte));
        bytes.push(to_byte(row.opacity));
        bytes.extend(
            row.rotation
                .map(|q| (128.0 * q + 128.0).round().clamp(0.0, 255.0) as u8),
        );
        to.write_all(&bytes)?;
    }
    if rows.harmonics() > 0 {
        rows.warn(".splat holds no view-dependent colour: it is left out".into());
    }
    if rows.gaussians.compensated {
        rows.warn(".splat cannot say that the Gaussians were trained with anti-aliasing".into());
    }
    Ok(())
}
