//! Sequences against the posed meshes that they came from, seen by a camera that stands still.
//!
//! Squared errors are pooled over all frames, so that a frame without error does not make a mean infinite. The
//! foreground is where the mesh covers more than half of a pixel, the inside where it and all pixels within
//! [`BORDER`] are foreground. The temporal error is that of differences between consecutive pictures, over pixels that
//! are inside in both frames.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use b2p::gaussians::learned::HeadsModel;
use b2p::gaussians::{Frame, Gaussians, HeadSet};
use b2p::renderer::Renderer;
use b2p::renderer::camera::Camera;
use b2p::{Decoder, Limits, embedded};
use serde::Serialize;

use super::item::{self, Content, Item};
use super::metrics::Ssimulacra2;
use super::picture::Picture;
use super::points::Points;
use super::protocol::TrueView;
use super::reframe::into_frame;
use super::surfels::{Surfels, WIDE_BLUR};
use crate::error::{LabError, Result};
use crate::motion::{Motion, Sequence};

/// Pixels at the silhouette that do not count as inside.
pub const BORDER: usize = 3;
/// The standard deviation of surfels that clouds are drawn with, as a multiple of the points' spacing.
const WIDTH: f64 = 0.5;

/// A sequence to judge: one file for each frame.
#[derive(Debug)]
pub struct Coded {
    name: String,
    files: Vec<PathBuf>,
    bpp: Option<f64>,
    decoder: Decoder,
}

/// A frame of a coded sequence.
#[derive(Debug)]
pub struct CodedFrame {
    /// What is drawn.
    pub gaussians: Gaussians,
    /// Bytes of the frame's stream; None for clouds and Gaussians.
    pub bytes: Option<u64>,
}

impl Coded {
    /// Finds the files of `frames` frames: those that a pattern with `%d` or `%0Nd` names from 0 on, or those in a
    /// folder in the order of their names.
    ///
    /// # Errors
    /// If there are fewer files, or the heads cannot be loaded.
    pub fn open(item: &Item, frames: usize, heads: HeadSet, level: Option<u8>) -> Result<Self> {
        let mut files = files(&item.path, frames)?;
        if files.len() < frames {
            let (path, have) = (item.path.display(), files.len());
            return Err(LabError::Usage(format!("{path}: {have} files for {frames} frames")));
        }
        files.truncate(frames);
        let heads_model = HeadsModel::from_bytes(embedded::HEADS)?;
        Ok(Coded {
            name: item.name.clone(),
            files,
            bpp: item.bpp,
            decoder: Decoder::new()
                .with_heads_model(heads_model)
                .with_heads(heads)
                .with_level(level),
        })
    }

    /// The Gaussians of frame `index` in the cube of `frame`: decoded, read, or surfels of the cloud's points.
    ///
    /// # Errors
    /// If the file cannot be read or decoded.
    pub fn frame(&self, index: usize, frame: Frame) -> Result<CodedFrame> {
        let (gaussians, bytes) = match item::open(&self.files[index], &Limits::default())? {
            Content::Stream(bytes) => (self.decoder.decode(&bytes)?, Some(bytes.len() as u64)),
            Content::Gaussians(gaussians) => (gaussians, None),
            Content::Cloud(cloud) => {
                let points = Points::on_grid(&cloud, frame.bits, None);
                (Surfels::new(&points).to_gaussians(frame, WIDTH, WIDE_BLUR), None)
            }
        };
        let gaussians = into_frame(gaussians, frame);
        Ok(CodedFrame { gaussians, bytes })
    }
}

fn files(path: &Path, frames: usize) -> Result<Vec<PathBuf>> {
    if path.is_dir() {
        let mut files = Vec::new();
        for entry in std::fs::read_dir(path).map_err(LabError::io(path))? {
            let file = entry.map_err(LabError::io(path))?.path();
            let name = file.to_string_lossy();
            if [".b2p", ".ply", ".ply.zst"].iter().any(|end| name.ends_with(end)) {
                files.push(file);
            }
        }
        files.sort();
        return Ok(files);
    }
    let text = path.to_string_lossy();
    let broken = || {
        let what = "expected a folder or a pattern such as frame_%04d.b2p";
        LabError::Usage(format!("{}: {what}", path.display()))
    };
    let (before, rest) = text.split_once('%').ok_or_else(broken)?;
    let (digits, after) = rest.split_once('d').ok_or_else(broken)?;
    let width = match digits {
        "" => 0,
        _ => digits.parse::<usize>().ok().filter(|w| *w <= 20).ok_or_else(broken)?,
    };
    let name = |i: usize| PathBuf::from(format!("{before}{i:0width$}{after}"));
    Ok((0..frames).map(name).take_while(|file| file.exists()).collect())
}

/// Squared errors of 8-bit values.
#[derive(Debug, Clone, Copy, Default)]
struct Pool {
    sum: u64,
    count: u64,
}

impl Pool {
    fn add(&mut self, a: [i32; 3], b: [i32; 3]) {
        let squares = (0..3).map(|k| (i64::from(a[k]) - i64::from(b[k])).pow(2) as u64);
        self.sum += squares.sum::<u64>();
        self.count += 3;
    }

    fn mse(self) -> f64 {
        self.sum as f64 / self.count.max(1) as f64
    }

    /// In dB; infinite without error.
    fn psnr(self) -> f64 {
        10.0 * (255.0 * 255.0 / self.mse()).log10()
    }
}

/// What a sequence scored. Infinite values are null in JSON.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SequenceRow {
    /// The item.
    pub name: String,
    /// Bits per point of the clouds that `animate` wrote, if known.
    pub bpp: Option<f64>,
    /// PSNR in dB over whole pictures.
    pub psnr: f64,
    /// PSNR in dB over the foreground.
    pub foreground_psnr: f64,
    /// PSNR in dB inside the silhouette.
    pub inside_psnr: f64,
    /// PSNR in dB of frame-to-frame differences inside.
    pub temporal_psnr: f64,
    /// Mean squared error of frame-to-frame differences inside, of 8-bit values.
    pub temporal_mse: f64,
    /// Mean over the frames.
    pub ssimulacra2: f64,
    /// The worst frame's.
    pub worst_ssimulacra2: f64,
    /// Frame by frame: PSNR over whole pictures, SSIMULACRA2.
    pub frames: Vec<[f64; 2]>,
}

/// Everything that one run found out.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SequenceReport {
    /// The recipe of the truth.
    pub truth: String,
    /// Azimuth, elevation and distance of the camera.
    pub camera: [f64; 3],
    /// How many frames were judged.
    pub frames: usize,
    /// What was judged.
    pub rows: Vec<SequenceRow>,
}

/// The errors of one item so far.
#[derive(Default)]
struct Tally {
    whole: Pool,
    foreground: Pool,
    inside: Pool,
    temporal: Pool,
    bytes: Option<u64>,
    frames: Vec<[f64; 2]>,
    before: Option<Picture>,
}

/// The truth of a frame.
struct Truth {
    picture: Picture,
    foreground: Vec<bool>,
    inside: Vec<bool>,
    ssimulacra2: Ssimulacra2,
}

/// Draws and compares the first `frames` frames of all items.
///
/// # Errors
/// If a frame cannot be read, decoded or drawn, or the camera does not see the mesh.
pub fn judge(
    truth: &Sequence,
    motion: &Motion,
    frames: usize,
    camera: &Camera,
    items: Vec<Coded>,
) -> Result<Vec<SequenceRow>> {
    let grid = truth.grid();
    let frame = Frame {
        bits: grid.bits,
        placement: grid.placement(),
    };
    let mut tallies: Vec<Tally> = items.iter().map(|_| Tally::default()).collect();
    let mut before: Option<Truth> = None;
    for index in 0..frames {
        let in_cube = |p: [f32; 3]| frame.placement.to_cube(frame.bits, p.map(f64::from));
        let now = Truth::new(TrueView::from_camera(
            &truth.surface(motion, index).map(in_cube),
            *camera,
        )?)?;
        for (item, tally) in items.iter().zip(&mut tallies) {
            let coded = item.frame(index, frame)?;
            let picture = Picture::from(&Renderer::new().render(&coded.gaussians, camera)?.box_half());
            tally.add(picture, coded.bytes, &now, before.as_ref())?;
        }
        before = Some(now);
    }
    let points: u64 = truth.frames[..frames].iter().map(|f| f.voxels).sum();
    Ok(items.into_iter().zip(tallies).map(|(i, t)| t.row(i, points)).collect())
}

impl Truth {
    fn new(view: TrueView) -> Result<Self> {
        let TrueView {
            picture,
            foreground,
            ssimulacra2,
            ..
        } = view;
        if !foreground.contains(&true) {
            return Err(LabError::Usage("the camera does not see the mesh".into()));
        }
        let inside = eroded(&foreground, picture.width, BORDER);
        Ok(Truth {
            picture,
            foreground,
            inside,
            ssimulacra2,
        })
    }
}

/// The pixels of a mask of which all within a square of `2·by + 1` pixels are in the mask and on the picture.
fn eroded(mask: &[bool], width: usize, by: usize) -> Vec<bool> {
    let height = mask.len() / width.max(1);
    let keep = |at: &dyn Fn(usize) -> bool, i: usize, end: usize| i >= by && i + by < end && (i - by..=i + by).all(at);
    let pixels = || (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let rows: Vec<bool> = pixels()
        .map(|(x, y)| keep(&|k| mask[y * width + k], x, width))
        .collect();
    pixels()
        .map(|(x, y)| keep(&|k| rows[k * width + x], y, height))
        .collect()
}

impl Tally {
    fn add(&mut self, picture: Picture, bytes: Option<u64>, truth: &Truth, before: Option<&Truth>) -> Result<()> {
        let wide = |c: [u8; 3]| c.map(i32::from);
        let mut frame = Pool::default();
        for (i, (&a, &b)) in picture.rgb.iter().zip(&truth.picture.rgb).enumerate() {
            let (a, b) = (wide(a), wide(b));
            frame.add(a, b);
            if truth.foreground[i] {
                self.foreground.add(a, b);
            }
            if truth.inside[i] {
                self.inside.add(a, b);
            }
            if let (Some(own), Some(old)) = (&self.before, before)
                && truth.inside[i]
                && old.inside[i]
            {
                let difference = |now: [i32; 3], then: [u8; 3]| [0, 1, 2].map(|k| now[k] - i32::from(then[k]));
                self.temporal
                    .add(difference(a, own.rgb[i]), difference(b, old.picture.rgb[i]));
            }
        }
        self.whole.sum += frame.sum;
        self.whole.count += frame.count;
        let score = truth.ssimulacra2.score(&picture);
        let score = score.map_err(|e| LabError::Usage(format!("SSIMULACRA2 failed: {e}")))?;
        self.frames.push([frame.psnr(), score]);
        if let Some(bytes) = bytes {
            *self.bytes.get_or_insert(0) += bytes;
        }
        self.before = Some(picture);
        Ok(())
    }

    fn row(self, item: Coded, points: u64) -> SequenceRow {
        let scores = || self.frames.iter().map(|f| f[1]);
        let coded = self.bytes.map(|b| 8.0 * b as f64 / points.max(1) as f64);
        SequenceRow {
            name: item.name,
            bpp: item.bpp.or(coded),
            psnr: self.whole.psnr(),
            foreground_psnr: self.foreground.psnr(),
            inside_psnr: self.inside.psnr(),
            temporal_psnr: self.temporal.psnr(),
            temporal_mse: self.temporal.mse(),
            ssimulacra2: scores().sum::<f64>() / self.frames.len() as f64,
            worst_ssimulacra2: scores().fold(f64::INFINITY, f64::min),
            frames: self.frames,
        }
    }
}

impl SequenceReport {
    /// A table.
    pub fn to_markdown(&self) -> String {
        let mut text = String::from(
            "| item | bits/point | PSNR | foreground | inside | temporal, inside | SSIMULACRA2 | worst frame |\n\
             |---|---:|---:|---:|---:|---:|---:|---:|\n",
        );
        for row in &self.rows {
            let bpp = row.bpp.map_or("–".into(), |b| format!("{b:.4}"));
            let [whole, front, inside] = [row.psnr, row.foreground_psnr, row.inside_psnr];
            let (temporal, mean, worst) = (row.temporal_psnr, row.ssimulacra2, row.worst_ssimulacra2);
            let name = &row.name;
            let _ = writeln!(
                text,
                "| {name} | {bpp} | {whole:.2} | {front:.2} | {inside:.2} | {temporal:.2} | {mean:.2} | {worst:.2} |"
            );
        }
        text
    }

    /// All scores.
    ///
    /// # Errors
    /// If they cannot be JSON.
    pub fn to_json(&self) -> Result<String> {
        serde_json::to_string_pretty(self).map_err(|e| LabError::Usage(format!("the report cannot be JSON: {e}")))
    }
}

#[cfg(test)]
#[path = "sequence_tests.rs"]
mod tests;
