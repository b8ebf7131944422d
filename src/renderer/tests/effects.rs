//! What effects change, and what they leave alone.

use super::*;
use crate::gaussians::Harmonics;
use crate::renderer::{Channel, EffectMode, Effects};

pub(super) fn with(scene: &Gaussians, camera: &Camera, isa: Isa, effects: Effects) -> (Image, Stats) {
    let renderer = Renderer::new().with_isa(isa).with_effects(effects);
    let renderer = renderer.with_quality(Quality::Fine).with_background(Background::BLACK);
    drawn(renderer, scene, camera)
}

pub(super) const ANTIALIAS: Effects = Effects {
    antialias: EffectMode::On,
    supersample: EffectMode::Off,
    ..Effects::AUTO
};

#[test]
fn with_opacity_compensation_pictures_are_close_to_the_reference() {
    let cutoffs = Cutoffs {
        compensated: true,
        ..Cutoffs::NONE
    };
    for (seed, radius) in [(1, 3.0), (2, 20.0), (3, 0.8)] {
        let scene = scene(random_splats(seed, 200));
        let camera = Camera::orbit(30.0, 10.0, radius, 45.0, 75, 50).unwrap();
        let exact = reference::render(&scene, &camera, Background::BLACK, cutoffs);
        for isa in isas() {
            let (image, stats) = with(&scene, &camera, isa, ANTIALIAS);
            assert!(stats.effects.antialias);
            let (largest, psnr) = difference(&image, &exact);
            assert!(largest <= 2.0 / 255.0 && psnr >= 60.0, "{isa}: {largest} {psnr}");
        }
    }
}

#[test]
fn effects_that_are_not_called_for_change_no_pixel_when_forced_either_way() {
    // No harmonics to switch off or on, and a stream's Gaussians call for no compensation.
    let scene = scene(random_splats(4, 300));
    let camera = orbit(75, 50);
    let (plain, _) = with(&scene, &camera, Isa::detect(), Effects::default());
    for harmonics in [EffectMode::On, EffectMode::Off] {
        let forced = Effects {
            harmonics,
            antialias: EffectMode::Off,
            ..Effects::default()
        };
        let (image, stats) = with(&scene, &camera, Isa::detect(), forced);
        assert!(image == plain && !stats.effects.harmonics);
    }
}

#[test]
fn where_splats_are_much_larger_than_pixels_compensation_changes_next_to_nothing() {
    let scene = scene(
        random_splats(5, 100)
            .into_iter()
            .map(|s| Splat { scale: [0.3; 3], ..s }),
    );
    let camera = orbit(300, 200);
    let (off, _) = with(&scene, &camera, Isa::detect(), Effects::default());
    let (on, _) = with(&scene, &camera, Isa::detect(), ANTIALIAS);
    assert!(difference(&off, &on).0 < 2.0 / 255.0);
}

#[test]
fn harmonics_turn_the_colour_with_the_view_and_can_be_switched_off() {
    let mut one = scene([WHITE]);
    one.colour = vec![[0.5; 3]];
    // Red grows towards −y of the direction, green towards z, blue towards −x.
    one.harmonics = Harmonics {
        count: 3,
        coefficients: vec![[0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.5]],
    };
    let middle = |azimuth: f64, elevation: f64, effects| {
        let camera = Camera::orbit(azimuth, elevation, 3.0, 45.0, 33, 33).unwrap();
        with(&one, &camera, Isa::detect(), effects).0.pixel(16, 16)
    };
    let add = 0.5 * 0.488_602_5 * 0.99;
    let half = 0.5 * 0.99;
    // From the front one looks along −z, from above along −y.
    for ((azimuth, elevation), expected) in [
        ((0.0, 0.0), [half, half - add, half]),
        ((90.0, 0.0), [half, half, half + add]),
        ((0.0, 90.0), [half + add, half, half]),
    ] {
        let seen = middle(azimuth, elevation, Effects::default());
        for k in 0..3 {
            assert!((seen[k] - expected[k]).abs() < 1e-3, "{azimuth} {elevation}: {seen:?}");
        }
        let off = Effects {
            harmonics: EffectMode::Off,
            ..Effects::default()
        };
        assert!((middle(azimuth, elevation, off)[0] - half).abs() < 1e-3);
    }
}

#[test]
fn harmonics_that_are_not_finite_drop_their_gaussian() {
    let mut one = scene([WHITE, RED]);
    one.harmonics = Harmonics {
        count: 3,
        coefficients: vec![[0.0; 3]; 6],
    };
    one.harmonics.coefficients[4][1] = f32::NAN;
    let (_, stats) = draw_on(&one, &orbit(20, 20), Background::BLACK);
    assert_eq!((stats.visible, stats.dropped.not_finite), (1, 1));
    one.harmonics.coefficients.pop();
    let result = render(&one, &orbit(20, 20), Background::BLACK, &Limits::default());
    assert!(result.is_err());
}

#[test]
fn parallel_rays_are_close_to_the_reference_and_do_not_shrink_what_is_far() {
    let scene = scene(random_splats(6, 200));
    let camera = orbit(75, 50).orthographic(3.0).unwrap();
    assert_close(&scene, &camera);
    let width = |z: f32| {
        let splat = Splat {
            position: [0.0, 0.0, z],
            scale: [0.1; 3],
            ..RED
        };
        let camera = straight(60.0, 60, 60).orthographic(3.0).unwrap();
        let (image, _) = draw_on(&super::scene([splat]), &camera, Background::Transparent);
        image.pixels.iter().filter(|p| p[3] > 0.0).count()
    };
    assert_eq!(width(1.0), width(9.0));
}

#[test]
fn depth_and_normals_are_those_of_what_is_seen() {
    let disc = |z: f32, turn: f32| Splat {
        position: [0.0, 0.0, z],
        scale: [3.0, 3.0, 0.001],
        rotation: [(turn / 2.0).cos(), 0.0, (turn / 2.0).sin(), 0.0],
        ..RED
    };
    let scene = scene([disc(5.0, 0.0), disc(2.0, 0.5)]);
    let camera = straight(40.0, 31, 31);
    let middle = |channel| {
        let mut image = Image::default();
        let (background, limits) = (Background::Transparent, Limits::default());
        Renderer::default()
            .draw_into(&scene, &camera, channel, background, &limits, &mut image)
            .unwrap();
        image.pixel(15, 15)
    };
    let [depth, _, _, alpha] = middle(Channel::Depth);
    assert!((depth / alpha - 2.03).abs() < 0.01, "{depth} {alpha}");
    let [x, y, z, alpha] = middle(Channel::Normal);
    let normal = [x, y, z].map(|c| c / alpha * 2.0 - 1.0);
    // Turned around y by half a radian, and towards the eye.
    let expected = [-(0.5f32.sin()), 0.0, -(0.5f32.cos())];
    for k in 0..3 {
        assert!((normal[k] - expected[k]).abs() < 0.03, "{normal:?}");
    }
}
