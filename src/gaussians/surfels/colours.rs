//! Colour gradients along the surface (`docs/format.md`, clause 6.6.3).

use super::discs::Disc;
use super::lanes::{GROUP, Lane, axes, lane};
use crate::geometry::ones;

/// Ridge regularisation of the least squares, since the colours of few neighbours are mostly noise.
const DAMPING: f32 = 0.3;

/// Places of a 3³ row, as steps from the middle.
const OFFSETS: [[f32; 3]; 27] = {
    let mut offsets = [[0.0; 3]; 27];
    let mut k = 0;
    while k < 27 {
        offsets[k] = [(k % 3) as f32 - 1.0, (k / 3 % 3) as f32 - 1.0, (k / 9) as f32 - 1.0];
        k += 1;
    }
    offsets
};

/// The planes of up to [`GROUP`] discs, and how the colours change along them.
pub struct Gradients {
    /// The axes of the planes, by component.
    pub axes: [[Lane; 3]; 2],
    /// What red, green and blue change by per voxel along both axes.
    pub along: [[Lane; 3]; 2],
}

impl Gradients {
    /// Those of consecutive voxels, from voxel `first` on, by least squares over the occupied ones of the 26
    /// neighbours. `rows` are the voxels' of their level's map, and `masks` have a bit for each place that is occupied.
    #[inline(always)]
    pub fn new(discs: &[Disc], masks: &[u32], rows: &[u32], colours: &[[u8; 3]], first: usize) -> Self {
        let axes = planes(discs);
        let (mut there, mut own) = ([0; GROUP], [[0; GROUP]; 3]);
        // Of absent neighbours any colour will do, since they weigh nothing.
        let mut around = [[[0; GROUP]; 3]; 27];
        for (j, (&mask, row)) in masks.iter().zip(rows.as_chunks::<27>().0).enumerate() {
            there[j] = mask;
            for (own, value) in own.iter_mut().zip(colours[first + j]) {
                own[j] = value;
            }
            for k in ones(mask) {
                for (around, value) in around[k].iter_mut().zip(colours[row[k] as usize]) {
                    around[j] = value;
                }
            }
        }
        let along = least_squares(&there, &axes, &own, &around);
        Gradients { axes, along }
    }
}

/// The axes of the planes of discs: the rotated x and y.
#[inline(always)]
fn planes(discs: &[Disc]) -> [[Lane; 3]; 2] {
    let mut rotations = [[0.0; GROUP]; 3];
    for (j, disc) in discs.iter().enumerate() {
        for (axis, value) in rotations.iter_mut().zip(disc.rotation) {
            axis[j] = value;
        }
    }
    let [w, x, y] = &rotations;
    [
        [
            lane(|j| 1.0 - 2.0 * y[j] * y[j]),
            lane(|j| 2.0 * x[j] * y[j]),
            lane(|j| -2.0 * w[j] * y[j]),
        ],
        [
            lane(|j| 2.0 * x[j] * y[j]),
            lane(|j| 1.0 - 2.0 * x[j] * x[j]),
            lane(|j| 2.0 * w[j] * x[j]),
        ],
    ]
}

/// The slopes of colours along both axes of planes. `there` has a bit for each neighbour that counts.
#[inline(always)]
fn least_squares(
    there: &[u32; GROUP],
    [u, v]: &[[Lane; 3]; 2],
    own: &[[u8; GROUP]; 3],
    around: &[[[u8; GROUP]; 3]; 27],
) -> [[Lane; 3]; 2] {
    let (mut uu, mut uv, mut vv) = ([DAMPING; GROUP], [0.0; GROUP], [DAMPING; GROUP]);
    let (mut ru, mut rv) = ([[0.0; GROUP]; 3], [[0.0; GROUP]; 3]);
    for (k, (&[x, y, z], around)) in OFFSETS.iter().zip(around).enumerate() {
        // Adding zero changes no sum.
        let along = |axis: &[Lane; 3], j: usize| {
            let along = x * axis[0][j] + y * axis[1][j] + z * axis[2][j];
            if there[j] >> k & 1 == 0 { 0.0 } else { along }
        };
        let (a, b) = (lane(|j| along(u, j)), lane(|j| along(v, j)));
        for j in 0..GROUP {
            uu[j] += a[j] * a[j];
            uv[j] += a[j] * b[j];
            vv[j] += b[j] * b[j];
        }
        for channel in 0..3 {
            for j in 0..GROUP {
                let change = f32::from(around[channel][j]) - f32::from(own[channel][j]);
                ru[channel][j] += a[j] * change;
                rv[channel][j] += b[j] * change;
            }
        }
    }
    let determinant = lane(|j| uu[j] * vv[j] - uv[j] * uv[j]);
    let solve = |a: &Lane, b: &Lane, c: &Lane, d: &Lane| lane(|j| (a[j] * b[j] - c[j] * d[j]) / determinant[j]);
    [
        axes(|channel| solve(&vv, &ru[channel], &uv, &rv[channel])),
        axes(|channel| solve(&uu, &rv[channel], &uv, &ru[channel])),
    ]
}
