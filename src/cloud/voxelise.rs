//! Voxelisation: from points to the occupied voxels of the finest level.

use rayon::prelude::*;

use super::select::bounds;
use super::{Coordinates, Hints, PointCloud, grouped, malformed};
use crate::axes::Axes;
use crate::error::{Error, Result};
use crate::geometry::{Voxels, morton};
use crate::placement::Placement;

/// Location in errors, since a cloud in memory has no lines.
const POINTS: &str = "the points";
/// The bit depth of points that do not form a surface, and the least one of integer coordinates.
pub(super) const DEFAULT_BITS: u8 = 10;

/// The minimum depth that [`voxelise_closed`] tries.
const LEAST_CLOSED: u8 = 5;
/// How far from a voxel's centre a point may be that is one of the grid in the comments, in voxels.
const CENTRE: f64 = 0.01;

/// Occupied voxels of the finest level with one colour each.
#[derive(Debug, Clone, PartialEq)]
pub struct ColouredVoxels {
    /// The voxels. Their depth is the bit depth N.
    pub voxels: Voxels,
    /// One sRGB colour per voxel: the mean of its points, halves rounded up.
    pub colours: Vec<[u8; 3]>,
    /// Placement of the grid in the world.
    pub placement: Placement,
}

/// What [`voxelise_closed`] did. Its text is a line for the user.
#[derive(Debug, Clone, PartialEq)]
pub struct GridReport {
    /// Number of points.
    pub points: u64,
    /// Number of voxels.
    pub voxels: u64,
    /// Depth of the grid.
    pub bits: u8,
    /// Depth of the grid on which the coordinates are voxels, or the depth for points that form no surface.
    pub finest: u8,
    /// Edge of a voxel in units of the cloud.
    pub voxel_size: f64,
    /// Edge of a voxel in metres, if that is known.
    pub metres: Option<f64>,
}

/// Conversion from coordinates to voxels of the depth that keys are sorted by.
enum Grid {
    /// `coordinate − offset` are voxels.
    Integer([f64; 3]),
    /// Coordinates are centres of voxels of this grid.
    Centres(Placement),
    /// `(coordinate − origin) / voxel_size`, rounded down, of the deepest grid.
    Fitted(Placement),
}

/// Points as voxels of a deep grid, sorted, and where that grid lies.
struct Sorted {
    points: Vec<(u64, [u8; 3])>,
    /// Depth of the grid.
    depth: u8,
    placement: Placement,
    /// Whether the coordinates are voxels already.
    is_grid: bool,
    /// Number of points at different places.
    distinct: u64,
}

/// Voxelises a cloud on a grid of depth `bits`.
///
/// If every coordinate is an integer in `0..2²¹`, or the hints name a grid and every point is the centre of one of its
/// voxels, the cloud is a voxel grid already. Its depth is `bits`. Without `bits` it is the depth in the comments if
/// the coordinates fit that, else the minimum that they fit, but at least 10. If the coordinates do not fit `bits`,
/// their lowest bits are dropped until they fit. The placement is that of the comments, or [`Placement::VOXEL_GRID`].
/// Integers outside of `0..2²¹` that span less than 2²¹ are a grid, too, which starts at the least.
///
/// Any other cloud is fitted to a grid of depth `bits`, by default 10: the longest side of its bounding box spans the
/// cube, and the box is centred in the cube. Points in the same voxel are merged.
///
/// # Errors
/// [`Error::Usage`] if `bits` is not 1 to 21 or colours and points differ in number; [`Error::Malformed`] if there
/// are no points or the bounding box is not finite.
pub fn voxelise(cloud: &PointCloud, bits: Option<u8>) -> Result<ColouredVoxels> {
    check_bits(bits)?;
    let sorted = Sorted::of(cloud, bits)?;
    let bits = bits.unwrap_or_else(|| sorted.usual_depth());
    Ok(sorted.merged(bits))
}

/// Voxelises a cloud on the finest grid on which its surfaces are closed.
///
/// The finest drawn level of a stream is N − 1. If its voxels contain fewer than 2.5 points on average, random points
/// on a surface leave more than one in nine of the surface's voxels empty: pictures have holes, and streams are large.
/// The deepest grid that reaches the average is chosen, from the grid on which the coordinates are voxels (21 bits for
/// other coordinates) down to 5 bits. Points far from all others hardly change the average, so they make the cube
/// larger but its voxels not. If no depth reaches the average, the points do not form a surface and keep the depth of
/// [`voxelise`].
///
/// # Errors
/// Those of [`voxelise`].
pub fn voxelise_closed(cloud: &PointCloud) -> Result<(ColouredVoxels, GridReport)> {
    let sorted = Sorted::of(cloud, None)?;
    let levels = Levels::of(sorted.keys());
    let finest = sorted.usual_depth();
    let deepest = if sorted.is_grid { finest } else { morton::MAX_DEPTH };
    let bits = levels.closed(sorted.distinct, deepest).unwrap_or(finest);
    let grid = sorted.merged(bits);
    let report = GridReport::of(&grid, cloud.positions.len(), &cloud.axes, finest);
    Ok((grid, report))
}

/// Bytes that so many points and their voxelisation take at most: the cloud, a key and a colour to sort for each, and
/// either a hash for each, to count places, or voxels.
pub fn voxelise_memory(points: u64) -> u64 {
    const CLOUD: usize = size_of::<[f64; 3]>() + size_of::<[u8; 3]>();
    const SORTED: usize = size_of::<(u64, [u8; 3])>();
    // Vectors that grow take twice what is in them.
    const VOXELS: usize = 2 * (size_of::<u64>() + size_of::<[u8; 3]>());
    points.saturating_mul((CLOUD + SORTED + VOXELS) as u64)
}

fn check_bits(bits: Option<u8>) -> Result<()> {
    match bits {
        Some(bits) if !(1..=morton::MAX_DEPTH).contains(&bits) => {
            Err(Error::Usage(format!("the bit depth is 1 to 21, not {bits}")))
        }
        _ => Ok(()),
    }
}

impl GridReport {
    /// The report of `points` points with these axes that became `grid`.
    pub fn of(grid: &ColouredVoxels, points: usize, axes: &Axes, finest: u8) -> Self {
        let voxel_size = grid.placement.voxel_size;
        GridReport {
            points: points as u64,
            voxels: grid.voxels.len() as u64,
            bits: grid.voxels.depth(),
            finest,
            voxel_size,
            metres: axes.metres_per_unit.map(|metres| metres * voxel_size),
        }
    }

    /// Whether more than half of the points were merged with others.
    pub fn merges_most(&self) -> bool {
        2 * self.voxels < self.points
    }

    /// Whether the points are too far apart for the finest grid.
    pub fn is_coarser(&self) -> bool {
        self.bits < self.finest
    }
}

impl std::fmt::Display for GridReport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let size = match self.metres {
            Some(metres) if metres < 0.01 => format!("{} mm", short(metres * 1e3)),
            Some(metres) if metres < 1.0 => format!("{} cm", short(metres * 1e2)),
            Some(metres) => format!("{} m", short(metres)),
            None => format!("{} units", short(self.voxel_size)),
        };
        let [points, voxels] = [self.points, self.voxels].map(grouped);
        write!(f, "{points} points → {voxels} voxels of {size} ({} bits)", self.bits)
    }
}

/// A number with two digits after the first, without zeros at the end.
fn short(value: f64) -> String {
    let rounded: f64 = format!("{value:.1e}").parse().unwrap_or(value);
    format!("{rounded}")
}

impl Sorted {
    fn of(cloud: &PointCloud, bits: Option<u8>) -> Result<Self> {
        let (positions, colours) = (&cloud.positions, &cloud.colours);
        if positions.len() != colours.len() {
            let (points, colours) = (positions.len(), colours.len());
            return Err(Error::Usage(format!("{points} points have {colours} colours")));
        }
        let (low, high) = finite_bounds(positions)?;
        let (grid, depth, placement) = grid_of(cloud, low, high, bits);
        if !placement.is_valid() {
            let extent = format!("{low:?} to {high:?}");
            let expected = "a size that numbers can express";
            return Err(malformed(POINTS, "bounding box", extent, expected));
        }
        let key = |position: &[f64; 3]| match &grid {
            Grid::Integer(offset) => morton::encode(std::array::from_fn(|i| (position[i] - offset[i]) as u32)),
            Grid::Centres(to) => morton::encode(std::array::from_fn(|i| voxel_of(position[i], i, to) as u32)),
            Grid::Fitted(to) => fitted_key(position, to),
        };
        let pairs = positions.par_iter().zip(colours);
        let mut points: Vec<(u64, [u8; 3])> = pairs.map(|(p, &colour)| (key(p), colour)).collect();
        // Means are computed from integer sums, so the order of points within a voxel does not matter.
        points.par_sort_unstable_by_key(|point| point.0);
        let is_grid = !matches!(grid, Grid::Fitted(_));
        let mut sorted = Sorted {
            points,
            depth,
            placement,
            is_grid,
            distinct: 0,
        };
        sorted.distinct = sorted.count_distinct(positions);
        Ok(sorted)
    }

    fn keys(&self) -> impl Iterator<Item = u64> {
        let shift = 3 * (morton::MAX_DEPTH - self.depth);
        self.points.iter().map(move |point| point.0 << shift)
    }

    /// Number of points at different places.
    fn count_distinct(&self, positions: &[[f64; 3]]) -> u64 {
        let voxels = self.points.chunk_by(|a, b| a.0 == b.0).count();
        if self.is_grid || 2 * voxels >= positions.len() {
            return voxels as u64;
        }
        // Many points share voxels of the deepest grid: duplicates, or points so close together that it cannot separate
        // them because others are so far away.
        let mut hashes: Vec<u64> = positions.par_iter().map(hash).collect();
        hashes.par_sort_unstable();
        hashes.dedup();
        hashes.len() as u64
    }

    /// The depth without a choice by spacing.
    fn usual_depth(&self) -> u8 {
        if self.is_grid { self.depth } else { DEFAULT_BITS }
    }

    /// The voxels of depth `bits`.
    fn merged(self, bits: u8) -> ColouredVoxels {
        let shift = self.depth.saturating_sub(bits);
        let mut keys = Vec::new();
        let mut colours = Vec::new();
        for same in self.points.chunk_by(|a, b| a.0 >> (3 * shift) == b.0 >> (3 * shift)) {
            keys.push(same[0].0 >> (3 * shift));
            colours.push(mean(same));
        }
        let mut placement = self.placement;
        placement.voxel_size *= f64::from(1u32 << shift);
        ColouredVoxels {
            voxels: Voxels::from_sorted(bits, keys),
            colours,
            placement,
        }
    }
}

/// Numbers of occupied voxels of the levels 0 to 21.
pub(super) struct Levels([u64; 1 + morton::MAX_DEPTH as usize]);

impl Levels {
    /// Counts the voxels of ascending keys of level 21.
    pub(super) fn of(keys: impl Iterator<Item = u64>) -> Self {
        let mut counts = [0; 1 + morton::MAX_DEPTH as usize];
        let mut last = None;
        for key in keys {
            // The coarsest level at which this voxel and the one before differ.
            let level = match last {
                None => 0,
                Some(last) if last == key => continue,
                Some(last) => morton::MAX_DEPTH as usize - (63 - u64::leading_zeros(last ^ key)) as usize / 3,
            };
            counts[level] += 1;
            last = Some(key);
        }
        for level in 1..counts.len() {
            counts[level] += counts[level - 1];
        }
        Levels(counts)
    }

    /// The voxels of a level.
    pub(super) fn voxels(&self, level: u8) -> u64 {
        self.0[usize::from(level)]
    }

    /// The deepest level N, at most `deepest`, of which level N − 1 has at least 2.5 of `points` points per voxel.
    pub(super) fn closed(&self, points: u64, deepest: u8) -> Option<u8> {
        (LEAST_CLOSED..=deepest)
            .rev()
            .find(|bits| 5 * self.voxels(bits - 1) <= 2 * points)
    }
}

/// The key of a point on a fitted grid of the deepest level.
pub(super) fn fitted_key(position: &[f64; 3], placement: &Placement) -> u64 {
    let last = ((1u64 << morton::MAX_DEPTH) - 1) as f64;
    // The upper faces of the box belong to the last voxel.
    morton::encode(std::array::from_fn(|i| {
        ((position[i] - placement.origin[i]) / placement.voxel_size).clamp(0.0, last) as u32
    }))
}

/// A hash of a position's bits, of which few positions share one.
fn hash(position: &[f64; 3]) -> u64 {
    let mut bytes = [0; 24];
    for (part, x) in bytes.chunks_exact_mut(8).zip(position) {
        // Zeros of both signs are one place.
        part.copy_from_slice(&(x + 0.0).to_le_bytes());
    }
    xxhash_rust::xxh3::xxh3_64(&bytes)
}

/// The grid of the cloud, the depth of its keys, and where it lies.
fn grid_of(cloud: &PointCloud, low: [f64; 3], high: [f64; 3], bits: Option<u8>) -> (Grid, u8, Placement) {
    let hints = &cloud.hints;
    let fitted = || {
        let placement = fit(low, high, morton::MAX_DEPTH);
        (Grid::Fitted(placement), morton::MAX_DEPTH, placement)
    };
    if hints.coordinates == Coordinates::World {
        return hinted(cloud, bits).unwrap_or_else(fitted);
    }
    let Some(offset) = integers(&cloud.positions, low, high) else {
        return fitted();
    };
    let largest = (0..3).map(|i| high[i] - offset[i]).fold(0.0, f64::max) as u32;
    let mut placement = hints.placement.unwrap_or(Placement::VOXEL_GRID);
    for (origin, offset) in placement.origin.iter_mut().zip(offset) {
        *origin += offset * placement.voxel_size;
    }
    (Grid::Integer(offset), grid_depth(largest, bits, hints), placement)
}

/// The grid of hints in the world, if every point is the centre of one of its voxels.
fn hinted(cloud: &PointCloud, bits: Option<u8>) -> Option<(Grid, u8, Placement)> {
    let placement = cloud.hints.placement?;
    let end = f64::from(1u32 << morton::MAX_DEPTH);
    let largest = cloud.positions.par_iter().map(|position| {
        let mut largest = 0u32;
        for (coordinate, origin) in position.iter().zip(placement.origin) {
            let at = (coordinate - origin) / placement.voxel_size;
            let voxel = at.floor();
            if !((0.0..end).contains(&voxel) && (at - voxel - 0.5).abs() <= CENTRE) {
                return None;
            }
            largest = largest.max(voxel as u32);
        }
        Some(largest)
    });
    let largest = largest.try_reduce(|| 0, |a, b| Some(a.max(b)))?;
    let depth = grid_depth(largest, bits, &cloud.hints);
    Some((Grid::Centres(placement), depth, placement))
}

/// The voxel that a coordinate in the world lies in.
fn voxel_of(coordinate: f64, axis: usize, placement: &Placement) -> f64 {
    ((coordinate - placement.origin[axis]) / placement.voxel_size).floor()
}

impl ColouredVoxels {
    /// The voxels as points with integer coordinates and the grid in the hints. [`voxelise`] restores the same voxels.
    pub fn to_cloud(&self) -> PointCloud {
        let voxels = 0..self.voxels.len();
        PointCloud {
            positions: voxels.map(|i| self.voxels.coordinate(i).map(f64::from)).collect(),
            colours: self.colours.clone(),
            hints: Hints {
                bits: Some(self.voxels.depth()),
                placement: Some(self.placement),
                coordinates: Coordinates::Voxels,
            },
            axes: Axes::default(),
        }
    }

    /// The voxels as points at their centres in the world, with the grid in the hints. [`voxelise`] restores the same
    /// voxels, unless the origin is so far away that numbers cannot separate voxels.
    pub fn to_world(&self) -> PointCloud {
        let Placement { origin, voxel_size } = self.placement;
        let mut cloud = self.to_cloud();
        for position in &mut cloud.positions {
            *position = std::array::from_fn(|i| origin[i] + voxel_size * (position[i] + 0.5));
        }
        cloud.hints.coordinates = Coordinates::World;
        cloud
    }
}

pub(super) fn finite_bounds(positions: &[[f64; 3]]) -> Result<([f64; 3], [f64; 3])> {
    if positions.is_empty() {
        return Err(malformed(POINTS, "number of points", 0, "at least one"));
    }
    let is_finite = |p: &[f64; 3]| p.iter().all(|x| x.is_finite());
    if let Some(row) = positions.iter().position(|p| !is_finite(p)) {
        let field = format!("position of point {row}");
        return Err(malformed(
            POINTS,
            field,
            format!("{:?}", positions[row]),
            "finite numbers",
        ));
    }
    Ok(bounds(positions))
}

/// What to subtract from coordinates that are all integers, so that they are voxels. Nothing if they are voxels
/// already.
fn integers(positions: &[[f64; 3]], low: [f64; 3], high: [f64; 3]) -> Option<[f64; 3]> {
    let end = f64::from(1u32 << morton::MAX_DEPTH);
    let fits = |from: f64, to: f64| (0.0..end).contains(&from) && (0.0..end).contains(&to);
    let offset = match (0..3).all(|i| fits(low[i], high[i])) {
        true => [0.0; 3],
        false if (0..3).all(|i| high[i] - low[i] < end) => low,
        false => return None,
    };
    // Beyond that, all doubles are integers.
    let is_exact = |x: f64| x.fract() == 0.0 && x.abs() < f64::from(1u32 << 31) * f64::from(1u32 << 20);
    positions.as_flattened().iter().all(|&x| is_exact(x)).then_some(offset)
}

/// Depth of the keys of a grid whose largest coordinate this is: the depth asked for, or what the coordinates need.
fn grid_depth(largest: u32, bits: Option<u8>, hints: &Hints) -> u8 {
    let needed = (u32::BITS - largest.leading_zeros()).max(1) as u8;
    match (bits, hints.bits) {
        (Some(bits), _) => bits.max(needed),
        (None, Some(bits)) if bits >= needed => bits,
        _ => needed.max(DEFAULT_BITS),
    }
}

/// The cube around the bounding box. For a box without extent its side is one unit.
pub(super) fn fit(low: [f64; 3], high: [f64; 3], depth: u8) -> Placement {
    let longest = (0..3).map(|i| high[i] - low[i]).fold(0.0, f64::max);
    let side = if longest > 0.0 { longest } else { 1.0 };
    Placement {
        origin: std::array::from_fn(|i| low[i] / 2.0 + high[i] / 2.0 - side / 2.0),
        voxel_size: side / f64::from(1u32 << depth),
    }
}

pub(super) fn mean(points: &[(u64, [u8; 3])]) -> [u8; 3] {
    let count = points.len() as u64;
    std::array::from_fn(|channel| {
        let sum: u64 = points.iter().map(|(_, c)| u64::from(c[channel])).sum();
        ((sum + count / 2) / count) as u8
    })
}

#[cfg(test)]
mod tests;
