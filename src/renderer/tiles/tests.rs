//! The lists of the tiles.

use b2p_kernels::Isa;

use super::*;
use crate::error::Error;
use crate::gaussians::Gaussians;
use crate::renderer::camera::Camera;
use crate::renderer::projection::How;

/// A small generator: the shapes need no quality, only variety.
fn gaussians(count: usize) -> Gaussians {
    let mut state = 1u32;
    let mut random = |low: f32, high: f32| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        low + (high - low) * ((state >> 8) as f32 / (1u32 << 24) as f32)
    };
    let mut all = Gaussians::default();
    for _ in 0..count {
        all.position.push(std::array::from_fn(|_| random(-1.0, 1.0)));
        all.scale.push(std::array::from_fn(|_| 10f32.powf(random(-3.0, -0.5))));
        all.rotation.push(std::array::from_fn(|_| random(-1.0, 1.0)));
        all.opacity.push(random(0.0, 1.0));
        all.colour.push([0.0; 3]);
    }
    all
}

struct Scene {
    grid: Grid,
    ellipses: Ellipses,
    counts: Vec<Count>,
}

fn project(all: &Gaussians, width: u32, height: u32) -> Scene {
    let camera = Camera::orbit(30.0, 10.0, 3.0, 45.0, width, height).unwrap();
    let mut scene = Scene {
        grid: Grid::new(camera.window()),
        ellipses: Ellipses::default(),
        counts: Vec::new(),
    };
    let how = How {
        isa: Isa::SCALAR,
        compensated: false,
        floor: 1.0 / 255.0,
        near_care: false,
        slopes: false,
        colours: None,
    };
    scene
        .ellipses
        .project(
            all,
            &camera,
            how,
            &mut scene.counts,
            |count, length| count.start(scene.grid, length),
            |count, e| count.count(scene.grid, e),
        )
        .unwrap();
    scene
}

/// The ellipses that touch a tile, nearest first, found the plain way.
fn expected(scene: &Scene, row: usize, column: usize) -> Vec<u64> {
    let (x, y) = (column as u32 * TILE, row as u32 * TILE);
    let mut keys = Vec::new();
    let runs: Vec<_> = scene.ellipses.runs().collect();
    for place in runs.into_iter().flatten() {
        let e = &scene.ellipses.all()[place];
        let b = &e.bounds;
        if b.x0 < x + TILE && b.x1 > x && b.y0 < y + TILE && b.y1 > y {
            keys.push(u64::from(e.depth.to_bits()) << 32 | place as u64);
        }
    }
    keys.sort();
    keys
}

#[test]
fn every_tile_lists_just_the_ellipses_whose_bounds_touch_it_nearest_first() {
    let all = gaussians(9000);
    for most in [u64::MAX, 20_000, 4000] {
        let mut scene = project(&all, 183, 150);
        let mut bins = Bins::default();
        let pairs = bins.plan(scene.grid, &mut scene.counts, 0, &Limits::default()).unwrap();
        bins.most = bins.most.min(most).max(3500);
        let (mut part, mut parts, mut listed, mut tiles) = (bins.next(None), 0, 0, 0);
        while let Some(now) = part {
            bins.fill(now.clone(), &scene.ellipses, &mut scene.counts).unwrap();
            for row in now.rows.clone() {
                for column in now.columns.clone() {
                    let mut nearest = Nearest::default();
                    nearest.take(bins.tile(row, column));
                    let mut keys = Vec::new();
                    nearest.each(|some, _| {
                        keys.extend_from_slice(some);
                        true
                    });
                    assert_eq!(keys, expected(&scene, row, column));
                    listed += keys.len() as u64;
                    tiles += 1;
                }
            }
            parts += 1;
            part = bins.next(Some(&now));
        }
        assert_eq!((listed, tiles), (pairs, 6 * 5));
        assert_eq!(parts > 1, most != u64::MAX, "{parts} parts");
    }
}

#[test]
fn a_far_outlier_in_a_tile_leaves_the_order_of_the_rest() {
    let keys: Vec<u64> = (0..5000u64)
        .map(|i| {
            let depth = if i == 77 {
                1e30
            } else {
                2.0 + (i * 7919 % 5000) as f32 * 1e-6
            };
            u64::from(depth.to_bits()) << 32 | i
        })
        .collect();
    let entries: Vec<AtomicU64> = keys.iter().copied().map(AtomicU64::new).collect();
    let mut nearest = Nearest::default();
    nearest.take(&entries);
    let mut sorted = Vec::new();
    nearest.each(|some, _| {
        sorted.extend_from_slice(some);
        true
    });
    let mut expected = keys;
    expected.sort();
    assert_eq!(sorted, expected);
}

#[test]
fn lists_over_the_limit_are_refused_before_they_are_made() {
    let all = gaussians(300);
    let entries = project(&all, 32, 32).ellipses.len() as u64;
    let threads = rayon::current_num_threads() as u64;
    let needed = entries * (8 + Nearest::BYTES * threads);
    let plan = |reserved, max_bytes| {
        let mut scene = project(&all, 32, 32);
        let limits = Limits {
            max_bytes,
            ..Limits::default()
        };
        Bins::default().plan(scene.grid, &mut scene.counts, reserved, &limits)
    };
    assert_eq!(plan(100, needed + 100).unwrap(), entries);
    let error = plan(100, needed + 99).unwrap_err();
    assert!(matches!(error, Error::LimitExceeded { needed: n, .. } if n == needed + 100));
}

#[test]
fn more_pairs_than_are_allowed_are_refused_before_they_are_listed() {
    let all = gaussians(300);
    let pairs = project(&all, 64, 64)
        .counts
        .iter()
        .map(|count| count.pairs)
        .sum::<u64>();
    let plan = |max_pairs| {
        let mut scene = project(&all, 64, 64);
        let limits = Limits {
            max_pairs,
            ..Limits::default()
        };
        Bins::default().plan(scene.grid, &mut scene.counts, 0, &limits)
    };
    assert_eq!(plan(pairs).unwrap(), pairs);
    let error = plan(pairs - 1).unwrap_err();
    assert!(
        matches!(
            error,
            Error::LimitExceeded {
                option: "max_pairs",
                ..
            }
        ),
        "{error}"
    );
}

#[test]
fn tiles_are_put_in_order_whatever_their_depths_are() {
    let mut state = 1u64;
    let mut random = |below: u64| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (state >> 33) % below
    };
    let mut nearest = Nearest::default();
    for count in [0, 1, 2, 31, 64, 65, 96, 100, 1000, 20_000] {
        for depths in [1, 2, 10, 1000, 1 << 23] {
            // Of each kind a few far away.
            let mut keys: Vec<u64> = (0..count)
                .map(|i| {
                    let far = if random(50) == 0 { 1 << 28 } else { 0 };
                    ((1 << 29) + far + random(depths)) << 32 | i
                })
                .collect();
            let entries: Vec<AtomicU64> = keys.iter().copied().map(AtomicU64::new).collect();
            nearest.take(&entries);
            let mut sorted = Vec::new();
            nearest.each(|some, _| {
                sorted.extend_from_slice(some);
                true
            });
            keys.sort();
            assert_eq!(sorted, keys, "{count} of {depths} depths");
        }
    }
}
