//! Pinhole cameras in the cube frame.

pub mod files;
mod framing;

use std::ops::Range;

use glam::{DAffine3, DMat3, DVec3};

use b2p_kernels::splat::{Bounds, TILE};

use crate::axes::Up;
use crate::error::{Error, Result};

pub use framing::Extent;

/// How far `R·Rᵀ` of a pose may be from the identity, so that a rotation printed with four decimals still is one.
const ROTATION_TOLERANCE: f64 = 1e-3;

/// A pinhole camera. Camera axes: x right, y down, z forward. Pixel `i` covers `[i, i + 1]`, its centre is `i + ½`.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct Camera {
    /// From the cube frame to the camera: a rotation and a translation.
    #[doc(hidden)]
    pub pose: DAffine3,
    /// Focal length along x, in pixels.
    pub fx: f64,
    /// Focal length along y, in pixels.
    pub fy: f64,
    /// Principal point, x, in pixels; it may lie outside the picture.
    pub cx: f64,
    /// Principal point, y, in pixels.
    pub cy: f64,
    /// Width of the picture in pixels.
    pub width: u32,
    /// Height of the picture in pixels.
    pub height: u32,
    /// What is not farther than this along z is not drawn. Cube-frame units.
    pub near: f64,
    /// How rays go.
    pub projection: Projection,
    /// The part of the picture that is drawn, if not all of it: see [`Camera::with_crop`].
    #[doc(hidden)]
    pub crop: Option<Bounds>,
}

/// How a camera's rays go.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Projection {
    /// Through one point.
    #[default]
    Pinhole,
    /// Side by side along z; the focal lengths are pixels per cube-frame unit.
    Orthographic,
}

impl Camera {
    /// The near plane of [`Camera::orbit`]: five finest voxels of a 10-bit cloud.
    pub const NEAR: f64 = 0.01;
    /// The longest side of a picture: up to here a pixel's centre is exactly an `f32`.
    pub const MAX_SIDE: u32 = 1 << 22;

    /// A camera on a sphere around the cube's centre, looking at it, with +y up.
    ///
    /// `azimuth` and `elevation` in degrees: the eye is at `radius·(cos el·sin az, sin el, cos el·cos az)`. `fov` is
    /// the horizontal field of view in degrees; pixels are square and the principal point is the middle. At the poles,
    /// up is the limit of up.
    ///
    /// # Errors
    /// [`Error::Usage`] if that is no camera: see [`Camera::check`].
    pub fn orbit(azimuth: f64, elevation: f64, radius: f64, fov: f64, width: u32, height: u32) -> Result<Camera> {
        Self::orbit_around([0.0; 3], azimuth, elevation, radius, fov, width, height)
    }

    /// A pinhole camera of square pixels with its principal point in the middle, and `focal` in pixels. `rotation`
    /// (three rows) and `translation` take points of the cube frame to camera axes: x right, y down, z forward.
    ///
    /// # Errors
    /// [`Error::Usage`] if that is no camera: see [`Camera::check`].
    pub fn new(rotation: [[f64; 3]; 3], translation: [f64; 3], focal: f64, width: u32, height: u32) -> Result<Camera> {
        let rotation = DMat3::from_cols_array_2d(&rotation).transpose();
        let pose = DAffine3::from_mat3_translation(rotation, translation.into());
        let camera = Self::centred(pose, focal, width, height);
        camera.check()?;
        Ok(camera)
    }

    /// A pinhole camera of square pixels with its principal point in the middle; unchecked.
    #[doc(hidden)]
    pub fn centred(pose: DAffine3, focal: f64, width: u32, height: u32) -> Camera {
        Camera {
            pose,
            fx: focal,
            fy: focal,
            cx: f64::from(width) / 2.0,
            cy: f64::from(height) / 2.0,
            width,
            height,
            near: Self::NEAR,
            projection: Projection::Pinhole,
            crop: None,
        }
    }

    /// The orthographic camera that shows what is `distance` away as large as this pinhole does.
    ///
    /// # Errors
    /// [`Error::Usage`] if that is no camera.
    pub fn orthographic(mut self, distance: f64) -> Result<Camera> {
        self.projection = Projection::Orthographic;
        self.fx /= distance;
        self.fy /= distance;
        self.check()?;
        Ok(self)
    }

    /// The camera of [`Camera::orbit_around`] `target` with another axis up: the world is turned about the target so
    /// that `up` becomes +y.
    pub fn with_up(mut self, up: Up, target: [f64; 3]) -> Camera {
        let target = DVec3::from(target);
        let before = self.pose.matrix3 * target;
        self.pose.matrix3 *= DMat3::from_cols_array_2d(&up.to_y()).transpose();
        self.pose.translation += before - self.pose.matrix3 * target;
        self
    }

    /// The camera that draws only these columns and rows of this one's picture: the pixels are equal to the bit.
    ///
    /// # Errors
    /// [`Error::Usage`] if that is empty or reaches out of the picture.
    pub fn with_crop(self, columns: Range<u32>, rows: Range<u32>) -> Result<Camera> {
        self.crop(Bounds {
            x0: columns.start,
            y0: rows.start,
            x1: columns.end,
            y1: rows.end,
        })
    }

    /// The camera that draws only the pixels `x0 ≤ x < x1`, `y0 ≤ y < y1` of this one's picture: to the bit what the
    /// whole shows there.
    ///
    /// # Errors
    /// [`Error::Usage`] if that is empty or reaches out of the picture.
    #[doc(hidden)]
    pub fn crop(mut self, part: Bounds) -> Result<Camera> {
        self.crop = Some(part);
        self.check()?;
        Ok(self)
    }

    /// The camera whose picture is the same, `times` larger.
    pub fn magnified(mut self, times: u32) -> Camera {
        let factor = f64::from(times);
        for length in [&mut self.fx, &mut self.fy, &mut self.cx, &mut self.cy] {
            *length *= factor;
        }
        self.width *= times;
        self.height *= times;
        if let Some(Bounds { x0, y0, x1, y1 }) = &mut self.crop {
            for at in [x0, y0, x1, y1] {
                *at *= times;
            }
        }
        self
    }

    /// The most pixels that a cube-frame unit takes in the picture, where the cube of the Gaussians comes nearest.
    pub fn pixels_per_unit(&self) -> f64 {
        let along = self.pose.matrix3.row(2).abs();
        let nearest = self.pose.translation.z - along.element_sum();
        let focal = self.fx.max(self.fy);
        match self.projection {
            Projection::Pinhole => focal / nearest.max(self.near),
            Projection::Orthographic => focal,
        }
    }

    /// The pixels that are drawn.
    #[doc(hidden)]
    pub fn window(&self) -> Bounds {
        self.crop.unwrap_or(Bounds {
            x0: 0,
            y0: 0,
            x1: self.width,
            y1: self.height,
        })
    }

    /// Width and height of what is drawn.
    pub fn size(&self) -> [u32; 2] {
        let Bounds { x0, y0, x1, y1 } = self.window();
        [x1 - x0, y1 - y0]
    }

    /// The window, widened to the edges of tiles as far as there is a picture: what is drawn in a pixel may depend on
    /// which splats reach its neighbours, but never on where the picture is cut.
    pub(crate) fn tiled_window(&self) -> Bounds {
        let Bounds { x0, y0, x1, y1 } = self.window();
        Bounds {
            x0: x0 - x0 % TILE,
            y0: y0 - y0 % TILE,
            x1: x1.next_multiple_of(TILE).min(self.width),
            y1: y1.next_multiple_of(TILE).min(self.height),
        }
    }

    /// Whether pictures can be taken with it.
    ///
    /// # Errors
    /// [`Error::Usage`] if a number is not finite, the pose scales, shears or mirrors, a focal length or the near plane
    /// is not positive, a side of the picture is 0 or over [`Camera::MAX_SIDE`], or the crop is not a part of it.
    pub fn check(&self) -> Result<()> {
        let complaint = |what: String| Err(Error::Usage(format!("camera: {what}")));
        let rotation = self.pose.matrix3;
        let error = rotation * rotation.transpose() - DMat3::IDENTITY;
        let largest = error.to_cols_array().iter().fold(0.0, |m: f64, x| m.max(x.abs()));
        if !self.pose.is_finite() {
            return complaint("the pose holds a number that is not finite".into());
        }
        if !(largest <= ROTATION_TOLERANCE && rotation.determinant() > 0.0) {
            return complaint("the pose is not a rotation and a translation: it scales, shears or mirrors".into());
        }
        for (name, length) in [("fx", self.fx), ("fy", self.fy), ("near", self.near)] {
            if !(length >= f64::from(f32::MIN_POSITIVE) && length <= f64::from(f32::MAX)) {
                return complaint(format!("{name} is {length}, it must be positive and finite"));
            }
        }
        for (name, centre) in [("cx", self.cx), ("cy", self.cy)] {
            if !(-f64::from(f32::MAX)..=f64::from(f32::MAX)).contains(&centre) {
                return complaint(format!("{name} is {centre}, it must be finite"));
            }
        }
        let sides = 1..=Self::MAX_SIDE;
        if !(sides.contains(&self.width) && sides.contains(&self.height)) {
            return complaint(format!(
                "the picture is {}×{}, each side must be of 1 to {} pixels",
                self.width,
                self.height,
                Self::MAX_SIDE
            ));
        }
        let Bounds { x0, y0, x1, y1 } = self.window();
        if !(x0 < x1 && x1 <= self.width && y0 < y1 && y1 <= self.height) {
            return complaint(format!(
                "the crop from {x0}, {y0} to {x1}, {y1} is not a part of a picture of {}×{}",
                self.width, self.height
            ));
        }
        Ok(())
    }

    /// The range of `x/z` and of `y/z` outside which the projection is linearised at the range's end: the field of
    /// view, and 15 % of its width more at either side. Far outside the picture the linearisation would otherwise
    /// stretch splats into streaks.
    ///
    /// The ends follow the principal point, so an off-centre one is handled.
    pub(crate) fn slope_ranges(&self) -> [[f64; 2]; 2] {
        let range = |size: u32, focal: f64, centre: f64| {
            let size = f64::from(size);
            let margin = 0.15 * size;
            [(-centre - margin) / focal, (size - centre + margin) / focal]
        };
        [
            range(self.width, self.fx, self.cx),
            range(self.height, self.fy, self.cy),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        Camera::orbit(0.0, 0.0, 3.0, 45.0, 64, 48).unwrap()
    }

    fn pixel(camera: &Camera, p: [f64; 3]) -> [f64; 2] {
        let t = camera.pose.transform_point3(p.into());
        [camera.fx * t.x / t.z + camera.cx, camera.fy * t.y / t.z + camera.cy]
    }

    #[test]
    fn an_orbit_looks_at_the_centre_with_y_up_and_x_to_the_right_of_the_front() {
        for (azimuth, elevation) in [(0.0, 0.0), (30.0, 0.0), (200.0, 40.0), (0.0, -90.0)] {
            let camera = Camera::orbit(azimuth, elevation, 3.0, 45.0, 64, 48).unwrap();
            let [x, y] = pixel(&camera, [0.0; 3]);
            assert!((x - 32.0).abs() < 1e-9 && (y - 24.0).abs() < 1e-9);
        }
        let front = camera();
        assert!(pixel(&front, [0.0, 0.5, 0.0])[1] < 24.0);
        assert!(pixel(&front, [0.5, 0.0, 0.0])[0] > 32.0);
        let from_plus_x = Camera::orbit(90.0, 0.0, 3.0, 45.0, 64, 48).unwrap();
        assert!(pixel(&from_plus_x, [0.0, 0.0, 0.5])[0] < 32.0);
        let from_above = Camera::orbit(0.0, 90.0, 3.0, 45.0, 64, 48).unwrap();
        assert!(pixel(&from_above, [0.0, 0.0, -0.5])[1] < 24.0);
    }

    #[test]
    fn with_another_axis_up_that_axis_is_up_in_the_picture() {
        for (up, at) in [
            (Up::X, [0.5, 0.0, 0.0]),
            (Up::MinusX, [-0.5, 0.0, 0.0]),
            (Up::MinusY, [0.0, -0.5, 0.0]),
            (Up::Z, [0.0, 0.0, 0.5]),
            (Up::MinusZ, [0.0, 0.0, -0.5]),
        ] {
            let turned = camera().with_up(up, [0.0; 3]);
            let [x, y] = pixel(&turned, at);
            assert!((x - 32.0).abs() < 1e-9 && y < 24.0, "{up}");
            turned.check().unwrap();
        }
        assert_eq!(camera().with_up(Up::Y, [0.1, 0.2, 0.3]), camera());
    }

    #[test]
    fn the_horizontal_field_of_view_spans_the_width() {
        let camera = camera();
        let edge = 3.0 * (22.5f64).to_radians().tan();
        assert!((pixel(&camera, [edge, 0.0, 0.0])[0] - 64.0).abs() < 1e-9);
    }

    #[test]
    fn what_is_no_camera_is_refused() {
        let broken: [fn(&mut Camera); 12] = [
            |c| c.pose.translation.x = f64::NAN,
            |c| c.pose.matrix3.x_axis.y = f64::INFINITY,
            |c| c.pose.matrix3 *= 2.0,
            |c| c.pose.matrix3 = DMat3::ZERO,
            |c| c.pose.matrix3.x_axis *= -1.0,
            |c| c.fx = 0.0,
            |c| c.fy = f64::NAN,
            |c| c.cx = f64::INFINITY,
            |c| c.near = -1.0,
            |c| c.width = 0,
            |c| c.height = 0,
            |c| c.height = Camera::MAX_SIDE + 1,
        ];
        for (i, spoil) in broken.iter().enumerate() {
            let mut camera = camera();
            spoil(&mut camera);
            assert!(matches!(camera.check(), Err(Error::Usage(_))), "case {i}");
        }
        for fov in [0.0, 180.0, f64::NAN] {
            assert!(Camera::orbit(0.0, 0.0, 3.0, fov, 8, 8).is_err());
        }
        assert!(Camera::orbit(f64::NAN, 0.0, 3.0, 45.0, 8, 8).is_err());
    }

    #[test]
    fn the_range_of_slopes_follows_an_off_centre_principal_point() {
        let mut camera = camera();
        let [low, high] = camera.slope_ranges()[0];
        let half = 32.0 / camera.fx;
        assert!((low + 1.3 * half).abs() < 1e-12 && (high - 1.3 * half).abs() < 1e-12);
        camera.cx = -40.0;
        let [low, high] = camera.slope_ranges()[0];
        assert!(low < 40.0 / camera.fx && high > 104.0 / camera.fx);
    }
}
