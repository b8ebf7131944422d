//! Parameters that are no numbers, or hardly.

use super::*;

/// Case 1.
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
    let (_, stats) = draw_on(&scene([Splat { rotation, ..splat }]), &camera, Background::WHITE);
    assert_eq!(stats.dropped.no_rotation, 1);
}

/// Case 2, all fields; what an opacity may be comes next.
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

/// Case 2, opacity.
#[test]
fn an_opacity_of_no_number_or_none_is_dropped_and_an_endless_one_is_no_opacity() {
    let camera = orbit(20, 20);
    let drawn = |opacity| {
        let (_, stats) = draw_on(&scene([Splat { opacity, ..RED }]), &camera, Background::WHITE);
        (stats.visible, stats.dropped.not_finite, stats.dropped.too_faint)
    };
    assert_eq!(drawn(f32::NAN), (0, 1, 0));
    assert_eq!(drawn(0.0), (0, 0, 1));
    assert_eq!(drawn(-1.0), (0, 0, 1));
    assert_eq!(drawn(7.0), (1, 0, 0));
}

/// Case 15.
#[test]
fn depths_of_nothing_are_behind_and_depths_a_bit_apart_keep_their_order() {
    let mut camera = straight(50.0, 16, 16);
    camera.near = f64::from(f32::MIN_POSITIVE);
    let at = |z: f32, colour| Splat {
        position: [0.0, 0.0, z],
        scale: [sigma(9.0, 50.0); 3],
        colour,
        ..RED
    };
    for z in [-0.0, 0.0, 1e-45, f32::MIN_POSITIVE] {
        for isa in isas() {
            let (_, stats) = without_ray_space(&scene([at(z, [1.0; 3])]), &camera, isa);
            assert_eq!((stats.visible, stats.dropped.behind), (0, 1), "{isa}: {z:e}");
        }
    }
    let (_, stats) = draw_on(&scene([at(f32::INFINITY, [1.0; 3])]), &camera, Background::WHITE);
    assert_eq!((stats.visible, stats.dropped.not_finite), (0, 1));
    for z in [1e-3, 1.0, 2.0, 1e6, f32::MAX / 2.0] {
        let (near, far) = (at(z, [1.0, 0.0, 0.0]), at(z.next_up(), [0.0, 1.0, 0.0]));
        for order in [[near, far], [far, near]] {
            let [r, g, _, _] = draw_on(&scene(order), &camera, Background::BLACK).0.pixel(8, 8);
            assert!(r > 1.5 * g, "{z:e}: {r} {g}");
        }
    }
}

/// Case 15, and every other parameter at the ends of its range.
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

/// Case 23.
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
