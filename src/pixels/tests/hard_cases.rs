//! Splats, cameras and sizes that have broken renderers.

use super::*;
use crate::error::Error;

/// A splat two units in front of a camera at the origin that looks along +z.
const AHEAD: Splat = Splat {
    position: [0.0, 0.0, 2.0],
    ..RED
};

/// σ in cube-frame units of a splat at [`AHEAD`] that is `pixels` wide under focal length `focal`.
fn sigma(pixels: f32, focal: f64) -> f32 {
    pixels * 2.0 / focal as f32
}

/// A turn around the viewing axis.
fn turned(degrees: f32) -> [f32; 4] {
    let (sin, cos) = (degrees.to_radians() / 2.0).sin_cos();
    [cos, 0.0, 0.0, sin]
}

fn visible(splat: Splat, camera: &Camera) -> bool {
    draw_on(&scene([splat]), camera, Background::WHITE)
        .1
        .visible
        == 1
}

#[test]
fn what_is_not_finite_is_dropped_and_counted() {
    let camera = orbit(20, 20);
    for poison in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for field in 0..5 {
            let mut splat = RED;
            match field {
                0 => splat.position[1] = poison,
                1 => splat.scale[2] = poison,
                2 => splat.rotation[0] = poison,
                3 => splat.opacity = poison,
                _ => splat.colour[1] = poison,
            }
            let (image, stats) = draw_on(&scene([splat]), &camera, Background::WHITE);
            assert_eq!((stats.visible, stats.dropped.not_finite), (0, 1));
            assert!(image.pixels.iter().all(|p| *p == [1.0; 4]));
        }
    }
}

#[test]
fn a_quaternion_of_any_length_is_normalised_and_none_is_dropped() {
    let camera = orbit(40, 40);
    let splat = Splat {
        scale: [0.3, 0.05, 0.1],
        rotation: [0.5, -0.5, 0.5, 0.5],
        ..RED
    };
    let unit = draw(&scene([splat]), &camera);
    for length in [1e-30, 1e-3, 7.0, 1e30] {
        let rotation = splat.rotation.map(|x| x * length);
        let long = draw(&scene([Splat { rotation, ..splat }]), &camera);
        assert!(difference(&unit, &long).0 < 1e-5);
    }
    let rotation = [0.0, -0.0, 0.0, 0.0];
    let (_, stats) = draw_on(
        &scene([Splat { rotation, ..splat }]),
        &camera,
        Background::WHITE,
    );
    assert_eq!(stats.dropped.no_rotation, 1);
}

#[test]
fn flat_thin_and_pointlike_splats_are_drawn_at_least_as_wide_as_the_pixels_blur() {
    let camera = orbit(45, 45);
    for scale in [[0.3, 0.3, 0.0], [0.3, 0.0, 0.0], [0.0; 3]] {
        for seed in 0..8 {
            let splat = Splat {
                scale,
                rotation: Random(seed).rotation(),
                ..RED
            };
            assert!(visible(splat, &camera));
            assert_close(&scene([splat]), &camera);
        }
    }
}

#[test]
fn a_disc_seen_from_its_edge_is_a_line_of_the_pixels_blur() {
    let focal = 100.0;
    let camera = straight(focal, 41, 41);
    let disc = Splat {
        scale: [sigma(9.0, focal), 0.0, sigma(9.0, focal)],
        ..AHEAD
    };
    assert_close(&scene([disc]), &camera);
    let (image, _) = draw_on(&scene([disc]), &camera, Background::Transparent);
    let column: f32 = (0..41).map(|y| image.pixel(20, y)[3]).sum();
    let blur = (2.0 * std::f32::consts::PI * 0.3).sqrt();
    assert!((column / blur - 1.0).abs() < 0.05, "{column} {blur}");
}

#[test]
fn a_needle_keeps_its_shape_at_any_angle() {
    let focal = 1000.0;
    let camera = straight(focal, 150, 130);
    for degrees in [0.0, 0.01, 30.0, 44.9, 45.0, 60.0, 90.0, 135.0] {
        for (x, y) in [(0.0, 0.0), (-3.0, -3.0)] {
            let needle = Splat {
                position: [x, y, 2.0],
                scale: [sigma(3000.0, focal), sigma(0.1, focal), sigma(0.1, focal)],
                rotation: turned(degrees),
                ..RED
            };
            let scene = scene([needle]);
            assert_close(&scene, &camera);
        }
    }
}

#[test]
fn circles_and_axis_aligned_ellipses_need_no_special_care() {
    let camera = straight(100.0, 50, 40);
    for (x, y) in [(5.0, 5.0), (9.0, 2.0), (2.0, 9.0)] {
        let splat = Splat {
            scale: [sigma(x, 100.0), sigma(y, 100.0), 0.01],
            ..AHEAD
        };
        assert_close(&scene([splat]), &camera);
    }
}

#[test]
fn a_splat_is_drawn_when_its_centre_is_beyond_the_near_plane() {
    let mut camera = straight(50.0, 20, 20);
    camera.near = 0.25;
    let at = |z: f32| Splat {
        position: [0.0, 0.0, z],
        scale: [0.01; 3],
        ..RED
    };
    assert!(!visible(at(0.0), &camera));
    assert!(!visible(at(-2.0), &camera));
    assert!(!visible(at(0.25f32.next_down()), &camera));
    assert!(!visible(at(0.25), &camera));
    assert!(visible(at(0.25f32.next_up()), &camera));
}

#[test]
fn a_splat_behind_that_reaches_over_the_near_plane_is_not_mirrored_into_view() {
    let camera = straight(50.0, 20, 20);
    let splat = Splat {
        position: [0.3, 0.2, -0.1],
        scale: [3.0; 3],
        ..RED
    };
    let (image, stats) = draw_on(&scene([splat]), &camera, Background::WHITE);
    assert_eq!(stats.dropped.behind, 1);
    assert!(image.pixels.iter().all(|p| *p == [1.0; 4]));
}

#[test]
fn a_splat_beside_the_view_fades_out_without_a_jump_as_the_camera_turns() {
    let mut previous: Option<Image> = None;
    let splat = Splat {
        position: [0.0, 0.0, 1.0],
        scale: [0.6, 0.6, 0.6],
        ..RED
    };
    let mut camera = straight(40.0, 40, 30);
    let mut drawn = 0;
    for step in 0..170 {
        let angle = f64::from(step) * 0.5f64.to_radians();
        camera.pose.matrix3 = DMat3::from_rotation_y(angle);
        let (image, stats) = draw_on(&scene([splat]), &camera, Background::WHITE);
        drawn += stats.visible;
        if let Some(previous) = previous {
            let (largest, _) = difference(&previous, &image);
            assert!(largest < 0.1, "{step}: {largest}");
        }
        previous = Some(image);
    }
    assert!(drawn > 60);
}

#[test]
fn a_principal_point_outside_the_picture_flips_nothing() {
    let scene = scene(random_splats(11, 120).into_iter().map(|s| Splat {
        position: [s.position[0] * 3.0, s.position[1], s.position[2] + 3.0],
        ..s
    }));
    for cx in [-70.0, -20.0, 60.0, 130.0] {
        let mut camera = straight(60.0, 40, 30);
        camera.cx = cx;
        assert_close(&scene, &camera);
    }
}

#[test]
fn an_enormous_splat_is_a_constant_colour() {
    let camera = straight(500.0, 64, 48);
    for scale in [[4.85e8; 3], [f32::MAX; 3], [f32::MAX, f32::MAX, 0.0]] {
        let splat = Splat { scale, ..AHEAD };
        for pixel in draw_on(&scene([splat]), &camera, Background::BLACK)
            .0
            .pixels
        {
            assert!((pixel[0] - 0.99).abs() < 1e-5 && pixel[1] == 0.0);
        }
    }
}

#[test]
fn numbers_at_the_ends_of_the_range_draw_finite_pictures() {
    let ends = [f32::MAX, -f32::MAX, f32::MIN_POSITIVE, 1e-45, -0.0, 1e19];
    let mut camera = straight(1e6, 33, 17);
    camera.near = f64::from(f32::MIN_POSITIVE);
    for a in ends {
        for b in ends {
            let splats = [
                Splat {
                    position: [a, 0.0, b],
                    ..RED
                },
                Splat {
                    position: [a, b, 1e-38],
                    scale: [b, a, 1.0],
                    ..RED
                },
                Splat {
                    scale: [a, b, a],
                    rotation: [a, b, 1.0, -a],
                    ..AHEAD
                },
                Splat {
                    colour: [a, b, 0.5],
                    opacity: a,
                    ..AHEAD
                },
            ];
            let image = draw(&scene(splats), &camera);
            assert!(image.to_pixmap().is_ok());
            let finite = |p: &[f32; 4]| p.iter().all(|x| x.is_finite());
            assert!(image.pixels.iter().all(finite), "{a:e} {b:e}");
        }
    }
}

#[test]
fn ten_thousand_splats_that_fill_the_picture_are_drawn_in_bounded_memory() {
    let camera = straight(50.0, 100, 90);
    let wall = |i| Splat {
        position: [0.0, 0.0, 1.0 + i as f32 * 1e-4],
        scale: [30.0; 3],
        opacity: 0.5,
        ..RED
    };
    let scene = scene((0..10_000).map(wall));
    let (image, stats) = draw_on(&scene, &camera, Background::BLACK);
    assert_eq!(stats.pairs, 10_000 * 4 * 3);
    assert!(image.pixels.iter().all(|p| p[0] > 0.999 && p[0] <= 1.0));

    let limits = Limits {
        max_bytes: 1 << 19,
        ..Limits::default()
    };
    let refused = render(&scene, &camera, Background::BLACK, &limits);
    assert!(matches!(refused, Err(Error::LimitExceeded { .. })));
}

#[test]
fn a_hundred_thousand_splats_in_one_pixel_are_drawn_nearest_first() {
    let camera = straight(100.0, 33, 33);
    let count = 100_000;
    let at = |i: usize| Splat {
        position: [0.0, 0.0, 2.0 + i as f32 * 1e-5],
        scale: [1e-4; 3],
        opacity: 0.5,
        colour: if i == 0 {
            [0.0, 1.0, 0.0]
        } else {
            [1.0, 0.0, 0.0]
        },
        ..RED
    };
    // Farthest first.
    let image = draw(&scene((0..count).rev().map(at)), &camera);
    let [r, g, _, _] = image.pixel(16, 16);
    assert!((g - 0.5).abs() < 1e-3 && (r - 0.5).abs() < 1e-3);
}

#[test]
fn a_distant_splat_does_not_disturb_the_order_of_the_near_ones() {
    let near = random_splats(12, 300);
    let camera = orbit(60, 50);
    let alone = draw(&scene(near.clone()), &camera);
    let far = Splat {
        position: [-3e5, 0.0, -1e6],
        scale: [0.1; 3],
        ..RED
    };
    let both = draw(&scene(near.into_iter().chain([far])), &camera);
    // The far one is a dot of the pixels' blur.
    let differ = alone.pixels.iter().zip(&both.pixels);
    assert!(differ.filter(|(a, b)| a != b).count() <= 25);
}

#[test]
fn two_opaque_layers_finish_a_pixel() {
    let camera = straight(50.0, 16, 16);
    let wall = |z: f32, colour| Splat {
        position: [0.0, 0.0, z],
        scale: [50.0; 3],
        colour,
        ..RED
    };
    let scene = scene([
        wall(1.0, [1.0, 0.0, 0.0]),
        wall(1.1, [0.0, 1.0, 0.0]),
        wall(1.2, [0.0, 0.0, 1.0]),
    ]);
    for [r, g, b, alpha] in draw_on(&scene, &camera, Background::Transparent).0.pixels {
        assert!((r - 0.99).abs() < 1e-4 && (g - 0.0099).abs() < 1e-4);
        assert!(b <= 1.01e-4 && alpha <= 1.0 && alpha > 0.9998);
    }
}

#[test]
fn a_thousand_layers_below_the_floor_are_skipped_and_the_reference_says_what_that_costs() {
    let camera = straight(50.0, 8, 8);
    let veil = |i| Splat {
        position: [0.0, 0.0, 1.0 + i as f32 * 1e-4],
        scale: [50.0; 3],
        opacity: 1.0 / 300.0,
        ..RED
    };
    let scene = scene((0..1000).map(veil));
    let (image, stats) = draw_on(&scene, &camera, Background::Transparent);
    assert_eq!(stats.dropped.too_faint, 1000);
    assert!(image.pixels.iter().all(|p| *p == [0.0; 4]));
    let exact = reference::render(&scene, &camera, Background::Transparent, Cutoffs::NONE);
    assert!((exact.pixel(4, 4)[3] - 0.9646).abs() < 1e-3);
}

#[test]
fn colours_out_of_range_are_clamped_once_at_the_end() {
    let camera = straight(50.0, 8, 8);
    let wall = |z: f32, colour| Splat {
        position: [0.0, 0.0, z],
        scale: [50.0; 3],
        opacity: 0.5,
        colour,
        ..RED
    };
    // Half of 1.6 and a quarter of −0.8: clamped each, it would be ½.
    let scene = scene([wall(1.0, [1.6, 1e30, -1e30]), wall(1.1, [-0.8, 0.0, 0.0])]);
    let image = draw_on(&scene, &camera, Background::BLACK).0;
    assert!((image.pixel(4, 4)[0] - 0.6).abs() < 1e-3);
    let pixmap = image.to_pixmap().unwrap();
    assert_eq!(pixmap.data()[..4], [153, 255, 0, 255]);
}

#[test]
fn pictures_of_any_size_are_drawn_to_the_last_pixel() {
    let splats = random_splats(13, 60);
    for (width, height) in [(1, 1), (2, 3), (15, 17), (16, 16), (33, 1), (1, 70)] {
        let mut camera = straight(20.0, width, height);
        camera.pose.translation.z = 2.0;
        assert_close(&scene(splats.clone()), &camera);
    }
}

#[test]
fn a_strip_of_65535_pixels_is_drawn_to_its_ends() {
    for upright in [false, true] {
        let (width, height) = if upright { (1, 65_535) } else { (65_535, 1) };
        let camera = straight(30_000.0, width, height);
        let end = |i: u32| {
            let offset = (i as f32 + 0.5 - 32_767.5) / 30_000.0 * 2.0;
            let (x, y) = if upright {
                (0.0, offset)
            } else {
                (offset, 0.0)
            };
            Splat {
                position: [x, y, 2.0],
                scale: [sigma(1.0, 30_000.0); 3],
                ..RED
            }
        };
        let image = draw(&scene([end(0), end(65_534)]), &camera);
        for pixel in [image.pixels[0], image.pixels[65_534]] {
            assert!(pixel[0] > 0.98 && pixel[1] < 0.05, "{pixel:?}");
        }
        assert_eq!(image.pixels[30_000], [1.0; 4]);
    }
}

#[test]
fn what_cannot_be_drawn_is_an_error() {
    let scene = scene([RED]);
    let limits = Limits::default();
    let mut broken = orbit(8, 8);
    broken.pose.matrix3.x_axis.x = f64::NAN;
    let usage = |camera: &Camera, background| {
        let result = render(&scene, camera, background, &limits);
        assert!(matches!(result, Err(Error::Usage(_))));
    };
    usage(&broken, Background::WHITE);
    usage(&orbit(8, 8), Background::Colour([f32::NAN, 0.0, 0.0]));

    let mut uneven = scene.clone();
    uneven.colour.clear();
    let result = render(&uneven, &orbit(8, 8), Background::WHITE, &limits);
    assert!(matches!(result, Err(Error::Usage(_))));

    let huge = orbit(1 << 15, 1 << 15);
    let result = render(&scene, &huge, Background::WHITE, &limits);
    assert!(matches!(
        result,
        Err(Error::LimitExceeded {
            option: "max_pixels",
            ..
        })
    ));
}

#[test]
fn every_instruction_set_of_the_machine_is_among_those_that_the_tests_run() {
    let ran: Vec<String> = Isa::available().iter().map(Isa::to_string).collect();
    println!("ran on: {}", ran.join(", "));
    #[cfg(target_arch = "x86_64")]
    {
        let avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
        assert!(!avx2 || ran.iter().any(|isa| isa == "avx2"), "{ran:?}");
        let avx512 = avx2 && is_x86_feature_detected!("avx512vnni");
        assert!(!avx512 || ran.iter().any(|isa| isa == "avx512"), "{ran:?}");
    }
    assert!(ran.iter().any(|isa| isa == "scalar"));
}

#[test]
fn an_opacity_of_no_number_or_none_is_dropped_and_an_endless_one_is_no_opacity() {
    let camera = orbit(20, 20);
    let drawn = |opacity| {
        let (_, stats) = draw_on(
            &scene([Splat { opacity, ..RED }]),
            &camera,
            Background::WHITE,
        );
        (
            stats.visible,
            stats.dropped.not_finite,
            stats.dropped.too_faint,
        )
    };
    assert_eq!(drawn(f32::NAN), (0, 1, 0));
    assert_eq!(drawn(0.0), (0, 0, 1));
    assert_eq!(drawn(-1.0), (0, 0, 1));
    assert_eq!(drawn(7.0), (1, 0, 0));
}

#[test]
fn on_every_instruction_set_any_number_of_threads_draws_the_same_bits() {
    let scene = scene(random_splats(14, 5000));
    let camera = orbit(130, 90);
    for isa in Isa::available() {
        let on = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
            let pool = pool.build().unwrap();
            let limits = Limits::default();
            pool.install(|| Renderer::new(isa).render(&scene, &camera, Background::BLACK, &limits))
                .unwrap()
                .0
        };
        assert!(on(1) == on(3) && on(1) == on(16), "{isa}");
    }
}

#[test]
fn a_million_splats_in_one_pixel_stop_early_and_keep_their_order() {
    let camera = straight(100.0, 9, 9);
    let count = 1_000_000;
    let mut scene = scene([AHEAD]);
    scene.position = (0..count)
        .map(|i| [0.0, 0.0, 2.0 + ((i * 7919) % count) as f32 * 1e-5])
        .collect();
    scene.scale = vec![[1e-4; 3]; count];
    scene.rotation = vec![AHEAD.rotation; count];
    scene.opacity = vec![0.5; count];
    scene.colour = vec![[1.0, 0.0, 0.0]; count];
    scene.colour[0] = [0.0, 1.0, 0.0];
    let image = Renderer::default()
        .render(&scene, &camera, Background::WHITE, &Limits::default())
        .unwrap()
        .0;
    let [r, g, _, _] = image.pixel(4, 4);
    assert!((g - 0.5).abs() < 1e-3 && (r - 0.5).abs() < 2e-3, "{r} {g}");
}
