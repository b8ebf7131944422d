//! 3D Gaussians in memory.

mod harmonics;
mod head_map;
mod heads;
pub mod learned;
pub mod surfels;

pub use harmonics::Harmonics;
pub use head_map::HeadMap;
pub use heads::{HeadSet, Heads};

#[cfg(feature = "ply")]
pub mod ply;

use crate::error::{Error, Result};
use crate::placement::Placement;

/// Renderable Gaussians, one array per parameter, all of the same length.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Gaussians {
    /// Centres in the cube frame, in which the voxel cube is `[−1, 1]³`.
    pub position: Vec<[f32; 3]>,
    /// Standard deviations along the Gaussian's own axes, in cube-frame units (not logarithms).
    pub scale: Vec<[f32; 3]>,
    /// Unit quaternions w, x, y, z from the Gaussian's axes to the cube frame's.
    pub rotation: Vec<[f32; 4]>,
    /// Opacity at the centre, in `[0, 1]` (not a logit).
    pub opacity: Vec<f32>,
    /// Display-referred (sRGB) colour in `[0, 1]`.
    pub colour: Vec<[f32; 3]>,
    /// View-dependent colour. Decoded streams have none.
    pub harmonics: Harmonics,
    /// Whether the Gaussians were trained for rendering with opacity compensation (anti-aliasing).
    pub compensated: bool,
    /// Variance that the renderer adds to every Gaussian, in cube-frame units squared, or 0. A stream's Gaussians were
    /// trained with about this variance and leave gaps without it in close-ups. Where its projection is smaller than
    /// [`Gaussians::pixel_blur`], the renderer adds that instead.
    pub blur: f32,
    /// The cube's position and size in the world.
    pub frame: Frame,
}

/// Bit depth of the cube that is fitted to Gaussians without one.
const FITTED_BITS: u8 = 10;

/// The cube that the Gaussians' coordinates refer to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// Bit depth: the cube is `2^bits` finest voxels a side.
    pub bits: u8,
    /// Position and voxel size in the world.
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

    /// A cube of 2¹⁰ voxels a side around the central 99 % of the finite `centres`, in world units; the default one if
    /// they are so far that single precision cannot tell such a cube.
    pub fn fitted(centres: impl Iterator<Item = [f64; 3]>) -> Self {
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
        let cube = |side: f64| Frame {
            bits: FITTED_BITS,
            placement: Placement {
                origin: ranges.map(|(low, high)| 0.5 * low + 0.5 * high - 0.5 * side),
                voxel_size: side / cubes,
            },
        };
        // Voxels of a tiny cube are as small as single precision tells them.
        let fitted = cube(side.max(cubes * f64::from(f32::MIN_POSITIVE)));
        if side > 0.0 && fitted.is_valid() {
            return fitted;
        }
        // All centres coincide, or their extent overflows.
        let usual = cube(cubes);
        if usual.is_valid() { usual } else { Frame::default() }
    }

    /// What files in single precision subtract from world coordinates: zeros, or a round number per axis for a cube so
    /// far from the origin that single precision does not resolve 1/32 of its voxels.
    pub fn offset(&self) -> [f64; 3] {
        let side = 2.0 * self.unit();
        let farthest = |low: f64| low.abs().max((low + side).abs());
        let Placement { origin, voxel_size } = self.placement;
        let far = |low: f64| farthest(low) > 16.0 * side && farthest(low) * f64::from(f32::EPSILON) > voxel_size / 32.0;
        if !origin.iter().any(|&low| far(low)) {
            return [0.0; 3];
        }
        let digits = side.log10().floor();
        let power = 10f64.powf(digits.abs());
        origin.map(|low| match (far(low), digits < 0.0) {
            (false, _) => 0.0,
            (true, true) => ((low + side / 2.0) * power).round() / power,
            (true, false) => ((low + side / 2.0) / power).round() * power,
        })
    }

    /// Whether the frame has 1 to 21 bits and a valid placement, and its corners and voxels can be told in single
    /// precision, as files of Gaussians do.
    pub fn is_valid(&self) -> bool {
        let Placement { origin, voxel_size } = self.placement;
        let single = |x: f64| (x as f32).is_finite();
        (1..=21).contains(&self.bits)
            && self.placement.is_valid()
            && (voxel_size as f32).is_normal()
            && origin.iter().all(|x| single(*x) && single(x + 2.0 * self.unit()))
    }

    /// The error that it is not [valid](Frame::is_valid).
    #[doc(hidden)]
    pub fn not_valid(&self) -> Error {
        let Placement { origin, voxel_size } = self.placement;
        Error::Usage(format!(
            "a cube of {} bits with voxels of {voxel_size:e} from {origin:?} on cannot be told in single precision",
            self.bits
        ))
    }
}

impl Gaussians {
    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.position.len()
    }

    /// Minimum variance that the renderer adds to every projected Gaussian, in px²: 0.3, with which 3D Gaussian
    /// Splatting is trained, or 1/64 for Gaussians with a [`blur`](Gaussians::blur), which closes surfaces at any
    /// distance. More would enlarge silhouettes, and more so for objects that are small in the picture
    /// (`docs/rendering.md`, "Blur").
    #[doc(hidden)]
    pub fn pixel_blur(&self) -> f32 {
        if self.own_blur() > 0.0 { 1.0 / 64.0 } else { 0.3 }
    }

    /// [`Gaussians::blur`], or 0 if that is negative or not finite.
    pub(crate) fn own_blur(&self) -> f32 {
        if self.blur.is_finite() { self.blur.max(0.0) } else { 0.0 }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.position.is_empty()
    }

    /// Takes all Gaussians out; there is still room for as many.
    pub(crate) fn clear(&mut self) {
        self.position.clear();
        self.scale.clear();
        self.rotation.clear();
        self.opacity.clear();
        self.colour.clear();
    }

    /// Adds the variance of this standard deviation, in cube-frame units, to the least one of each.
    pub(crate) fn thicken(&mut self, by: f32) {
        if by == 0.0 {
            return;
        }
        for scale in &mut self.scale {
            let [a, b, c] = *scale;
            let least = if a <= b && a <= c { 0 } else { 2 - usize::from(b <= c) };
            scale[least] = (scale[least] * scale[least] + by * by).sqrt();
        }
    }

    /// Appends other Gaussians of the same frame, without harmonics.
    pub(crate) fn append(&mut self, mut other: Gaussians) {
        self.position.append(&mut other.position);
        self.scale.append(&mut other.scale);
        self.rotation.append(&mut other.rotation);
        self.opacity.append(&mut other.opacity);
        self.colour.append(&mut other.colour);
    }

    /// Checks that all arrays have the same length.
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
