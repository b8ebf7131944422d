//! Warped frames beside a plain search, cell by cell.

use super::*;
use crate::geometry::{Octree, Voxels};
use b2p_kernels::Isa;
use proptest::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

/// A frame of `top` levels, with values that differ.
fn frame(top: u8, keys: Vec<u64>) -> (PreviousLevel, Voxels) {
    let voxels = Voxels::new(top, keys);
    let values = (0..voxels.len())
        .map(|i| (i % 4000) as i16)
        .map(|i| [i % 700 * 37 % 500, -i, i])
        .collect();
    (PreviousLevel::new(&voxels, values), voxels)
}

/// A lattice of that frame with vectors that `vector` makes of the places of corners.
fn lattice(voxels: &Voxels, level: u8, vector: impl Fn([u32; 3]) -> [i16; 3]) -> Lattice {
    let octree = Octree::new(voxels.clone()).unwrap();
    let mut lattice = Lattice::of(octree.level(level).keys(), level);
    let corners = lattice.level_mut(level).1;
    for i in 0..corners.vectors.len() {
        corners.vectors[i] = vector(corners.at(i));
    }
    lattice
}

fn keys(level: &WarpedLevel) -> Vec<u64> {
    let near = level.near.bricks.each();
    near.flat_map(|(place, mask, _)| ones(mask).map(move |key| morton::encode(place) << 6 | key as u64))
        .collect()
}

/// The warped frame as the clauses say it, cell by cell: of each near cell of the finest level its weight and sums.
fn plain(
    previous: &PreviousLevel,
    voxels: &Voxels,
    lattice: &Lattice,
    [top, unit]: [u8; 2],
    smooth: bool,
) -> BTreeMap<u64, (i64, [i64; 3])> {
    let level = lattice.levels().len() as u8 - 1;
    let side = 1i64 << (top - level);
    let mut cells = BTreeMap::<u64, (i64, [i64; 3])>::new();
    for (i, key) in voxels.keys().iter().enumerate() {
        let at = morton::decode(*key).map(i64::from);
        let node = at.map(|x| x / side);
        let mut sums = [0i128; 3];
        for d in 0..8i64 {
            let d = [d & 1, d >> 1 & 1, d >> 2];
            let offset = [0, 1, 2].map(|axis| 2 * (at[axis] - node[axis] * side) + 1);
            let weights = [0, 1, 2].map(|axis| {
                if d[axis] == 1 {
                    offset[axis]
                } else {
                    2 * side - offset[axis]
                }
            });
            let corners = lattice.finest();
            let corner = corners.number([0, 1, 2].map(|axis| (node[axis] + d[axis]) as u32));
            let weight: i64 = weights.iter().product();
            for (sum, x) in sums.iter_mut().zip(corners.vectors[corner]) {
                *sum += i128::from(weight) * i128::from(x);
            }
        }
        let shift = 3 * (top - level + 1) + unit - top;
        let mut moved =
            [0, 1, 2].map(|axis| 16 * i128::from(at[axis]) + ((16 * sums[axis] + (1 << (shift - 1))) >> shift));
        if smooth && moved.iter().any(|x| x % 16 != 0) {
            let window = (0..64).filter(|cell| {
                let near = [cell & 3, cell >> 2 & 3, cell >> 4];
                let near = [0, 1, 2].map(|axis| at[axis] as i32 + near[axis] - 1);
                previous.index(near).is_some()
            });
            let offset = surface::offset(window.fold(0, |window, cell| window | 1 << cell));
            (0..3).for_each(|axis| moved[axis] += i128::from(offset[axis]));
        }
        for d in 0..8i128 {
            let d = [d & 1, d >> 1 & 1, d >> 2];
            let share = |axis: usize| match d[axis] {
                1 => moved[axis].rem_euclid(16),
                _ => 16 - moved[axis].rem_euclid(16),
            };
            let weight = (share(0) * share(1) * share(2)) as i64;
            let place = [0, 1, 2].map(|axis| moved[axis].div_euclid(16) + d[axis]);
            if weight > 0 && place.iter().all(|x| (0..1 << top).contains(x)) {
                let cell = cells.entry(morton::encode(place.map(|x| x as u32))).or_default();
                cell.0 += weight;
                (0..3).for_each(|t| cell.1[t] += weight * i64::from(previous.values[i][t]));
            }
        }
    }
    cells.retain(|_, (weight, _)| *weight >= 640);
    cells
}

proptest! {
    #[test]
    fn warped_frames_are_those_of_a_plain_search(
        top in 2u8..6,
        depth in 2u8..6,
        keys_of in prop::collection::vec(0u64..1 << 15, 1..300),
        turned in prop::array::uniform9(-3i16..4),
        shift in prop::array::uniform3(-20i16..21),
        least in LEAST..,
        smooth: bool,
    ) {
        let (level, unit) = (top.saturating_sub(depth), top + 2);
        let side = 1i32 << (top - level);
        let (previous, voxels) = frame(top, keys_of.into_iter().map(|key| key & ((1 << (3 * top)) - 1)).collect());
        let lattice = lattice(&voxels, level, |at| [0, 1, 2].map(|axis| {
            let sum: i32 = (0..3).map(|i| i32::from(turned[3 * axis + i]) * at[i] as i32 * side / 8).sum();
            sum as i16 + shift[axis]
        }));
        let expected = plain(&previous, &voxels, &lattice, [top, unit], smooth);
        match Scattered::new(Isa::detect(), &previous, &lattice, [top, unit], smooth).warped(least) {
            Err(error) => {
                prop_assert_eq!(error.clause(), Some(TOO_MANY));
                prop_assert!(expected.len() > 4 * voxels.len() + 64);
            }
            Ok(warped) => for level in 0..=top {
                let down = 3 * (top - level);
                let mut nodes = BTreeMap::<u64, (i64, [i64; 3])>::new();
                let mut there = BTreeSet::new();
                for (key, (weight, sums)) in &expected {
                    let node = nodes.entry(key >> down).or_default();
                    node.0 += weight;
                    (0..3).for_each(|t| node.1[t] += sums[t]);
                    if *weight >= 16 * i64::from(least) {
                        there.insert(key >> down);
                    }
                }
                let found = warped.at(level).unwrap();
                prop_assert_eq!(keys(found), nodes.keys().copied().collect::<Vec<_>>());
                for (i, (weight, sums)) in nodes.values().enumerate() {
                    let colour = sums.map(|sum| (sum as f64 / *weight as f64 + 0.5).floor() as i16);
                    prop_assert_eq!(found.near.values[i], colour);
                }
                let is_there: Vec<u64> = found.voxels().map(|voxel| voxel.0).collect();
                prop_assert_eq!(is_there, there.into_iter().collect::<Vec<_>>());
            },
        }
    }
}

#[test]
fn a_lattice_without_motion_leaves_all_as_it_is_and_whole_steps_move_it() {
    let (previous, voxels) = frame(5, (0..4000).map(|i| i * 7 % 32_768).collect());
    for smooth in [false, true] {
        let still = Scattered::new(
            Isa::detect(),
            &previous,
            &lattice(&voxels, 3, |_| [0; 3]),
            [5, 7],
            smooth,
        )
        .warped(128)
        .unwrap();
        assert_eq!(keys(still.at(5).unwrap()), voxels.keys());
        assert_eq!(still.at(5).unwrap().near.values, previous.values);
        let moved = Scattered::new(
            Isa::detect(),
            &previous,
            &lattice(&voxels, 3, |_| [4, -8, 0]),
            [5, 7],
            smooth,
        )
        .warped(128)
        .unwrap();
        let (cells, colours) = moved.finest();
        for (key, colour) in cells.iter().zip(colours) {
            let [x, y, z] = morton::decode(*key).map(|x| x as i32);
            let index = previous.index([x - 1, y + 2, z]).expect("a voxel was there");
            assert_eq!(previous.values[index], colour);
        }
    }
}

#[test]
fn voxels_that_all_fall_apart_are_refused_by_their_number() {
    // Eight cells are near each of them, a quarter of a weight each.
    let (previous, voxels) = frame(6, (0..200).map(|i| i * 1237 % (1 << 18)).collect());
    let apart = lattice(&voxels, 4, |_| [2, 2, 2]);
    // An eighth of the weight for each of eight cells is less than makes them near; two axes give four of a quarter.
    assert!(
        keys(
            Scattered::new(Isa::detect(), &previous, &apart, [6, 8], false)
                .warped(128)
                .unwrap()
                .at(6)
                .unwrap()
        )
        .is_empty()
    );
    let apart = lattice(&voxels, 4, |_| [2, 2, 0]);
    let near = keys(
        Scattered::new(Isa::detect(), &previous, &apart, [6, 8], false)
            .warped(128)
            .unwrap()
            .at(6)
            .unwrap(),
    );
    assert!(near.len() > 2 * voxels.len(), "{}", near.len());
}
