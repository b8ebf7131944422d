//! What may not change a picture, and sums that must come out.

use super::*;

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
            opacity: 0.003,
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
    let mut renderer = Renderer::default();
    let limits = Limits::default();
    for (seed, count, size) in [(1, 400, 70), (2, 50, 33), (3, 300, 90), (4, 0, 20)] {
        let scene = scene(random_splats(seed, count));
        let camera = orbit(size, size + 5);
        let (image, _) = renderer
            .render(&scene, &camera, Background::WHITE, &limits)
            .unwrap();
        assert!(image == draw(&scene, &camera));
    }
}

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
    let white = |splats: Vec<Splat>| {
        splats.into_iter().map(|s| Splat {
            colour: [1.0; 3],
            ..s
        })
    };
    let scenes = [
        scene(white(random_splats(9, 2000))),
        scene(white(surface_splats(4000, 0.8, 0.02))),
        scene(layers(1.0, 100)),
        scene(layers(0.1, 1000)),
        scene(layers(1.01 / 255.0, 3000)),
    ];
    for (i, scene) in scenes.iter().enumerate() {
        for pixel in draw(scene, &camera).pixels {
            assert!(
                pixel.iter().all(|x| (x - 1.0).abs() <= 2e-6),
                "{i}: {pixel:?}"
            );
        }
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
        Splat {
            opacity: 0.0,
            ..RED
        },
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
fn a_picture_in_crops_is_the_picture() {
    // What a crop sees is linearised within its own field of view: splats well inside the whole are the same.
    let scene = scene(random_splats(15, 200).into_iter().map(|s| Splat {
        position: s.position.map(|x| 0.5 * x),
        ..s
    }));
    let camera = orbit(96, 80);
    let whole = draw(&scene, &camera);
    for (x0, y0, width, height) in [(0, 0, 40, 33), (40, 33, 56, 47), (17, 5, 64, 64)] {
        let mut crop = camera;
        (crop.width, crop.height) = (width, height);
        (crop.cx, crop.cy) = (camera.cx - f64::from(x0), camera.cy - f64::from(y0));
        let part = draw(&scene, &crop);
        for y in 0..height {
            for x in 0..width {
                let (a, b) = (part.pixel(x, y), whole.pixel(x0 + x, y0 + y));
                for k in 0..3 {
                    assert!((a[k] - b[k]).abs() < 4.5 / 255.0, "{x} {y}: {a:?} {b:?}");
                }
            }
        }
    }
}

#[test]
fn from_the_second_picture_on_no_memory_is_taken() {
    let scene = scene(random_splats(16, 3000));
    let camera = orbit(90, 90);
    let mut renderer = Renderer::default();
    let mut image = Image::default();
    let mut draw = |camera: &Camera| {
        let limits = Limits::default();
        renderer
            .render_into(&scene, camera, Background::WHITE, &limits, &mut image)
            .unwrap();
        (image.pixels.as_ptr(), renderer.ellipses.all().as_ptr())
    };
    assert_eq!(draw(&camera), draw(&camera));
}
