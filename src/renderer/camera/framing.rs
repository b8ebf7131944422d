//! Cameras that keep an object in view.

use glam::{DAffine3, DMat3, DVec3};
use rayon::prelude::*;

use super::{Camera, Projection};
use crate::error::{Error, Result};
use crate::gaussians::Gaussians;

/// How much of half the picture's width and height an object may take.
const SHARE: f64 = 0.95;
/// Standard deviations of a Gaussian that count as part of the object.
const REACH: f64 = 1.5;

/// Directions in which an object's outermost points are looked for, beside the axes: so many, spread evenly, miss less
/// than 3 % of the radius of a ball.
const DIRECTIONS: usize = 64;
/// Points that are looked at in these directions; along the axes all are.
const LOOKED_AT: usize = 1 << 15;

/// The part of the cube that an object takes, by its outermost points.
#[derive(Debug, Clone, PartialEq)]
pub struct Extent {
    points: Vec<DVec3>,
}

impl Extent {
    /// The cube `[−1, 1]³`.
    pub fn cube() -> Extent {
        let corner = |i: u32| DVec3::from([0, 1, 2].map(|axis| if i >> axis & 1 == 1 { 1.0 } else { -1.0 }));
        Extent {
            points: (0..8).map(corner).collect(),
        }
    }

    /// The part that `spheres` take, each a centre and a radius, as far as it lies in the cube; the cube if there are
    /// none. What is not finite does not count.
    pub fn of(spheres: impl Iterator<Item = ([f64; 3], f64)> + Clone) -> Extent {
        let spheres = spheres
            .map(|(centre, radius)| (DVec3::from(centre), radius))
            .filter(|(centre, radius)| centre.is_finite() && radius.is_finite() && centre.abs().max_element() <= 1.0);
        let mut count = 0usize;
        let mut on_axes = DVec3::AXES.map(|axis| [Outermost::along(axis), Outermost::along(-axis)]);
        for sphere in spheres.clone() {
            count += 1;
            on_axes.as_flattened_mut().iter_mut().for_each(|most| most.add(sphere));
        }
        let some: Vec<_> = spheres.step_by(count.div_ceil(LOOKED_AT).max(1)).collect();
        let around = (0..DIRECTIONS).into_par_iter().map(|i| {
            let mut most = Outermost::along(spread(i, DIRECTIONS));
            some.iter().for_each(|sphere| most.add(*sphere));
            most.point
        });
        let around: Vec<_> = around.collect();
        let points = on_axes
            .as_flattened()
            .iter()
            .map(|most| most.point)
            .chain(around)
            .flatten();
        let points: Vec<DVec3> = points.map(|point| point.clamp(DVec3::NEG_ONE, DVec3::ONE)).collect();
        match points.is_empty() {
            true => Extent::cube(),
            false => Extent { points },
        }
    }

    /// The part that Gaussians take, as far as it lies in the cube.
    pub fn of_gaussians(gaussians: &Gaussians) -> Extent {
        let spheres = gaussians.position.iter().zip(&gaussians.scale);
        Extent::of(spheres.map(|(position, scale)| {
            let largest = scale.iter().fold(0.0f32, |largest, s| largest.max(s.abs()));
            (position.map(f64::from), REACH * f64::from(largest))
        }))
    }

    /// The middle of the box around it.
    pub fn middle(&self) -> [f64; 3] {
        let [low, high] = self.corners().map(DVec3::from);
        (0.5 * (low + high)).to_array()
    }

    /// The lowest and the highest corner of the box around it.
    pub fn corners(&self) -> [[f64; 3]; 2] {
        let points = || self.points.iter().copied();
        let low = points().reduce(DVec3::min).unwrap_or_default();
        let high = points().reduce(DVec3::max).unwrap_or_default();
        [low.to_array(), high.to_array()]
    }
}

/// The outermost point of spheres in a direction.
struct Outermost {
    direction: DVec3,
    point: Option<DVec3>,
}

impl Outermost {
    fn along(direction: DVec3) -> Self {
        Outermost { direction, point: None }
    }

    fn add(&mut self, (centre, radius): (DVec3, f64)) {
        let point = centre + self.direction * radius;
        let is_further = |other: DVec3| point.dot(self.direction) > other.dot(self.direction);
        if self.point.is_none_or(is_further) {
            self.point = Some(point);
        }
    }
}

/// Direction `i` of `count` that are spread evenly.
fn spread(i: usize, count: usize) -> DVec3 {
    let z = 1.0 - (2.0 * i as f64 + 1.0) / count as f64;
    let (sin, cos) = (i as f64 * std::f64::consts::PI * (3.0 - 5f64.sqrt())).sin_cos();
    let across = (1.0 - z * z).max(0.0).sqrt();
    DVec3::new(across * cos, across * sin, z)
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

    /// The least radius from which [`Camera::orbit_around`] `target` has the whole of `extent` in view; with parallel
    /// rays, the distance for [`Camera::orthographic`]. `self` has the view's direction, focal length and size,
    /// whatever its distance is.
    pub fn radius_for(&self, extent: &Extent, target: [f64; 3], projection: Projection) -> f64 {
        let half = [self.width, self.height].map(|side| SHARE * f64::from(side) / 2.0);
        let needed = |point: DVec3| {
            let at = self.pose.matrix3 * (point - DVec3::from(target));
            let across = (self.fx * at.x.abs() / half[0]).max(self.fy * at.y.abs() / half[1]);
            match projection {
                Projection::Pinhole => across.max(2.0 * self.near) - at.z,
                Projection::Orthographic => across,
            }
        };
        let points = extent.points.iter().copied();
        points.map(needed).fold(2.0 * self.near, f64::max)
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

    const LOW: [f64; 3] = [-0.2, -1.0, -0.3];
    const HIGH: [f64; 3] = [0.4, 0.9, 0.1];

    fn corners() -> impl Iterator<Item = [f64; 3]> + Clone {
        (0..8).map(|i| [0, 1, 2].map(|axis: usize| if i >> axis & 1 == 0 { LOW[axis] } else { HIGH[axis] }))
    }

    fn tall() -> Extent {
        Extent::of(corners().map(|corner| (corner, 0.0)))
    }

    #[test]
    fn all_corners_are_in_view_and_one_is_near_the_border_whatever_the_picture_s_shape() {
        let tall = tall();
        for (width, height) in [(640, 480), (300, 900), (1000, 40), (64, 64)] {
            for (azimuth, elevation) in [(0.0, 0.0), (35.0, 20.0), (180.0, -60.0), (77.0, 90.0)] {
                for target in [tall.middle(), [0.0; 3], [0.5, 0.5, -0.5]] {
                    let at = |r| Camera::orbit_around(target, azimuth, elevation, r, 45.0, width, height).unwrap();
                    let radius = at(3.0).radius_for(&tall, target, Projection::Pinhole);
                    let camera = at(radius);
                    let mut widest = 0.0f64;
                    for corner in corners() {
                        let t = camera.pose.transform_point3(corner.into());
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
        let tall = tall();
        let target = tall.middle();
        let at = |r| Camera::orbit_around(target, 30.0, 10.0, r, 45.0, 200, 100).unwrap();
        let radius = at(3.0).radius_for(&tall, target, Projection::Orthographic);
        let camera = at(radius).orthographic(radius).unwrap();
        for corner in corners() {
            let t = camera.pose.transform_point3(corner.into());
            assert!((camera.fx * t.x).abs() <= 100.0 && (camera.fy * t.y).abs() <= 50.0);
        }
    }

    #[test]
    fn a_ball_is_seen_whole_from_everywhere_and_fills_the_picture() {
        let ball = Extent::of([([0.0, 0.1, 0.2], 0.5)].into_iter());
        let target = [0.0, 0.1, 0.2];
        for azimuth in 0..36 {
            let at = |r| Camera::orbit_around(target, 10.0 * f64::from(azimuth), 30.0, r, 45.0, 100, 100).unwrap();
            let radius = at(3.0).radius_for(&ball, target, Projection::Pinhole);
            let sees = 0.5 / (radius * radius - 0.25).sqrt() / 22.5f64.to_radians().tan();
            assert!((0.9..0.99).contains(&sees), "{azimuth}: {sees}");
        }
    }

    #[test]
    fn an_orbit_around_the_origin_is_the_orbit() {
        let around = Camera::orbit_around([0.0; 3], 20.0, -30.0, 2.5, 45.0, 64, 48).unwrap();
        assert_eq!(around, Camera::orbit(20.0, -30.0, 2.5, 45.0, 64, 48).unwrap());
    }

    #[test]
    fn an_extent_is_around_what_is_finite_and_within_the_cube() {
        let odd = [
            ([f64::NAN, 0.0, 0.0], 0.1),
            ([0.2; 3], f64::INFINITY),
            ([7.0, 0.0, 0.0], 0.1),
        ];
        let spheres = [([0.0, 0.5, -0.5], 0.25)].into_iter().chain(odd);
        let extent = Extent::of(spheres);
        assert_eq!(extent, Extent::of([([0.0, 0.5, -0.5], 0.25)].into_iter()));
        let middle = extent.middle();
        assert!(
            (0..3).all(|axis| (middle[axis] - [0.0, 0.5, -0.5][axis]).abs() < 1e-9),
            "{middle:?}"
        );
        assert_eq!(Extent::of(odd.into_iter()), Extent::cube());
        assert_eq!(Extent::cube().middle(), [0.0; 3]);
        assert_eq!(Extent::cube().corners(), [[-1.0; 3], [1.0; 3]]);
    }
}
