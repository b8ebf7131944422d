//! Cameras that keep an object in view.

use glam::{DAffine3, DMat3, DVec3};

use super::{Camera, Projection};
use crate::error::{Error, Result};
use crate::gaussians::Gaussians;

/// How much of half the picture's width and height an object may take.
const SHARE: f64 = 0.95;
/// Standard deviations of a Gaussian that count as part of the object.
const REACH: f64 = 1.5;

/// A box along the axes of the cube frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extent {
    /// The lowest corner.
    pub low: [f64; 3],
    /// The highest corner.
    pub high: [f64; 3],
}

impl Extent {
    /// The cube `[−1, 1]³`.
    pub const CUBE: Extent = Extent {
        low: [-1.0; 3],
        high: [1.0; 3],
    };

    /// The box around `spheres`, each a centre and a radius, as far as it lies in the cube; the cube if there are none. What is not
    /// finite does not count.
    pub fn of(spheres: impl Iterator<Item = ([f64; 3], f64)>) -> Extent {
        let mut extent = Extent {
            low: [f64::INFINITY; 3],
            high: [f64::NEG_INFINITY; 3],
        };
        for (centre, radius) in spheres {
            if !(radius.is_finite() && centre.iter().all(|x| x.is_finite())) {
                continue;
            }
            for axis in 0..3 {
                extent.low[axis] = extent.low[axis].min(centre[axis] - radius);
                extent.high[axis] = extent.high[axis].max(centre[axis] + radius);
            }
        }
        let inside = (0..3).all(|axis| extent.low[axis] < 1.0 && extent.high[axis] > -1.0);
        if !inside {
            return Extent::CUBE;
        }
        extent.low = extent.low.map(|x| x.max(-1.0));
        extent.high = extent.high.map(|x| x.min(1.0));
        extent
    }

    /// The box around Gaussians, as far as it lies in the cube.
    pub fn of_gaussians(gaussians: &Gaussians) -> Extent {
        let spheres = gaussians.position.iter().zip(&gaussians.scale);
        Extent::of(spheres.map(|(position, scale)| {
            let largest = scale.iter().fold(0.0f32, |largest, s| largest.max(s.abs()));
            (position.map(f64::from), REACH * f64::from(largest))
        }))
    }

    /// Its middle.
    pub fn middle(&self) -> [f64; 3] {
        std::array::from_fn(|axis| 0.5 * (self.low[axis] + self.high[axis]))
    }

    fn corners(&self) -> impl Iterator<Item = DVec3> + '_ {
        (0..8).map(|corner| {
            let side = |axis: usize| match corner >> axis & 1 {
                0 => self.low[axis],
                _ => self.high[axis],
            };
            DVec3::new(side(0), side(1), side(2))
        })
    }
}

impl Camera {
    /// As [`Camera::orbit`], around `target`, a point of the cube frame.
    ///
    /// # Errors
    /// [`Error::Usage`] if that is no camera: see [`Camera::check`].
    pub fn orbit_around(
        target: [f64; 3],
        azimuth: f64,
        elevation: f64,
        radius: f64,
        fov: f64,
        width: u32,
        height: u32,
    ) -> Result<Camera> {
        if !(fov > 0.0 && fov < 180.0) {
            return Err(Error::Usage(format!(
                "the field of view is {fov}°, it must lie between 0° and 180°"
            )));
        }
        let rotation = towards(azimuth, elevation);
        let focal = f64::from(width) / 2.0 / (fov.to_radians() / 2.0).tan();
        let translation = DVec3::new(0.0, 0.0, radius) - rotation * DVec3::from(target);
        let camera = Self::centred(
            DAffine3::from_mat3_translation(rotation, translation),
            focal,
            width,
            height,
        );
        camera.check()?;
        Ok(camera)
    }

    /// The least radius from which [`Camera::orbit_around`] `target` has the whole of `extent` in view; with parallel rays, the
    /// distance for [`Camera::orthographic`]. `self` has the view's direction, focal length and size, whatever its distance is.
    pub fn radius_for(&self, extent: &Extent, target: [f64; 3], projection: Projection) -> f64 {
        let half = [self.width, self.height].map(|side| SHARE * f64::from(side) / 2.0);
        let needed = |corner: DVec3| {
            let at = self.pose.matrix3 * (corner - DVec3::from(target));
            let across = (self.fx * at.x.abs() / half[0]).max(self.fy * at.y.abs() / half[1]);
            match projection {
                Projection::Pinhole => across.max(2.0 * self.near) - at.z,
                Projection::Orthographic => across,
            }
        };
        extent.corners().map(needed).fold(2.0 * self.near, f64::max)
    }
}

/// The rotation of a camera that looks from there to the middle, with +y up.
pub(super) fn towards(azimuth: f64, elevation: f64) -> DMat3 {
    let (sin_az, cos_az) = azimuth.to_radians().sin_cos();
    let (sin_el, cos_el) = elevation.to_radians().sin_cos();
    let outwards = DVec3::new(cos_el * sin_az, sin_el, cos_el * cos_az);
    let right = DVec3::new(cos_az, 0.0, -sin_az);
    let down = right.cross(outwards);
    DMat3::from_cols(right, down, -outwards).transpose()
}

#[cfg(test)]
mod tests {
    use super::*;

    const TALL: Extent = Extent {
        low: [-0.2, -1.0, -0.3],
        high: [0.4, 0.9, 0.1],
    };

    #[test]
    fn all_corners_are_in_view_and_one_is_near_the_border_whatever_the_picture_s_shape() {
        for (width, height) in [(640, 480), (300, 900), (1000, 40), (64, 64)] {
            for (azimuth, elevation) in [(0.0, 0.0), (35.0, 20.0), (180.0, -60.0), (77.0, 90.0)] {
                for target in [TALL.middle(), [0.0; 3], [0.5, 0.5, -0.5]] {
                    let at = |r| Camera::orbit_around(target, azimuth, elevation, r, 45.0, width, height).unwrap();
                    let radius = at(3.0).radius_for(&TALL, target, Projection::Pinhole);
                    let camera = at(radius);
                    let mut widest = 0.0f64;
                    for corner in TALL.corners() {
                        let t = camera.pose.transform_point3(corner);
                        assert!(t.z > camera.near);
                        let x = camera.fx * t.x / t.z / (f64::from(width) / 2.0);
                        let y = camera.fy * t.y / t.z / (f64::from(height) / 2.0);
                        widest = widest.max(x.abs()).max(y.abs());
                    }
                    assert!((widest - SHARE).abs() < 1e-6, "{width}×{height} {azimuth}: {widest}");
                }
            }
        }
    }

    #[test]
    fn parallel_rays_see_all_of_it_as_well() {
        let target = TALL.middle();
        let at = |r| Camera::orbit_around(target, 30.0, 10.0, r, 45.0, 200, 100).unwrap();
        let radius = at(3.0).radius_for(&TALL, target, Projection::Orthographic);
        let camera = at(radius).orthographic(radius).unwrap();
        for corner in TALL.corners() {
            let t = camera.pose.transform_point3(corner);
            assert!((camera.fx * t.x).abs() <= 100.0 && (camera.fy * t.y).abs() <= 50.0);
        }
    }

    #[test]
    fn an_orbit_around_the_origin_is_the_orbit() {
        let around = Camera::orbit_around([0.0; 3], 20.0, -30.0, 2.5, 45.0, 64, 48).unwrap();
        assert_eq!(around, Camera::orbit(20.0, -30.0, 2.5, 45.0, 64, 48).unwrap());
    }

    #[test]
    fn an_extent_is_around_what_is_finite_and_within_the_cube() {
        let spheres = [
            ([0.0, 0.5, -0.5], 0.25),
            ([f64::NAN, 0.0, 0.0], 0.1),
            ([0.2; 3], f64::INFINITY),
        ];
        let extent = Extent::of(spheres.into_iter());
        assert_eq!((extent.low, extent.high), ([-0.25, 0.25, -0.75], [0.25, 0.75, -0.25]));
        assert_eq!(Extent::of([([0.9, -7.0, 0.0], 8.0)].into_iter()), Extent::CUBE);
        assert_eq!(Extent::of(std::iter::empty()), Extent::CUBE);
        assert_eq!(Extent::of([([3.0; 3], 0.5)].into_iter()), Extent::CUBE);
    }
}
