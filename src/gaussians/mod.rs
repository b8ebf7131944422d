//! 3D Gaussians in memory.

mod harmonics;
mod heads;
pub mod learned;
pub mod surfels;

pub use harmonics::Harmonics;
pub use heads::{HeadSet, Heads};

#[cfg(feature = "ply")]
pub mod ply;

use crate::error::{Error, Result};
use crate::placement::Placement;

/// Renderable Gaussians, one array per parameter, all of the same length.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Gaussians {
    /// Centres in the cube frame: the voxel cube is `[−1, 1]³`.
    pub position: Vec<[f32; 3]>,
    /// Standard deviations along the Gaussian's own axes, in cube-frame units, linear (no logarithm).
    pub scale: Vec<[f32; 3]>,
    /// Unit quaternions w, x, y, z from the Gaussian's axes to the cube frame's.
    pub rotation: Vec<[f32; 4]>,
    /// Opacity at the centre, linear, in `[0, 1]`.
    pub opacity: Vec<f32>,
    /// Display-referred (sRGB) colour in `[0, 1]`.
    pub colour: Vec<[f32; 3]>,
    /// View-dependent colour; a stream's Gaussians have none.
    pub harmonics: Harmonics,
    /// Whether they were made to be drawn with opacity compensation (anti-aliasing).
    pub compensated: bool,
    /// Pictures widen every Gaussian by this variance, in cube-frame units squared: a stream's Gaussians were trained with about so much, and
    /// leave gaps without it when seen from close up. Zero for none; then, and wherever it comes to less, the pixel's blur takes its place
    /// ([`Gaussians::pixel_blur`]).
    pub blur: f32,
    /// Where the cube lies in the world.
    pub frame: Frame,
}

/// The cube that the Gaussians' coordinates refer to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// Bit depth: the cube is `2^bits` finest voxels a side.
    pub bits: u8,
    /// Its place in the world.
    pub placement: Placement,
}

impl Default for Frame {
    fn default() -> Self {
        Frame {
            bits: 10,
            placement: Placement::VOXEL_GRID,
        }
    }
}

impl Frame {
    /// One cube-frame unit, half the cube's side, in world units. The frame must be valid.
    pub fn unit(&self) -> f64 {
        f64::from(1u32 << (self.bits - 1)) * self.placement.voxel_size
    }

    /// Whether it is a cube: 1 to 21 bits, and a valid placement.
    pub fn is_valid(&self) -> bool {
        (1..=21).contains(&self.bits) && self.placement.is_valid()
    }
}

impl Gaussians {
    /// How many Gaussians.
    pub fn len(&self) -> usize {
        self.position.len()
    }

    /// The variance, in px², that pictures widen every Gaussian by at least: 0.3, which 3D Gaussian Splatting trains with, or next to
    /// nothing where they have a blur of their own. That keeps surfaces closed whatever the distance; by 0.3 more, silhouettes would
    /// grow the more, the smaller an object is seen.
    pub fn pixel_blur(&self) -> f32 {
        if self.own_blur() > 0.0 { 1.0 / 16.0 } else { 0.3 }
    }

    /// [`Gaussians::blur`], where it is a variance; otherwise none.
    pub(crate) fn own_blur(&self) -> f32 {
        if self.blur.is_finite() { self.blur.max(0.0) } else { 0.0 }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.position.is_empty()
    }

    /// Whether every Gaussian has all its parameters.
    ///
    /// # Errors
    /// [`Error::Usage`] if the arrays differ in length.
    pub fn check_lengths(&self) -> Result<()> {
        let others = [
            self.scale.len(),
            self.rotation.len(),
            self.opacity.len(),
            self.colour.len(),
        ];
        if others == [self.len(); 4] {
            let Harmonics { count, coefficients } = &self.harmonics;
            if coefficients.len() == self.len() * count && [0, 3, 8, 15].contains(count) {
                return Ok(());
            }
            return Err(Error::Usage(format!(
                "{} positions, but {} coefficients of view-dependent colour, {count} each",
                self.len(),
                coefficients.len()
            )));
        }
        Err(Error::Usage(format!(
            "{} positions, but {others:?} scales, rotations, opacities and colours",
            self.len()
        )))
    }
}
