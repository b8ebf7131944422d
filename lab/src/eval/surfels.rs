//! Point clouds drawn as surfels: what a careful viewer makes of a decoded cloud without learning.
//!
//! A point becomes an opaque disc. Its normal is the least axis of the covariance of its [`NEIGHBOURS`] nearest points,
//! itself among them, and its centre moves along the normal onto the plane through their mean, which takes the
//! staircase of voxels away.

use b2p::gaussians::{Frame, Gaussians};
use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;

use super::nearest::{CHUNK, Found, Tree};
use super::points::Points;

/// How many points a plane is fitted to.
pub const NEIGHBOURS: usize = 40;
/// The standard deviation along the normal, as a multiple of the points' spacing.
const THICKNESS: f64 = 0.05;
/// Variance that pictures widen surfels by, in finest voxels squared, so that rough surfaces close.
pub const WIDE_BLUR: f64 = 0.15;
/// The same of slim surfels: that of the surfels which streams decode to.
pub const SLIM_BLUR: f64 = 0.003;
/// Sweeps of Jacobi's method. It converges quadratically: a few reach the precision of doubles.
const SWEEPS: usize = 8;

/// A cloud's points with the planes that they lie in.
pub struct Surfels<'a> {
    points: &'a Points,
    planes: Vec<Plane>,
}

/// Where a surfel is, and how it is turned: its normal is the turned z axis.
#[derive(Debug, Clone, Copy)]
struct Plane {
    centre: [f32; 3],
    rotation: [f32; 4],
}

impl<'a> Surfels<'a> {
    /// Fits a plane to every point.
    pub fn new(points: &'a Points) -> Self {
        let tree = Tree::new(&points.positions);
        let fitted: Vec<Plane> = tree
            .points()
            .par_chunks(CHUNK)
            .flat_map_iter(|chunk| {
                let mut found = Vec::with_capacity(NEIGHBOURS);
                let fit = |point: &super::nearest::Point| {
                    tree.nearest(point.at, NEIGHBOURS, &mut found);
                    Plane::fit(point.at, &found)
                };
                chunk.iter().map(fit).collect::<Vec<_>>()
            })
            .collect();
        let mut planes = fitted.clone();
        for (point, plane) in tree.points().iter().zip(fitted) {
            planes[point.index as usize] = plane;
        }
        Surfels { points, planes }
    }

    /// One opaque Gaussian a point, whose standard deviation in its plane is the `factor`-fold spacing of the points.
    /// Pictures widen it by `blur`, in finest voxels squared.
    pub fn to_gaussians(&self, frame: Frame, factor: f64, blur: f64) -> Gaussians {
        let Points { colours, spacing, .. } = self.points;
        let wide = (factor * spacing) as f32;
        let voxel = 2.0 / f64::from(1u32 << frame.bits);
        let count = self.planes.len();
        Gaussians {
            position: self.planes.iter().map(|p| p.centre).collect(),
            scale: vec![[wide, wide, (THICKNESS * spacing) as f32]; count],
            rotation: self.planes.iter().map(|p| p.rotation).collect(),
            opacity: vec![1.0; count],
            blur: (blur * voxel * voxel) as f32,
            colour: colours.iter().map(|c| c.map(|v| f32::from(v) / 255.0)).collect(),
            frame,
            ..Gaussians::default()
        }
    }
}

impl Plane {
    fn fit(at: [f32; 3], near: &[Found]) -> Plane {
        let place = |p: [f32; 3]| DVec3::from(p.map(f64::from));
        let mean = near.iter().map(|f| place(f.at)).sum::<DVec3>() / near.len() as f64;
        let mut covariance = DMat3::ZERO;
        for found in near {
            let off = place(found.at) - mean;
            covariance += DMat3::from_cols(off * off.x, off * off.y, off * off.z);
        }
        let normal = least_axis(covariance);
        let centre = place(at) - (place(at) - mean).dot(normal) * normal;
        let turn = DQuat::from_rotation_arc(DVec3::Z, normal);
        Plane {
            centre: centre.as_vec3().to_array(),
            rotation: [turn.w, turn.x, turn.y, turn.z].map(|v| v as f32),
        }
    }
}

/// The unit eigenvector of the least eigenvalue of a symmetric matrix, by Jacobi's method.
fn least_axis(matrix: DMat3) -> DVec3 {
    let mut a = matrix.to_cols_array_2d();
    let mut axes = DMat3::IDENTITY.to_cols_array_2d();
    for _ in 0..SWEEPS {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if a[p][q] == 0.0 {
                continue;
            }
            // The rotation in the plane of p and q that makes a[p][q] vanish (Golub and Van Loan, Matrix Computations,
            // 8.5).
            let half = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
            let tangent = half.signum() / (half.abs() + (half * half + 1.0).sqrt());
            let cosine = 1.0 / (tangent * tangent + 1.0).sqrt();
            let sine = tangent * cosine;
            for column in &mut a {
                (column[p], column[q]) = turned(column[p], column[q], cosine, sine);
            }
            for k in 0..3 {
                (a[p][k], a[q][k]) = turned(a[p][k], a[q][k], cosine, sine);
                (axes[p][k], axes[q][k]) = turned(axes[p][k], axes[q][k], cosine, sine);
            }
        }
    }
    let least = (1..3).fold(0, |least, k| if a[k][k] < a[least][least] { k } else { least });
    DVec3::from(axes[least]).normalize()
}

fn turned(p: f64, q: f64, cosine: f64, sine: f64) -> (f64, f64) {
    (cosine * p - sine * q, sine * p + cosine * q)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::procedural::rng::Rng;

    #[test]
    fn the_least_axis_is_that_of_the_matrix_it_was_made_from() {
        let mut rng = Rng::new(7);
        for _ in 0..200 {
            let first = rng.direction().as_dvec3().normalize();
            let second = first.any_orthonormal_vector();
            let axes = DMat3::from_cols(first, second, first.cross(second));
            let values = DVec3::new(rng.unit().into(), 1.5, 40.0 * f64::from(rng.unit()) + 2.0);
            let matrix = axes * DMat3::from_diagonal(values) * axes.transpose();
            let found = least_axis(matrix);
            assert!((found.dot(first).abs() - 1.0).abs() < 1e-9, "{values}");
        }
        assert_eq!(least_axis(DMat3::ZERO).length(), 1.0);
    }

    /// The voxels, of a grid of 64³, that a plane through the middle goes through.
    fn voxels_of_a_plane(normal: DVec3) -> Points {
        let middle = |v: i32| (f64::from(v) + 0.5) / 32.0 - 1.0;
        let mut positions = Vec::new();
        for x in 0..64 {
            for y in 0..64 {
                let (x, y) = (middle(x), middle(y));
                let z = -(normal.x * x + normal.y * y) / normal.z;
                let z = middle(((z + 1.0) * 32.0).floor() as i32);
                positions.push([x, y, z].map(|v| v as f32));
            }
        }
        Points {
            colours: vec![[255, 0, 51]; positions.len()],
            positions,
            spacing: 1.0 / 32.0,
        }
    }

    #[test]
    fn the_staircase_of_a_slanted_plane_becomes_nearly_flat() {
        let normal = DVec3::new(0.2, -0.35, 1.0).normalize();
        let points = voxels_of_a_plane(normal);
        let surfels = Surfels::new(&points);
        let inside = |p: &[f32; 3]| p[0].abs() < 0.8 && p[1].abs() < 0.8;
        let off = |p: [f32; 3]| DVec3::from(p.map(f64::from)).dot(normal);
        let (mut before, mut after, mut count) = (0.0, 0.0, 0.0);
        for (p, plane) in points.positions.iter().zip(&surfels.planes) {
            if inside(p) {
                before += off(*p).powi(2);
                after += off(plane.centre).powi(2);
                count += 1.0;
                let [w, x, y, z] = plane.rotation.map(f64::from);
                let turned = DQuat::from_xyzw(x, y, z, w) * DVec3::Z;
                assert!(turned.dot(normal).abs() > 0.98, "{turned}");
            }
        }
        assert!(after < before / 9.0, "{after} {before} {count}");
    }

    #[test]
    fn surfels_are_as_wide_as_asked_for_opaque_and_coloured_as_their_points() {
        let points = voxels_of_a_plane(DVec3::Z);
        let frame = Frame::default();
        let gaussians = Surfels::new(&points).to_gaussians(frame, 0.5, WIDE_BLUR);
        assert_eq!(gaussians.len(), points.positions.len());
        assert_eq!(gaussians.scale[9], [1.0 / 64.0, 1.0 / 64.0, 0.05 / 32.0]);
        assert_eq!(gaussians.opacity[9], 1.0);
        assert_eq!(gaussians.colour[9], [1.0, 0.0, 0.2]);
    }

    #[test]
    fn one_point_alone_stays_where_it_is() {
        let points = Points {
            positions: vec![[0.25, 0.5, -1.0]],
            colours: vec![[0; 3]],
            spacing: 0.1,
        };
        let gaussians = Surfels::new(&points).to_gaussians(Frame::default(), 0.42, WIDE_BLUR);
        assert_eq!(gaussians.position, [[0.25, 0.5, -1.0]]);
    }
}
