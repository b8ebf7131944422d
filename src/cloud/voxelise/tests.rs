use super::*;
use crate::testing::Random;
use proptest::prelude::*;

fn cloud(positions: &[[f64; 3]]) -> PointCloud {
    PointCloud {
        positions: positions.to_vec(),
        colours: (0..positions.len()).map(|i| [i as u8; 3]).collect(),
        ..PointCloud::default()
    }
}

fn coordinates(voxels: &Voxels) -> Vec<[u32; 3]> {
    (0..voxels.len()).map(|i| voxels.coordinate(i)).collect()
}

#[test]
fn integer_coordinates_are_kept() {
    let grid = voxelise(&cloud(&[[5.0, 0.0, 1.0], [4.0, 0.0, 0.0]]), None).unwrap();
    assert_eq!(grid.voxels.depth(), 10);
    assert_eq!(coordinates(&grid.voxels), [[4, 0, 0], [5, 0, 1]]);
    assert_eq!(grid.colours, [[1; 3], [0; 3]]);
    assert_eq!(grid.placement, Placement::VOXEL_GRID);
}

#[test]
fn the_depth_is_the_caller_s_else_the_comments_else_the_least_from_ten() {
    let mut points = cloud(&[[0.0; 3], [1500.0, 3.0, 0.0]]);
    let depth = |points: &PointCloud, bits| voxelise(points, bits).unwrap().voxels.depth();
    assert_eq!(depth(&points, None), 11);
    assert_eq!(depth(&points, Some(15)), 15);
    points.hints.bits = Some(12);
    assert_eq!(depth(&points, None), 12);
    points.hints.bits = Some(9);
    assert_eq!(depth(&points, None), 11);
    points.positions[1] = [0.0; 3];
    points.hints.bits = Some(1);
    assert_eq!(depth(&points, None), 1);
    for bits in [0, 22] {
        assert!(matches!(voxelise(&points, Some(bits)), Err(Error::Usage(_))));
    }
}

/// Random points on a sphere of radius 1.
fn sphere(count: usize) -> PointCloud {
    let mut random = Random(3);
    let mut draw = || (random.next() % 2001) as f64 / 1000.0 - 1.0;
    let mut positions = Vec::new();
    while positions.len() < count {
        let at = [draw(), draw(), draw()];
        let length = at.iter().map(|x| x * x).sum::<f64>().sqrt();
        if (0.1..1.0).contains(&length) {
            positions.push(at.map(|x| x / length));
        }
    }
    cloud(&positions)
}

#[test]
fn sparse_surfaces_get_the_finest_grid_that_closes_them() {
    let mut last = 0;
    for points in [3_000, 12_000, 60_000, 250_000] {
        let cloud = sphere(points);
        let (grid, finest) = voxelise_closed(&cloud).unwrap();
        assert_eq!(finest.finest, 10);
        let voxels = |bits: u8| voxelise(&cloud, Some(bits)).unwrap().voxels.len();
        let depth = grid.voxels.depth();
        let is_closed = |bits: u8| 2 * voxels(10) >= 5 * voxels(bits - 1);
        assert!(is_closed(depth) && !is_closed(depth + 1), "{points} at {depth}");
        assert!(depth > last);
        assert_eq!(grid, voxelise(&cloud, Some(depth)).unwrap());
        last = depth;
    }
}

#[test]
fn closed_grids_and_points_without_a_surface_keep_their_depth() {
    let plane = (0..90_000).map(|i| [f64::from(i % 300), f64::from(i / 300), 7.0]);
    let grid = cloud(&plane.collect::<Vec<_>>());
    let alone = cloud(&[[0.0; 3], [0.5, 0.25, 0.125], [1.0; 3]]);
    for cloud in [grid, alone] {
        let whole = voxelise(&cloud, None).unwrap();
        let (closed, report) = voxelise_closed(&cloud).unwrap();
        assert_eq!((closed, report.bits, report.finest), (whole, 10, 10));
    }
}

#[test]
fn points_far_from_all_others_cost_depth_but_no_detail() {
    let alone = sphere(60_000);
    let (own, report) = voxelise_closed(&alone).unwrap();
    let mut with_strays = alone.clone();
    for far in [[900.0, 3.0, 0.0], [-20.0, 1000.0, 5.0], [0.0, 0.0, -700.0]] {
        with_strays.positions.push(far);
        with_strays.colours.push([9; 3]);
    }
    let (grid, strayed) = voxelise_closed(&with_strays).unwrap();
    assert!(strayed.bits > report.bits + 7, "{strayed}");
    assert!(
        strayed.voxel_size <= 1.5 * report.voxel_size,
        "{strayed} against {report}"
    );
    assert!(
        grid.voxels.len() * 10 > own.voxels.len() * 6,
        "{strayed} against {report}"
    );

    // A kilometre of air for a millimetre of detail: the deepest grid is as good as there is.
    with_strays.positions.push([1e7, 0.0, 0.0]);
    with_strays.colours.push([9; 3]);
    assert_eq!(voxelise_closed(&with_strays).unwrap().1.bits, 21);
}

#[test]
fn outliers_are_left_out_on_request_and_nothing_else_is() {
    let mut raw = crate::cloud::RawPoints {
        positions: sphere(60_000).positions,
        ..Default::default()
    };
    raw.positions
        .extend([[1e7, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 0.0]]);
    let options = crate::cloud::ReadOptions {
        drop_outliers: true,
        ..Default::default()
    };
    let (cloud, notes) = raw.finish(&options).unwrap();
    assert_eq!(cloud.positions.len(), 60_000);
    assert_eq!(notes[1].to_string(), "left out 3 points: far from all others");
}

#[test]
fn integers_anywhere_are_a_grid_that_starts_at_the_least() {
    let grid = voxelise(&cloud(&[[-3.0, 4_000_000.0, 7.0], [5.0, 4_000_002.0, 7.0]]), None).unwrap();
    assert_eq!(coordinates(&grid.voxels), [[0, 0, 0], [8, 2, 0]]);
    assert_eq!(grid.placement.origin, [-3.5, 3_999_999.5, 6.5]);
    assert_eq!(grid.placement.voxel_size, 1.0);
}

#[test]
fn centres_of_voxels_in_the_world_come_back_as_those_voxels() {
    for origin in [[0.1, -7.0, 3.0], [500_000.0, 4_000_000.0, 12.0], [-1.0; 3]] {
        let points = [[0.0; 3], [3.0, 700.0, 1.0], [1023.0, 5.0, 77.0]];
        let mut grid = voxelise(&cloud(&points), None).unwrap();
        for voxel_size in [0.003, 2.0] {
            grid.placement = Placement { origin, voxel_size };
            let world = grid.to_world();
            assert_eq!(voxelise(&world, None).unwrap(), grid, "{origin:?} {voxel_size}");
            assert_eq!(voxelise_closed(&world).unwrap().0, grid);
            let file = PointCloud::from_ply(&world.to_ply(), &crate::Limits::default()).unwrap();
            assert_eq!(voxelise(&file, None).unwrap(), grid);
            let coarse = voxelise(&world, Some(8)).unwrap();
            assert!(coordinates(&coarse.voxels).contains(&[255, 1, 19]));
        }
    }
}

#[test]
fn a_report_says_what_became_of_the_points() {
    let grid = voxelise(&cloud(&[[0.0; 3], [0.5, 0.25, 0.125], [1.0; 3]]), Some(9)).unwrap();
    let axes = crate::Axes {
        metres_per_unit: Some(1.587_2),
        ..Default::default()
    };
    let report = GridReport::of(&grid, 341_989, &axes, 9);
    assert_eq!(report.to_string(), "341,989 points → 3 voxels of 3.1 mm (9 bits)");
    assert!(report.merges_most());
    let report = GridReport::of(&grid, 5, &Axes::default(), 9);
    assert_eq!(report.to_string(), "5 points → 3 voxels of 0.002 units (9 bits)");
    assert!(!report.merges_most());
}

#[test]
fn too_few_bits_drop_the_lowest_and_keep_the_place() {
    let grid = voxelise(&cloud(&[[1500.0, 3.0, 0.0]]), Some(9)).unwrap();
    assert_eq!(coordinates(&grid.voxels), [[375, 0, 0]]);
    assert_eq!(grid.placement.origin, [-0.5; 3]);
    assert_eq!(grid.placement.voxel_size, 4.0);
}

#[test]
fn points_in_one_voxel_merge_to_their_mean_colour() {
    let mut points = cloud(&[[1.0, 1.0, 1.0]; 4]);
    points.colours = vec![[0, 255, 1], [0, 255, 1], [1, 255, 2], [1, 254, 1]];
    let grid = voxelise(&points, None).unwrap();
    assert_eq!(grid.voxels.len(), 1);
    assert_eq!(grid.colours, [[1, 255, 1]]);
}

#[test]
fn the_longest_side_of_a_metric_cloud_spans_the_cube_and_the_others_are_centred() {
    let points = cloud(&[[-1.0, 0.25, 7.0], [3.0, 2.25, 7.0], [1.0, 1.25, 7.0]]);
    let grid = voxelise(&points, Some(4)).unwrap();
    assert_eq!(coordinates(&grid.voxels), [[0, 4, 8], [8, 8, 8], [15, 12, 8]]);
    assert_eq!(grid.placement.voxel_size, 0.25);
    assert_eq!(grid.placement.origin, [-1.0, -0.75, 5.0]);
}

#[test]
fn a_single_point_lies_in_the_middle() {
    let grid = voxelise(&cloud(&[[0.1, -7e9, 3.3]]), Some(3)).unwrap();
    assert_eq!(coordinates(&grid.voxels), [[4, 4, 4]]);
    assert_eq!(grid.placement.voxel_size, 0.125);
}

#[test]
fn boxes_that_overflow_are_refused() {
    for far in [f64::MAX, f64::NAN, f64::INFINITY] {
        let points = cloud(&[[far, 0.0, 0.5], [-far, 0.0, 0.5]]);
        assert!(matches!(voxelise(&points, None), Err(Error::Malformed { .. })));
    }
    let points = cloud(&[[5e-324, 0.0, 0.0], [0.0; 3]]);
    assert!(matches!(voxelise(&points, None), Err(Error::Malformed { .. })));
    assert!(matches!(voxelise(&cloud(&[]), None), Err(Error::Malformed { .. })));
}

proptest! {
    #[test]
    fn every_fitted_voxel_contains_its_point(
        points in prop::collection::vec(prop::array::uniform3(-1e3f64..1e3), 1..40),
        bits in 1u8..=21,
    ) {
        let grid = voxelise(&cloud(&points), Some(bits)).unwrap();
        let p = grid.placement;
        for point in points {
            let near = coordinates(&grid.voxels).into_iter().any(|v| (0..3).all(|i| {
                let low = p.origin[i] + p.voxel_size * f64::from(v[i]);
                (low - 1e-9..=low + p.voxel_size + 1e-9).contains(&point[i])
            }));
            prop_assert!(near);
        }
    }

    #[test]
    fn voxels_written_as_a_file_come_back(
        points in prop::collection::vec(prop::array::uniform3(-1e3f64..1e3), 1..40),
        bits in 1u8..=21,
    ) {
        let grid = voxelise(&cloud(&points), Some(bits)).unwrap();
        let file = grid.to_cloud().to_ply();
        let cloud = PointCloud::from_ply(&file, &crate::Limits::default()).unwrap();
        prop_assert_eq!(voxelise(&cloud, None).unwrap(), grid);
    }
}
