use super::discs::Disc;
use super::*;
use crate::geometry::{Octree, morton};
use crate::testing::Random;
use proptest::prelude::*;

/// A cloud's voxels and their map.
fn cloud(depth: u8, voxels: impl IntoIterator<Item = [u32; 3]>) -> (Voxels, SiblingMap) {
    let keys = voxels.into_iter().map(morton::encode).collect();
    let octree = Octree::new(Voxels::new(depth, keys)).unwrap();
    (octree.level(depth).clone(), octree.sibling_map(depth))
}

fn one_each(voxels: &Voxels, map: &SiblingMap) -> Gaussians {
    let grey = vec![[128; 3]; voxels.len()];
    surfels(
        Isa::detect(),
        voxels,
        map,
        &grey,
        PerVoxel::One,
        SurfelSelection::ALL,
        Frame::default(),
    )
}

/// The walk counts from one voxel to all, by stepping between all pairs of voxels.
fn walks(coordinates: &[[u32; 3]], from: usize, steps: usize) -> Vec<f64> {
    let beside = |a: [u32; 3], b: [u32; 3]| a.into_iter().zip(b).all(|(a, b)| a.abs_diff(b) <= 1);
    let mut counts = vec![0.0; coordinates.len()];
    counts[from] = 1.0;
    for _ in 0..steps {
        let reached = coordinates.iter().map(|&to| {
            let neighbours = coordinates.iter().zip(&counts);
            neighbours.filter(|(q, _)| beside(**q, to)).map(|(_, n)| n).sum()
        });
        counts = reached.collect();
    }
    counts
}

/// Mean and covariance of a neighbourhood around a voxel, as defined.
fn distribution(coordinates: &[[u32; 3]], voxel: usize, steps: usize) -> ([f64; 3], [[f64; 3]; 3]) {
    let weights = walks(coordinates, voxel, steps);
    let total: f64 = weights.iter().sum();
    let offset = |i: usize| {
        let of = |axis| f64::from(coordinates[i][axis]) - f64::from(coordinates[voxel][axis]);
        [0, 1, 2].map(of)
    };
    let mean_of = |f: &dyn Fn([f64; 3]) -> f64| {
        let terms = weights.iter().enumerate().map(|(i, w)| w * f(offset(i)));
        terms.sum::<f64>() / total
    };
    let mean = [0, 1, 2].map(|a| mean_of(&|d| d[a]));
    let covariance = [0, 1, 2].map(|a| [0, 1, 2].map(|b| mean_of(&|d| (d[a] - mean[a]) * (d[b] - mean[b]))));
    (mean, covariance)
}

fn all_discs(isa: Isa, voxels: &Voxels, map: &SiblingMap) -> Vec<Disc> {
    let far = walks::after_all_steps(isa, voxels, map, 0..voxels.len());
    let coordinates: Vec<_> = (0..voxels.len()).map(|i| voxels.coordinate(i)).collect();
    let mut masks = vec![0; voxels.len()];
    map.masks(0, &mut masks);
    isa.run(passes::Fit {
        coordinates: &coordinates,
        masks: &masks,
        far: &far,
    })
}

fn normal(disc: &Disc) -> [f64; 3] {
    let [w, x, y, _] = disc.rotation.map(f64::from);
    [2.0 * w * y, -2.0 * w * x, 1.0 - 2.0 * (x * x + y * y)]
}

fn product(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn discs_match_the_definition(
        keys in prop::collection::vec(0u64..512, 1..150), far_out in prop::bool::ANY
    ) {
        // Far from the origin, sums of absolute coordinates wrap.
        let shift = if far_out { [900_001, 77_777, 1_048_000] } else { [0; 3] };
        let moved = |key| { let c = morton::decode(key); [0, 1, 2].map(|a| c[a] + shift[a]) };
        let (voxels, map) = cloud(21, keys.into_iter().map(moved));
        let coordinates: Vec<_> = (0..voxels.len()).map(|i| voxels.coordinate(i)).collect();
        for isa in Isa::available() {
            for (i, disc) in all_discs(isa, &voxels, &map).iter().enumerate() {
                let n = normal(disc);
                prop_assert!((product(n, n) - 1.0).abs() < 1e-5);
                let (near, _) = distribution(&coordinates, i, 1);
                let (mean, covariance) = distribution(&coordinates, i, moments::ROUNDS);
                // The variance along the normal is the least of all: no direction has less.
                let along = |d: [f64; 3]| product(d, covariance.map(|row| product(row, d)));
                let least = along(n);
                for a in -4..=4 {
                    for b in -4..=4 {
                        for d in [[a, b, 4], [a, 4, b], [4, a, b]] {
                            let d = d.map(f64::from);
                            prop_assert!(along(d) / product(d, d) > least - 2e-5);
                        }
                    }
                }
                let density: f64 = n.iter().map(|v| v.abs()).sum();
                let thick = ((least - density * density / 12.0) / 0.4).clamp(0.0, 1.0);
                let high = product(mean, n);
                let height = high + thick * (product(near, n) - high);
                for axis in 0..3 {
                    let inwards = 0.2 * (mean[axis] - high * n[axis]);
                    let centre = f64::from(disc.centre[axis]);
                    prop_assert!((centre - height * n[axis] - inwards).abs() < 1e-4);
                }
            }
        }
    }

    #[test]
    fn every_instruction_set_gives_the_same_bits(
        keys in prop::collection::vec(0u64..4096, 1..600), seed in any::<u8>()
    ) {
        let (voxels, map) = cloud(4, keys.into_iter().map(morton::decode));
        let colour = |i: usize| [i * 7, i * 31, i * 101].map(|v| (v as u8).wrapping_mul(seed));
        let colours: Vec<_> = (0..voxels.len()).map(colour).collect();
        for per_voxel in [PerVoxel::One, PerVoxel::Four] {
            let made = |isa| surfels(isa, &voxels, &map, &colours, per_voxel, SurfelSelection::ALL, Frame::default());
            let expected = made(Isa::available()[0]);
            prop_assert!(expected.check_lengths().is_ok());
            for isa in Isa::available() {
                prop_assert!(made(isa) == expected, "{}", isa);
            }
        }
    }
}

#[test]
fn an_isolated_voxel_becomes_a_sphere_at_its_centre() {
    let (voxels, map) = cloud(3, [[5, 2, 7]]);
    let blob = one_each(&voxels, &map);
    let [x, y, z] = blob.scale[0];
    assert!(x == y && y == z && x == 0.4 * 0.25);
    assert_eq!(blob.position[0], [0.375, -0.375, 0.875]);
    assert_eq!(blob.colour[0], [128.0 / 255.0; 3]);
}

#[test]
fn a_row_of_voxels_is_as_thick_as_a_voxel() {
    let (voxels, map) = cloud(5, (3..25).map(|x| [x, 4, 4]));
    for scale in one_each(&voxels, &map).scale {
        assert!(scale.iter().all(|s| (s / (2.0 / 32.0) - 0.4).abs() < 0.01));
    }
}

#[test]
fn a_flat_face_is_flat() {
    for axis in 0..3 {
        let at = |i: u32| {
            let mut c = [i % 16, i / 16, 0];
            c.rotate_right(axis);
            c[(2 + axis) % 3] = 9;
            c
        };
        let (voxels, map) = cloud(4, (0..256).map(at));
        let gaussians = one_each(&voxels, &map);
        let flat = (2 + axis) % 3;
        let height = 2.0 * 9.5 / 16.0 - 1.0;
        assert!(gaussians.position.iter().all(|p| (p[flat] - height).abs() < 1e-6));
        let thin = gaussians.scale.iter().filter(|s| s[2] < 0.02 * s[0]).count();
        assert!(thin >= 14 * 14, "{thin} discs are thin");
    }
}

#[test]
fn a_staircase_becomes_a_plane() {
    // A plane of slope 1/3, and every voxel that it cuts.
    let on = |i: u32| (i % 48, i / 48);
    let voxels = (0..48 * 48).map(on).map(|(x, y)| [x, y, 8 + x / 3]);
    let (voxels, map) = cloud(6, voxels);
    let discs = all_discs(Isa::detect(), &voxels, &map);
    for (i, disc) in discs.iter().enumerate() {
        let [x, y, z] = voxels.coordinate(i);
        if [x, y].iter().any(|v| !(5..43).contains(v)) {
            continue;
        }
        // Voxels of one step have the middles of their heights on the slope.
        let centre = [x, y, z].map(|v| f64::from(v) + 0.5);
        let at: Vec<f64> = (0..3).map(|a| centre[a] + f64::from(disc.centre[a])).collect();
        let off = (at[2] - 8.5 - (at[0] - 1.5) / 3.0) / 10f64.sqrt() * 3.0;
        assert!(off.abs() < 0.12, "voxel {i} is {off} off");
        let cosine = product(normal(disc), [-1.0, 0.0, 3.0]) / 10f64.sqrt();
        assert!(cosine > 0.99, "{cosine}");
    }
}

#[test]
fn unconnected_sheets_do_not_affect_each_other() {
    let sheet = |z: u32| (0..400).map(move |i| [i % 20, i / 20, z]);
    let (alone, map) = cloud(5, sheet(8));
    let one = one_each(&alone, &map);
    let (both, map) = cloud(5, sheet(8).chain(sheet(10)));
    let two = one_each(&both, &map);
    let lower = (0..both.len()).filter(|&i| both.coordinate(i)[2] == 8);
    for (i, j) in lower.zip(0..) {
        assert_eq!(two.position[i], one.position[j]);
        assert_eq!(two.scale[i], one.scale[j]);
        assert_eq!(two.rotation[i], one.rotation[j]);
    }
}

#[test]
fn touching_sheets_and_a_full_cube_give_finite_discs_within_their_voxels() {
    let sheets = (0..800).map(|i| [i % 20, i / 20 % 20, 8 + i / 400]);
    let full = (0..4096).map(|i| [i % 16, i / 16 % 16, i / 256]);
    for (voxels, map) in [cloud(5, sheets), cloud(5, full)] {
        for disc in all_discs(Isa::detect(), &voxels, &map) {
            assert!(disc.centre.iter().all(|v| v.abs() < 1.0));
            assert!(disc.rotation.iter().all(|v| v.is_finite()));
            assert!(disc.radius > 0.3 && disc.radius < 0.7);
        }
    }
}

#[test]
fn discs_of_a_ball_lie_below_its_surface_and_face_outwards() {
    const RADIUS: f64 = 12.0;
    let middle = 15.7;
    let from = |c: [u32; 3]| c.map(|v| f64::from(v) + 0.5 - middle);
    let length = |d: [f64; 3]| product(d, d).sqrt();
    let shell = (0..1 << 15).map(|i| [i % 32, i / 32 % 32, i / 1024]);
    let shell = shell.filter(|&c| (length(from(c)) - RADIUS).abs() < 0.6);
    let (voxels, map) = cloud(5, shell);
    let mut mean = 0.0;
    for (i, disc) in all_discs(Isa::detect(), &voxels, &map).iter().enumerate() {
        let d = from(voxels.coordinate(i));
        let at = [0, 1, 2].map(|a| d[a] + f64::from(disc.centre[a]));
        assert!((length(at) - RADIUS).abs() < 0.5, "{}", length(at));
        assert!(product(normal(disc), d).abs() / length(d) > 0.95);
        mean += length(at) / voxels.len() as f64;
    }
    assert!((RADIUS - 0.3..RADIUS).contains(&mean), "{mean}");
}

#[test]
fn four_discs_follow_the_colour_gradient() {
    let (voxels, map) = cloud(5, (0..900).map(|i| [i % 30, i / 30, 7]));
    let colours = (0..voxels.len()).map(|i| {
        let [x, y, _] = voxels.coordinate(i);
        [(8 * x) as u8, (6 * y) as u8, 100]
    });
    let colours: Vec<_> = colours.collect();
    let frame = Frame::default();
    let four = surfels(
        Isa::detect(),
        &voxels,
        &map,
        &colours,
        PerVoxel::Four,
        SurfelSelection::ALL,
        frame,
    );
    assert_eq!(four.len(), 4 * voxels.len());
    for i in 0..four.len() {
        let [x, y, z] = voxels.coordinate(i / 4);
        if [x, y].iter().any(|v| !(3..27).contains(v)) {
            continue;
        }
        let place = four.position[i].map(|v| (v + 1.0) * 16.0 - 0.5);
        assert!((place[0] - x as f32).abs() == 0.25 && (place[1] - y as f32).abs() == 0.25);
        assert!((place[2] - z as f32).abs() < 1e-4);
        // Damping takes some of the slope.
        let [red, green, blue] = four.colour[i].map(|v| v * 255.0);
        assert!((red - 8.0 * place[0]).abs() < 0.25 && (green - 6.0 * place[1]).abs() < 0.25);
        assert_eq!(blue, 100.0);
    }
}

#[test]
fn a_choice_of_voxels_gives_their_discs_in_another_size() {
    let (voxels, map) = cloud(6, (0..3000).map(|i| [i % 60, i / 60, (i % 60 + i / 60) / 4]));
    let colours: Vec<_> = (0..voxels.len()).map(|i| [i as u8, (i / 7) as u8, 9]).collect();
    let only: Vec<bool> = (0..voxels.len()).map(|i| i % 3 == 0 || i / 500 % 2 == 0).collect();
    for per_voxel in [PerVoxel::One, PerVoxel::Four] {
        let make = |choice| {
            surfels(
                Isa::detect(),
                &voxels,
                &map,
                &colours,
                per_voxel,
                choice,
                Frame::default(),
            )
        };
        let all = make(SurfelSelection::ALL);
        let some = make(SurfelSelection {
            only: Some(&only),
            size: 0.5,
            ..SurfelSelection::ALL
        });
        let n = per_voxel.count();
        let chosen: Vec<usize> = (0..all.len()).filter(|i| only[i / n]).collect();
        assert_eq!(some.len(), chosen.len());
        for (to, &from) in chosen.iter().enumerate() {
            assert_eq!(some.position[to], all.position[from]);
            assert_eq!(some.colour[to], all.colour[from]);
            let [u, v, thickness] = all.scale[from];
            assert_eq!(some.scale[to], [0.5 * u, 0.5 * v, thickness]);
        }
    }
}

/// A wall of 128 × 128 voxels at z = 9 of which a random share is there.
fn wall(share: f64) -> Vec<[u32; 3]> {
    let mut random = Random(5);
    let mut is_there = move || (random.next() % 10_000) as f64 / 10_000.0 < share;
    let all = (0..128 * 128).map(|i| [i % 128, i / 128, 9]);
    all.filter(|_| is_there()).collect()
}

/// How opaque discs are at a place of the plane z = 9.5, in voxels.
fn opacity(gaussians: &Gaussians, edge: f64, at: [f64; 2]) -> f64 {
    let splats = gaussians.position.iter().zip(&gaussians.scale);
    let transmitted = splats.map(|(p, s)| {
        let off = |axis: usize| (f64::from(p[axis]) + 1.0) / edge - at[axis];
        let sigma = f64::from(s[0]) / edge;
        1.0 - (-(off(0).powi(2) + off(1).powi(2)) / (2.0 * sigma * sigma)).exp()
    });
    1.0 - transmitted.product::<f64>()
}

#[test]
fn walls_close_whatever_share_of_their_voxels_is_there() {
    for share in [1.0, 0.4, 0.25, 0.12] {
        let (voxels, map) = cloud(7, wall(share));
        let wall = one_each(&voxels, &map);
        let inner = |i: u32| [f64::from(12 + i % 30 * 3) + 0.3, f64::from(12 + i / 30 * 3) + 0.7];
        let open = (0..900)
            .filter(|&i| opacity(&wall, 2.0 / 128.0, inner(i)) < 0.5)
            .count();
        assert!(open < 9, "{open} of 900 places are open at {share}");
    }
}

#[test]
fn discs_at_the_border_of_a_wall_reach_no_farther_than_its_points_are_apart() {
    for share in [1.0, 0.6, 0.4, 0.25, 0.12, 0.08] {
        let (voxels, map) = cloud(8, wall(share));
        let wall = one_each(&voxels, &map);
        // The mean distance of the points, and half a voxel.
        let reach = 0.5 + 1.0 / share.sqrt();
        let beside = |i: u32| [128.0 + reach, 4.0 + f64::from(2 * i)];
        let mean = (0..60).map(|i| opacity(&wall, 2.0 / 256.0, beside(i))).sum::<f64>() / 60.0;
        assert!(mean < 0.4, "{mean} at {share}");
    }
}

#[test]
fn lone_voxels_are_faint_beside_a_dense_surface_only() {
    let specks = |count: u32| (0..count).map(|i| [4 * (i % 32), 4 * (i / 32), 20]);
    let (voxels, map) = cloud(7, wall(1.0).into_iter().chain(specks(40)));
    let drawn = one_each(&voxels, &map);
    for (i, opacity) in drawn.opacity.iter().enumerate() {
        let is_speck = voxels.coordinate(i)[2] == 20;
        assert_eq!(*opacity, if is_speck { 1.0 / 64.0 } else { 1.0 });
    }
    // A few stand for nothing, and without a surface they are all there is.
    for few in [
        wall(1.0).into_iter().chain(specks(20)).collect(),
        specks(1024).collect::<Vec<_>>(),
    ] {
        let (voxels, map) = cloud(7, few);
        assert!(one_each(&voxels, &map).opacity.iter().all(|&opacity| opacity == 1.0));
    }
}

#[test]
fn levels_that_are_not_sparse_have_the_discs_of_walks_to_the_bit() {
    let range = |side: u32| (0..side.pow(3)).map(move |i| [i % side, i / side % side, i / side.pow(2)]);
    let off = |v: u32, middle: f64| f64::from(v) + 0.5 - middle;
    let ball = range(48).filter(|at| (at.map(|v| off(v, 24.0).powi(2)).iter().sum::<f64>().sqrt() - 20.0).abs() < 0.6);
    let torus = range(64).filter(|&[x, y, z]| {
        let along = off(x, 32.0).hypot(off(y, 32.0)) - 20.0;
        (along.hypot(off(z, 32.0)) - 7.0).abs() < 0.6
    });
    // A surface with single voxels missing, and one with a few lone voxels beside it.
    let specks = (0..20).map(|i| [3 * i, 40, 50]);
    let clouds = [
        ball.collect::<Vec<_>>(),
        torus.collect(),
        wall(0.8),
        wall(1.0).into_iter().chain(specks).collect(),
    ];
    for of in clouds {
        let octree = Octree::new(Voxels::new(7, of.into_iter().map(morton::encode).collect())).unwrap();
        for level in 4..=7 {
            let (voxels, map) = (octree.level(level), octree.sibling_map(level));
            let drawn = one_each(voxels, &map);
            let edge = 2.0 / (1u32 << level) as f32;
            for (i, disc) in all_discs(Isa::detect(), voxels, &map).into_iter().enumerate() {
                let [radius, thickness] = [disc.radius, disc.thickness].map(|v| v * edge);
                assert_eq!(drawn.scale[i], [radius, radius, thickness]);
                let centre = cube_centre(voxels.coordinate(i), edge);
                let position = [0, 1, 2].map(|axis| centre[axis] + disc.centre[axis] * edge);
                assert_eq!(drawn.position[i], position);
                assert_eq!((drawn.rotation[i], drawn.opacity[i]), (disc.rotation, 1.0));
            }
        }
    }
}

#[test]
fn bars_beside_a_dense_surface_do_not_merge() {
    // Bars one voxel thick, every fourth column, above a sheet that has most of the voxels; lone voxels above them.
    let sheet = (0..60 * 60).map(|i| [i % 60, i / 60, 2]);
    let bars = (0..4 * 20).map(|i| [4 * (i % 4), i / 4, 12]);
    let specks = (0..20).map(|i| [3 * i, 50, 50]);
    let (voxels, map) = cloud(6, sheet.chain(bars).chain(specks));
    assert!(sparsity::is_sparse(&map, 0..map.len()));
    let gaussians = one_each(&voxels, &map);
    for i in (0..voxels.len()).filter(|&i| voxels.coordinate(i)[2] == 12) {
        assert!(gaussians.scale[i].iter().all(|s| (s * 32.0 - 0.4).abs() < 0.01));
    }
}

#[test]
fn windows_give_the_same_discs_with_every_instruction_set_and_number_of_threads() {
    let (voxels, map) = cloud(7, wall(0.2));
    let colours: Vec<[u8; 3]> = (0..voxels.len()).map(|i| [i as u8, (i / 7) as u8, 90]).collect();
    let draw = |isa, per_voxel| {
        let (all, frame) = (SurfelSelection::ALL, Frame::default());
        surfels(isa, &voxels, &map, &colours, per_voxel, all, frame)
    };
    for per_voxel in [PerVoxel::One, PerVoxel::Four] {
        let expected = draw(Isa::SCALAR, per_voxel);
        assert!(expected.scale.iter().any(|s| s[0] > 1.5 * 0.62 / 64.0));
        for isa in Isa::available() {
            for threads in [1, 2, 5] {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                let found = pool.install(|| draw(isa, per_voxel));
                assert!(found == expected, "{isa}, {threads} threads");
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn windows_hold_what_is_within_their_reach(
        keys in prop::collection::vec(0u64..1 << 15, 1..200), depth in 5u8..21
    ) {
        let (voxels, _) = cloud(depth, keys.into_iter().map(morton::decode));
        let mut search = Windows::new(&voxels);
        let all: Vec<_> = (0..voxels.len()).map(|i| voxels.coordinate(i)).collect();
        for &middle in &all {
            let within = |reach: u32| {
                let near = |at: &&[u32; 3]| (0..3).all(|a| at[a].abs_diff(middle[a]) <= reach);
                all.iter().filter(near).collect::<Vec<_>>()
            };
            let reach = [2, 4, 8].into_iter().find(|&reach| within(reach).len() >= 16);
            let window = search.around(middle);
            prop_assert_eq!(window.map(|w| u32::from(w.reach)), reach);
            if let Some(window) = window {
                let inside = within(window.reach.into());
                let offset = |at: &[u32; 3], a: usize| at[a] as i32 - middle[a] as i32;
                prop_assert_eq!(usize::from(window.count), inside.len());
                for (k, (a, b)) in moments::PAIRS.into_iter().enumerate() {
                    let square: i32 = inside.iter().map(|at| offset(at, a) * offset(at, b)).sum();
                    prop_assert_eq!(window.square[k], square);
                }
                for a in 0..3 {
                    prop_assert_eq!(window.sum[a], inside.iter().map(|at| offset(at, a)).sum::<i32>());
                }
            }
        }
    }
}
