//! What effects need to know of a Gaussian beyond its ellipse.

use b2p_kernels::splat::{Crossing, MAX_SCALE};
use glam::{DMat3, DQuat, DVec2, DVec3};

use super::{Camera, Projection};
use crate::gaussians::Gaussians;

/// `√(log₂(e)/2)`: with it `exp(−½d²) = 2^−(d·FORM_SCALE)²`.
const FORM_SCALE: f64 = 0.849_321_800_288_019_3;

/// A Gaussian before a camera.
struct Seen {
    centre: DVec3,
    /// From the Gaussian's axes to the camera's; not scaled.
    axes: DMat3,
    scale: DVec3,
}

fn see(gaussians: &Gaussians, camera: &Camera, i: usize) -> Seen {
    let [w, x, y, z] = gaussians.rotation[i].map(f64::from);
    let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let scale = gaussians.scale[i].map(|s| f64::from(s.abs().min(MAX_SCALE)));
    let position = DVec3::from(gaussians.position[i].map(f64::from));
    Seen {
        centre: camera.pose.transform_point3(position),
        axes: camera.pose.matrix3 * rotation,
        scale: scale.into(),
    }
}

/// Gaussian `i`, which reaches over the near plane: each of its axes is widened by the pixel's blur as it is at its
/// centre, or at the near plane if that is farther.
pub(super) fn crossing(gaussians: &Gaussians, camera: &Camera, i: usize) -> Crossing {
    let Seen { centre, axes, scale } = see(gaussians, camera, i);
    let focal = DVec2::new(camera.fx, camera.fy);
    let pinhole = camera.projection == Projection::Pinhole;
    let distance = if pinhole { centre.z.max(camera.near) } else { 1.0 };
    let pixel = distance * distance / (focal.x * focal.y);
    let blur = (f64::from(gaussians.pixel_blur()) * pixel).max(gaussians.own_blur().into());
    let measure = (scale * scale + blur).map(|variance| FORM_SCALE / variance.sqrt());
    // From the camera's axes to the Gaussian's, in its own measure.
    let whiten = DMat3::from_diagonal(measure) * axes.transpose();
    let (x, y) = (DVec3::X / focal.x, DVec3::Y / focal.y);
    let corner = DVec3::new(-camera.cx / focal.x, -camera.cy / focal.y, 0.0);
    let rays = if pinhole {
        [DMat3::ZERO, DMat3::from_cols(x, y, corner + DVec3::Z)]
    } else {
        [
            DMat3::from_cols(x, y, corner),
            DMat3::from_cols(DVec3::ZERO, DVec3::ZERO, DVec3::Z),
        ]
    };
    let from = whiten * (rays[0] - DMat3::from_cols(DVec3::ZERO, DVec3::ZERO, centre));
    let along = whiten * rays[1];
    let rows = |m: DMat3| std::array::from_fn(|k| m.row(k).as_vec3().into());
    Crossing {
        index: i as u32,
        near: camera.near as f32,
        from: rows(from),
        along: rows(along),
    }
}

/// How the depth of Gaussian `i` changes by pixel to the right and down: the mean depth of what of it is seen there.
pub(super) fn slopes(gaussians: &Gaussians, camera: &Camera, i: usize) -> [f32; 2] {
    let Seen { centre, axes, scale } = see(gaussians, camera, i);
    let axes = axes * DMat3::from_diagonal(scale);
    let [right, down, ahead] = [0, 1, 2].map(|k| axes.row(k));
    let [[left, most], [top, bottom]] = camera.slope_ranges();
    let (m1, m2, near) = match camera.projection {
        Projection::Pinhole => {
            let sx = (centre.x / centre.z).clamp(left, most);
            let sy = (centre.y / centre.z).clamp(top, bottom);
            let focal = [camera.fx, camera.fy].map(|f| f / centre.z);
            let m1 = (right - ahead * sx) * focal[0];
            (m1, (down - ahead * sy) * focal[1], centre.z)
        }
        Projection::Orthographic => (right * camera.fx, down * camera.fy, 1.0),
    };
    let own = f64::from(gaussians.own_blur()) * camera.fx * camera.fy / (near * near);
    let blur = own.max(gaussians.pixel_blur().into());
    let (a, b, c) = (m1.length_squared() + blur, m1.dot(m2), m2.length_squared() + blur);
    // By Cauchy and Binet, as everywhere.
    let determinant = m1.cross(m2).length_squared() + blur * (a + c - blur);
    let with = [m1.dot(ahead), m2.dot(ahead)];
    let slopes = [c * with[0] - b * with[1], a * with[1] - b * with[0]];
    slopes.map(|slope| (slope / determinant) as f32)
}
