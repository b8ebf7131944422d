//! Moments of the voxel distribution around every voxel, in integers (`docs/format.md`, clause 6.2).
//!
//! A neighbourhood consists of the ends of all walks of [`ROUNDS`] steps over occupied voxels, where a step leads to
//! one of the 27 positions around a voxel. The weight of a voxel is the number of walks that end there. On a plane the
//! weights along an axis are those of three box filters, 1 3 6 7 6 3 1. A second sheet counts only if voxels connect it
//! to the first. Each step replaces the moments of a voxel by the sum over its 27 neighbours.
//!
//! The sums are of absolute coordinates modulo 2¹⁶, so that a step consists of additions only. [`centred`] moves them
//! to the voxel's own coordinate, where they are exact: below 2¹⁶ (n ≤ 27³, Σx² ≤ 2 · 27³) or within ±2¹⁵ (|Σx| ≤ 5/9 ·
//! 27³, |Σxy| ≤ 5/4 · 27³). The first step counts the occupied places of the voxel's row instead.

use b2p_kernels::{Isa, zeros};
use rayon::prelude::*;

use super::lanes::{GROUP, Lane};
use super::passes;
use crate::geometry::{SiblingMap, Voxels};

/// Steps of a walk.
pub const ROUNDS: usize = 3;
/// n, Σx, Σy, Σz, Σxx, Σyy, Σzz, Σxy, Σxz, Σyz, and six unused values that pad it to 32 bytes.
pub type Moments = [u16; 16];
/// Voxels per task.
const BLOCK: usize = 1024;

/// Of each axis the places of a 3³ row one step behind the voxel, and one step ahead of it.
const STEPS: [[u32; 2]; 3] = {
    let mut steps = [[0; 2]; 3];
    let mut k = 0;
    while k < 27 {
        let place = [k % 3, k / 3 % 3, k / 9];
        let mut axis = 0;
        while axis < 3 {
            steps[axis][0] |= ((place[axis] == 0) as u32) << k;
            steps[axis][1] |= ((place[axis] == 2) as u32) << k;
            axis += 1;
        }
        k += 1;
    }
    steps
};

/// The moments of a voxel's occupied neighbours, itself included, relative to its coordinate, as [`Moments`] has them:
/// those after one step.
#[inline(always)]
fn of_neighbours(mask: u32) -> [i16; 10] {
    let count = |places: u32| (mask & places).count_ones() as i16;
    let mut moments = [0; 10];
    moments[0] = count(!0);
    for (axis, [behind, ahead]) in STEPS.into_iter().enumerate() {
        moments[1 + axis] = count(ahead) - count(behind);
    }
    for (k, (a, b)) in PAIRS.into_iter().enumerate() {
        let ([behind_a, ahead_a], [behind_b, ahead_b]) = (STEPS[a], STEPS[b]);
        let alike = behind_a & behind_b | ahead_a & ahead_b;
        let opposite = behind_a & ahead_b | ahead_a & behind_b;
        moments[4 + k] = count(alike) - count(opposite);
    }
    moments
}

/// Moments after one step with absolute coordinates, of a voxel at `coordinate` with these neighbours.
#[inline(always)]
pub fn absolute(mask: u32, coordinate: [u32; 3]) -> Moments {
    let times = u16::wrapping_mul;
    let c = coordinate.map(|v| v as u16);
    let relative = of_neighbours(mask).map(|v| v as u16);
    let (n, sum) = (relative[0], &relative[1..4]);
    let mut moments = [0; 16];
    moments[0] = n;
    for axis in 0..3 {
        moments[1 + axis] = times(n, c[axis]).wrapping_add(sum[axis]);
    }
    // Σ(c + x)(d + y) = n·c·d + c·Σy + d·Σx + Σxy.
    for (k, (a, b)) in PAIRS.into_iter().enumerate() {
        let moved = times(times(n, c[a]).wrapping_add(sum[a]), c[b]).wrapping_add(times(c[a], sum[b]));
        moments[4 + k] = relative[4 + k].wrapping_add(moved);
    }
    moments
}

/// The moments of every voxel of a level after one step, then one element of zeros.
fn after_one_step(isa: Isa, voxels: &Voxels, map: &SiblingMap) -> Vec<Moments> {
    let mut moments: Vec<Moments> = zeros(voxels.len() + 1);
    let blocks = moments[..voxels.len()].par_chunks_mut(BLOCK).enumerate();
    blocks.for_each(|(i, to)| {
        let (mut masks, mut coordinates) = ([0; BLOCK], [[0; 3]; BLOCK]);
        let (masks, coordinates) = (&mut masks[..to.len()], &mut coordinates[..to.len()]);
        map.masks(i * BLOCK, masks);
        for (voxel, coordinate) in (i * BLOCK..).zip(coordinates.iter_mut()) {
            *coordinate = voxels.coordinate(voxel);
        }
        isa.run(passes::FirstStep { masks, coordinates, to });
    });
    moments
}

/// The moments of every voxel of a level after all steps, then one element of zeros.
pub fn after_all_steps(isa: Isa, voxels: &Voxels, map: &SiblingMap) -> Vec<Moments> {
    let mut moments = after_one_step(isa, voxels, map);
    let mut spare: Vec<Moments> = zeros(moments.len());
    for _ in 1..ROUNDS {
        let blocks = spare[..map.len()].par_chunks_mut(BLOCK).enumerate();
        blocks.for_each(|(i, to)| {
            isa.run(passes::SumOfLevel {
                from: &moments,
                map,
                first: i * BLOCK,
                to,
            });
        });
        std::mem::swap(&mut moments, &mut spare);
    }
    moments
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

/// Moments after one step of up to [`GROUP`] voxels with these neighbours. Missing voxels get the moments of a single
/// voxel.
#[inline(always)]
pub fn near(masks: &[u32]) -> CentredMoments {
    let mut lanes = CentredMoments::single();
    for (j, &mask) in masks.iter().enumerate() {
        let moments = of_neighbours(mask).map(f32::from);
        lanes.count[j] = moments[0];
        for (axis, lane) in lanes.sum.iter_mut().enumerate() {
            lane[j] = moments[1 + axis];
        }
        for (k, lane) in lanes.square.iter_mut().enumerate() {
            lane[j] = moments[4 + k];
        }
    }
    lanes
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
