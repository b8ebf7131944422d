//! Clouds as instruments capture them: with holes, noise and uneven density. The truth stays the mesh.
//!
//! An object's longest side is taken to be one metre long where an instrument's noise is given in metres. Every
//! instrument takes photographs for the points' colours, each with its own exposure and white balance and through a
//! JPEG, so that colours have seams between views, blocks, and some of the backdrop at the object's edges. Equal seeds
//! give equal captures, for any number of threads.

mod cameras;
mod lidar;
mod photogrammetry;
mod station;
#[cfg(test)]
mod tests;

use std::path::Path;

use crate::error::{LabError, Result};
use crate::random::Random;
use crate::sample::write_bytes;
use crate::surface::Surface;

/// An instrument.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Kind {
    /// A laser scanner at five places: rings, range noise, fewer returns at grazing angles and far away
    Lidar,
    /// Eight depth cameras around the object, some of which fail: noise and steps of disparity that grow with the
    /// square of the distance, flying pixels at edges
    Depth,
    /// One depth camera in front: a single frame
    Frame,
    /// Points of dense stereo between 24 photographs: density by texture, bumps of low frequency, outliers
    Photogrammetry,
}

/// What to capture.
#[derive(Debug, Clone, Copy)]
pub struct Options {
    /// The instrument.
    pub kind: Kind,
    /// About how many points.
    pub points: u64,
    /// Everything random follows from it.
    pub seed: u64,
    /// Noise over that of the instrument. 0 leaves geometry exact; colours keep their seams.
    pub noise: f64,
}

/// Points in the mesh's space.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Capture {
    /// Positions.
    pub positions: Vec<[f64; 3]>,
    /// 8-bit sRGB.
    pub rgb: Vec<[u8; 3]>,
}

/// The object that instruments stand around.
struct Scene<'a> {
    surface: &'a Surface,
    centre: glam::DVec3,
    /// Units of the mesh's space per metre.
    metre: f64,
    options: Options,
}

/// Captures a surface.
///
/// # Errors
/// If the surface has no extent, or nothing of it is captured.
pub fn capture(surface: &Surface, options: &Options) -> Result<Capture> {
    let [low, high] = surface.bounds().map(glam::DVec3::from);
    let longest = (high - low).max_element();
    if !(longest > 0.0 && longest.is_finite()) {
        return Err(LabError::Usage("the mesh has no extent".into()));
    }
    let scene = Scene {
        surface,
        centre: (low + high) / 2.0,
        metre: longest,
        options: *options,
    };
    let mut random = Random::new(options.seed);
    let capture = match options.kind {
        Kind::Lidar => lidar::scan(&scene, &mut random),
        Kind::Depth => cameras::around(&scene, &mut random),
        Kind::Frame => cameras::single(&scene, &mut random),
        Kind::Photogrammetry => photogrammetry::reconstruct(&scene, &mut random),
    };
    if capture.positions.is_empty() {
        return Err(LabError::Usage("the instrument sees nothing of the mesh".into()));
    }
    Ok(capture)
}

impl Scene<'_> {
    /// A place around the object: azimuth and elevation in degrees, distance from the centre in metres.
    fn around(&self, azimuth: f64, elevation: f64, distance: f64) -> glam::DVec3 {
        let (sin_az, cos_az) = azimuth.to_radians().sin_cos();
        let (sin_el, cos_el) = elevation.to_radians().sin_cos();
        self.centre + distance * self.metre * glam::DVec3::new(cos_el * sin_az, sin_el, cos_el * cos_az)
    }
}

impl Capture {
    fn push(&mut self, place: glam::DVec3, colour: [f32; 3]) {
        self.positions.push(place.to_array());
        self.rgb.push(colour.map(|v| (v * 255.0).round() as u8));
    }

    fn append(&mut self, mut other: Capture) {
        self.positions.append(&mut other.positions);
        self.rgb.append(&mut other.rgb);
    }

    /// Writes binary little-endian PLY: float x y z, uchar red green blue.
    ///
    /// # Errors
    /// If the file cannot be written; nothing is left behind then.
    pub fn write_ply(&self, path: &Path) -> Result<()> {
        let mut bytes = format!(
            "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\n\
             property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
            self.positions.len()
        )
        .into_bytes();
        for (position, rgb) in self.positions.iter().zip(&self.rgb) {
            for &x in position {
                bytes.extend_from_slice(&(x as f32).to_le_bytes());
            }
            bytes.extend_from_slice(rgb);
        }
        write_bytes(path, &bytes)
    }
}
