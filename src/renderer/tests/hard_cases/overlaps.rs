//! Many splats, and what lies behind what.

use super::*;
use crate::error::Error;

/// Case 12.
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

/// Case 13.
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
    let image = draw(&scene, &camera);
    let [r, g, _, _] = image.pixel(4, 4);
    assert!((g - 0.5).abs() < 1e-3 && (r - 0.5).abs() < 2e-3, "{r} {g}");
}

/// Case 13, the farthest first.
#[test]
fn a_hundred_thousand_splats_in_one_pixel_are_drawn_nearest_first() {
    let camera = straight(100.0, 33, 33);
    let count = 100_000;
    let at = |i: usize| Splat {
        position: [0.0, 0.0, 2.0 + i as f32 * 1e-5],
        scale: [1e-4; 3],
        opacity: 0.5,
        colour: if i == 0 { [0.0, 1.0, 0.0] } else { [1.0, 0.0, 0.0] },
        ..RED
    };
    // Farthest first.
    let image = draw(&scene((0..count).rev().map(at)), &camera);
    let [r, g, _, _] = image.pixel(16, 16);
    assert!((g - 0.5).abs() < 1e-3 && (r - 0.5).abs() < 1e-3);
}

/// Case 14.
#[test]
fn among_coincident_splats_the_first_is_in_front() {
    let green = Splat {
        colour: [0.0, 1.0, 0.0],
        ..RED
    };
    let camera = orbit(32, 32);
    let middle = |splats: [Splat; 2]| draw(&scene(splats), &camera).pixel(16, 16);
    let [r, g, _, _] = middle([RED, green]);
    assert!(r > 0.9 && g < 0.1);
    let [r, g, _, _] = middle([green, RED]);
    assert!(g > 0.9 && r < 0.1);
}

/// Case 16.
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
    let differ = differ.filter(|(a, b)| (0..4).any(|k| (a[k] - b[k]).abs() > 1.0 / 255.0));
    assert!(differ.count() <= 25);
}

/// Case 17.
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

/// Case 19: what a renderer that skips an α below 1/255 leaves out altogether.
#[test]
fn a_thousand_faint_layers_are_drawn_and_the_fast_quality_says_that_it_dropped_them() {
    let camera = straight(50.0, 8, 8);
    let veil = |i| Splat {
        position: [0.0, 0.0, 1.0 + i as f32 * 1e-4],
        scale: [50.0, 50.0, 0.0],
        opacity: 1.0 / 300.0,
        ..RED
    };
    let scene = scene((0..1000).map(veil));
    let exact = reference::render(&scene, &camera, Background::Transparent, Cutoffs::NONE);
    assert!((exact.pixel(4, 4)[3] - 0.9646).abs() < 1e-3);
    for isa in isas() {
        let on = |quality| {
            let renderer = Renderer::new().with_isa(isa).with_quality(quality);
            drawn(renderer.with_background(Background::Transparent), &scene, &camera)
        };
        assert!(difference(&on(Quality::Fine).0, &exact).0 <= 1.0 / 255.0, "{isa}");
        let (image, stats) = on(Quality::Fast);
        assert_eq!(stats.dropped.too_faint, 1000);
        assert!(image.pixels.iter().all(|p| *p == [0.0; 4]));
    }
}

/// Case 20.
#[test]
fn white_on_white_stays_white() {
    let camera = orbit(64, 64);
    let layers = |opacity, count| -> Vec<Splat> {
        let layer = |i| Splat {
            position: [0.0, 0.0, i as f32 * 1e-4],
            opacity,
            ..WHITE
        };
        (0..count).map(layer).collect()
    };
    let white = |splats: Vec<Splat>| splats.into_iter().map(|s| Splat { colour: [1.0; 3], ..s });
    // Each layer rounds once more: of thousands, most of them faint, a little is left.
    let scenes = [
        (scene(white(random_splats(9, 2000))), 2e-6),
        (scene(white(surface_splats(4000, 0.8, 0.02))), 2e-6),
        (scene(layers(1.0, 100)), 2e-6),
        (scene(layers(0.1, 1000)), 1e-5),
        (scene(layers(1.01 / 255.0, 3000)), 2e-5),
    ];
    for (i, (scene, tolerance)) in scenes.iter().enumerate() {
        for pixel in draw(scene, &camera).pixels {
            assert!(pixel.iter().all(|x| (x - 1.0).abs() <= *tolerance), "{i}: {pixel:?}");
        }
    }
}

/// Case 25; that the sets agree is part of every other case.
#[test]
fn on_every_instruction_set_any_number_of_threads_draws_the_same_bits() {
    let scene = scene(random_splats(14, 5000));
    let camera = orbit(130, 90);
    for isa in isas() {
        let on = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
            let pool = pool.build().unwrap();
            let mut renderer = Renderer::new().with_isa(isa).with_background(Background::BLACK);
            pool.install(|| renderer.render(&scene, &camera)).unwrap()
        };
        assert!(on(1) == on(3) && on(1) == on(16), "{isa}");
    }
}
