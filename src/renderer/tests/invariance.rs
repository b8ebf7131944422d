//! What may not change a picture, and sums that must come out.

use super::effects::with;
use super::*;
use crate::renderer::projection::Bounds;
use crate::renderer::{EffectMode, Effects};

#[test]
fn nothing_to_draw_gives_the_background() {
    let camera = orbit(37, 21);
    let colour = Background::Colour([0.25, 0.5, 0.75]);
    let (image, stats) = draw_on(&Gaussians::default(), &camera, colour);
    assert!(image.pixels.iter().all(|p| *p == [0.25, 0.5, 0.75, 1.0]));
    assert_eq!((stats.visible, stats.pairs), (0, 0));
    let (image, _) = draw_on(&Gaussians::default(), &camera, Background::Transparent);
    assert!(image.pixels.iter().all(|p| *p == [0.0; 4]));
}

#[test]
fn a_hidden_splat_does_not_change_a_pixel() {
    // Three layers of α = 0.99 finish every pixel they cover; what lies behind them is smaller.
    let wall = |z, colour| Splat {
        position: [0.0, 0.0, z],
        scale: [40.0, 40.0, 0.01],
        colour,
        ..RED
    };
    let walls = [
        wall(2.0, [0.2, 0.4, 0.6]),
        wall(2.1, [1.0, 0.0, 1.0]),
        wall(2.2, [0.0, 1.0, 0.0]),
    ];
    let camera = straight(60.0, 50, 40);
    let open = draw(&scene(walls), &camera);
    let hidden = random_splats(3, 100).into_iter().map(|s| Splat {
        position: [s.position[0], s.position[1], s.position[2] + 6.0],
        ..s
    });
    let both = draw(&scene(hidden.chain(walls)), &camera);
    assert!(open == both);
}

#[test]
fn splats_that_are_not_visible_do_not_change_a_pixel() {
    let seen = random_splats(4, 200);
    let camera = straight(60.0, 50, 40);
    let unseen = [
        Splat {
            position: [0.0, 0.0, -1.0],
            ..RED
        },
        Splat {
            position: [f32::NAN; 3],
            ..RED
        },
        Splat {
            rotation: [0.0; 4],
            ..RED
        },
        Splat {
            opacity: 0.00004,
            ..RED
        },
        Splat {
            position: [90.0, 0.0, 1.0],
            ..RED
        },
    ];
    let mixed = seen
        .iter()
        .flat_map(|&s| unseen.into_iter().chain([s]).collect::<Vec<_>>());
    assert!(draw(&scene(seen.clone()), &camera) == draw(&scene(mixed), &camera));
}

#[test]
fn the_order_of_the_input_does_not_matter() {
    let splats = random_splats(5, 500);
    let mut reversed = splats.clone();
    reversed.reverse();
    let camera = orbit(75, 50);
    assert!(draw(&scene(splats), &camera) == draw(&scene(reversed), &camera));
}

#[test]
fn any_number_of_threads_draws_the_same_bits() {
    let mut splats = random_splats(6, 9000);
    // Equal depths, to tempt an unstable order.
    splats.extend(splats.clone());
    let scene = scene(splats);
    let camera = orbit(200, 150);
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        let pool = pool.build().unwrap();
        pool.install(|| draw_on(&scene, &camera, Background::Transparent).0)
    };
    let one = on(1);
    for threads in [2, 7] {
        assert!(one == on(threads), "{threads} threads");
    }
}

#[test]
fn a_renderer_that_has_drawn_before_draws_the_same() {
    let mut renderer = Renderer::new();
    for (seed, count, size) in [(1, 400, 70), (2, 50, 33), (3, 300, 90), (4, 0, 20)] {
        let scene = scene(random_splats(seed, count));
        let camera = orbit(size, size + 5);
        let image = renderer.render(&scene, &camera).unwrap();
        assert!(image == draw(&scene, &camera));
    }
}

#[test]
fn transparent_over_a_colour_is_the_picture_on_that_colour() {
    let scene = scene(random_splats(10, 200));
    let camera = orbit(75, 50);
    let colour = [0.1, 0.9, 0.4];
    let (opaque, _) = draw_on(&scene, &camera, Background::Colour(colour));
    let (transparent, _) = draw_on(&scene, &camera, Background::Transparent);
    for (o, t) in opaque.pixels.iter().zip(&transparent.pixels) {
        for k in 0..3 {
            assert!((t[k] + (1.0 - t[3]) * colour[k] - o[k]).abs() < 1e-6);
        }
        assert!((0.0..=1.0).contains(&t[3]));
    }
}

#[test]
fn every_gaussian_is_counted_once() {
    let splats = [
        RED,
        Splat {
            position: [0.0, 0.0, 4.0],
            ..RED
        },
        Splat {
            position: [0.0, 9.0, 0.0],
            ..RED
        },
        Splat {
            rotation: [0.0; 4],
            opacity: 0.0,
            ..RED
        },
        Splat { opacity: 0.0, ..RED },
        Splat {
            colour: [0.0, f32::INFINITY, 0.0],
            ..RED
        },
    ];
    let camera = Camera::orbit(0.0, 0.0, 3.0, 45.0, 40, 40).unwrap();
    let (_, stats) = draw_on(&scene(splats), &camera, Background::WHITE);
    let dropped = stats.dropped;
    assert_eq!((stats.visible, dropped.total()), (1, 5));
    assert_eq!((dropped.behind, dropped.outside), (1, 1));
    assert_eq!((dropped.no_rotation, dropped.too_faint), (1, 1));
    assert_eq!(dropped.not_finite, 1);
}

#[test]
fn a_picture_in_crops_is_the_picture_to_the_bit() {
    let scene = scene(random_splats(15, 400));
    let parts = [
        [0, 0, 40, 33],
        [40, 33, 96, 80],
        [17, 5, 81, 69],
        [31, 31, 33, 33],
        [95, 79, 96, 80],
    ];
    // From inside too, where much lies outside of the view.
    for radius in [3.0, 0.6] {
        let camera = Camera::orbit(30.0, 10.0, radius, 70.0, 96, 80).unwrap();
        for isa in isas() {
            let (plain, on) = (Effects::default(), EffectMode::On);
            let antialias = Effects { antialias: on, ..plain };
            let order = Effects { order: on, ..plain };
            for effects in [plain, antialias, order] {
                let (whole, stats) = with(&scene, &camera, isa, effects);
                assert_eq!(stats.effects.near, radius < 1.0, "{radius}");
                for [x0, y0, x1, y1] in parts {
                    let crop = camera.crop(Bounds { x0, y0, x1, y1 }).unwrap();
                    let part = with(&scene, &crop, isa, effects).0;
                    assert_eq!([part.width, part.height], [x1 - x0, y1 - y0]);
                    for y in y0..y1 {
                        for x in x0..x1 {
                            let (a, b) = (part.pixel(x - x0, y - y0), whole.pixel(x, y));
                            assert_eq!(a, b, "{isa}, {x} {y} of {x0} {y0} {x1} {y1}");
                        }
                    }
                }
            }
        }
    }
}
