//! Dense stereo between photographs: each point comes from a pixel that a second camera sees, too.

use super::station::Station;
use super::{Capture, Scene};
use crate::random::Random;
use crate::raster::View;

/// Photographs: rings of azimuths at these elevations in degrees.
const ELEVATIONS: [f64; 3] = [-10.0, 15.0, 40.0];
const PER_RING: usize = 8;
/// Side of a photograph: at most, at least, and per square root of a point.
const SIDES: [f64; 3] = [640.0, 160.0, 1.2];
/// Chance of a pixel without texture over that of one with much, and the change of brightness from a pixel to the next
/// that is much.
const PLAIN: f64 = 0.12;
const TEXTURED: f64 = 0.04;
/// Waves of the error of low frequency: how many, their standard deviation and their lengths in metres.
const WAVES: usize = 24;
const BUMPS: f64 = 0.0012;
const LENGTHS: [f64; 2] = [0.04, 0.3];
/// Standard deviation of a point's own error where there is much texture, in metres. Without texture it is four times
/// that.
const NOISE: f64 = 0.0006;
/// Share of outliers and their standard deviation along the ray in metres.
const OUTLIERS: f64 = 0.006;
const OUTLIER_NOISE: f64 = 0.03;
/// A second camera confirms a pixel if it sees the same depth within this, in metres.
const TOLERANCE: f64 = 0.006;
/// Cosine of the most oblique angle at which stereo matches.
const OBLIQUE: f64 = 0.25;

/// The sum of plane waves by which the surface is off along its normal.
struct Bumps {
    /// Wave vector and phase.
    waves: Vec<(glam::DVec3, f64)>,
    amplitude: f64,
}

impl Bumps {
    fn new(scene: &Scene, random: &mut Random) -> Self {
        let wave = |random: &mut Random| {
            let direction = glam::DVec3::from_array([0; 3].map(|_| random.normal())).normalize_or(glam::DVec3::X);
            let length = random.log_range(LENGTHS[0], LENGTHS[1]) * scene.metre;
            let tau = std::f64::consts::TAU;
            (direction * tau / length, random.range(0.0, tau))
        };
        Bumps {
            waves: (0..WAVES).map(|_| wave(random)).collect(),
            amplitude: BUMPS * scene.metre * scene.options.noise * (2.0 / WAVES as f64).sqrt(),
        }
    }

    fn at(&self, place: glam::DVec3) -> f64 {
        let waves = self.waves.iter().map(|(k, phase)| (k.dot(place) + phase).sin());
        self.amplitude * waves.sum::<f64>()
    }
}

/// Points of all photographs.
pub fn reconstruct(scene: &Scene, random: &mut Random) -> Capture {
    let [most, least, per_point] = SIDES;
    let side = (per_point * (scene.options.points as f64).sqrt()).clamp(least, most) as u32;
    let bumps = Bumps::new(scene, random);
    let mut stations = Vec::new();
    for (ring, elevation) in ELEVATIONS.into_iter().enumerate() {
        for i in 0..PER_RING {
            let azimuth = (i as f64 + 0.5 * ring as f64) * 360.0 / PER_RING as f64 + random.range(-6.0, 6.0);
            let distance = random.range(1.3, 1.6);
            let eye = scene.around(azimuth, elevation + random.range(-4.0, 4.0), distance);
            let focal = f64::from(side) / 2.0 * distance / 0.62;
            let view = View::look_at(eye.to_array(), scene.centre.to_array(), focal, [side; 2]);
            stations.push(Station::new(scene.surface, view, [side; 2], random));
        }
    }
    // Pixels by how likely they match, so that the sum of all chances is the number of points.
    let chances: Vec<Vec<f64>> = stations
        .iter()
        .map(|station| chances(scene, &stations, station))
        .collect();
    let total: f64 = chances.iter().flatten().sum();
    let scale = scene.options.points as f64 / total.max(1.0);
    let mut capture = Capture::default();
    for (i, (station, chances)) in stations.iter().zip(&chances).enumerate() {
        capture.append(points(
            scene,
            station,
            chances,
            scale,
            &bumps,
            &mut random.fork(i as u64),
        ));
    }
    capture
}

/// How likely each pixel matches, up to a factor; 0 where no second camera sees the same.
fn chances(scene: &Scene, stations: &[Station], station: &Station) -> Vec<f64> {
    use rayon::prelude::*;
    let width = i64::from(station.size[0]);
    let count = width * i64::from(station.size[1]);
    let chance = |i: i64| {
        let (x, y) = (i % width, i / width);
        let at = [x as f64 + 0.5, y as f64 + 0.5];
        let Some(met) = station.trace(scene.surface, at) else {
            return 0.0;
        };
        let place = station.place(at, met.depth);
        let tolerance = TOLERANCE * scene.metre;
        let others = stations.iter().filter(|other| !std::ptr::eq(*other, station));
        let oblique = |other: &Station| (other.eye() - place).normalize().dot(met.normal) < OBLIQUE;
        if met.cosine < OBLIQUE
            || !others
                .clone()
                .any(|other| !oblique(other) && other.sees(place, tolerance))
        {
            return 0.0;
        }
        PLAIN + (1.0 - PLAIN) * (station.texture(x, y) / TEXTURED).min(1.0)
    };
    (0..count).into_par_iter().map(chance).collect()
}

fn points(
    scene: &Scene,
    station: &Station,
    chances: &[f64],
    scale: f64,
    bumps: &Bumps,
    random: &mut Random,
) -> Capture {
    let mut capture = Capture::default();
    let width = i64::from(station.size[0]);
    let (metre, noise) = (scene.metre, scene.options.noise);
    for (i, &chance) in chances.iter().enumerate() {
        let wanted = chance * scale;
        let count = wanted.floor() as usize + usize::from(random.chance(wanted.fract()));
        for _ in 0..count {
            let (x, y) = (i as i64 % width, i as i64 / width);
            let at = [x as f64 + random.unit(), y as f64 + random.unit()];
            let Some(met) = station.trace(scene.surface, at) else {
                continue;
            };
            let own = NOISE * noise * metre * (4.0 - 3.0 * (chance - PLAIN) / (1.0 - PLAIN)) * random.normal();
            let outlier = if random.chance(OUTLIERS) {
                OUTLIER_NOISE * noise * metre * random.normal()
            } else {
                0.0
            };
            let place = station.place(at, met.depth + own + outlier);
            capture.push(place + bumps.at(place) * met.normal, station.colour(at));
        }
    }
    capture
}
