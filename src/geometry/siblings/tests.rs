use super::*;
use crate::geometry::{Octree, Voxels, morton};
use proptest::prelude::*;

/// Compares the maps of all levels with those that have a row for every voxel.
fn check(voxels: Voxels) {
    let octree = Octree::new(voxels).unwrap();
    for level in 0..=octree.depth() {
        let (map, table) = (octree.sibling_map(level), octree.kernel_map(level));
        assert_eq!(map.len(), table.len());
        assert!(map.table() == table, "level {level}");
        for first in [0, map.len() / 3, map.len()] {
            let mut windows = map.windows(first);
            for voxel in first..map.len() {
                let (window, corner) = windows.next().expect("a window for each voxel");
                let (voxels, there) = window.voxels();
                for (k, &neighbour) in table.row(voxel).iter().enumerate() {
                    let at = corner + place(k);
                    assert_eq!(there >> at & 1 == 1, neighbour != KernelMap::ABSENT);
                    assert_eq!(voxels[at], neighbour);
                }
            }
            assert!(windows.next().is_none());
        }
        for i in (0..map.len()).step_by(1 + map.len() / 50) {
            assert_eq!(map.row(i), table.row(i));
            let range = i..(i + 1 + i % 7 * 21).min(map.len());
            let mut buffer = RowBuffer::new();
            let rows = buffer.fill(&map, range.clone());
            assert_eq!(rows, &table.rows()[27 * range.start..27 * range.end]);
            let present = |i: usize| table.row(i).iter().filter(|q| **q != KernelMap::ABSENT).count();
            assert!(
                map.degrees(range.clone())
                    .into_iter()
                    .map(usize::from)
                    .eq(range.clone().map(present))
            );
            let mut masks = vec![0; range.len()];
            map.masks(i, &mut masks);
            for (mask, i) in masks.into_iter().zip(range) {
                assert!((0..27).all(|k| (mask >> k & 1 == 1) == (table.row(i)[k] != KernelMap::ABSENT)));
                assert_eq!(mask >> 27, 0);
            }
        }
        let Some(above) = level.checked_sub(1) else {
            continue;
        };
        let parents = octree.occupancy(above).iter().zip(octree.first_child(above));
        for (parent, (&mask, &first)) in parents.enumerate() {
            let window = map.window(parent);
            for (child, octant) in (first as usize..).zip(crate::geometry::ones(mask)) {
                let around = window.around(octant);
                assert!((0..27).all(|k| around[place(k)] == table.row(child)[k]));
                assert!((0..27).all(|k| window.has(octant, k) == (table.row(child)[k] != KernelMap::ABSENT)));
            }
        }
    }
}

proptest! {
    #[test]
    fn rows_are_those_of_the_kernel_map(keys in prop::collection::vec(0u64..1 << 12, 1..300)) {
        check(Voxels::new(4, keys));
    }
}

#[test]
fn rows_of_extreme_clouds_are_those_of_the_kernel_map() {
    check(Voxels::new(0, vec![0]));
    check(Voxels::new(3, (0..512).collect()));
    check(Voxels::new(21, vec![0, (1 << 63) - 1]));
    check(Voxels::new(21, vec![1 << 62, (1 << 62) - 1]));
}

#[test]
fn rows_of_several_blocks_are_those_of_the_kernel_map() {
    let bowl = (0..1u32 << 14).map(|i| {
        let [x, y] = [i % 128, i / 128];
        morton::encode([x, y, (x * x + y * y) / 256])
    });
    let voxels = Voxels::new(7, bowl.collect());
    assert!(voxels.len() > 8 * BLOCK);
    check(voxels);
}

#[test]
fn a_voxel_lies_in_at_most_eight_windows() {
    for voxels in [
        Voxels::new(3, (0..512).collect()),
        Voxels::new(4, (0..1 << 12).step_by(9).collect()),
        Voxels::new(9, (0..1 << 27).step_by(20_011).collect()),
    ] {
        let map = Octree::new(voxels).unwrap();
        let map = map.sibling_map(map.depth());
        let shown: usize = map.blocks.iter().map(|block| block.voxels.len()).sum();
        assert!(shown <= 8 * map.len(), "{shown} of {}", map.len());
    }
}
