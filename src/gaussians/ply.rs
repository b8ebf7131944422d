//! Gaussians as PLY files in the convention of splat viewers.
//!
//! Per Gaussian, as `float`: `x y z` in world units; `f_dc_0..2`, with colour = ½ + 0.2820948·f_dc; `opacity`, the
//! logit; `scale_0..2`, the natural logarithms of the standard deviations in world units; `rot_0..3`, the quaternion w,
//! x, y, z. Logits and logarithms must be finite: the writer clamps opacities to [10⁻⁶, 1 − 10⁻⁶] and deviations to at
//! least 10⁻³⁸. Comments hold the cube, so that the reader restores the frame. Positions are single precision, which
//! does not resolve the voxels of a cube far from the origin: [`Frame::offset`] is subtracted from them, and written as
//! a comment, too.
//!
//! View-dependent colour is `f_rest_*`. The comment `SplatRenderMode: mip` marks Gaussians that were trained for
//! rendering with opacity compensation.
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
        let header = self.ply_header(self.len())?;
        let io = |source| Error::Io {
            path: path.to_owned(),
            source,
        };
        to.write_all(header.as_bytes()).map_err(io)?;
        self.write_ply_rows(to, path)
    }

    /// The header of a PLY file of `count` Gaussians like these, of which these are some.
    ///
    /// # Errors
    /// [`Error::Usage`] if the frame is invalid.
    #[doc(hidden)]
    pub fn ply_header(&self, count: usize) -> Result<String> {
        if !self.frame.is_valid() {
            return Err(self.frame.not_valid());
        }
        let mut header = format!(
            "ply\nformat binary_little_endian 1.0\n{}element vertex {count}\n",
            comments(&self.frame, self.compensated, self.blur),
        );
        for name in PROPERTIES {
            header += &format!("property float {name}\n");
        }
        for i in 0..3 * self.harmonics.count {
            header += &format!("property float f_rest_{i}\n");
        }
        header += "end_header\n";
        Ok(header)
    }

    /// What follows the header: a row for each Gaussian.
    ///
    /// # Errors
    /// [`Error::Io`] if `to` fails; [`Error::Usage`] if the arrays differ in length.
    #[doc(hidden)]
    pub fn write_ply_rows<W: Write + ?Sized>(&self, to: &mut W, path: &Path) -> Result<()> {
        self.check_lengths()?;
        let io = |source| Error::Io {
            path: path.to_owned(),
            source,
        };
        let rest = self.harmonics.count;
        let offset = self.frame.offset();
        let mut bytes = Vec::with_capacity(BLOCK * (PROPERTIES.len() + 3 * rest) * size_of::<f32>());
        for first in (0..self.len()).step_by(BLOCK) {
            bytes.clear();
            for i in first..self.len().min(first + BLOCK) {
                bytes.extend(self.row(i, offset).into_iter().flat_map(f32::to_le_bytes));
                let coefficients = &self.harmonics.coefficients[i * rest..][..rest];
                for channel in 0..3 {
                    bytes.extend(coefficients.iter().flat_map(|c| c[channel].to_le_bytes()));
                }
            }
            to.write_all(&bytes).map_err(io)?;
        }
        Ok(())
    }

    /// The values of Gaussian `i` in the order of [`PROPERTIES`], its place less `offset`.
    fn row(&self, i: usize, offset: [f64; 3]) -> [f32; 14] {
        let unit = self.frame.unit();
        let world = self.frame.placement.from_cube(self.frame.bits, self.position[i]);
        let [x, y, z] = std::array::from_fn(|k| world[k] - offset[k]);
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

/// The comments that [`Comments`] reads, each a line of a header: render mode, cube, `blur` if there is any, and the
/// offset of the cube, which was subtracted from all coordinates.
pub fn comments(frame: &Frame, compensated: bool, blur: f32) -> String {
    let Frame { bits, placement } = *frame;
    let [x, y, z] = placement.origin;
    let mode = if compensated { MIP[0] } else { "default" };
    let mut lines = format!(
        "comment SplatRenderMode: {mode}\ncomment b2p bits {bits}\ncomment b2p origin {x} {y} {z}\n\
         comment b2p voxel_size {}\n",
        placement.voxel_size
    );
    if blur > 0.0 {
        lines += &format!("comment b2p blur {blur}\n");
    }
    let [x, y, z] = frame.offset();
    if [x, y, z] != [0.0; 3] {
        lines += &format!("comment b2p offset {x} {y} {z}\n");
    }
    lines
}

/// What the comments of a file's header say: see [`comments`].
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Comments {
    /// The cube.
    pub frame: Option<Frame>,
    /// The blur, or 0.
    pub blur: f32,
    /// What was subtracted from all coordinates.
    pub offset: [f64; 3],
    /// Trained for rendering with opacity compensation.
    pub compensated: bool,
    /// The render mode, if it is neither the default nor that.
    pub ignored_mode: Option<String>,
}

impl Comments {
    /// Reads a header. Comments are free text: those that do not parse are ignored, as are offsets beyond single precision.
    pub fn of(header: &Header) -> Self {
        let mode = render_mode(header);
        let compensated = mode.as_deref().is_some_and(|mode| MIP.contains(&mode));
        let frame = named_frame(header);
        let offset = words(header, "offset")
            .and_then(three)
            .filter(|o| o.iter().all(|x| (*x as f32).is_finite()));
        Comments {
            blur: if frame.is_some() { blur(header) } else { 0.0 },
            frame,
            offset: offset.unwrap_or_default(),
            compensated,
            ignored_mode: mode.filter(|_| !compensated),
        }
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
    let told = Comments::of(&ply.header);
    let rest = ply.element("vertex").map_or(0, |vertex| {
        let names = vertex.properties.iter().map(|p| &p.name);
        names.filter(|name| name.starts_with("f_rest_")).count()
    });
    let whole = [9, 24, 45].contains(&rest) && (0..rest).all(|i| has(&format!("f_rest_{i}")));
    let mut notes = Notes {
        ignored_mode: told.ignored_mode,
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
    let centre = |i: usize| -> [f64; 3] { std::array::from_fn(|k| columns[k].get(i) + told.offset[k]) };

    let frame = told.frame.unwrap_or_else(|| {
        notes.fitted = true;
        Frame::fitted((0..count).map(centre))
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
        blur: told.blur,
        harmonics,
        compensated: told.compensated,
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

/// The first three numbers.
fn three(words: std::str::SplitAsciiWhitespace) -> Option<[f64; 3]> {
    let mut numbers = words.map(|word| word.parse().ok());
    Some([numbers.next()??, numbers.next()??, numbers.next()??])
}

/// The blur in the comments, in cube-frame units squared, or 0.
fn blur(header: &Header) -> f32 {
    let blur = words(header, "blur").and_then(|mut words| words.next()?.parse().ok());
    blur.filter(|blur: &f32| blur.is_finite() && *blur > 0.0).unwrap_or(0.0)
}

/// The cube in the comments. Comments are free text: those that do not parse are ignored.
fn named_frame(header: &Header) -> Option<Frame> {
    let words = |key: &str| words(header, key);
    let frame = Frame {
        bits: words("bits")?.next()?.parse().ok()?,
        placement: Placement {
            origin: three(words("origin")?)?,
            voxel_size: words("voxel_size")?.next()?.parse().ok()?,
        },
    };
    frame.is_valid().then_some(frame)
}

#[cfg(test)]
mod tests;
