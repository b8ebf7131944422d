//! Splats flat, long, vast and tiny.

use super::*;
use crate::renderer::tests::effects::ANTIALIAS;

/// A turn around the viewing axis.
fn turned(degrees: f32) -> [f32; 4] {
    let (sin, cos) = (degrees.to_radians() / 2.0).sin_cos();
    [cos, 0.0, 0.0, sin]
}

/// Case 3.
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

/// Case 3, the disc from its edge.
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

/// Case 4.
#[test]
fn an_enormous_splat_is_a_constant_colour() {
    let camera = straight(500.0, 64, 48);
    for scale in [[4.85e8; 3], [f32::MAX; 3], [f32::MAX, f32::MAX, 0.0]] {
        let splat = Splat { scale, ..AHEAD };
        for pixel in draw_on(&scene([splat]), &camera, Background::BLACK).0.pixels {
            assert!((pixel[0] - 0.99).abs() < 1e-5 && pixel[1] == 0.0);
        }
    }
}

/// Case 5.
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

/// Cases 6 and 7: no covariance between x and y, and two equal variances.
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

/// Case 18.
#[test]
fn a_splat_smaller_than_a_pixel_covers_in_proportion_to_its_area_down_to_a_floor() {
    let camera = straight(100.0, 33, 33);
    let light = |isa: Isa, sigma: f32| -> f32 {
        let splat = Splat {
            position: [0.0, 0.0, 2.0],
            scale: [sigma * 0.02; 3],
            ..WHITE
        };
        let (image, _) = with(&scene([splat]), &camera, isa, ANTIALIAS);
        image.pixels.iter().map(|p| p[3].min(p[0])).sum()
    };
    for isa in isas() {
        let (one, half) = (light(isa, 0.4), light(isa, 0.2));
        assert!((one / half - 4.0).abs() < 0.4, "{isa}: {one} {half}");
        // Nothing at all is still the floor of 0.005, which is just bright enough to be drawn.
        assert!(light(isa, 0.0) > 0.0 && light(isa, 0.0) < 0.02);
    }
}
