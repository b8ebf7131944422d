//! Against the reference.

use super::*;

#[test]
fn random_scenes_are_close_to_the_reference() {
    for seed in 0..6 {
        let scene = scene(random_splats(seed, 150));
        assert_close(&scene, &orbit(75, 50));
    }
}

#[test]
fn gaussians_with_a_blur_of_their_own_are_close_to_the_reference() {
    for (seed, blur) in [(1, 1e-5), (2, 1e-3), (3, 0.1)] {
        let mut scene = scene(random_splats(seed, 150));
        scene.blur = blur;
        assert_close(&scene, &orbit(75, 50));
    }
}

#[test]
fn gaussians_with_a_blur_of_their_own_close_gaps_from_close_up_and_stay_slim_from_a_distance() {
    let small = surface_splats(2000, 0.8, 1e-3);
    let mut scene = scene(small);
    let (far, near) = (orbit(64, 64), orbit(640, 640));
    let [before_far, before_near] = [&far, &near].map(|camera| draw(&scene, camera));
    // A deviation of 0.01: a quarter of a pixel from a distance, two and a half from close up.
    scene.blur = 1e-4;
    let ink = |image: &Image| image.pixels.iter().map(|p| 1.0 - p[0]).sum::<f32>();
    let covered = |image: &Image| image.pixels.iter().filter(|p| p[0] < 0.9).count();
    assert!(covered(&draw(&scene, &near)) > 2 * covered(&before_near));
    assert!(ink(&draw(&scene, &far)) < 0.95 * ink(&before_far));
}

/// What a pixel of a picture so many wide and high lacks of white, on average.
fn ink(scene: &Gaussians, side: u32) -> f64 {
    let image = draw(scene, &orbit(side, side));
    let all = image.pixels.iter().map(|p| f64::from(1.0 - p[0])).sum::<f64>();
    all / f64::from(side * side)
}

#[test]
fn an_object_with_a_blur_of_its_own_is_as_large_from_a_distance_as_from_close_up() {
    let mut scene = scene(surface_splats(40_000, 0.8, 1e-3));
    // From a distance a fifteenth of a pixel squared.
    scene.blur = 1e-4;
    let [near, far] = [512, 64].map(|side| ink(&scene, side));
    assert!((far / near - 1.0).abs() < 0.02, "{near} {far}");
}

#[test]
fn an_object_of_splats_below_a_pixel_is_nearly_as_large_from_a_distance_as_from_close_up() {
    let black = surface_splats(40_000, 0.8, 0.006).into_iter().map(|splat| Splat {
        colour: [0.0; 3],
        ..splat
    });
    let mut scene = scene(black.collect::<Vec<_>>());
    scene.blur = 1e-6;
    let [near, far] = [512, 64].map(|side| ink(&scene, side));
    assert!((far / near - 1.0).abs() < 0.03, "{near} {far}");
}

#[test]
fn with_hardly_any_cut_off_only_rounding_is_left() {
    let mut worst = 0.0f32;
    for seed in 0..6 {
        let scene = scene(random_splats(seed, 600));
        let camera = orbit(75, 50);
        let transmittance = Cutoffs {
            through: 1.0 / 1024.0,
            ..Cutoffs::NONE
        };
        let exact = reference::render(&scene, &camera, Background::WHITE, transmittance);
        for isa in isas() {
            let mut renderer = Renderer::new().with_isa(isa).with_quality(Quality::Exact);
            let drawn = renderer.render(&scene, &camera);
            let (largest, psnr) = difference(&drawn.unwrap(), &exact);
            worst = worst.max(largest);
            assert!(
                largest <= 0.3 / 255.0 && psnr >= 80.0,
                "{isa}: {:.5}/255, {psnr:.1} dB",
                largest * 255.0
            );
        }
    }
    assert!(worst > 0.0);
}

/// What is left out beside a silhouette, where many faint tails overlap, is what the qualities differ in.
#[test]
fn a_better_quality_is_nearer_to_the_reference() {
    let scene = scene(surface_splats(4000, 0.8, 0.02));
    let camera = orbit(75, 50);
    let exact = reference::render(&scene, &camera, Background::WHITE, Cutoffs::NONE);
    for isa in isas() {
        let cost = [Quality::Fast, Quality::Fine, Quality::Exact].map(|quality| {
            let mut renderer = Renderer::new().with_isa(isa).with_quality(quality);
            difference(&renderer.render(&scene, &camera).unwrap(), &exact)
        });
        let [(fast, _), (standard, _), (best, _)] = cost;
        // Between the better two only rounding is left.
        assert!(best <= standard + 1e-6 && standard < fast, "{isa}: {cost:?}");
        assert!(fast <= 10.0 / 255.0, "{isa}: {cost:?}");
    }
}

#[test]
fn a_surface_of_small_splats_is_close_to_the_reference() {
    let scene = scene(surface_splats(4000, 0.8, 0.02));
    assert_close(&scene, &orbit(70, 90));
}

/// As a decoder makes them: thin discs along a surface, a voxel wide.
#[test]
fn a_decoded_surface_is_close_to_the_reference_from_near_and_far() {
    let discs = surface_splats(6000, 0.7, 0.03).into_iter().map(|s| {
        let [x, y, z] = s.position.map(|x| x / 0.7);
        Splat {
            scale: [0.027, 0.033, 0.012],
            rotation: [1.0 + z, -y, x, 0.0],
            ..s
        }
    });
    let scene = scene(discs);
    for (i, radius) in [0.9, 1.3, 2.0, 3.0, 6.0, 20.0].into_iter().enumerate() {
        let (azimuth, elevation) = (60.0 * i as f64, 25.0 * i as f64 - 60.0);
        let camera = Camera::orbit(azimuth, elevation, radius, 45.0, 60, 50).unwrap();
        // From a distance hundreds share a pixel, and what is left out of each adds up.
        let quality = if radius < 5.0 { Quality::Fine } else { Quality::Exact };
        assert_close_in(quality, &scene, &camera);
    }
}

#[test]
fn an_off_centre_principal_point_is_close_to_the_reference() {
    let scene = scene(random_splats(7, 150));
    for (cx, cy) in [(-40.0, 20.0), (200.0, -90.0), (3.5, 49.5)] {
        let mut camera = orbit(75, 50);
        (camera.cx, camera.cy) = (cx, cy);
        assert_close(&scene, &camera);
    }
}

#[test]
fn a_wide_view_from_among_the_splats_is_close_to_the_reference() {
    let scene = scene(random_splats(8, 150));
    let camera = Camera::orbit(70.0, -20.0, 0.3, 100.0, 75, 50).unwrap();
    assert_close(&scene, &camera);
}
