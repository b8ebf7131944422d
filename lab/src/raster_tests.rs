use super::*;
use crate::mesh::fixtures::{mesh, plain_quad, quad, texture};
use crate::mesh::{Mesh, Part};

/// A camera at the origin that looks along z, x right and y down as on the picture; 10 pixels a unit at depth 1.
fn view() -> View {
    View {
        rotation: [[1., 0., 0.], [0., 1., 0.], [0., 0., 1.]],
        translation: [0.0; 3],
        focal: [10.0; 2],
        centre: [8.0; 2],
        near: 0.01,
    }
}

fn draw(parts: Vec<Part>, clip: Option<Clip>) -> Picture {
    render(&Surface::new(&Mesh { parts }), &view(), [16, 16], 4, clip)
}

/// A square across the line of sight, 1 wide at its depth: 10/depth pixels.
fn square(depth: f32, rgb: [f32; 3]) -> Part {
    plain_quad([-0.5, -0.5, depth], [1., 0., 0.], [0., 1., 0.], rgb)
}

fn pixel(picture: &Picture, x: u32, y: u32) -> [f32; 4] {
    picture.rgba[(y * picture.width + x) as usize]
}

const RED: [f32; 3] = [1., 0., 0.];
const BLUE: [f32; 3] = [0., 0., 1.];

#[test]
fn a_slanted_textured_quads_pixels_are_the_analytic_ones() {
    // A ramp of 256 texels: bilinear lookup is linear in u. The quad recedes from depth 2 at the left to 6 at the
    // right.
    let ramp = texture(256, 1, |x, _| [x as u8, 255 - x as u8, 7, 255]);
    let part = quad([-2., -3., 2.], [4., 0., 4.], [0., 6., 0.], Some(ramp));
    let picture = render(&Surface::new(&mesh(part)), &view(), [16, 16], 4, None);
    let mut checked = 0;
    for (x, y) in (0..16).flat_map(|x| (0..16).map(move |y| (x, y))) {
        let got = pixel(&picture, x, y);
        let mut expected = 0.0;
        for k in 0..4 {
            // The ray (a, ·, 1) meets the plane z = x + 4 at depth 4 / (1 − a).
            let a = (f64::from(x) + (f64::from(k) + 0.5) / 4.0 - 8.0) / 10.0;
            let depth = 4.0 / (1.0 - a);
            let u = (a * depth + 2.0) / 4.0;
            expected += (u * 256.0 - 0.5) / 4.0 / 255.0;
        }
        if got[3] == 1.0 && (0.01..0.98).contains(&expected) {
            assert!((f64::from(got[0]) - expected).abs() < 1e-4, "{x}: {got:?}");
            assert!((got[0] + got[1] - 1.0).abs() < 1e-4);
            checked += 1;
        }
    }
    assert!(checked > 60, "{checked}");
}

#[test]
fn coverage_is_the_share_of_a_pixel_that_is_covered() {
    // At depth 4 the square spans pixels 6.75 to 9.25.
    let picture = draw(vec![square(4.0, RED)], None);
    assert_eq!(pixel(&picture, 8, 8), [1., 0., 0., 1.]);
    assert_eq!(pixel(&picture, 6, 8), [0.25, 0., 0., 0.25]);
    assert_eq!(pixel(&picture, 9, 9), [0.0625, 0., 0., 0.0625]);
    assert_eq!(pixel(&picture, 10, 8), [0.0; 4]);
    let half = plain_quad([-0.5, -0.5, 4.0], [0.5, 0., 0.], [0., 1., 0.], BLUE);
    let mut shifted = half;
    for p in &mut shifted.positions {
        // A quarter of a unit is 0.625 pixels; the right border falls on the middle of pixel 8.
        p[0] += 0.2;
    }
    assert_eq!(pixel(&draw(vec![shifted], None), 8, 8), [0., 0., 0.5, 0.5]);
}

#[test]
fn the_nearer_triangle_wins_whichever_comes_first() {
    let (near, far) = (square(2.0, RED), square(3.0, BLUE));
    let one = draw(vec![near.clone(), far.clone()], None);
    assert_eq!(pixel(&one, 8, 8), [1., 0., 0., 1.]);
    assert_eq!(one, draw(vec![far, near], None));
}

#[test]
fn where_triangles_cross_each_is_seen_on_its_own_side() {
    let flat = square(3.0, BLUE);
    let slanted = plain_quad([-0.5, -0.5, 2.0], [1., 0., 2.], [0., 1., 0.], RED);
    let picture = draw(vec![flat, slanted], None);
    assert_eq!(pixel(&picture, 7, 8), [1., 0., 0., 1.]);
    assert_eq!(pixel(&picture, 8, 8), [0., 0., 1., 1.]);
}

#[test]
fn of_coincident_triangles_the_same_one_is_seen_in_any_order() {
    let mut pair = square(2.0, RED);
    let skin = texture(1, 1, |_, _| [9, 9, 9, 255]);
    let other = quad([-0.5, -0.5, 2.0], [1., 0., 0.], [0., 1., 0.], Some(skin));
    pair.texture = other.texture.clone();
    pair.uvs = vec![[0.5, 0.5]; 4];
    let mut both = pair.clone();
    both.uvs.extend(&other.uvs);
    both.positions.extend(&other.positions);
    both.triangles.extend([[4, 5, 6], [4, 6, 7]]);
    let mut turned = both.clone();
    turned.triangles.reverse();
    assert_eq!(draw(vec![both], None), draw(vec![turned], None));
}

#[test]
fn both_sides_of_a_triangle_are_seen() {
    let mut turned = square(2.0, RED);
    for triangle in &mut turned.triangles {
        triangle.swap(1, 2);
    }
    assert_eq!(draw(vec![turned], None), draw(vec![square(2.0, RED)], None));
}

#[test]
fn only_what_lies_in_the_clip_box_is_drawn() {
    let clip = Clip {
        low: [0.0, -10.0, 0.0],
        high: [10.0, 10.0, 2.5],
    };
    let picture = draw(vec![square(2.0, RED), square(3.0, BLUE)], Some(clip));
    assert_eq!(pixel(&picture, 7, 8), [0.0; 4]);
    assert_eq!(pixel(&picture, 8, 8), [1., 0., 0., 1.]);
}

#[test]
fn a_floor_that_passes_under_the_camera_reaches_the_horizon_and_no_further() {
    let floor = plain_quad([-1e4, 1.0, -1e4], [2e4, 0., 0.], [0., 0., 2e4], [0., 1., 0.]);
    let picture = draw(vec![floor], None);
    for x in 0..16 {
        assert_eq!(pixel(&picture, x, 7), [0.0; 4]);
        assert_eq!(pixel(&picture, x, 8), [0., 1., 0., 1.]);
        assert_eq!(pixel(&picture, x, 15), [0., 1., 0., 1.]);
    }
}

#[test]
fn what_fails_the_alpha_test_shows_what_is_behind() {
    let hole = texture(1, 1, |_, _| [255, 0, 0, 100]);
    let glass = quad([-0.5, -0.5, 2.0], [1., 0., 0.], [0., 1., 0.], Some(hole));
    let picture = draw(vec![glass, square(3.0, BLUE)], None);
    assert_eq!(pixel(&picture, 8, 8), [0., 0., 1., 1.]);
}

#[test]
fn the_number_of_threads_changes_no_pixel() {
    let parts: Vec<Part> = (0..20)
        .map(|i| {
            let t = i as f32;
            let corner = [-0.9 + 0.05 * t, -0.8 + 0.03 * t, 2.0 + (t * 0.7).sin()];
            plain_quad(corner, [0.6, 0.2, 0.3], [-0.1, 0.7, 0.2], [t / 20., 0.5, 1.0])
        })
        .collect();
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        pool.build().unwrap().install(|| draw(parts.clone(), None))
    };
    let one = with(1);
    assert_eq!(one, with(5));
    assert!(one.rgba.iter().any(|p| p[3] == 1.0));
}

#[test]
fn a_camera_that_looks_at_a_point_has_it_in_the_middle_and_up_above() {
    for eye in [[3., 4., 5.], [0., 9., 0.], [-7., 0.5, 0.]] {
        let target = [0.5, -0.5, 0.25];
        let view = View::look_at(eye, target, 100.0, [64, 48]);
        let middle = view.to_pixel(view.to_camera(target));
        assert!((middle[0] - 32.0).abs() < 1e-9 && (middle[1] - 24.0).abs() < 1e-9);
        let above = view.to_pixel(view.to_camera([0.5, 0.0, 0.25]));
        assert!(above[1] < 24.0 + 1e-9, "{eye:?}: {above:?}");
        let rows = glam::DMat3::from_cols_array_2d(&view.rotation);
        assert!((rows.determinant() - 1.0).abs() < 1e-12);
    }
}

#[test]
fn a_picture_over_a_background_is_rgb_plus_what_is_not_covered() {
    let picture = draw(vec![square(4.0, RED)], None);
    let white = picture.over([1.0; 3]);
    assert_eq!(white[8 * 16 + 6], [1.0, 0.75, 0.75]);
    assert_eq!(picture.to_rgba8()[8 * 16 + 8], [255, 0, 0, 255]);
}
