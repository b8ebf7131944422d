//! The disc of a voxel: centre, radius, thickness and orientation (`docs/format.md`, clause 6.5).

use b2p_kernels::Instructions;

use super::lanes::{GROUP, Lane, axes, dot, lane};
use super::moments::{CentredMoments, PAIRS};
use super::normals::normals;

/// σ in the plane of a disc whose normal is a coordinate axis, in voxels. Voxels of oblique planes lie closer together.
const RADIUS: f32 = 0.62;
/// σ along the normal, in voxels.
const THICKNESS: f32 = 0.01;
/// σ of the sphere that replaces an isolated voxel, in voxels.
const SPHERE: f32 = 0.4;
/// Middle eigenvalue from which a neighbourhood counts as a surface: the variance across a strip three voxels wide.
const SURFACE: f32 = 0.6;
/// Smallest eigenvalue, minus that of a plane's voxels, from which on only the nearest voxels determine the disc's
/// height: the mean of a strongly curved surface lies below the surface, and that of two sheets lies between them.
const THICK: f32 = 0.4;
/// Fraction of the way to the neighbourhood's mean by which a disc moves in its plane. It keeps discs from extending
/// over the borders of a surface.
const INWARDS: f32 = 0.2;

/// How much fewer voxels a window holds at the border of a surface, per squared distance of the mean from the voxel
/// over the squared reach.
const BORDER: f32 = 4.0;
/// How much farther than the mean distance discs must reach to close a surface of which most voxels are missing, since
/// those that are there are not evenly distributed.
const UNEVEN: f32 = 0.5;
/// Middle eigenvalue of a window from which on it counts as a surface, over the squared reach. A full one has 1/3.
const WINDOW_SURFACE: f32 = 0.15;

/// A voxel's disc. Lengths are in voxels.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Disc {
    /// Centre, relative to the voxel's centre.
    pub centre: [f32; 3],
    /// Unit quaternion w, x, y, z that rotates z to the normal.
    pub rotation: [f32; 4],
    /// σ in the plane.
    pub radius: f32,
    /// σ along the normal.
    pub thickness: f32,
    /// Distance of the surface's voxels over that of a plane's, 1 or more.
    pub spacing: f32,
    pub opacity: f32,
}

/// The discs of [`GROUP`] voxels, from their moments after one step (`near`) and after all steps (`far`). With a
/// `reach`, `far` has the moments of windows in place of those of walks.
#[inline(always)]
pub fn discs<I: Instructions>(
    instructions: I,
    near: &CentredMoments,
    far: &CentredMoments,
    reach: Option<&Lane>,
) -> [Disc; GROUP] {
    let mean = |m: &CentredMoments| axes(|axis| lane(|j| m.sum[axis][j] / m.count[j]));
    let (near, centre) = (mean(near), mean(far));
    let mut covariance = [[0.0; GROUP]; 6];
    for (k, (entry, (a, b))) in covariance.iter_mut().zip(PAIRS).enumerate() {
        *entry = lane(|j| far.square[k][j] / far.count[j] - centre[a][j] * centre[b][j]);
    }
    let system = normals(instructions, &covariance);
    let normal = system.normal;
    let (low, high) = (dot(&near, &normal), dot(&centre, &normal));
    let density = density(&normal);
    // The centres of the voxels that a plane cuts are uniformly distributed along its normal, over an interval as long
    // as the density. Its variance is density² / 12.
    let thick = lane(|j| {
        let excess = system.least[j] - density[j] * density[j] / 12.0;
        (excess / THICK).clamp(0.0, 1.0)
    });
    let height = lane(|j| high[j] + thick[j] * (low[j] - high[j]));
    let place = axes(|axis| {
        let (n, mean) = (&normal[axis], &centre[axis]);
        lane(|j| n[j] * height[j] + INWARDS * (mean[j] - high[j] * n[j]))
    });
    let (flat, spacing) = match reach {
        None => (lane(|j| (system.middle[j] / SURFACE).min(1.0)), [1.0; GROUP]),
        Some(reach) => {
            let distance = dot(&centre, &centre);
            let shift = lane(|j| (distance[j] - high[j] * high[j]).max(0.0));
            let flat = lane(|j| window_flatness(system.least[j], system.middle[j], reach[j]));
            (flat, window_spacing(&far.count, &shift, &density, reach))
        }
    };
    let radius = lane(|j| SPHERE + flat[j] * (RADIUS / density[j].sqrt() * spacing[j] - SPHERE));
    let thickness = lane(|j| SPHERE + flat[j] * (THICKNESS - SPHERE));
    let rotation = rotation_to(&normal);
    let mut discs = [Disc::default(); GROUP];
    for (j, disc) in discs.iter_mut().enumerate() {
        let ([x, y, z], [w, i, k, l]) = (&place, &rotation);
        *disc = Disc {
            centre: [x[j], y[j], z[j]],
            rotation: [w[j], i[j], k[j], l[j]],
            radius: radius[j],
            thickness: thickness[j],
            spacing: spacing[j],
            opacity: 1.0,
        };
    }
    discs
}

/// How far a surface's voxels lie apart, from how many there are in a window.
#[inline(always)]
fn window_spacing(count: &Lane, shift: &Lane, density: &Lane, reach: &Lane) -> Lane {
    lane(|j| {
        let side = 2.0 * reach[j] + 1.0;
        let border = 1.0 + BORDER * shift[j] / (reach[j] * reach[j]);
        let filled = (count[j] * border / (side * side * density[j])).min(1.0);
        ((1.0 + UNEVEN * (1.0 - filled)) / filled.sqrt()).min(reach[j])
    })
}

/// 1 if the voxels of a window form a surface, 0 if they form a line or fill the space.
#[inline(always)]
fn window_flatness(least: f32, middle: f32, reach: f32) -> f32 {
    let extent = (middle / (WINDOW_SURFACE * (reach * reach))).min(1.0);
    // TINY prevents 0 / 0.
    let planar = (2.0 - 4.0 * least / (middle + TINY)).clamp(0.0, 1.0);
    extent * planar
}

/// Far below the variance of voxels that are not on one line.
const TINY: f32 = 1e-6;

/// Number of voxels per unit area that a plane with this normal cuts.
#[inline(always)]
fn density([x, y, z]: &[Lane; 3]) -> Lane {
    lane(|j| x[j].abs() + y[j].abs() + z[j].abs())
}

/// The shortest rotations from z to normals with z ≥ 0.
#[inline(always)]
fn rotation_to([x, y, z]: &[Lane; 3]) -> [Lane; 4] {
    let w = lane(|j| 1.0 + z[j]);
    let norm = lane(|j| (w[j] * w[j] + x[j] * x[j] + y[j] * y[j]).sqrt());
    [
        lane(|j| w[j] / norm[j]),
        lane(|j| -y[j] / norm[j]),
        lane(|j| x[j] / norm[j]),
        [0.0; GROUP],
    ]
}
