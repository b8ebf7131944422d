//! Effects that need to know where a splat is in space: ray-space evaluation, an order for each pixel; and whose a
//! pixel is.

use super::effects::with;
use super::*;
use crate::renderer::projection::Bounds;
use crate::renderer::{EffectMode, Effects, Ids};

const WITHOUT_RAY_SPACE: Effects = Effects {
    near: EffectMode::Off,
    ..Effects::AUTO
};
const ORDERED: Effects = Effects {
    order: EffectMode::On,
    ..Effects::AUTO
};

/// Whether something reaches over the near plane, and the picture is close to the reference on every instruction set.
fn assert_evaluated_along_rays(scene: &Gaussians, camera: &Camera) {
    let exact = reference::render(scene, camera, Background::BLACK, Cutoffs::NONE);
    for isa in isas() {
        let (image, stats) = with(scene, camera, isa, Effects::AUTO);
        assert!(stats.effects.near && stats.crossing > 0, "{isa}");
        let (largest, psnr) = difference(&image, &exact);
        assert!(largest <= 2.0 / 255.0 && psnr >= 60.0, "{isa}: {largest} {psnr}");
    }
}

#[test]
fn what_reaches_over_the_near_plane_is_close_to_the_reference() {
    // From among them, with a near plane that many are cut by.
    for (seed, near) in [(1, 0.01), (2, 0.3), (3, 0.8)] {
        let scene = scene(random_splats(seed, 150));
        let mut camera = Camera::orbit(70.0, -20.0, 0.7, 80.0, 60, 50).unwrap();
        camera.near = near;
        for camera in [camera, camera.orthographic(1.0).unwrap()] {
            assert_evaluated_along_rays(&scene, &camera);
        }
    }
}

/// At the near plane, as far beside the view as within it: what isn't looked at has to be what isn't seen.
#[test]
fn splats_all_along_the_near_plane_are_close_to_the_reference() {
    for (seed, size, spread) in [(1, 0.003, 0.6), (2, 0.03, 1.5), (3, 0.3, 5.0)] {
        let mut random = Random(seed);
        let mut camera = straight(40.0, 60, 50);
        camera.near = 0.2;
        [camera.cx, camera.cy] = [-20.0, 70.0];
        let splat = |_| {
            let [x, y, z] = [spread, spread, 4.0 * size].map(|most| random.within(-most, most));
            let [width, depth] = [random.within(0.1, 1.0), random.within(0.1, 2.0)];
            Splat {
                position: [x, y, 0.2 + z],
                scale: [size * width, size, size * depth],
                rotation: random.rotation(),
                opacity: random.next(),
                colour: random.colour(),
            }
        };
        let scene = scene((0..800).map(splat).collect::<Vec<_>>());
        for camera in [camera, camera.orthographic(1.0).unwrap()] {
            assert_evaluated_along_rays(&scene, &camera);
        }
    }
}

#[test]
fn what_reaches_over_the_near_plane_beside_the_picture_is_looked_at_nowhere() {
    let beside = |i: usize| Splat {
        position: [[5.0, 0.0, 0.25], [-5.0, 0.0, 0.25], [0.0, 5.0, 0.25], [0.0, -5.0, 0.25]][i % 4],
        ..RED
    };
    let mut camera = straight(30.0, 64, 64);
    camera.near = 0.25;
    for camera in [camera, camera.orthographic(1.0).unwrap()] {
        for isa in isas() {
            let (image, stats) = with(&scene((0..100).map(beside)), &camera, isa, Effects::AUTO);
            assert_eq!(
                (stats.pairs, stats.crossing, stats.dropped.outside),
                (0, 0, 100),
                "{isa}"
            );
            assert!(!stats.effects.near);
            assert!(image.pixels.iter().all(|p| p[..3] == [0.0; 3]));
        }
    }
}

#[test]
fn walking_through_a_splat_changes_the_picture_little_by_little() {
    let splat = Splat {
        position: [0.1, 0.05, 0.0],
        scale: [0.3, 0.2, 0.25],
        opacity: 0.8,
        ..RED
    };
    let mut camera = straight(30.0, 32, 24);
    for isa in isas() {
        let mut last: Option<Image> = None;
        for step in 0..240 {
            // Up to the splat, through it, and on.
            camera.pose.translation.z = 0.75 - f64::from(step) * 0.006;
            let image = with(&scene([splat]), &camera, isa, Effects::AUTO).0;
            if let Some(last) = last {
                let (largest, _) = difference(&last, &image);
                assert!(largest < 0.03, "{isa} {step}: {largest}");
            }
            last = Some(image);
        }
        let seen = last.unwrap().pixels.iter().any(|p| p[0] > 0.02);
        assert!(!seen, "{isa}: behind the camera there is nothing");
    }
}

#[test]
fn where_nothing_reaches_over_the_near_plane_ray_space_changes_no_bit() {
    let scene = scene(random_splats(4, 300));
    let camera = orbit(75, 50);
    for isa in isas() {
        let (without, _) = with(&scene, &camera, isa, WITHOUT_RAY_SPACE);
        for choice in [EffectMode::Auto, EffectMode::On] {
            let effects = Effects {
                near: choice,
                ..Effects::AUTO
            };
            let (image, stats) = with(&scene, &camera, isa, effects);
            assert!(image == without && !stats.effects.near);
        }
    }
}

/// Two discs that cut through each other, a slanted one in front of both, and many overlapping splats of all shapes.
#[test]
fn with_an_order_for_each_pixel_pictures_are_close_to_the_reference() {
    let exact = Cutoffs {
        ordered: true,
        ..Cutoffs::NONE
    };
    let disc = |z: f32, turn: f32, colour| Splat {
        position: [0.0, 0.0, z],
        scale: [0.5, 0.5, 0.002],
        rotation: [(turn / 2.0).cos(), 0.0, (turn / 2.0).sin(), 0.0],
        opacity: 0.9,
        colour,
    };
    let crossed = vec![
        disc(0.0, 0.7, [1.0, 0.0, 0.0]),
        disc(0.001, -0.7, [0.0, 1.0, 0.0]),
        disc(0.3, 1.2, [0.0, 0.0, 1.0]),
    ];
    // Blur apart, few enough lie behind each other to be told apart.
    let overlapping = random_splats(5, 100);
    for (splats, differs) in [(crossed, 0.3), (overlapping, 0.003)] {
        let scene = scene(splats);
        let camera = Camera::orbit(10.0, 5.0, 3.0, 45.0, 75, 50).unwrap();
        let by_pixel = reference::render(&scene, &camera, Background::BLACK, exact);
        let by_centre = reference::render(&scene, &camera, Background::BLACK, Cutoffs::NONE);
        assert!(difference(&by_pixel, &by_centre).0 > differs);
        for isa in isas() {
            let (image, stats) = with(&scene, &camera, isa, ORDERED);
            assert!(stats.effects.order);
            let (largest, psnr) = difference(&image, &by_pixel);
            assert!(largest <= 2.0 / 255.0 && psnr >= 60.0, "{isa}: {largest} {psnr}");
        }
    }
}

#[test]
fn where_depths_do_not_interleave_an_order_for_each_pixel_changes_little() {
    let layer = |i: usize| Splat {
        position: [0.0, 0.0, 1.0 + i as f32 * 0.05],
        scale: [1.0, 1.0, 0.0],
        opacity: 0.2,
        colour: [(i % 3) as f32 / 2.0, (i % 5) as f32 / 4.0, 0.5],
        ..RED
    };
    let scene = scene((0..60).map(layer));
    let camera = straight(40.0, 40, 30);
    for isa in isas() {
        let [off, on] = [Effects::AUTO, ORDERED].map(|effects| with(&scene, &camera, isa, effects).0);
        assert!(difference(&off, &on).0 < 1e-5, "{isa}");
    }
}

#[test]
fn a_pixel_s_number_is_that_of_the_gaussian_that_it_shows_most_of() {
    let wall = |z: f32, opacity, colour| Splat {
        position: [0.0, 0.0, z],
        scale: [9.0, 9.0, 0.01],
        opacity,
        colour,
        ..RED
    };
    let spot = Splat {
        position: [0.0, 0.0, 1.0],
        scale: [0.02; 3],
        ..RED
    };
    let scene = scene([wall(3.0, 0.9, [0.0, 1.0, 0.0]), wall(2.0, 0.3, [0.0, 0.0, 1.0]), spot]);
    let camera = straight(100.0, 40, 33);
    for isa in isas() {
        let mut ids = Ids::default();
        let limits = Limits::default();
        let stats = Renderer::new()
            .with_isa(isa)
            .ids_into(&scene, &camera, &limits, &mut ids)
            .unwrap();
        assert_eq!((ids.width, ids.height, stats.touched), (40, 33, 40 * 33));
        // Through the faint wall one sees mostly the one behind, and the spot is before both.
        assert_eq!(ids.indices[16 * 40 + 20], 2, "{isa}");
        assert_eq!(ids.indices[0], 0, "{isa}");

        let nothing = Gaussians::default();
        Renderer::new()
            .with_isa(isa)
            .ids_into(&nothing, &camera, &limits, &mut ids)
            .unwrap();
        assert!(ids.indices.iter().all(|id| *id == u32::MAX));
    }
}

#[test]
fn numbers_are_mixed_as_colours_are() {
    let splats = random_splats(9, 300);
    // From a distance, and from among them, where some reach over the near plane.
    for (distance, crossing) in [(4.0, false), (0.7, true)] {
        let camera = Camera::orbit(20.0, 10.0, distance, 50.0, 70, 45).unwrap();
        let part = Bounds {
            x0: 5,
            y0: 7,
            x1: 61,
            y1: 42,
        };
        let crop = camera.crop(part).unwrap();
        let both = |isa| [(isa, camera), (isa, crop)];
        for (isa, camera) in isas().into_iter().flat_map(both) {
            let scene = scene(splats.clone());
            let mut renderer = Renderer::new().with_isa(isa).with_background(Background::Transparent);
            let (limits, mut image) = (Limits::default(), Image::default());
            let stats = renderer.render_into(&scene, &camera, &mut image);
            assert_eq!(stats.unwrap().crossing > 0, crossing);
            let numbers = |i: usize| {
                let [r, g, b] = scene.colour[i];
                [1.0, b, g, r, 0.0]
            };
            let mut mixed = Vec::new();
            renderer
                .mix_into(&scene, &camera, numbers, &limits, &mut mixed)
                .unwrap();
            assert_eq!(mixed.len(), image.pixels.len());
            for ([one, b, g, r, nothing], want) in mixed.into_iter().zip(&image.pixels) {
                assert_eq!(nothing, 0.0);
                for (x, want) in [r, g, b, one].into_iter().zip(want) {
                    assert!((x - want).abs() < 1e-5, "{isa}: {x} instead of {want}");
                }
            }
        }
    }
}

#[test]
fn numbers_are_mixed_the_same_with_any_number_of_threads() {
    let scene = scene(random_splats(5, 3000));
    let camera = orbit(150, 130);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        let mut mixed = Vec::new();
        let numbers = |i: usize| [i as f32, 1.0];
        let mix = || Renderer::default().mix_into(&scene, &camera, numbers, &Limits::default(), &mut mixed);
        pool.build().unwrap().install(mix).unwrap();
        mixed
    };
    assert!(with(1) == with(3));
}

#[test]
fn gathering_is_the_transpose_of_mixing() {
    let splats = random_splats(9, 300);
    for distance in [4.0, 0.7] {
        let camera = Camera::orbit(20.0, 10.0, distance, 50.0, 70, 45).unwrap();
        let part = Bounds {
            x0: 5,
            y0: 7,
            x1: 61,
            y1: 42,
        };
        let crop = camera.crop(part).unwrap();
        let both = |isa| [(isa, camera), (isa, crop)];
        for (isa, camera) in isas().into_iter().flat_map(both) {
            let scene = scene(splats.clone());
            let (limits, mut renderer) = (Limits::default(), Renderer::new().with_isa(isa));
            // ⟨mixed x, y⟩ = ⟨x, gathered y⟩
            let x = |i: usize| [(i % 7) as f32 - 3.0];
            let mut mixed = Vec::new();
            renderer.mix_into(&scene, &camera, x, &limits, &mut mixed).unwrap();
            let y: Vec<[f32; 1]> = (0..mixed.len()).map(|i| [(i % 11) as f32 - 4.0]).collect();
            let left: f64 = mixed.iter().zip(&y).map(|(a, b)| f64::from(a[0] * b[0])).sum();
            let right = std::sync::Mutex::new(0.0);
            let add = |i: usize, [sum]: [f32; 1]| *right.lock().unwrap() += f64::from(x(i)[0] * sum);
            renderer.gather(&scene, &camera, &y, &limits, add).unwrap();
            let right = right.into_inner().unwrap();
            assert!(
                left != 0.0 && (left - right).abs() < 1e-4 * left.abs(),
                "{isa}: {left} and {right}"
            );
            let few = renderer.gather(&scene, &camera, &y[1..], &limits, |_, _| ());
            assert!(matches!(few, Err(crate::Error::Usage(_))));
        }
    }
}
