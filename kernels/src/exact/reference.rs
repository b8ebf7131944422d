//! The convolution as its definition reads: a triple loop over i64. What the kernels are tested against.

use super::requantise::{LIMIT, Requantise};
use crate::sparse::taps::{ABSENT, Taps};

/// The input row that output row `i` reads through tap `k`.
pub fn tap(taps: &Taps<'_>, i: usize, k: usize) -> Option<usize> {
    match taps {
        Taps::Same => Some(i),
        Taps::Map { volume, rows, .. } => {
            let row = rows[i * volume + k];
            (row != ABSENT).then_some(row as usize)
        }
        Taps::Made { volume, rows, .. } => {
            let mut row = vec![ABSENT; *volume];
            rows.fill(i, &mut row);
            (row[k] != ABSENT).then_some(row[k] as usize)
        }
        Taps::Octants { parents, octants } => (usize::from(octants[i]) == k).then(|| parents[i] as usize),
        Taps::Children => (i % 8 == k).then_some(i / 8),
        Taps::AllChildren { neighbours, .. } => {
            // Where the neighbour is, in steps of a child from the parent's corner.
            let axis = |bit: usize, step: usize| (i >> bit & 1) as i32 + (step % 3) as i32 - 1;
            let at = [axis(0, k), axis(1, k / 3), axis(2, k / 9)];
            let sum =
                |part: fn(i32) -> i32, base: i32| at.iter().rev().fold(0, |sum, &x| sum * base + part(x)) as usize;
            let neighbour = neighbours[i / 8 * 27 + sum(|x| x.div_euclid(2) + 1, 3)];
            let octant = sum(|x| x.rem_euclid(2), 2);
            (neighbour != ABSENT).then(|| 8 * neighbour as usize + octant)
        }
    }
}

/// `rows` rows of an exact layer: sums in i64, wrapped to i32 once.
pub fn exact(
    [cin, cout]: [usize; 2],
    weights: &[i16],
    requantise: &Requantise,
    taps: &Taps<'_>,
    input: &[i16],
    rows: usize,
    residual: Option<&[i16]>,
    relu: bool,
) -> Vec<i16> {
    let mut out = Vec::with_capacity(rows * cout);
    let limit = i64::from(LIMIT);
    for i in 0..rows {
        for o in 0..cout {
            let (mut sum, mut energy) = (0i64, 0i64);
            for k in 0..taps.volume() {
                let Some(row) = tap(taps, i, k) else { continue };
                for c in 0..cin {
                    let w = i64::from(weights[(k * cin + c) * cout + o]);
                    sum += w * i64::from(input[row * cin + c]);
                    energy += w * w;
                }
            }
            let mut q = match requantise {
                Requantise::Shift { bias, shift } => i64::from((sum + i64::from(bias[o])) as i32 >> shift[o]),
                Requantise::Scale { scale, bias } => (sum as i32 as f32 * scale[o] + bias[o]).round_ties_even() as i64,
                Requantise::Invariant { gain, bias } => {
                    let scale = gain[o] / ((energy as u32).max(1) as f32).sqrt();
                    (sum as i32 as f32 * scale + bias[o]).round_ties_even() as i64
                }
            }
            .clamp(-limit, limit);
            if let Some(residual) = residual {
                q = (q + i64::from(residual[i * cout + o])).clamp(-limit, limit);
            }
            out.push(if relu { q.max(0) } else { q } as i16);
        }
    }
    out
}
