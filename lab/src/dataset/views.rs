//! Where the pictures of a sample are taken from.

use super::{Crop, Options};
use crate::random::Random;
use crate::raster::View;

/// Cameras in crop coordinates.
///
/// Pixels per finest voxel are log-uniform in 0.55 to 1.6 at the point looked at (the protocol has 0.8), the distance
/// in 1.6 to 16 crop sides (the protocol has 12 for the whole body's cube at 10 bits, 1.5 at 7).
pub(super) fn random(crop: &Crop, options: &Options, random: &mut Random) -> Vec<View> {
    let side = f64::from(options.crop);
    let middle = crop.centroid();
    (0..options.views)
        .map(|_| {
            let azimuth = random.range(0.0, std::f64::consts::TAU);
            // Two in three near the horizon, where the protocol's cameras are; the rest anywhere on the sphere.
            let elevation = if random.chance(0.67) {
                (random.normal() * 0.25).clamp(-1.2, 1.2)
            } else {
                random.range(-1.0, 1.0).asin()
            };
            let distance = side * random.log_range(1.6, 16.0);
            let scale = random.log_range(0.55, 1.6);
            let jitter = side / 10.0;
            let target: [f64; 3] = std::array::from_fn(|i| middle[i] + random.range(-jitter, jitter));
            let (sin_el, cos_el) = elevation.sin_cos();
            let direction = [cos_el * azimuth.sin(), sin_el, cos_el * azimuth.cos()];
            let eye = std::array::from_fn(|i| target[i] + distance * direction[i]);
            View::look_at(eye, target, scale * distance, [options.size; 2])
        })
        .collect()
}
