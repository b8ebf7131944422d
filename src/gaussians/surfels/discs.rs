//! The disc of a voxel: where, how wide, how thick, facing where.

use super::lanes::{GROUP, Lane, dot, lane};
use super::moments::{Around, PAIRS};
use super::normals::normals;

/// σ in the plane, in voxels, of a disc that faces along an axis. Voxels of other planes lie closer together.
const RADIUS: f32 = 0.62;
/// σ across, in voxels.
const THICKNESS: f32 = 0.01;
/// σ of the round blob that a lone voxel becomes, in voxels.
const BLOB: f32 = 0.4;
/// The variance along the middle axis above which a neighbourhood is a surface: that of a strip three voxels wide.
const SURFACE: f32 = 0.6;
/// The variance across, beyond that of a flat surface's voxels, from which on the nearest voxels alone say where the surface is: the mean
/// of a strongly curved surface lies under it, that of two sheets between them.
const THICK: f32 = 0.4;
/// How far a disc moves in its plane towards the mean of its neighbourhood, as a share of the way: at borders, so as not to stand over them.
const INWARDS: f32 = 0.2;

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
    let density = density(&normal);
    // The centres of the voxels that a plane cuts are spread evenly across it, over a width of the density.
    let thick = lane(|j| {
        let beyond = axes.least[j] - density[j] * density[j] / 12.0;
        (beyond / THICK).clamp(0.0, 1.0)
    });
    let height = lane(|j| high[j] + thick[j] * (low[j] - high[j]));
    let place = [0, 1, 2].map(|axis| {
        let (n, mean) = (&normal[axis], &centre[axis]);
        lane(|j| n[j] * height[j] + INWARDS * (mean[j] - high[j] * n[j]))
    });
    let flat = lane(|j| (axes.middle[j] / SURFACE).min(1.0));
    let radius = lane(|j| BLOB + flat[j] * (RADIUS / density[j].sqrt() - BLOB));
    let thickness = lane(|j| BLOB + flat[j] * (THICKNESS - BLOB));
    let rotation = towards(&normal);
    std::array::from_fn(|j| Disc {
        centre: place.map(|axis| axis[j]),
        rotation: rotation.map(|component| component[j]),
        radius: radius[j],
        thickness: thickness[j],
    })
}

/// How many voxels a plane with such a normal cuts per unit of its area.
#[inline(always)]
fn density([x, y, z]: &[Lane; 3]) -> Lane {
    lane(|j| x[j].abs() + y[j].abs() + z[j].abs())
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
