//! Typical splat size, from a sample of the splats.

use glam::DVec3;

use crate::gaussians::Gaussians;
use crate::renderer::camera::{Camera, Projection};

/// At most so many Gaussians are sampled.
const SAMPLED: usize = 1024;

/// The median width, in pixels, of every so many-th of the Gaussians in the picture. Infinite if there are none.
pub(super) fn typical_width(gaussians: &Gaussians, camera: &Camera) -> f64 {
    let step = gaussians.len().div_ceil(SAMPLED).max(1);
    let all = (0..gaussians.len()).step_by(step);
    let (mut widths, mut seen) = ([0.0; SAMPLED], 0);
    for width in all.filter_map(|i| width(gaussians, camera, i)) {
        widths[seen] = width;
        seen += 1;
    }
    let widths = &mut widths[..seen];
    if widths.is_empty() {
        return f64::INFINITY;
    }
    *widths.select_nth_unstable_by(seen / 2, f64::total_cmp).1
}

/// The width of Gaussian `i`, if it is in the picture: the middle one of its three standard deviations, in pixels.
fn width(gaussians: &Gaussians, camera: &Camera, i: usize) -> Option<f64> {
    let centre = DVec3::from(gaussians.position[i].map(f64::from));
    let at = camera.pose.transform_point3(centre);
    let depth = match camera.projection {
        Projection::Pinhole => at.z,
        Projection::Orthographic => 1.0,
    };
    let mut scale = gaussians.scale[i].map(|s| f64::from(s).abs());
    scale.sort_by(f64::total_cmp);
    let pixels = (camera.fx * camera.fy).sqrt() / depth;
    let width = (scale[1].powi(2) + f64::from(gaussians.blur)).sqrt() * pixels;
    let inside = |at: f64, side: u32| (0.0..f64::from(side)).contains(&at);
    let seen = at.z > camera.near
        && width.is_finite()
        && inside(camera.fx * at.x / depth + camera.cx, camera.width)
        && inside(camera.fy * at.y / depth + camera.cy, camera.height);
    seen.then_some(width)
}
