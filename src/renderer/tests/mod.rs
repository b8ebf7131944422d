//! The renderer's behaviour, seen from outside.

mod accuracy;
mod effects;
mod hard_cases;
mod invariance;
mod space;

use b2p_kernels::Isa;
use glam::{DAffine3, DMat3};

use super::reference::{self, Cutoffs};
use super::{Background, Image, Quality, Renderer, Stats, render};
use crate::gaussians::Gaussians;
use crate::limits::Limits;
use crate::renderer::camera::Camera;

/// A small generator of numbers in `[0, 1)` that needs no quality, only variety.
pub(super) struct Random(pub u64);

impl Random {
    fn next(&mut self) -> f32 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1u32 << 24) as f32
    }

    fn within(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.next()
    }

    fn rotation(&mut self) -> [f32; 4] {
        std::array::from_fn(|_| self.within(-1.0, 1.0))
    }

    fn colour(&mut self) -> [f32; 3] {
        std::array::from_fn(|_| self.next())
    }
}

/// One Gaussian; the tests override what they are about.
#[derive(Clone, Copy)]
pub(super) struct Splat {
    position: [f32; 3],
    scale: [f32; 3],
    rotation: [f32; 4],
    opacity: f32,
    colour: [f32; 3],
}

const RED: Splat = Splat {
    position: [0.0; 3],
    scale: [0.2; 3],
    rotation: [1.0, 0.0, 0.0, 0.0],
    opacity: 1.0,
    colour: [1.0, 0.0, 0.0],
};
const WHITE: Splat = Splat {
    colour: [1.0; 3],
    ..RED
};

fn scene(splats: impl IntoIterator<Item = Splat>) -> Gaussians {
    let mut scene = Gaussians::default();
    for s in splats {
        scene.position.push(s.position);
        scene.scale.push(s.scale);
        scene.rotation.push(s.rotation);
        scene.opacity.push(s.opacity);
        scene.colour.push(s.colour);
    }
    scene
}

/// Splats of all shapes anywhere in the cube.
fn random_splats(seed: u64, count: usize) -> Vec<Splat> {
    let mut random = Random(seed);
    let splat = |_| Splat {
        position: std::array::from_fn(|_| random.within(-1.0, 1.0)),
        scale: std::array::from_fn(|_| 10f32.powf(random.within(-3.0, -0.7))),
        rotation: random.rotation(),
        opacity: random.next(),
        colour: random.colour(),
    };
    (0..count).map(splat).collect()
}

/// Small opaque splats on a sphere, as a decoder makes them.
fn surface_splats(count: usize, radius: f32, sigma: f32) -> Vec<Splat> {
    let golden = std::f32::consts::PI * (3.0 - 5f32.sqrt());
    let splat = |i| {
        let y = 1.0 - 2.0 * (i as f32 + 0.5) / count as f32;
        let (sin, cos) = (golden * i as f32).sin_cos();
        let ring = (1.0 - y * y).sqrt();
        let normal = [cos * ring, y, sin * ring];
        Splat {
            position: normal.map(|x| x * radius),
            scale: [sigma; 3],
            colour: normal.map(|x| 0.5 + 0.5 * x),
            ..RED
        }
    };
    (0..count).map(splat).collect()
}

fn orbit(width: u32, height: u32) -> Camera {
    Camera::orbit(30.0, 10.0, 3.0, 45.0, width, height).unwrap()
}

/// A camera at the origin of the cube frame that looks along +z, with its principal point in the middle.
fn straight(focal: f64, width: u32, height: u32) -> Camera {
    Camera::centred(DAffine3::IDENTITY, focal, width, height)
}

fn draw(scene: &Gaussians, camera: &Camera) -> Image {
    draw_on(scene, camera, Background::WHITE).0
}

/// Every instruction set that the processor has and drawing is compiled for; fails if one of them would not be run.
fn isas() -> Vec<Isa> {
    let mut isas = Isa::available();
    // Drawing has no use for matrix tiles, nor for sums of integers' products.
    isas.retain(|isa| !isa.has_tiles() && !["avxvnni", "dotprod"].contains(&&*isa.to_string()));
    let names: Vec<String> = isas.iter().map(Isa::to_string).collect();
    #[allow(unused_mut)]
    let mut expected = vec!["scalar"];
    #[cfg(target_arch = "x86_64")]
    {
        expected.extend(is_x86_feature_detected!("avx2").then_some("avx2"));
        expected.extend(is_x86_feature_detected!("avx512vnni").then_some("avx512"));
    }
    #[cfg(target_arch = "aarch64")]
    expected.extend(std::arch::is_aarch64_feature_detected!("neon").then_some("neon"));
    assert_eq!(names, expected, "the sets that are run, and those that there are");
    isas
}

/// A picture, and what it took.
fn drawn(mut renderer: Renderer, scene: &Gaussians, camera: &Camera) -> (Image, Stats) {
    let mut image = Image::default();
    let stats = renderer.render_into(scene, camera, &mut image).unwrap();
    (image, stats)
}

/// With the best instructions; the picture on every other set is held to it, and the counts are.
fn draw_on(scene: &Gaussians, camera: &Camera, background: Background) -> (Image, Stats) {
    let on = |isa| drawn(Renderer::new().with_isa(isa).with_background(background), scene, camera);
    let (image, stats) = on(Isa::detect());
    let peak = colours(scene);
    for isa in isas() {
        let (other, counts) = on(isa);
        let (largest, psnr) = difference(&image, &other);
        assert!(
            largest <= 1.0 / 255.0 * peak && psnr + 20.0 * f64::from(peak).log10() >= 60.0,
            "{isa}: {:.3}/255, {psnr:.1} dB",
            largest * 255.0
        );
        assert!(
            counts.visible.abs_diff(stats.visible) <= 1 + stats.visible / 1000,
            "{isa}"
        );
    }
    (image, stats)
}

/// The largest colour of what is drawn, at least 1.
fn colours(scene: &Gaussians) -> f32 {
    let finite = scene.colour.as_flattened().iter().filter(|c| c.is_finite());
    finite.fold(1.0, |largest, c| largest.max(c.abs()))
}

/// The largest difference of a channel, and the peak signal to noise ratio of all in dB.
fn difference(a: &Image, b: &Image) -> (f32, f64) {
    assert_eq!((a.width, a.height), (b.width, b.height));
    let (a, b) = (a.pixels.as_flattened(), b.pixels.as_flattened());
    let mut largest = 0.0f32;
    let mut squares = 0.0;
    for (x, y) in a.iter().zip(b) {
        assert!(x.is_finite() && y.is_finite());
        largest = largest.max((x - y).abs());
        squares += f64::from(x - y).powi(2);
    }
    (largest, -10.0 * (squares / a.len() as f64).log10())
}

/// Whether the renderer keeps what it promises of fine quality on every instruction set: at most 2/255 off anywhere,
/// and 60 dB, from the reference.
fn assert_close(scene: &Gaussians, camera: &Camera) {
    assert_close_in(Quality::Fine, scene, camera);
}

/// The same of any quality.
fn assert_close_in(quality: Quality, scene: &Gaussians, camera: &Camera) {
    for background in [Background::WHITE, Background::Transparent] {
        let exact = reference::render(scene, camera, background, Cutoffs::NONE);
        for isa in isas() {
            let renderer = Renderer::new().with_isa(isa).with_quality(quality);
            let (image, _) = drawn(renderer.with_background(background), scene, camera);
            let (largest, psnr) = difference(&image, &exact);
            assert!(
                largest <= 2.0 / 255.0 && psnr >= 60.0,
                "{isa}: {:.3}/255, {psnr:.1} dB",
                largest * 255.0
            );
        }
    }
}
