//! A laser scanner that turns: rings of constant elevation, photographs from the same places.

use super::station::Station;
use super::{Capture, Scene};
use crate::random::Random;
use crate::raster::View;

/// Places around an object.
const PLACES: usize = 5;
/// Side of the picture that rays are looked up in: at most, at least, and per square root of a point.
const SIDES: [f64; 3] = [1536.0, 256.0, 3.0];
/// How much farther rings are apart than the points on a ring.
const ANISOTROPY: f64 = 2.5;
/// Standard deviation of a range and of a ring's own error, in metres.
const NOISE: f64 = 0.0015;
const RING_ERROR: f64 = 0.0007;
/// All returns come back up to this distance in metres from a bright surface that faces the scanner.
const REACH: f64 = 4.0;
/// Depth differences between neighbouring pixels from which on a beam meets two surfaces, over the depth.
const EDGE: f64 = 0.02;
/// Share of such beams that return a range between the two.
const MIXED: f64 = 0.3;

/// Scans from places around the object.
pub fn scan(scene: &Scene, random: &mut Random) -> Capture {
    let [most, least, per_point] = SIDES;
    let side = (per_point * (scene.options.points as f64).sqrt()).clamp(least, most) as u32;
    let first = random.range(0.0, 360.0);
    let stations: Vec<Station> = (0..PLACES)
        .map(|i| {
            let azimuth = first + 360.0 * i as f64 / PLACES as f64 + random.range(-15.0, 15.0);
            let distance = random.range(1.3, 2.4);
            let eye = scene.around(azimuth, random.range(-8.0, 20.0), distance);
            let focal = f64::from(side) / 2.0 * distance / 0.9;
            let view = View::look_at(eye.to_array(), scene.centre.to_array(), focal, [side; 2]);
            Station::new(scene.surface, view, [side; 2], random)
        })
        .collect();
    // The solid angle of the object from all places, over that of a ray.
    let pixel = |s: &Station| s.covered() as f64 / s.view.focal[0].powi(2);
    let angle: f64 = stations.iter().map(pixel).sum();
    let along = (angle / scene.options.points as f64 / ANISOTROPY).sqrt();
    let mut capture = Capture::default();
    for (i, station) in stations.iter().enumerate() {
        capture.append(turn(scene, station, along, &mut random.fork(i as u64)));
    }
    capture
}

/// One turn: `along` is the angle between the points of a ring.
fn turn(scene: &Scene, station: &Station, along: f64, random: &mut Random) -> Capture {
    let mut capture = Capture::default();
    let noise = scene.options.noise;
    let ahead = (scene.centre - station.eye()).normalize_or(glam::DVec3::NEG_Z);
    let (azimuth, elevation) = (ahead.x.atan2(ahead.z), ahead.y.asin());
    let half = (0.9 * scene.metre / (scene.centre - station.eye()).length()).atan();
    let rings = (2.0 * half / (along * ANISOTROPY)).ceil() as i64;
    let steps = (2.0 * half / along).ceil() as i64;
    for ring in 0..rings {
        let elevation = elevation - half + ring as f64 * along * ANISOTROPY;
        let bias = RING_ERROR * noise * random.normal();
        for step in 0..steps {
            let azimuth = azimuth - half / elevation.cos() + step as f64 * along / elevation.cos();
            let draws = [random.unit(), random.unit(), random.unit()];
            let error = NOISE * noise * random.normal() + bias;
            let ray = glam::DVec3::new(
                elevation.cos() * azimuth.sin(),
                elevation.sin(),
                elevation.cos() * azimuth.cos(),
            );
            let local = station.view.to_camera((station.eye() + ray).to_array());
            if local[2] <= 0.0 {
                continue;
            }
            let at = station.view.to_pixel(local);
            if let Some(range) = returned(scene, station, at, local[2], draws) {
                let place = station.eye() + (range + error * scene.metre) * ray;
                capture.push(place, station.colour(at));
            }
        }
    }
    capture
}

/// The range of a beam; none if it does not come back. `axial` is the ray's share along the view's axis.
fn returned(scene: &Scene, station: &Station, at: [f64; 2], axial: f64, draws: [f64; 3]) -> Option<f64> {
    let met = station.trace(scene.surface, at)?;
    let range = met.depth / axial;
    if scene.options.noise == 0.0 {
        return Some(range);
    }
    let [r, g, b] = station.colour(at);
    let albedo = f64::from(0.25 + 0.75 * (r + g + b) / 3.0);
    let power = albedo * met.cosine * (REACH * scene.metre / range).powi(2) * 0.5;
    if draws[0] > power.min(1.0) {
        return None;
    }
    let [x, y] = at.map(|v| v.floor() as i64);
    let beside = [(-1, 0), (1, 0), (0, -1), (0, 1)].into_iter();
    let behind = beside
        .filter_map(|(dx, dy)| station.hit(x + dx, y + dy))
        .map(|hit| hit.depth);
    let farthest = behind.fold(0.0, f64::max);
    let mixed = farthest > (1.0 + EDGE) * met.depth && draws[1] < MIXED;
    Some(if mixed {
        range + draws[2] * (farthest / axial - range)
    } else {
        range
    })
}
