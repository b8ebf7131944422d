//! How long pictures take: a body-like surface of small discs, as a decoder makes them, at several sizes, and a room
//! full of splats of all shapes, seen from within. The first picture's time, least and median time of those after it,
//! and the stages of the fastest.
//!
//! `raster [--threads N] [--isa NAME] [--effects] [--quality NAME] [--turn DEGREES] [SCENE…]`; `--effects` draws with
//! each effect instead of the plain pictures, `--quality` in that quality; with `--turn` the camera goes around by so
//! much from picture to picture; a scene is a name of [`SCENES`] or a PLY file, drawn at 1024×1024.

use std::time::{Duration, Instant};

use b2p::gaussians::{Gaussians, Harmonics, ply};
use b2p::renderer::camera::Camera;
use b2p::renderer::{Background, Channel, Effect, EffectMode, Effects, Image, Quality, Renderer, Stats};
use b2p::{Error, Limits, Result};
use b2p_kernels::Isa;

struct Scene {
    name: &'static str,
    count: usize,
    /// Of a body of how many, in Morton order, these are the first.
    of: usize,
    size: (u32, u32),
}

/// Gaussians of the room, and its name.
const ROOM: (&str, usize) = ("room", 500_000);

const SCENES: [Scene; 5] = [
    Scene {
        name: "10k",
        count: 10_000,
        of: 236_000,
        size: (1024, 1024),
    },
    Scene {
        name: "10k-large",
        count: 10_000,
        of: 10_000,
        size: (1024, 1024),
    },
    Scene {
        name: "body",
        count: 236_000,
        of: 236_000,
        size: (1024, 1024),
    },
    Scene {
        name: "1M",
        count: 1_000_000,
        of: 1_000_000,
        size: (1920, 1080),
    },
    Scene {
        name: "5M",
        count: 5_000_000,
        of: 5_000_000,
        size: (1920, 1080),
    },
];

/// Time that each scene is measured for, and the most frames.
const PATIENCE: Duration = Duration::from_millis(1500);
const FRAMES: usize = 60;

struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// A capsule: its ends and its radius, in cube-frame units.
struct Limb([f64; 3], [f64; 3], f64);

const BODY: [Limb; 6] = [
    Limb([0.0, -0.02, 0.0], [0.0, 0.42, 0.0], 0.19),
    Limb([0.0, 0.74, 0.02], [0.0, 0.80, 0.02], 0.12),
    Limb([-0.24, 0.50, 0.0], [-0.42, -0.10, 0.05], 0.065),
    Limb([0.24, 0.50, 0.0], [0.42, -0.10, 0.05], 0.065),
    Limb([-0.12, -0.15, 0.0], [-0.15, -0.85, 0.0], 0.095),
    Limb([0.12, -0.15, 0.0], [0.15, -0.85, 0.0], 0.095),
];

impl Limb {
    fn axis(&self) -> ([f64; 3], f64) {
        let d: [f64; 3] = std::array::from_fn(|k| self.1[k] - self.0[k]);
        let length = d.iter().map(|x| x * x).sum::<f64>().sqrt();
        (d.map(|x| x / length), length)
    }

    fn area(&self) -> f64 {
        let Limb(_, _, r) = self;
        std::f64::consts::TAU * r * self.axis().1 + 2.0 * std::f64::consts::TAU * r * r
    }

    /// A point of the surface and the normal there, evenly spread.
    fn sample(&self, random: &mut Random) -> ([f64; 3], [f64; 3]) {
        let Limb(from, to, radius) = self;
        let (axis, length) = self.axis();
        let y = 2.0 * random.next() - 1.0;
        let (sin, cos) = (random.next() * std::f64::consts::TAU).sin_cos();
        let ring = (1.0 - y * y).sqrt();
        let mut normal = [cos * ring, y, sin * ring];
        let along: f64 = (0..3).map(|k| normal[k] * axis[k]).sum();
        let caps = 2.0 * radius / (length + 2.0 * radius);
        let start = if random.next() < caps {
            if along > 0.0 { *to } else { *from }
        } else {
            let side: [f64; 3] = std::array::from_fn(|k| normal[k] - along * axis[k]);
            let norm = side.iter().map(|x| x * x).sum::<f64>().sqrt();
            normal = side.map(|x| x / norm);
            let t = random.next() * length;
            std::array::from_fn(|k| from[k] + t * axis[k])
        };
        (std::array::from_fn(|k| start[k] + radius * normal[k]), normal)
    }
}

/// The `first` of `count` discs of σ = 0.4, 0.9 and 1.1 voxels on a body, in Morton order; the voxels' edge goes with
/// the density.
fn body(count: usize, first: usize) -> Gaussians {
    let mut random = Random(1);
    let total: f64 = BODY.iter().map(Limb::area).sum();
    let voxel = 2.0 / 512.0 * (236_000.0 / count as f64).sqrt();
    let mut splats = Vec::with_capacity(count);
    for (i, limb) in BODY.iter().enumerate() {
        let share = (count as f64 * limb.area() / total) as usize;
        let share = if i + 1 == BODY.len() {
            count - splats.len()
        } else {
            share
        };
        for _ in 0..share {
            let (point, normal) = limb.sample(&mut random);
            let point = point.map(|x| ((x + 1.0) / voxel).floor() * voxel + 0.5 * voxel - 1.0);
            let offset: [f64; 3] = std::array::from_fn(|_| (random.next() - 0.5) * voxel);
            let point: [f64; 3] = std::array::from_fn(|k| point[k] + offset[k]);
            let morton = point.map(|x| ((x + 1.0) / 2.0 * 2048.0).clamp(0.0, 2047.0) as u64);
            let key = (0..11).fold(0, |key, bit| {
                (0..3).fold(key, |key, k| key | (morton[k] >> bit & 1) << (3 * bit + k as u64))
            });
            let shade: [f32; 3] = std::array::from_fn(|k| (0.5 + 0.4 * normal[k] + 0.1 * random.next()) as f32);
            splats.push((key, point.map(|x| x as f32), facing(normal), shade));
        }
    }
    splats.sort_unstable_by_key(|s| s.0);
    splats.truncate(first);
    let mut scene = Gaussians::default();
    for (_, point, rotation, colour) in splats {
        scene.position.push(point);
        scene.scale.push([0.9, 1.1, 0.4].map(|s| (s * voxel) as f32));
        scene.rotation.push(rotation);
        scene.opacity.push(1.0);
        scene.colour.push(colour);
    }
    scene
}

/// Splats of all shapes, σ around 5 thousandths, anywhere in the cube.
fn room(count: usize) -> Gaussians {
    let mut random = Random(2);
    let mut scene = Gaussians::default();
    for _ in 0..count {
        let mut cube = || std::array::from_fn(|_| (2.0 * random.next() - 1.0) as f32);
        scene.position.push(cube());
        let scale: [f32; 3] = cube();
        scene.scale.push(scale.map(|x| 0.005 * (1.5 * x).exp()));
        let [x, y, z]: [f32; 3] = cube();
        scene.rotation.push([0.5, x, y, z]);
        scene.colour.push(cube().map(f32::abs));
        scene.opacity.push(random.next() as f32);
    }
    scene
}

/// The quaternion that turns z into `normal`.
fn facing([x, y, z]: [f64; 3]) -> [f32; 4] {
    let w = 1.0 + z;
    let q = if w > 1e-6 {
        [w, -y, x, 0.0]
    } else {
        [0.0, 1.0, 0.0, 0.0]
    };
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    q.map(|v| (v / norm) as f32)
}

fn measure(
    isa: Isa,
    name: &str,
    (width, height): (u32, u32),
    radius: f64,
    gaussians: &Gaussians,
    quality: Quality,
    turn: f64,
    (what, effects, channel): (&str, Effects, Channel),
) -> Result<()> {
    let mut azimuth = 20.0;
    let mut renderer = Renderer::new().with_isa(isa);
    renderer.set_effects(effects);
    renderer.set_quality(quality);
    let mut image = Image::default();
    let mut frame = || -> Result<(Duration, Stats)> {
        let camera = Camera::orbit(azimuth, 10.0, radius, 45.0, width, height)?;
        azimuth += turn;
        let start = Instant::now();
        let stats = renderer.draw_into(
            gaussians,
            &camera,
            channel,
            Background::WHITE,
            &Limits::unlimited(),
            &mut image,
        )?;
        Ok((start.elapsed(), stats))
    };
    let (first, _) = frame()?;
    let start = Instant::now();
    let mut frames = Vec::new();
    while frames.len() < FRAMES && (start.elapsed() < PATIENCE || frames.len() < 3) {
        frames.push(frame()?);
    }
    frames.sort_by_key(|(time, _)| *time);
    let ms = |t: Duration| t.as_secs_f64() * 1e3;
    let (least, stats) = &frames[0];
    let t = stats.times;
    println!(
        "{:>7} {name:>9}{what}: {:7.2} ms, median {:7.2}, first {:7.2}; project {:6.2}, bin {:6.2}, sort {:6.2}, blend {:6.2}; {} visible, {} pairs",
        isa.to_string(),
        ms(*least),
        ms(frames[frames.len() / 2].0),
        ms(first),
        ms(t.project),
        ms(t.bin),
        ms(t.sort),
        ms(t.blend),
        stats.visible,
        stats.pairs,
    );
    Ok(())
}

/// What is drawn: the plain picture, one without ray-space evaluation too where something crosses the near plane, or
/// one with each effect.
fn variants(forced: bool, within: bool) -> Vec<(&'static str, Effects, Channel)> {
    let none = Effects::default();
    let without_ray_space = none.with(Effect::Near, EffectMode::Off);
    let antialias = none.with(Effect::Antialias, EffectMode::On);
    let order = none.with(Effect::Order, EffectMode::On);
    if forced {
        vec![
            (", antialias", antialias, Channel::Colour),
            (", order", order, Channel::Colour),
            (", harmonics", none, Channel::Colour),
            (", depth", none, Channel::Depth),
            (", normals", none, Channel::Normal),
        ]
    } else if within {
        vec![
            ("", none, Channel::Colour),
            (", no ray space", without_ray_space, Channel::Colour),
        ]
    } else {
        vec![("", none, Channel::Colour)]
    }
}

fn main() -> Result<()> {
    let (mut threads, mut forced, mut turn) = (0, false, 0.0);
    let mut quality = Quality::default();
    let mut isas = Isa::available();
    let mut names = Vec::new();
    let mut args = std::env::args().skip(1).filter(|arg| arg != "--bench");
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--threads" => threads = args.next().and_then(|n| n.parse().ok()).unwrap_or(0),
            "--effects" => forced = true,
            "--turn" => turn = args.next().and_then(|n| n.parse().ok()).unwrap_or(0.0),
            "--quality" => quality = args.next().and_then(|n| n.parse().ok()).unwrap_or_default(),
            "--isa" => isas = args.next().and_then(|n| n.parse().ok()).into_iter().collect(),
            name => names.push(name.to_owned()),
        }
    }
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|e| Error::Usage(e.to_string()))?;
    println!("{} threads", pool.current_num_threads());
    let draw = |name: &str, size, radius, mut gaussians: Gaussians| -> Result<()> {
        for &isa in &isas {
            for variant in variants(forced, radius < 1.0) {
                if variant.0 == ", harmonics" {
                    gaussians.harmonics = Harmonics {
                        count: 15,
                        coefficients: vec![[0.01; 3]; 15 * gaussians.len()],
                    };
                }
                let measure = || measure(isa, name, size, radius, &gaussians, quality, turn, variant);
                pool.install(measure)?;
                gaussians.harmonics = Harmonics::default();
            }
        }
        Ok(())
    };
    for scene in &SCENES {
        if names.is_empty() || names.iter().any(|n| n == scene.name) {
            draw(scene.name, scene.size, 3.0, body(scene.of, scene.count))?;
        }
    }
    let (name, count) = ROOM;
    if names.is_empty() || names.iter().any(|n| n == name) {
        draw(name, (1024, 1024), 0.3, room(count))?;
    }
    for path in names.iter().filter(|name| name.ends_with(".ply")) {
        let bytes = std::fs::read(path).map_err(|source| Error::Io {
            path: path.into(),
            source,
        })?;
        let (gaussians, _) = ply::read(&bytes, &Limits::default())?;
        draw("file", (1024, 1024), 3.0, gaussians)?;
    }
    Ok(())
}
