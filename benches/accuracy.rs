//! What each cut-off costs in accuracy and saves in time: pictures of a PLY of Gaussians from 24 views near and far,
//! against double precision without cut-offs.
//!
//! `accuracy FILE.ply [SIZE]`; without a file, the sample that comes with the program.

use std::time::{Duration, Instant};

use b2p::gaussians::{Gaussians, ply};
use b2p::latents::LatentDecoder;
use b2p::latents::network::Model;
use b2p::log::Log;
use b2p::renderer::camera::Camera;
use b2p::renderer::reference::{self, Cutoffs};
use b2p::renderer::{Background, Image, Quality, Renderer};
use b2p::{Error, Limits, Result};

/// Floors of α, as what they are the inverse of.
const FLOORS: [f32; 6] = [255.0, 512.0, 1024.0, 2048.0, 4096.0, 16384.0];
const DISTANCES: [f64; 3] = [1.2, 3.0, 9.0];
const TURNS: usize = 8;
const FRAMES: usize = 5;

fn gaussians(path: Option<&String>) -> Result<Gaussians> {
    let limits = Limits::default();
    match path {
        Some(path) => {
            let bytes = std::fs::read(path).map_err(|source| Error::Io {
                path: path.into(),
                source,
            })?;
            Ok(ply::read(&bytes, &limits)?.0)
        }
        None => {
            let model = Model::from_bytes(b2p::embedded::model())?;
            LatentDecoder::new(&model).decode(b2p::embedded::SAMPLE, None, &Log::default())
        }
    }
}

/// The largest difference of a channel, in steps of eight bits, and the mean square.
fn difference(a: &Image, b: &Image) -> (f32, f64) {
    let (a, b) = (a.pixels.as_flattened(), b.pixels.as_flattened());
    let pairs = a.iter().zip(b);
    let largest = pairs.clone().fold(0.0f32, |most, (x, y)| most.max((x - y).abs()));
    let squares: f64 = pairs.map(|(x, y)| f64::from(x - y).powi(2)).sum();
    (largest * 255.0, squares / a.len() as f64)
}

fn main() -> Result<()> {
    let args: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let scene = gaussians(args.first())?;
    let size = args.get(1).and_then(|n| n.parse().ok()).unwrap_or(512);
    let limits = Limits::default();
    for distance in DISTANCES {
        let mut worst = [(0.0f32, 0.0f64, Duration::ZERO); FLOORS.len()];
        for turn in 0..TURNS {
            let turns = turn as f64 / TURNS as f64;
            let camera = Camera::orbit(360.0 * turns, 60.0 * turns - 20.0, distance, 45.0, size, size)?;
            let exact = reference::render(&scene, &camera, Background::WHITE, Cutoffs::NONE);
            for (floor, (largest, square, time)) in FLOORS.iter().zip(&mut worst) {
                let renderer = Renderer::new().with_limits(limits.clone());
                let mut renderer = renderer.with_quality(Quality::Floor(1.0 / floor));
                let mut image = Image::default();
                let mut least = Duration::MAX;
                for _ in 0..FRAMES {
                    let start = Instant::now();
                    renderer.render_into(&scene, &camera, &mut image)?;
                    least = least.min(start.elapsed());
                }
                let (l, s) = difference(&image, &exact);
                (*largest, *square, *time) = (largest.max(l), square.max(s), *time + least);
            }
        }
        for (floor, (largest, square, time)) in FLOORS.iter().zip(worst) {
            println!(
                "distance {distance}, α ≥ 1/{floor}: {largest:5.2}/255, {:5.1} dB, {:6.2} ms",
                -10.0 * square.log10(),
                time.as_secs_f64() * 1e3 / TURNS as f64
            );
        }
    }
    Ok(())
}
