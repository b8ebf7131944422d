//! Gaussians as PLY files in the convention of splat viewers.
//!
//! Per Gaussian, as `float`: `x y z` in world units; `f_dc_0..2`, with colour = ½ + 0.2820948·f_dc; `opacity`, the
//! logit; `scale_0..2`, the natural logarithms of the standard deviations in world units; `rot_0..3`, the quaternion w,
//! x, y, z. Logits and logarithms must be finite: the writer clamps opacities to [10⁻⁶, 1 − 10⁻⁶] and deviations to at
//! least 10⁻³⁸. Comments hold the cube, so that the reader restores the frame. Positions are single precision: at an
//! origin a million voxels away they resolve a sixteenth of a voxel.
//!
//! View-dependent colour (`f_rest_*`) is read but not written, since decoded Gaussians have none. The comment
//! `SplatRenderMode: mip` marks Gaussians that were trained for rendering with opacity compensation.
//!
//! The reader accepts files of other programs: any number types, byte order and order of properties.

use std::io::Write;
use std::path::Path;

use rayon::prelude::*;

use super::{Frame, Gaussians, Harmonics};
use crate::cloud::ply::{Column, Header, Ply};
use crate::error::{Error, Result};
use crate::limits::Limits;
use crate::placement::Placement;

/// The spherical harmonic of degree 0: `1/(2√π)`.
const HARMONIC: f64 = 0.282_094_791_773_878_14;
/// Minimum opacity written. The maximum is 1 minus this.
const OPACITY_MARGIN: f64 = 1e-6;
/// Minimum standard deviation written.
const LEAST_SCALE: f64 = f32::MIN_POSITIVE as f64;
/// The properties written.
const PROPERTIES: [&str; 14] = [
    "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2",
    "rot_3",
];
/// Render modes that imply opacity compensation.
const MIP: [&str; 2] = ["mip", "antialiased"];
/// Rows per write.
const BLOCK: usize = 1024;
/// Bit depth of the cube that is fitted to a file without one.
const FITTED_BITS: u8 = 10;

/// Properties of a file that the reader ignored or had to guess.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Notes {
    /// Ignored coefficients of view-dependent colour per Gaussian (`f_rest_*`): their number fits no degree.
    pub ignored_harmonics: usize,
    /// Ignored render mode: neither `default` nor one with opacity compensation.
    pub ignored_mode: Option<String>,
    /// The file lacks `scale_2`: the Gaussians are discs.
    pub flat: bool,
    /// The file names no cube, so one was fitted to the centres.
    pub fitted: bool,
}

impl Notes {
    /// One sentence per note.
    pub fn warnings(&self) -> Vec<String> {
        let mut lines = Vec::new();
        if self.ignored_harmonics > 0 {
            lines.push(format!(
                "view-dependent colour is ignored: {} coefficients f_rest per Gaussian",
                self.ignored_harmonics
            ));
        }
        if let Some(mode) = &self.ignored_mode {
            lines.push(format!("drawn as `default`, not in its render mode `{mode}`"));
        }
        if self.flat {
            lines.push("the file has no scale_2: the Gaussians are read as flat discs".into());
        }
        if self.fitted {
            lines.push("the file names no cube: fitted one to the Gaussians' centres".into());
        }
        lines
    }
}

impl Gaussians {
    /// Writes a binary little-endian PLY file block by block. `path` appears in error messages only.
    ///
    /// # Errors
    /// [`Error::Io`] if `to` fails; [`Error::Usage`] if the arrays differ in length or the frame is invalid.
    pub fn write_ply<W: Write + ?Sized>(&self, to: &mut W, path: &Path) -> Result<()> {
        self.check_lengths()?;
        let Frame { bits, placement } = self.frame;
        if !self.frame.is_valid() {
            return Err(Error::Usage(format!("{:?} is no cube", self.frame)));
        }
        let io = |source| Error::Io {
            path: path.to_owned(),
            source,
        };
        let [x, y, z] = placement.origin;
        let blur = match self.blur > 0.0 {
            true => format!("comment b2p blur {}\n", self.blur),
            false => String::new(),
        };
        let mut header = format!(
            "ply\nformat binary_little_endian 1.0\ncomment SplatRenderMode: default\n\
             comment b2p bits {bits}\ncomment b2p origin {x} {y} {z}\n\
             comment b2p voxel_size {}\n{blur}element vertex {}\n",
            placement.voxel_size,
            self.len()
        );
        for name in PROPERTIES {
            header += &format!("property float {name}\n");
        }
        header += "end_header\n";
        to.write_all(header.as_bytes()).map_err(io)?;

        let mut bytes = Vec::with_capacity(BLOCK * size_of::<[f32; 14]>());
        for first in (0..self.len()).step_by(BLOCK) {
            bytes.clear();
            for i in first..self.len().min(first + BLOCK) {
                bytes.extend(self.row(i).into_iter().flat_map(f32::to_le_bytes));
            }
            to.write_all(&bytes).map_err(io)?;
        }
        Ok(())
    }

    /// The values of Gaussian `i` in the order of [`PROPERTIES`].
    fn row(&self, i: usize) -> [f32; 14] {
        let unit = self.frame.unit();
        let [x, y, z] = self.frame.placement.from_cube(self.frame.bits, self.position[i]);
        let [r, g, b] = self.colour[i].map(|c| (f64::from(c) - 0.5) / HARMONIC);
        let opacity = f64::from(self.opacity[i]).clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
        let opacity = (opacity / (1.0 - opacity)).ln();
        let [s0, s1, s2] = self.scale[i].map(|s| {
            let s = (f64::from(s) * unit).abs();
            // `max` would replace NaN.
            if s < LEAST_SCALE { LEAST_SCALE.ln() } else { s.ln() }
        });
        let [q0, q1, q2, q3] = self.rotation[i].map(f64::from);
        [x, y, z, r, g, b, opacity, s0, s1, s2, q0, q1, q2, q3].map(|x| x as f32)
    }

    /// As [`read`], without the notes.
    ///
    /// # Errors
    /// As [`read`].
    pub fn from_ply(bytes: &[u8], limits: &Limits) -> Result<Gaussians> {
        read(bytes, limits).map(|(gaussians, _)| gaussians)
    }
}

/// Reads Gaussians from a whole PLY file in memory.
///
/// Values that are not finite are kept: the projection drops and counts such Gaussians. The projection also normalises
/// the quaternions. A file without this crate's comments gets a cube of 2¹⁰ voxels a side around the central 99 % of
/// its centres.
///
/// # Errors
/// As [`Ply::vertex_columns`]: an absent property, a truncated file, or more data than `limits` allow.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<(Gaussians, Notes)> {
    let ply = Ply::open(bytes)?;
    let has = |name: &str| ply.element("vertex").is_some_and(|vertex| vertex.has(name));
    let mode = render_mode(&ply.header);
    let compensated = mode.as_deref().is_some_and(|mode| MIP.contains(&mode));
    let rest = ply.element("vertex").map_or(0, |vertex| {
        let names = vertex.properties.iter().map(|p| &p.name);
        names.filter(|name| name.starts_with("f_rest_")).count()
    });
    let whole = [9, 24, 45].contains(&rest) && (0..rest).all(|i| has(&format!("f_rest_{i}")));
    let mut notes = Notes {
        ignored_mode: mode.filter(|_| !compensated),
        ignored_harmonics: if whole { 0 } else { rest },
        flat: !has("scale_2") && has("scale_1"),
        fitted: false,
    };
    let mut names = PROPERTIES.to_vec();
    if notes.flat {
        names.retain(|&name| name != "scale_2");
    }
    let mut columns = ply.vertex_columns(&names, limits)?;
    let count = columns[0].len();
    let memory = size_of::<[f32; 14]>() as u64 + size_of::<[f64; 3]>() as u64 + 4 * rest as u64;
    limits.check_bytes("bytes of the Gaussians", count as u64 * memory)?;

    let rotation = columns.split_off(columns.len() - 4);
    let scale = columns.split_off(7);
    let opacity = columns.split_off(6);
    let colour = columns.split_off(3);
    let centre = |i: usize| -> [f64; 3] { std::array::from_fn(|k| columns[k].get(i)) };

    let frame = named_frame(&ply.header).unwrap_or_else(|| {
        notes.fitted = true;
        fitted_frame((0..count).map(centre))
    });
    let unit = frame.unit();
    let deviation = |i: usize, k: usize| {
        let log = scale.get(k).map_or(f64::NEG_INFINITY, |column| column.get(i));
        let deviation = (log.exp() / unit) as f32;
        // A finite logarithm gives a finite deviation: clamp it to the range of `f32`.
        if log.is_finite() {
            deviation.min(f32::MAX)
        } else {
            deviation
        }
    };
    let harmonics = if whole {
        harmonics(&ply, rest / 3, limits)?
    } else {
        Harmonics::default()
    };
    let gaussians = Gaussians {
        blur: if notes.fitted { 0.0 } else { blur(&ply.header) },
        harmonics,
        compensated,
        position: (0..count)
            .into_par_iter()
            .map(|i| frame.placement.to_cube(frame.bits, centre(i)))
            .collect(),
        scale: (0..count)
            .into_par_iter()
            .map(|i| std::array::from_fn(|k| deviation(i, k)))
            .collect(),
        rotation: (0..count)
            .into_par_iter()
            .map(|i| std::array::from_fn(|k| rotation[k].get(i) as f32))
            .collect(),
        opacity: (0..count)
            .into_par_iter()
            .map(|i| (1.0 / (1.0 + (-opacity[0].get(i)).exp())) as f32)
            .collect(),
        colour: (0..count)
            .into_par_iter()
            .map(|i| std::array::from_fn(|k| (0.5 + HARMONIC * colour[k].get(i)) as f32))
            .collect(),
        frame,
    };
    Ok((gaussians, notes))
}

/// Reads the properties `f_rest_*`: `count` coefficients of red, then of green, then of blue.
fn harmonics(ply: &Ply, count: usize, limits: &Limits) -> Result<Harmonics> {
    let names: Vec<String> = (0..3 * count).map(|i| format!("f_rest_{i}")).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let columns = ply.vertex_columns(&names, limits)?;
    let columns: Vec<Vec<f32>> = columns.into_iter().map(Column::into_f32).collect();
    let mut coefficients = vec![[0.0; 3]; columns[0].len() * count];
    let blocks = coefficients.par_chunks_mut(BLOCK * count).enumerate();
    blocks.for_each(|(block, to)| {
        for k in 0..count {
            let of = |channel: usize| &columns[channel * count + k][block * BLOCK..];
            let each = of(0).iter().zip(of(1)).zip(of(2));
            for (to, ((&r, &g), &b)) in to[k..].iter_mut().step_by(count).zip(each) {
                *to = [r, g, b];
            }
        }
    });
    Ok(Harmonics { count, coefficients })
}

/// The render mode in the comments, if it is not the default.
fn render_mode(header: &Header) -> Option<String> {
    let modes = header.comments.iter();
    let mode = modes
        .filter_map(|c| c.strip_prefix("SplatRenderMode:"))
        .next_back()?
        .trim();
    (mode != "default").then(|| mode.to_owned())
}

/// The values of the last comment `b2p KEY …`.
fn words<'a>(header: &'a Header, key: &str) -> Option<std::str::SplitAsciiWhitespace<'a>> {
    let mut comments = header.comments.iter().rev();
    comments.find_map(|comment| {
        let mut words = comment.split_ascii_whitespace();
        (words.next() == Some("b2p") && words.next() == Some(key)).then_some(words)
    })
}

/// The blur in the comments, in cube-frame units squared, or 0.
fn blur(header: &Header) -> f32 {
    let blur = words(header, "blur").and_then(|mut words| words.next()?.parse().ok());
    blur.filter(|blur: &f32| blur.is_finite() && *blur > 0.0).unwrap_or(0.0)
}

/// The cube in the comments. Comments are free text: those that do not parse are ignored.
fn named_frame(header: &Header) -> Option<Frame> {
    let words = |key: &str| words(header, key);
    let mut origin = words("origin")?.map(|word| word.parse().ok());
    let frame = Frame {
        bits: words("bits")?.next()?.parse().ok()?,
        placement: Placement {
            origin: [origin.next()??, origin.next()??, origin.next()??],
            voxel_size: words("voxel_size")?.next()?.parse().ok()?,
        },
    };
    frame.is_valid().then_some(frame)
}

/// A cube around the central 99 % of the finite centres.
fn fitted_frame(centres: impl Iterator<Item = [f64; 3]>) -> Frame {
    let mut centres: Vec<[f64; 3]> = centres.filter(|c| c.iter().all(|x| x.is_finite())).collect();
    if centres.is_empty() {
        return Frame::default();
    }
    let outer = centres.len() / 200;
    let last = centres.len() - 1 - outer;
    let mut range = |axis: usize| {
        let order = |a: &[f64; 3], b: &[f64; 3]| a[axis].total_cmp(&b[axis]);
        let low = centres.select_nth_unstable_by(outer, order).1[axis];
        let high = centres.select_nth_unstable_by(last, order).1[axis];
        (low, high)
    };
    let ranges = [range(0), range(1), range(2)];
    let side = ranges.iter().fold(0.0, |side: f64, (low, high)| side.max(high - low));
    let cubes = f64::from(1u32 << FITTED_BITS);
    // All centres coincide, or their extent overflows.
    let side = if side > 0.0 && side.is_finite() { side } else { cubes };
    Frame {
        bits: FITTED_BITS,
        placement: Placement {
            origin: ranges.map(|(low, high)| 0.5 * low + 0.5 * high - 0.5 * side),
            voxel_size: side / cubes,
        },
    }
}

#[cfg(test)]
mod tests;
