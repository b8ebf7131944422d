//! Where the camera stands, what it sees, and how large the picture is.

use super::*;
use crate::error::Error;

/// Case 8, without care for what reaches over.
#[test]
fn a_splat_is_drawn_when_its_centre_is_beyond_the_near_plane() {
    let mut camera = straight(50.0, 20, 20);
    camera.near = 0.25;
    let at = |z: f32| Splat {
        position: [0.0, 0.0, z],
        scale: [0.01; 3],
        ..RED
    };
    for isa in isas() {
        let visible = |z| careless(&scene([at(z)]), &camera, isa).1.visible == 1;
        for z in [0.0, -2.0, 0.25f32.next_down(), 0.25] {
            assert!(!visible(z), "{isa}: {z}");
        }
        assert!(visible(0.25f32.next_up()), "{isa}");
    }
}

/// Case 9, without care.
#[test]
fn a_splat_behind_that_reaches_over_the_near_plane_is_not_mirrored_into_view() {
    let camera = straight(50.0, 20, 20);
    let splat = Splat {
        position: [0.3, 0.2, -0.1],
        scale: [3.0; 3],
        ..RED
    };
    for isa in isas() {
        let (image, stats) = careless(&scene([splat]), &camera, isa);
        assert_eq!((stats.dropped.behind, stats.crossing), (1, 1));
        assert!(image.pixels.iter().all(|p| *p == [0.0, 0.0, 0.0, 1.0]));
    }
}

/// Case 9, with care: what of it is in front.
#[test]
fn a_splat_behind_that_reaches_over_the_near_plane_is_drawn_as_what_of_it_is_in_front() {
    let camera = straight(50.0, 20, 20);
    let splat = |scale| Splat {
        position: [0.3, 0.2, -0.1],
        scale: [scale; 3],
        ..RED
    };
    // Of a large one nearly all; of a small one, which is out of reach, nothing.
    for (scale, least, most) in [(3.0, 0.9, 1.0), (0.05, 0.0, 0.1), (0.03, 0.0, 0.0)] {
        assert_close(&scene([splat(scale)]), &camera);
        let image = draw_on(&scene([splat(scale)]), &camera, Background::BLACK).0;
        assert!(image.pixels.iter().all(|p| (least..=most).contains(&p[0])), "{scale}");
    }
}

/// Case 10.
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

/// Case 11.
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

/// Case 21.
#[test]
fn zooming_keeps_the_mean_luminance_with_anti_aliasing_on() {
    let scene = scene(surface_splats(20_000, 0.8, 0.012));
    let antialias = Effects {
        antialias: EffectMode::On,
        ..Effects::default()
    };
    // The mean of the middle of a picture, `side` pixels wide, under `zoom`.
    let mean = |isa, zoom: f64, side: u32| {
        let mut camera = Camera::orbit(30.0, 10.0, 3.0, 45.0, side, side).unwrap();
        (camera.fx, camera.fy) = (1000.0 * zoom, 1000.0 * zoom);
        let image = with(&scene, &camera, isa, antialias).0;
        let colours = image.pixels.iter().flat_map(|p| &p[..3]);
        let sum: f64 = colours.map(|c| f64::from(*c)).sum();
        sum / f64::from(side).powi(2)
    };
    for isa in isas() {
        // The whole sphere, with some black around it …
        let whole = mean(isa, 1.0, 600);
        for (zoom, side) in [(0.5, 300), (0.2, 120), (0.1, 60), (0.05, 30), (0.02, 12), (0.01, 6)] {
            let ratio = mean(isa, zoom, side) / whole;
            assert!((ratio - 1.0).abs() < 0.01, "{isa}, ×{zoom}: {ratio}");
        }
        // … and the middle of it.
        let middle = mean(isa, 1.0, 10);
        for (zoom, side) in [(10.0, 100), (100.0, 1000)] {
            let ratio = mean(isa, zoom, side) / middle;
            assert!((ratio - 1.0).abs() < 0.01, "{isa}, ×{zoom}: {ratio}");
        }
    }
}

/// Case 22.
#[test]
fn pictures_of_any_size_are_drawn_to_the_last_pixel() {
    let splats = random_splats(13, 60);
    for (width, height) in [(1, 1), (2, 3), (15, 17), (16, 16), (33, 1), (1, 70)] {
        let mut camera = straight(20.0, width, height);
        camera.pose.translation.z = 2.0;
        assert_close(&scene(splats.clone()), &camera);
    }
}

/// Case 22, the strip.
#[test]
fn a_strip_of_65535_pixels_is_drawn_to_its_ends() {
    for upright in [false, true] {
        let (width, height) = if upright { (1, 65_535) } else { (65_535, 1) };
        let camera = straight(30_000.0, width, height);
        let end = |i: u32| {
            let offset = (i as f32 + 0.5 - 32_767.5) / 30_000.0 * 2.0;
            let (x, y) = if upright { (0.0, offset) } else { (offset, 0.0) };
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

/// Case 24, and what else is no picture.
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
