//! Which points belong to a cloud: bounds, quantiles and outliers.

use super::voxelise::{self, Levels};
use crate::geometry::morton;

/// Points that quantiles are computed from at most.
const SAMPLE: usize = 200_000;
/// Quantiles that span the core of a cloud.
const CORE: [f64; 2] = [0.01, 0.99];
/// What is farther from the core than this many times its longest side is far from all others.
const REACH: f64 = 4.0;
/// Points in the 27 cells around a point's cell, its own included, below which it is far from all others.
const LEAST_NEAR: u32 = 5;

/// The corners of the points' box.
pub(super) fn bounds(positions: &[[f64; 3]]) -> ([f64; 3], [f64; 3]) {
    let mut corners = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for position in positions {
        for (axis, x) in position.iter().enumerate() {
            corners.0[axis] = corners.0[axis].min(*x);
            corners.1[axis] = corners.1[axis].max(*x);
        }
    }
    corners
}

/// Two quantiles of a value of the points, from a sample of them. There must be points.
pub(super) fn quantiles(positions: &[[f64; 3]], value: impl Fn(&[f64; 3]) -> f64, shares: [f64; 2]) -> [f64; 2] {
    let step = positions.len().div_ceil(SAMPLE).max(1);
    let mut values: Vec<f64> = positions.iter().step_by(step).map(value).collect();
    let last = values.len() - 1;
    shares.map(|share| {
        let index = (share * last as f64).round() as usize;
        *values.select_nth_unstable_by(index, f64::total_cmp).1
    })
}

/// Which points are near others: in the wider neighbourhood of the core, and with other points in the 27 cells around
/// them. A cell is four voxels of the grid that [`super::voxelise_closed`] chooses.
pub(super) fn not_outliers(positions: &[[f64; 3]]) -> Vec<bool> {
    if positions.is_empty() {
        return Vec::new();
    }
    let core: [[f64; 2]; 3] = std::array::from_fn(|axis| quantiles(positions, |p| p[axis], CORE));
    let longest = core.iter().map(|[low, high]| high - low).fold(0.0, f64::max);
    let near =
        |p: &[f64; 3]| (0..3).all(|i| (core[i][0] - REACH * longest..=core[i][1] + REACH * longest).contains(&p[i]));
    let mut keep: Vec<bool> = positions.iter().map(near).collect();
    if longest == 0.0 {
        return keep;
    }

    let inner: Vec<[f64; 3]> = positions
        .iter()
        .zip(&keep)
        .filter(|(_, k)| **k)
        .map(|(p, _)| *p)
        .collect();
    let (low, high) = bounds(&inner);
    let finest = voxelise::fit(low, high, morton::MAX_DEPTH);
    let key = |p: &[f64; 3]| voxelise::fitted_key(p, &finest);
    let mut keys: Vec<u64> = inner.iter().map(key).collect();
    keys.sort_unstable();
    let levels = Levels::of(keys.iter().copied());
    let depth = levels.closed(levels.voxels(morton::MAX_DEPTH), morton::MAX_DEPTH);
    let cell = depth.unwrap_or(voxelise::DEFAULT_BITS).saturating_sub(2).max(1);
    let populated = populated(&keys, cell);
    let shift = 3 * (morton::MAX_DEPTH - cell);
    for (keep, position) in keep.iter_mut().zip(positions).filter(|(k, _)| **k) {
        *keep = populated.binary_search(&(key(position) >> shift)).is_ok();
    }
    keep
}

/// The occupied cells, in ascending order, with enough points in them and around. `keys` are those of the finest level.
fn populated(keys: &[u64], cell: u8) -> Vec<u64> {
    let shift = 3 * (morton::MAX_DEPTH - cell);
    let runs = keys.chunk_by(|a, b| a >> shift == b >> shift);
    let cells: Vec<(u64, u32)> = runs
        .map(|run| (run[0] >> shift, u32::try_from(run.len()).unwrap_or(u32::MAX)))
        .collect();
    let last = (1i64 << cell) - 1;
    let around = |&(key, own): &(u64, u32)| {
        let mut sum = own;
        let at = morton::decode(key).map(i64::from);
        for k in 0..27 {
            let near = [at[0] + k % 3 - 1, at[1] + k / 3 % 3 - 1, at[2] + k / 9 - 1];
            if sum >= LEAST_NEAR || k == 13 || near.iter().any(|x| !(0..=last).contains(x)) {
                continue;
            }
            let key = morton::encode(near.map(|x| x as u32));
            if let Ok(found) = cells.binary_search_by_key(&key, |cell| cell.0) {
                sum = sum.saturating_add(cells[found].1);
            }
        }
        sum >= LEAST_NEAR
    };
    cells.iter().filter(|cell| around(cell)).map(|cell| cell.0).collect()
}
