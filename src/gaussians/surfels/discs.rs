//! The disc of a voxel: where, how wide, how thick, facing where.

use super::lanes::{GROUP, Lane, dot, lane};
use super::moments::{Around, PAIRS};
use super::normals::normals;

/// σ in the plane, in voxels, of a disc that faces along an axis. Voxels of other planes lie closer together.
const RADIUS: f32 = 0.6;
/// σ across, in voxels.
const THICKNESS: f32 = 0.01;
/// σ of the round blob that a lone voxel becomes, in voxels.
const BLOB: f32 = 0.4;
/// The variance along the middle axis above which a neighbourhood is a surface: that of a strip three voxels wide.
const SURFACE: f32 = 0.6;
/// How far the fitted plane of a curved surface is corrected towards that of the nearest voxels. The means of a cap lie under it by half its
/// curvature times their variance; a part of that is left, as a disc stands over the surface around the point where it touches.
const UNCURVED: f32 = 0.3;

/// A voxel's disc, in voxels, relative to the voxel's centre.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Disc {
    /// Its centre.
    pub centre: [f32; 3],
    /// A unit quaternion w, x, y, z that turns z into the normal.
    pub rotation: [f32; 4],
    /// σ in the plane.
    pub radius: f32,
    /// σ along the normal.
    pub thickness: f32,
}

/// The discs of [`GROUP`] voxels, from the moments around them after one step and after all.
#[inline(always)]
pub fn discs(near: &Around, far: &Around) -> [Disc; GROUP] {
    let mean = |m: &Around| [0, 1, 2].map(|axis| lane(|j| m.sum[axis][j] / m.count[j]));
    let (near, centre) = (mean(near), mean(far));
    let covariance = std::array::from_fn(|k| {
        let (a, b) = PAIRS[k];
        lane(|j| far.square[k][j] / far.count[j] - centre[a][j] * centre[b][j])
    });
    let axes = normals(covariance);
    let normal = axes.normal;
    let (low, high) = (dot(&near, &normal), dot(&centre, &normal));
    let height = lane(|j| high[j] + UNCURVED * (low[j] - high[j]));
    let flat = lane(|j| (axes.middle[j] / SURFACE).min(1.0));
    let radius = radius(&normal, &flat);
    let thickness = lane(|j| BLOB + flat[j] * (THICKNESS - BLOB));
    let rotation = towards(&normal);
    std::array::from_fn(|j| Disc {
        centre: normal.map(|n| n[j] * height[j]),
        rotation: rotation.map(|component| component[j]),
        radius: radius[j],
        thickness: thickness[j],
    })
}

/// σ in the plane. A plane cuts |x| + |y| + |z| voxels per unit of its area, its normal being (x, y, z).
#[inline(always)]
fn radius([x, y, z]: &[Lane; 3], flat: &Lane) -> Lane {
    lane(|j| {
        let density = x[j].abs() + y[j].abs() + z[j].abs();
        BLOB + flat[j] * (RADIUS / density.sqrt() - BLOB)
    })
}

/// The shortest rotations that turn z into normals whose z is not negative.
#[inline(always)]
fn towards([x, y, z]: &[Lane; 3]) -> [Lane; 4] {
    let w = lane(|j| 1.0 + z[j]);
    let norm = lane(|j| (w[j] * w[j] + x[j] * x[j] + y[j] * y[j]).sqrt());
    [
        lane(|j| w[j] / norm[j]),
        lane(|j| -y[j] / norm[j]),
        lane(|j| x[j] / norm[j]),
        [0.0; GROUP],
    ]
}
