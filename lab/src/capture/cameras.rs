//! Depth cameras.

use super::station::Station;
use super::{Capture, Scene};
use crate::random::Random;
use crate::raster::View;

/// Cameras around an object, and the chance that one fails.
const CAMERAS: usize = 8;
const MISSING: f64 = 0.15;
/// Depths that follow from neighbouring disparities are this far apart at one metre, in metres: a baseline of 75 mm, a
/// focal length of 580 pixels, steps of an eighth of a pixel have 2.9 mm; later cameras 1 mm.
const DISPARITY_STEP: f64 = 0.001;
const SINGLE_DISPARITY_STEP: f64 = 0.0029;
/// Standard deviation of depth at one metre, in metres.
const NOISE: f64 = 0.001;
/// Depth differences between neighbouring pixels from which on a pixel is at an edge, over the depth.
const EDGE: f64 = 0.02;
/// Share of the pixels at edges whose depth lies between the two surfaces. The others are removed.
const FLYING: f64 = 0.25;
/// Share of the pixels that have no depth.
const DROPPED: f64 = 0.01;

struct Camera {
    eye: glam::DVec3,
    /// Half of what fits on the picture's shorter side at the centre of the object, in metres.
    half: f64,
    step: f64,
}

/// Cameras around the object at alternating heights.
pub fn around(scene: &Scene, random: &mut Random) -> Capture {
    let first = random.range(0.0, 360.0);
    let mut present: Vec<bool> = (0..CAMERAS).map(|_| !random.chance(MISSING)).collect();
    // At least one fails and at least one works.
    present[random.below(CAMERAS as u64) as usize] = false;
    present[random.below(CAMERAS as u64) as usize] = true;
    let cameras = (0..CAMERAS).filter(|&i| present[i]).map(|i| Camera {
        eye: scene.around(
            first + 360.0 * i as f64 / CAMERAS as f64 + random.range(-8.0, 8.0),
            [-5.0, 25.0][i % 2] + random.range(-8.0, 8.0),
            random.range(1.2, 1.8),
        ),
        half: 0.62,
        step: DISPARITY_STEP,
    });
    let cameras: Vec<Camera> = cameras.collect();
    frames(scene, &cameras, random)
}

/// One camera of the first generation in front of the object.
pub fn single(scene: &Scene, random: &mut Random) -> Capture {
    let eye = scene.around(random.range(-10.0, 10.0), random.range(0.0, 8.0), 1.1);
    let camera = Camera {
        eye,
        half: 0.56,
        step: SINGLE_DISPARITY_STEP,
    };
    frames(scene, &[camera], random)
}

/// The side of a coarse picture, by which the resolution is chosen.
const COARSE: u32 = 128;

fn frames(scene: &Scene, cameras: &[Camera], random: &mut Random) -> Capture {
    let view = |camera: &Camera, side: u32| {
        let distance = (camera.eye - scene.centre).length() / scene.metre;
        let focal = f64::from(side) / 2.0 * distance / camera.half;
        View::look_at(camera.eye.to_array(), scene.centre.to_array(), focal, [side; 2])
    };
    let covered: usize = cameras
        .iter()
        .map(|camera| {
            let hits = crate::raster::trace(scene.surface, &view(camera, COARSE), [COARSE; 2]);
            hits.iter().flatten().count()
        })
        .sum();
    let ratio = (scene.options.points as f64 / covered.max(1) as f64).sqrt();
    let side = (f64::from(COARSE) * ratio).round().clamp(16.0, 4096.0) as u32;
    let mut capture = Capture::default();
    for camera in cameras {
        let station = Station::new(scene.surface, view(camera, side), [side; 2], random);
        capture.append(frame(scene, &station, camera.step, random));
    }
    capture
}

fn frame(scene: &Scene, station: &Station, step: f64, random: &mut Random) -> Capture {
    let mut capture = Capture::default();
    let [width, height] = station.size.map(i64::from);
    let noise = scene.options.noise;
    for y in 0..height {
        for x in 0..width {
            let Some(hit) = station.hit(x, y) else { continue };
            // The same number of draws for each pixel, so that pixels do not depend on each other.
            let (dropped, flies, part, normal) = (
                random.chance(DROPPED),
                random.chance(FLYING),
                random.unit(),
                random.normal(),
            );
            let mut depth = hit.depth;
            if noise > 0.0 {
                let other = edge(station, x, y, depth);
                if dropped || (other.is_some() && !flies) {
                    continue;
                }
                if let Some(other) = other {
                    depth += part * (other - depth);
                }
                depth = measured(depth / scene.metre, step * noise, NOISE * noise * normal) * scene.metre;
            }
            let at = [x as f64 + 0.5, y as f64 + 0.5];
            capture.push(station.place(at, depth), station.colour(at));
        }
    }
    capture
}

/// What the camera makes of a depth in metres: noise that grows with its square, then the nearest step of disparity.
fn measured(depth: f64, step: f64, noise: f64) -> f64 {
    let noisy = depth + noise * depth * depth;
    // Disparity is proportional to 1 / depth; one step of it is `step` metres at one metre.
    let disparity = (1.0 / (noisy.max(0.05) * step)).round().max(1.0);
    1.0 / (disparity * step)
}

/// The depth of a surface behind a pixel's, if one of its neighbours sees such; of a background without one, a little
/// more than the pixel's own.
fn edge(station: &Station, x: i64, y: i64, depth: f64) -> Option<f64> {
    let beside = [(-1, 0), (1, 0), (0, -1), (0, 1)].map(|(dx, dy)| station.hit(x + dx, y + dy));
    let behind = beside.map(|hit| hit.map_or(1.1 * depth, |hit| hit.depth));
    let farthest = behind.into_iter().fold(0.0, f64::max);
    (farthest > (1.0 + EDGE) * depth).then_some(farthest.min(1.1 * depth))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_of_disparity_grow_with_the_square_of_the_distance() {
        let steps = |near: f64| {
            let mut depths: Vec<f64> = (0..4000)
                .map(|i| measured(near + 1e-4 * f64::from(i), 0.001, 0.0))
                .collect();
            depths.dedup();
            0.4 / depths.len() as f64
        };
        let ratio = steps(3.8) / steps(1.8);
        assert!((ratio - 4.0).abs() < 0.4, "{ratio}");
        assert!((measured(2.0, 0.001, 0.0) - 2.0).abs() < 0.002);
    }
}
