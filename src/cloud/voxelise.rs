//! From points to the occupied voxels of the finest level.

use rayon::prelude::*;

use super::{Hints, PointCloud, malformed};
use crate::error::{Error, Result};
use crate::geometry::{Voxels, morton};
use crate::placement::Placement;

/// Where errors say they are: a cloud in memory has no lines.
const POINTS: &str = "the points";
/// The bit depth of a cloud that does not say, and is told, no other.
const DEFAULT_BITS: u8 = 10;

/// The least depth that [`voxelise_closed`] comes down to.
const LEAST_CLOSED: u8 = 5;

/// Occupied voxels of the finest level, each with its colour.
#[derive(Debug, Clone, PartialEq)]
pub struct ColouredVoxels {
    /// The voxels; their depth is the bit depth N.
    pub voxels: Voxels,
    /// One sRGB colour per voxel: the mean of its points, rounded, halves up.
    pub colours: Vec<[u8; 3]>,
    /// Where the grid lies in the world.
    pub placement: Placement,
}

/// How coordinates become voxels.
enum Grid {
    /// Coordinates are voxels already, of a grid `shift` levels finer.
    Integer { shift: u8 },
    /// `(coordinate − origin) / voxel_size`, rounded down.
    Fitted(Placement),
}

/// Puts a cloud on the voxel grid of depth `bits`.
///
/// If every coordinate is a whole number from 0 below 2²¹, the cloud is a voxel grid already. Its depth is `bits`, else the depth
/// that its comments tell, if those hold its coordinates, else 10 or the least that holds them. Where `bits` are too few, the
/// coordinates lose just as many low bits as makes them fit. The placement is that of the comments, else
/// [`Placement::VOXEL_GRID`].
///
/// Any other cloud is fitted to a grid of `bits` or 10: the longest side of its bounding box spans the whole cube, and the box lies
/// in the cube's middle. Points that share a voxel merge.
///
/// # Errors
/// [`Error::Usage`] if `bits` is not 1 to 21 or colours and points differ in number; [`Error::Malformed`] if there
/// are no points or the bounding box is not one of finite numbers.
pub fn voxelise(cloud: &PointCloud, bits: Option<u8>) -> Result<ColouredVoxels> {
    if let Some(bits) = bits
        && !(1..=morton::MAX_DEPTH).contains(&bits)
    {
        return Err(Error::Usage(format!("the bit depth is 1 to 21, not {bits}")));
    }
    if cloud.positions.len() != cloud.colours.len() {
        return Err(Error::Usage(format!(
            "{} points have {} colours",
            cloud.positions.len(),
            cloud.colours.len()
        )));
    }
    let (low, high) = bounds(&cloud.positions)?;
    let (depth, grid, placement) = if is_grid(&cloud.positions) {
        let largest = high.into_iter().fold(0.0, f64::max) as u32;
        let (depth, shift) = grid_depth(largest, bits, &cloud.hints);
        let mut placement = cloud.hints.placement.unwrap_or(Placement::VOXEL_GRID);
        placement.voxel_size *= f64::from(1u32 << shift);
        (depth, Grid::Integer { shift }, placement)
    } else {
        let depth = bits.unwrap_or(DEFAULT_BITS);
        let placement = fit(low, high, depth);
        (depth, Grid::Fitted(placement), placement)
    };
    if !placement.is_valid() {
        let extent = format!("{low:?} to {high:?}");
        return Err(malformed(
            POINTS,
            "bounding box",
            extent,
            "a size that numbers can express",
        ));
    }

    let last = ((1u64 << depth) - 1) as f64;
    let mut points: Vec<(u64, [u8; 3])> = cloud
        .positions
        .par_iter()
        .zip(&cloud.colours)
        .map(|(position, &colour)| {
            let voxel = std::array::from_fn(|i| match &grid {
                Grid::Integer { shift } => position[i] as u32 >> shift,
                Grid::Fitted(p) => {
                    // The far side of the box belongs to the last voxel.
                    ((position[i] - p.origin[i]) / p.voxel_size).clamp(0.0, last) as u32
                }
            });
            (morton::encode(voxel), colour)
        })
        .collect();
    // Means are of integer sums, so the order of points within a voxel does not matter.
    points.par_sort_unstable_by_key(|point| point.0);

    let mut keys = Vec::new();
    let mut colours = Vec::new();
    for same in points.chunk_by(|a, b| a.0 == b.0) {
        keys.push(same[0].0);
        colours.push(mean(same));
    }
    Ok(ColouredVoxels {
        voxels: Voxels::from_sorted(depth, keys),
        colours,
        placement,
    })
}

/// Puts a cloud on the finest voxel grid on which its surfaces are closed, and tells the depth that [`voxelise`] would choose.
///
/// The finest level of a stream that is drawn is N − 1. Where its voxels have fewer than 2.5 of the cloud's each, points at random on a surface
/// leave more than one in nine of the surface's voxels empty: pictures are full of holes, and streams large. So depths are tried from `voxelise`'s own down to 5,
/// until there are as many; if there never are, the points are those of no surface, and keep their depth.
///
/// # Errors
/// Those of [`voxelise`].
pub fn voxelise_closed(cloud: &PointCloud) -> Result<(ColouredVoxels, u8)> {
    let finest = voxelise(cloud, None)?;
    let depth = finest.voxels.depth();
    let is_closed = |bits: &u8| {
        let drawn = finest.voxels.keys().iter().map(|key| key >> (3 * (depth + 1 - bits)));
        let mut last = None;
        let count = drawn.filter(|&key| last.replace(key) != Some(key)).count();
        5 * count <= 2 * finest.voxels.len()
    };
    match (LEAST_CLOSED..=depth).rev().find(is_closed) {
        Some(bits) if bits < depth => Ok((voxelise(cloud, Some(bits))?, depth)),
        _ => Ok((finest, depth)),
    }
}

impl ColouredVoxels {
    /// The voxels as points with whole coordinates, the grid in the hints: [`voxelise`] makes the same voxels of them.
    pub fn to_cloud(&self) -> PointCloud {
        let voxels = 0..self.voxels.len();
        PointCloud {
            positions: voxels.map(|i| self.voxels.coordinate(i).map(f64::from)).collect(),
            colours: self.colours.clone(),
            hints: Hints {
                bits: Some(self.voxels.depth()),
                placement: Some(self.placement),
            },
        }
    }
}

fn bounds(positions: &[[f64; 3]]) -> Result<([f64; 3], [f64; 3])> {
    if positions.is_empty() {
        return Err(malformed(POINTS, "number of points", 0, "at least one"));
    }
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for (row, position) in positions.iter().enumerate() {
        for axis in 0..3 {
            if !position[axis].is_finite() {
                let field = format!("coordinate of point {row}");
                return Err(malformed(POINTS, field, position[axis], "a finite number"));
            }
            low[axis] = low[axis].min(position[axis]);
            high[axis] = high[axis].max(position[axis]);
        }
    }
    Ok((low, high))
}

fn is_grid(positions: &[[f64; 3]]) -> bool {
    let end = f64::from(1u32 << morton::MAX_DEPTH);
    positions
        .iter()
        .flatten()
        .all(|&x| x.fract() == 0.0 && (0.0..end).contains(&x))
}

/// Depth of an integer grid, and by how many bits its coordinates are to be shortened.
fn grid_depth(largest: u32, bits: Option<u8>, hints: &Hints) -> (u8, u8) {
    let needed = (u32::BITS - largest.leading_zeros()).max(1) as u8;
    match (bits, hints.bits) {
        (Some(bits), _) => (bits, needed.saturating_sub(bits)),
        (None, Some(bits)) if bits >= needed => (bits, 0),
        _ => (needed.max(DEFAULT_BITS), 0),
    }
}

/// The cube around the bounding box. A box without extent gets a cube one unit a side.
fn fit(low: [f64; 3], high: [f64; 3], depth: u8) -> Placement {
    let longest = (0..3).map(|i| high[i] - low[i]).fold(0.0, f64::max);
    let side = if longest > 0.0 { longest } else { 1.0 };
    Placement {
        origin: std::array::from_fn(|i| low[i] / 2.0 + high[i] / 2.0 - side / 2.0),
        voxel_size: side / f64::from(1u32 << depth),
    }
}

fn mean(points: &[(u64, [u8; 3])]) -> [u8; 3] {
    let count = points.len() as u64;
    std::array::from_fn(|channel| {
        let sum: u64 = points.iter().map(|(_, c)| u64::from(c[channel])).sum();
        ((sum + count / 2) / count) as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Random;
    use proptest::prelude::*;

    fn cloud(positions: &[[f64; 3]]) -> PointCloud {
        PointCloud {
            positions: positions.to_vec(),
            colours: (0..positions.len()).map(|i| [i as u8; 3]).collect(),
            hints: Hints::default(),
        }
    }

    fn coordinates(voxels: &Voxels) -> Vec<[u32; 3]> {
        (0..voxels.len()).map(|i| voxels.coordinate(i)).collect()
    }

    #[test]
    fn whole_coordinates_are_taken_as_they_are() {
        let grid = voxelise(&cloud(&[[5.0, 0.0, 1.0], [4.0, 0.0, 0.0]]), None).unwrap();
        assert_eq!(grid.voxels.depth(), 10);
        assert_eq!(coordinates(&grid.voxels), [[4, 0, 0], [5, 0, 1]]);
        assert_eq!(grid.colours, [[1; 3], [0; 3]]);
        assert_eq!(grid.placement, Placement::VOXEL_GRID);
    }

    #[test]
    fn the_depth_is_the_asked_one_else_the_comments_else_the_least_from_ten() {
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

    /// Points at random on a sphere of radius 1.
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
    fn sparse_surfaces_are_put_on_the_finest_grid_that_closes_them() {
        let mut last = 0;
        for points in [3_000, 12_000, 60_000, 250_000] {
            let cloud = sphere(points);
            let (grid, finest) = voxelise_closed(&cloud).unwrap();
            assert_eq!(finest, 10);
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
    fn closed_grids_and_points_of_no_surface_keep_their_depth() {
        let plane = (0..90_000).map(|i| [f64::from(i % 300), f64::from(i / 300), 7.0]);
        let grid = cloud(&plane.collect::<Vec<_>>());
        let alone = cloud(&[[0.0; 3], [0.5, 0.25, 0.125], [1.0; 3]]);
        for cloud in [grid, alone] {
            let whole = voxelise(&cloud, None).unwrap();
            assert_eq!(voxelise_closed(&cloud).unwrap(), (whole, 10));
        }
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
    fn boxes_that_numbers_cannot_express_are_refused() {
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
}
