//! Gaussians as a PLY file, the way splat viewers have them.
//!
//! Per Gaussian, as `float`: `x y z` in world units; `f_dc_0..2`, with colour = ½ + 0.2820948·f_dc; `opacity`, the logit; `scale_0..2`,
//! the natural logarithms of the standard deviations in world units; `rot_0..3`, the quaternion w, x, y, z. A logarithm has no zero
//! and a logit no end: opacities are written within [10⁻⁶, 1 − 10⁻⁶] and deviations of at least 10⁻³⁸. Comments hold the cube, so
//! that reading gives back the same frame. Positions are single precision: with an origin a million voxels away they keep a
//! sixteenth of a voxel.
//!
//! View-dependent colour (`f_rest_*`) is read, and not written: this crate's Gaussians have none. The comment `SplatRenderMode: mip`
//! says that they were made to be drawn with opacity compensation.
//!
//! Files of other programs are read as well: number types, byte order and the order of the properties are free.

use std::io::Write;
use std::path::Path;

use rayon::prelude::*;

use super::{Frame, Gaussians, Harmonics};
use crate::cloud::ply::{Column, Header, Ply};
use crate::error::{Error, Result};
use crate::limits::Limits;
use crate::placement::Placement;

/// The constant spherical harmonic: `1/(2√π)`.
const HARMONIC: f64 = 0.282_094_791_773_878_14;
/// The least opacity written; the greatest is 1 less this.
const OPACITY_MARGIN: f64 = 1e-6;
/// The least standard deviation written.
const LEAST_SCALE: f64 = f32::MIN_POSITIVE as f64;
/// The properties written.
const PROPERTIES: [&str; 14] = [
    "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2",
    "rot_3",
];
/// Render modes of Gaussians that were made to be drawn with opacity compensation.
const MIP: [&str; 2] = ["mip", "antialiased"];
/// Rows between two writes.
const BLOCK: usize = 1024;
/// Bit depth of a cube that is fitted to a file which names none.
const FITTED_BITS: u8 = 10;

/// What reading a file of another program had to leave out or make up.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Notes {
    /// Coefficients of view-dependent colour per Gaussian that were ignored (`f_rest_*`), because they are not all of a degree.
    pub ignored_harmonics: usize,
    /// A render mode other than `default` and `mip`, which was not followed.
    pub ignored_mode: Option<String>,
    /// There is no `scale_2`: the Gaussians are discs.
    pub flat: bool,
    /// The file names no cube: one was fitted to the centres.
    pub fitted: bool,
}

impl Notes {
    /// One sentence for each thing.
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
            lines.push("without scale_2 the Gaussians are taken as flat discs".into());
        }
        if self.fitted {
            lines.push("the file names no cube: one was fitted to the Gaussians' centres".into());
        }
        lines
    }
}

impl Gaussians {
    /// Writes a binary little-endian PLY, block by block. `path` is only for the error.
    ///
    /// # Errors
    /// [`Error::Io`] if `to` fails; [`Error::Usage`] if the arrays differ in length or the frame is none.
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

    /// The numbers of Gaussian `i` in the order of [`PROPERTIES`].
    fn row(&self, i: usize) -> [f32; 14] {
        let unit = self.frame.unit();
        let [x, y, z] = self.frame.placement.from_cube(self.frame.bits, self.position[i]);
        let [r, g, b] = self.colour[i].map(|c| (f64::from(c) - 0.5) / HARMONIC);
        let opacity = f64::from(self.opacity[i]).clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
        let opacity = (opacity / (1.0 - opacity)).ln();
        let [s0, s1, s2] = self.scale[i].map(|s| {
            let s = (f64::from(s) * unit).abs();
            // Not `max`, which would hide NaN.
            if s < LEAST_SCALE { LEAST_SCALE.ln() } else { s.ln() }
        });
        let [q0, q1, q2, q3] = self.rotation[i].map(f64::from);
        [x, y, z, r, g, b, opacity, s0, s1, s2, q0, q1, q2, q3].map(|x| x as f32)
    }

    /// [`read`], for callers that have no use for its notes.
    ///
    /// # Errors
    /// As [`read`].
    pub fn from_ply(bytes: &[u8], limits: &Limits) -> Result<Gaussians> {
        read(bytes, limits).map(|(gaussians, _)| gaussians)
    }
}

/// Reads Gaussians from a whole PLY file in memory.
///
/// Numbers that are not finite are kept: projection drops and counts such Gaussians. Quaternions are not normalised, projection
/// does. A file without this crate's comments is placed in a cube of 2¹⁰ voxels a side around the central 99 % of its centres.
///
/// # Errors
/// Those of [`Ply::vertex_columns`]: a property that is absent, a file that ends early, more than `limits` allow.
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
        // What a finite logarithm stands for is finite: beyond the range of `f32` it is the end of the range.
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

/// The coefficients `f_rest_*`, `count` for each of red, green and blue, in this order.
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

/// The render mode in the comments, if it isn't the default.
fn render_mode(header: &Header) -> Option<String> {
    let modes = header.comments.iter();
    let mode = modes
        .filter_map(|c| c.strip_prefix("SplatRenderMode:"))
        .next_back()?
        .trim();
    (mode != "default").then(|| mode.to_owned())
}

/// The last comment of this crate about `key`.
fn words<'a>(header: &'a Header, key: &str) -> Option<std::str::SplitAsciiWhitespace<'a>> {
    let mut comments = header.comments.iter().rev();
    comments.find_map(|comment| {
        let mut words = comment.split_ascii_whitespace();
        (words.next() == Some("b2p") && words.next() == Some(key)).then_some(words)
    })
}

/// The blur that the comments name, in the units of the cube that they name too; otherwise none.
fn blur(header: &Header) -> f32 {
    let blur = words(header, "blur").and_then(|mut words| words.next()?.parse().ok());
    blur.filter(|blur: &f32| blur.is_finite() && *blur > 0.0).unwrap_or(0.0)
}

/// The cube that the comments name. Comments are free text: what cannot be understood is none.
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

/// A cube around the central 99 % of the centres that are finite.
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
    // All in one place, or too far apart for a number.
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
