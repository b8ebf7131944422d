//! How the voxels around every voxel are distributed, in integers.
//!
//! The neighbourhood is what a walk of [`ROUNDS`] steps reaches, each to one of the 27 positions around a voxel that are occupied; a voxel
//! counts as often as there are walks to it. On a plane the weights along an axis are those of three box filters, 1 3 6 7 6 3 1, and a sheet
//! behind another one counts only if voxels join them. Counts and sums come from adding up the 27 neighbours' own, once a step.
//!
//! Sums are of absolute coordinates, modulo 2¹⁶, so that a step is additions alone; [`around`] moves them to the voxel. There they are
//! below 2¹⁶ (n ≤ 27³, Σx² ≤ 2 · 27³), or within ±2¹⁵ (|Σx| ≤ 5/9 · 27³, |Σxy| ≤ 5/4 · 27³), and so exact.

use b2p_kernels::{Isa, zeros};
use rayon::prelude::*;

use super::lanes::{GROUP, Lane};
use super::passes;
use crate::geometry::{KernelMap, Voxels};

/// Steps of a walk.
pub const ROUNDS: usize = 3;
/// n, Σx, Σy, Σz, Σxx, Σyy, Σzz, Σxy, Σxz, Σyz; the rest of 32 bytes is unused.
pub type Moments = [u16; 16];
/// Voxels that one task handles.
const BLOCK: usize = 1024;

/// The moments of each voxel alone, and zeros at the end.
pub fn of_voxels(voxels: &Voxels) -> Vec<Moments> {
    let of_voxel = |i: usize| {
        let [x, y, z] = voxels.coordinate(i).map(|v| v as u16);
        let times = u16::wrapping_mul;
        let squares = [times(x, x), times(y, y), times(z, z)];
        let products = [times(x, y), times(x, z), times(y, z)];
        let mut moments = [0; 16];
        moments[..4].copy_from_slice(&[1, x, y, z]);
        moments[4..7].copy_from_slice(&squares);
        moments[7..10].copy_from_slice(&products);
        moments
    };
    let mut moments: Vec<Moments> = zeros(voxels.len() + 1);
    let alone = moments[..voxels.len()].par_iter_mut().with_min_len(BLOCK);
    alone.enumerate().for_each(|(i, to)| *to = of_voxel(i));
    moments
}

/// One step: for every voxel the sum over those of its 27 neighbours that are there, and zeros at the end.
pub fn step(isa: Isa, map: &KernelMap, from: &[Moments]) -> Vec<Moments> {
    let mut to: Vec<Moments> = zeros(from.len());
    let blocks = to[..map.len()].par_chunks_mut(BLOCK);
    blocks
        .zip(map.rows().par_chunks(27 * BLOCK))
        .for_each(|(to, rows)| isa.run(passes::Sum { from, rows, to }));
    to
}

/// Moments of one group of voxels, relative to each voxel's own coordinate.
pub struct Around {
    /// Voxels in the neighbourhood, with their weights.
    pub count: Lane,
    /// Σx, Σy, Σz.
    pub sum: [Lane; 3],
    /// Σxx, Σyy, Σzz, Σxy, Σxz, Σyz.
    pub square: [Lane; 6],
}

/// The moments of up to [`GROUP`] voxels around their own `coordinates`; what is missing is as if it were alone.
#[inline(always)]
pub fn around(moments: &[Moments], coordinates: &[[u32; 3]]) -> Around {
    let mut lanes = Around {
        count: [1.0; GROUP],
        sum: [[0.0; GROUP]; 3],
        square: [[0.0; GROUP]; 6],
    };
    for (j, (m, coordinate)) in moments.iter().zip(coordinates).enumerate() {
        let c = coordinate.map(|v| v as u16);
        let (n, times) = (m[0], u16::wrapping_mul);
        let sum = [0, 1, 2].map(|a| m[1 + a].wrapping_sub(times(n, c[a])));
        lanes.count[j] = f32::from(n);
        for (lane, sum) in lanes.sum.iter_mut().zip(sum) {
            lane[j] = f32::from(sum as i16);
        }
        // Σ(x−c)(y−d) = Σxy − c·Σ(y−d) − d·Σx.
        for (k, (a, b)) in PAIRS.into_iter().enumerate() {
            let moved = times(c[a], sum[b]).wrapping_add(times(c[b], m[1 + a]));
            let square = m[4 + k].wrapping_sub(moved);
            lanes.square[k][j] = match a == b {
                true => f32::from(square),
                false => f32::from(square as i16),
            };
        }
    }
    lanes
}

/// The axes of the six products.
pub const PAIRS: [(usize, usize); 6] = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)];
