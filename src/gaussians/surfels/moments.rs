//! Moments of the voxel distribution around every voxel, in integers (`docs/format.md`, clause 6.2).
//!
//! A neighbourhood consists of the ends of all walks of [`ROUNDS`] steps over occupied voxels, where a step leads to
//! one of the 27 positions around a voxel. The weight of a voxel is the number of walks that end there. On a plane the
//! weights along an axis are those of three box filters, 1 3 6 7 6 3 1. A second sheet counts only if voxels connect it
//! to the first. Each step replaces the moments of a voxel by the sum over its 27 neighbours.
//!
//! The sums are of absolute coordinates modulo 2¹⁶, so that a step consists of additions only. [`centred`] moves them
//! to the voxel's own coordinate, where they are exact: below 2¹⁶ (n ≤ 27³, Σx² ≤ 2 · 27³) or within ±2¹⁵ (|Σx| ≤ 5/9 ·
//! 27³, |Σxy| ≤ 5/4 · 27³).

use b2p_kernels::{Isa, zeros};
use rayon::prelude::*;

use super::lanes::{GROUP, Lane};
use super::passes;
use crate::geometry::{KernelMap, Voxels};

/// Steps of a walk.
pub const ROUNDS: usize = 3;
/// n, Σx, Σy, Σz, Σxx, Σyy, Σzz, Σxy, Σxz, Σyz, and six unused values that pad it to 32 bytes.
pub type Moments = [u16; 16];
/// Voxels per task.
const BLOCK: usize = 1024;

/// The moments of each single voxel, then one element of zeros.
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
    let own = moments[..voxels.len()].par_iter_mut().with_min_len(BLOCK);
    own.enumerate().for_each(|(i, to)| *to = of_voxel(i));
    moments
}

/// One step: for every voxel the sum over the occupied ones of its 27 neighbours, then one element of zeros.
pub fn step(isa: Isa, map: &KernelMap, from: &[Moments]) -> Vec<Moments> {
    let mut to: Vec<Moments> = zeros(from.len());
    step_into(isa, map, from, &mut to);
    to
}

/// [`step`] into `to`, whose last element must be zeros.
///
/// # Panics
/// If `to` does not have one element for each of `from`.
pub fn step_into(isa: Isa, map: &KernelMap, from: &[Moments], to: &mut [Moments]) {
    assert_eq!(to.len(), from.len(), "one element per voxel, and zeros");
    let blocks = to[..map.len()].par_chunks_mut(BLOCK);
    blocks
        .zip(map.rows().par_chunks(27 * BLOCK))
        .for_each(|(to, rows)| isa.run(passes::Sum { from, rows, to }));
}

/// Moments of a group of voxels, each relative to its voxel's coordinate.
pub struct CentredMoments {
    /// Sum of the weights.
    pub count: Lane,
    /// Σx, Σy, Σz.
    pub sum: [Lane; 3],
    /// Σxx, Σyy, Σzz, Σxy, Σxz, Σyz.
    pub square: [Lane; 6],
}

impl CentredMoments {
    /// Those of single voxels.
    #[inline(always)]
    pub fn single() -> Self {
        CentredMoments {
            count: [1.0; GROUP],
            sum: [[0.0; GROUP]; 3],
            square: [[0.0; GROUP]; 6],
        }
    }
}

/// Moves the moments of up to [`GROUP`] voxels to their `coordinates`. Missing voxels get the moments of a single
/// voxel.
#[inline(always)]
pub fn centred(moments: &[Moments], coordinates: &[[u32; 3]]) -> CentredMoments {
    let mut lanes = CentredMoments::single();
    for (j, (m, coordinate)) in moments.iter().zip(coordinates).enumerate() {
        let c = [coordinate[0] as u16, coordinate[1] as u16, coordinate[2] as u16];
        let (n, times) = (m[0], u16::wrapping_mul);
        let moved = |a: usize| m[1 + a].wrapping_sub(times(n, c[a]));
        let sum = [moved(0), moved(1), moved(2)];
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

/// The axes of the six second moments.
pub const PAIRS: [(usize, usize); 6] = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)];
