use proptest::prelude::*;

use super::*;
use crate::cancel::Cancel;
use crate::container::Slice;
use crate::geometry::codec::guide::{Mode, own};
use crate::geometry::codec::{decode_masks, encode_guided, encode_level};
use crate::geometry::{Voxels, morton};
use crate::testing::Random;

/// A tilted plane of depth 7, whose voxels lie in one of two layers where noise decides.
fn noisy_plane() -> Octree {
    let mut random = Random(3);
    let column = |i: u32| {
        let (x, y) = (i % 128, i / 128);
        let noise = (random.next() % 100) as f32 / 100.0;
        morton::encode([x, y, (20.0 + 0.21 * x as f32 + 0.13 * y as f32 + noise) as u32])
    };
    Octree::new(Voxels::new(7, (0..128 * 128).map(column).collect())).unwrap()
}

/// Points in the voxels of a level: some, by their places, where the octree ends with it.
fn points(octree: &Octree, level: u8) -> Vec<u8> {
    let some = |key: &u64| (key.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 56) as u8 | 1;
    match level == octree.depth() {
        true => octree.level(level).keys().iter().map(some).collect(),
        false => octree.occupancy(level).to_vec(),
    }
}

/// The level optimised with this λ, in slices of 1000, and the octree that it decodes to.
fn optimised(octree: &Octree, level: u8, lambda: u32) -> (Vec<(u32, Vec<u8>)>, Octree) {
    guided(octree, level, lambda, None)
}

/// The same with what a previous frame tells.
fn guided(octree: &Octree, level: u8, lambda: u32, guide: Option<Guide>) -> (Vec<(u32, Vec<u8>)>, Octree) {
    let map = octree.kernel_map(level - 1);
    let points = points(octree, level);
    let distortion = Distortion {
        points: &points,
        lambda,
        shown: None,
    };
    let (masks, encoded) = optimise_level(Isa::detect(), octree, &map, level, 1000, distortion, guide);
    let slices: Vec<_> = encoded
        .iter()
        .map(|(voxels, bytes)| Slice {
            voxels: *voxels,
            bytes,
            offset: 0,
        })
        .collect();
    let mut decoded = octree.truncated(level - 1);
    let found = decode_masks(Isa::detect(), level, &map, &slices, 1000, guide, &Cancel::default()).unwrap();
    assert_eq!(found, masks);
    decoded.grow(found).unwrap();
    (encoded, decoded)
}

fn size(encoded: &[(u32, Vec<u8>)]) -> usize {
    encoded.iter().map(|(_, bytes)| bytes.len()).sum()
}

/// Whether every voxel of `a` has one of `b` within one in each coordinate.
fn is_near(a: &Voxels, b: &Voxels) -> bool {
    let side = 1i64 << a.depth();
    (0..a.len()).all(|i| {
        let at = a.coordinate(i).map(i64::from);
        (0..27i64).any(|k| {
            let d = [k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1];
            let place: [i64; 3] = std::array::from_fn(|c| at[c] + d[c]);
            let inside = place.iter().all(|x| (0..side).contains(x));
            inside && b.keys().binary_search(&morton::encode(place.map(|x| x as u32))).is_ok()
        })
    })
}

#[test]
fn a_bit_that_may_cost_nothing_leaves_the_level_exact() {
    let octree = noisy_plane();
    let (encoded, decoded) = optimised(&octree, 7, 0);
    let exact = encode_level(Isa::detect(), &octree, &octree.kernel_map(6), 7, 1000);
    assert_eq!((encoded, decoded), (exact, octree));
}

#[test]
fn the_larger_lambda_the_fewer_bytes() {
    let octree = noisy_plane();
    let sizes = [0, 64, 256, 1024].map(|lambda| size(&optimised(&octree, 7, lambda).0));
    assert!(sizes.is_sorted_by(|a, b| a > b), "{sizes:?}");
    assert!(2 * sizes[3] < sizes[0], "{sizes:?}");
}

#[test]
fn every_number_of_threads_and_every_instruction_set_give_the_same_bytes() {
    let octree = noisy_plane();
    let with_threads = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.unwrap().install(|| optimised(&octree, 7, 200))
    };
    let one = with_threads(1);
    assert_eq!(one, with_threads(3));
    let map = octree.kernel_map(6);
    let points = points(&octree, 7);
    let distortion = Distortion {
        points: &points,
        lambda: 200,
        shown: None,
    };
    for isa in Isa::available() {
        assert_eq!(
            optimise_level(isa, &octree, &map, 7, 1000, distortion, None).1,
            one.0,
            "{isa}"
        );
    }
}

/// The plane with other noise, and its windows as a previous frame would have them; every eleventh parent is skipped if
/// its window has the children that it has.
fn windows_of_other_noise(octree: &Octree) -> (Vec<Mode>, Vec<u64>) {
    let before = Octree::new(Voxels::new(7, {
        let moved = |key: &u64| {
            let [x, y, z] = morton::decode(*key);
            morton::encode([x, y, z + u32::from(key.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 62 == 0)])
        };
        octree.level(7).keys().iter().map(moved).collect()
    }))
    .unwrap();
    let there = |at: [i32; 3]| {
        let key = morton::encode(at.map(|x| x as u32));
        at.iter().all(|x| (0..128).contains(x)) && before.level(7).keys().binary_search(&key).is_ok()
    };
    let window = |parent: usize| {
        let first = octree.level(6).coordinate(parent).map(|x| 2 * x as i32 - 1);
        (0..64).fold(0u64, |window, cell| {
            let at = [0, 1, 2].map(|axis| first[axis] + (cell >> (2 * axis) & 3));
            window | u64::from(there(at)) << cell
        })
    };
    let windows: Vec<u64> = (0..octree.level(6).len()).map(window).collect();
    let masks = octree.occupancy(6).iter().zip(&windows).enumerate();
    let modes = masks.map(|(i, (mask, window))| match i % 11 == 0 && own(*window) == *mask {
        true => Mode::Skip,
        false => Mode::Inter,
    });
    (modes.collect(), windows)
}

#[test]
fn what_a_previous_frame_tells_saves_bits_and_skipped_parents_keep_their_children() {
    let octree = noisy_plane();
    let (modes, windows) = windows_of_other_noise(&octree);
    let guide = Guide {
        modes: &modes,
        windows: &windows,
        near: None,
    };
    let exact = encode_guided(Isa::detect(), &octree, &octree.kernel_map(6), 7, 1000, Some(guide));
    assert_eq!(guided(&octree, 7, 0, Some(guide)), (exact, octree.clone()));
    for lambda in [8, 32] {
        let (alone, with) = (optimised(&octree, 7, lambda), guided(&octree, 7, lambda, Some(guide)));
        let sizes = [&alone.0, &with.0].map(|coded| size(coded));
        assert!(4 * sizes[1] < 3 * sizes[0], "{sizes:?}");
        assert!(is_near(with.1.level(7), octree.level(7)) && is_near(octree.level(7), with.1.level(7)));
        for (i, mode) in modes.iter().enumerate() {
            let masks = [&octree, &with.1].map(|octree| octree.occupancy(6)[i]);
            assert!(*mode != Mode::Skip || masks[0] == masks[1], "parent {i}");
        }
    }
}

proptest! {
    #[test]
    fn coded_voxels_lie_within_one_of_true_ones_and_these_of_coded_ones(
        keys in prop::collection::vec(0u64..1 << 12, 1..400), lambda in 0u32..20_000
    ) {
        let octree = Octree::new(Voxels::new(4, keys)).unwrap();
        let (_, decoded) = optimised(&octree, 4, lambda);
        prop_assert!(is_near(decoded.level(4), octree.level(4)));
        prop_assert!(is_near(octree.level(4), decoded.level(4)));
        prop_assert_eq!(decoded.truncated(3), octree.truncated(3));
    }

    #[test]
    fn distortions_match_their_definition(
        keys in prop::collection::vec(0u64..1 << 12, 1..200),
        mask in 1u8..,
        // Whether voxels are true, copied, or true but not to be shown.
        kinds in prop::collection::vec(0u8..4, 200),
    ) {
        let octree = Octree::new(Voxels::new(4, keys)).unwrap();
        let (parents, truth) = (octree.level(2), octree.occupancy(2));
        let voxels = octree.level(3).keys().iter().zip(octree.occupancy(3)).zip(kinds.into_iter().chain([0; 512]));
        let voxels: Vec<_> = voxels.map(|((key, points), kind)| (*key, if kind == 1 { 0 } else { *points }, kind != 2)).collect();
        let points: Vec<u8> = voxels.iter().map(|voxel| voxel.1).collect();
        let shown_in = |parent: &u64| voxels.iter().filter(|v| v.0 >> 3 == *parent && v.2).map(|v| 1 << (v.0 & 7)).sum();
        let shown: Vec<u8> = parents.keys().iter().map(shown_in).collect();
        let (map, first) = (octree.kernel_map(2), octree.first_child(2));
        for parent in 0..parents.len() {
            let of = |parent: usize| &points[first[parent] as usize..];
            let mut surface = Surface::new(truth[parent], shown[parent], of(parent));
            for k in (0..27).filter(|k| *k != KernelMap::CENTRE) {
                let neighbour = map.row(parent)[k];
                if neighbour != KernelMap::ABSENT {
                    let neighbour = neighbour as usize;
                    surface.add(k, truth[neighbour], shown[neighbour], of(neighbour));
                }
            }
            surface.finish();
            let want = by_definition(&voxels, parents.keys()[parent], mask);
            prop_assert_eq!(surface.of(mask), want);
            let least = (0..8).map(|octant| surface.least(octant, mask >> octant & 1 == 1));
            prop_assert!(least.sum::<u32>() <= want);
        }
    }
}

/// The distortion if a voxel of level 2 has these children and all others are as they are to be shown, by coordinates in
/// quarters of a voxel of level 3. Of each of `voxels`: its key, which of its children hold points, whether it is shown.
fn by_definition(voxels: &[(u64, u8, bool)], parent: u64, mask: u8) -> u32 {
    let centre = |key: u64| morton::decode(key).map(|x| 4 * i64::from(x) + 2);
    let point = |key: u64| morton::decode(key).map(|x| 2 * i64::from(x) + 1);
    let squared = |a: [i64; 3], b: [i64; 3]| (0..3).map(|c| (a[c] - b[c]).pow(2)).sum::<i64>();
    let near = |a: u64, b: u64| {
        let (a, b) = (morton::decode(a), morton::decode(b));
        (0..3).all(|c| a[c].abs_diff(b[c]) <= 1)
    };
    let of = |child: u64| voxels.iter().find(|voxel| voxel.0 == child);
    let coded: Vec<u64> = (0..512)
        .filter(|child| match child >> 3 == parent {
            true => mask >> (child & 7) & 1 == 1,
            false => of(*child).is_some_and(|voxel| voxel.2),
        })
        .collect();
    let points_of = |voxel: &(u64, u8, bool)| {
        ones(voxel.1)
            .map(|octant| voxel.0 << 3 | octant as u64)
            .collect::<Vec<_>>()
    };
    let points: Vec<u64> = voxels.iter().flat_map(points_of).collect();
    // Half squared voxels more than within the voxel, or as far as nothing is seen.
    let nearest = |distances: &mut dyn Iterator<Item = i64>| {
        distances
            .min()
            .map_or(FARTHEST as u32, |nearest| (nearest - 3) as u32 / 8)
    };
    let mut sum = 0;
    for child in parent << 3..=parent << 3 | 7 {
        let here = of(child);
        let is_true = here.is_some_and(|voxel| voxel.1 != 0);
        match (is_true, mask >> (child & 7) & 1 == 1) {
            (true, false) => {
                for own in points.iter().filter(|point| *point >> 3 == child) {
                    let around = coded.iter().filter(|other| near(**other, child));
                    let half = nearest(&mut around.map(|other| squared(centre(*other), point(*own))));
                    let is_shown = here.is_some_and(|voxel| voxel.2);
                    sum += if is_shown { POINT * half } else { HIDDEN * half / 8 };
                }
            }
            (false, true) => {
                let around = points.iter().filter(|point| near(*point >> 3, child));
                let half = nearest(&mut around.map(|other| squared(centre(child), point(*other))));
                let is_chance = here.is_some() && half < FARTHEST as u32;
                sum += if is_chance { COPIED * half } else { ADDED * half };
            }
            _ => {}
        }
    }
    sum
}
