//! The post filter: takes coding noise out of the colours of a level that is shown.
//!
//! Nothing else is coded from filtered colours. A pass moves every voxel's colour, channel by channel, by five *terms* that the encoder weights. With `d` the difference of
//! an occupied neighbour to the voxel, a *narrow* response is `n(d) = d·(1 − (d/c)²)` where `|d| < c`, and else 0, with c = 0.7 quantisation steps; the *wide* response `w(d)` is
//! the same with c = 2.8 steps. Neighbours by a face, an edge and a corner count 20, 12 and 7 times; the terms are the sums over
//!
//! 1. faces of n, 2. edges of n, 3. corners of n, 4. faces of w, 5. edges and corners of w,
//!
//! each divided by the sum of the counts of all neighbours. This is an edge-preserving filter such as video codecs have after reconstruction (bilateral, fitted by least squares
//! as in an adaptive loop filter).
//!
//! # Payload
//! u8 number of passes, 1 or 2; for each pass, for Y, Co and Cg, five i8 weights in units of 1/16.
//!
//! # Arithmetic
//! Values and steps are in their fixed point units. With `x = min(4096, (|d|·r) >> 12)` and `r = min(⌊2²⁴ / c⌋, 2¹⁶)`, c the product of the step and 7 or 28, divided by 10 and rounded down, but at least 1:
//! the response is `(d·(4096 − ((x·x) >> 12))) >> 12`. A term is `(sum·⌊2¹⁶ / counts⌋) >> 14`, four times the mean; a pass adds `(Σ weight·term + 32) >> 6`. All shifts round down; products of a
//! sum and an inverse have 64 bits. Results are clamped as decoded colours are. A channel without a step stays as it is.

use b2p_kernels::smooth::{Lanes, Values, responses};
use b2p_kernels::{Instructions, Isa, Work};
use rayon::prelude::*;

use super::Coloured;
use super::space::{Steps, Ycc, clamp, display};
use crate::error::{Error, Result, Stage};
use crate::geometry::KernelMap;

pub(super) const TERMS: usize = 5;
/// The most passes.
const MAX_PASSES: usize = 2;
/// Bytes of a pass.
const PASS_BYTES: usize = 3 * TERMS;
/// How often neighbours by a face, an edge and a corner count.
const COUNTS: [i32; 3] = [20, 12, 7];
/// Voxels of a task.
const BLOCK: usize = 4096;

type Pass = [[i8; TERMS]; 3];
/// Five terms of three channels, four times the mean each.
type Terms = [[i32; TERMS]; 3];

/// The post filter of a level.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Filter {
    passes: Vec<Pass>,
}

impl Filter {
    /// Reads a payload that begins at byte `offset` of the stream.
    ///
    /// # Errors
    /// [`Error::Malformed`] if it is none.
    pub fn parse(bytes: &[u8], offset: usize) -> Result<Filter> {
        let (passes, rest) = bytes
            .split_first()
            .map_or((0, bytes), |(n, rest)| (usize::from(*n), rest));
        if !(1..=MAX_PASSES).contains(&passes) || rest.len() != passes * PASS_BYTES {
            let at = format!("byte {offset}");
            let value = format!("{passes} passes in {} bytes", bytes.len());
            let expected = format!("1 to {MAX_PASSES} passes of {PASS_BYTES} bytes after their number");
            return Err(Error::malformed(Stage::Colour, at, "colour filter", value, expected));
        }
        let pass =
            |bytes: &[u8]| -> Pass { std::array::from_fn(|t| std::array::from_fn(|j| bytes[t * TERMS + j] as i8)) };
        Ok(Filter {
            passes: rest.chunks_exact(PASS_BYTES).map(pass).collect(),
        })
    }

    /// The payload.
    pub fn to_bytes(&self) -> Vec<u8> {
        let weights = self.passes.iter().flatten().flatten().map(|w| *w as u8);
        [self.passes.len() as u8].into_iter().chain(weights).collect()
    }

    /// The filtered colours of a level, whose 3³ kernel map is `map`, for display.
    ///
    /// # Panics
    /// If the map is another level's.
    pub fn rgb(&self, isa: Isa, coloured: &Coloured, map: &KernelMap) -> Vec<[u8; 3]> {
        let fraction = coloured.steps().fraction();
        let values = self.apply(isa, coloured, map);
        values.par_iter().map(|ycc| display(*ycc, fraction)).collect()
    }

    /// The filtered values of a level ([`Coloured::values`]).
    fn apply(&self, isa: Isa, coloured: &Coloured, map: &KernelMap) -> Vec<Ycc> {
        assert_eq!(map.len(), coloured.values.len(), "the map of the level");
        let mut values = coloured.values.clone();
        for pass in &self.passes {
            values = filtered(isa, &values, map, coloured.steps, pass);
        }
        values
    }

    /// The filter that brings a level's colours nearest to `truth`, if that is worth its bytes.
    #[cfg(feature = "encoder")]
    pub fn fit(isa: Isa, coloured: &Coloured, map: &KernelMap, truth: &[Ycc]) -> Option<Filter> {
        assert_eq!(truth.len(), coloured.values.len(), "a true colour for every voxel");
        if coloured.steps.is_lossless() {
            return None;
        }
        let mut values = coloured.values.clone();
        let mut passes = Vec::new();
        for _ in 0..MAX_PASSES {
            let pass = super::encode::fit_pass(isa, &values, map, coloured.steps, truth);
            if pass == Pass::default() {
                break;
            }
            values = filtered(isa, &values, map, coloured.steps, &pass);
            passes.push(pass);
        }
        (!passes.is_empty()).then_some(Filter { passes })
    }
}

/// One pass over a level.
fn filtered(isa: Isa, values: &[Ycc], map: &KernelMap, steps: Steps, pass: &Pass) -> Vec<Ycc> {
    let (values, mut out) = (&widen(values), vec![[0; 3]; values.len()]);
    let tasks = out.par_chunks_mut(BLOCK).enumerate();
    tasks.for_each(|(i, out)| {
        isa.run(Task {
            first: i * BLOCK,
            values,
            map,
            steps,
            pass,
            out,
        })
    });
    out
}

struct Task<'a> {
    first: usize,
    values: &'a [Values],
    map: &'a KernelMap,
    steps: Steps,
    pass: &'a Pass,
    out: &'a mut [Ycc],
}

impl Work for Task<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, instructions: I) {
        let Task {
            first,
            values,
            map,
            steps,
            pass,
            out,
        } = self;
        let around = Responses::new(steps);
        for (voxel, out) in (first..).zip(out) {
            let terms = around.terms(instructions, values, map, voxel);
            for t in 0..3 {
                let weighted = pass[t].iter().zip(terms[t]);
                let sum = weighted.fold(0i32, |sum, (w, x)| sum.wrapping_add(i32::from(*w) * x));
                out[t] = clamp(i32::from(values[voxel][t]) + ((sum + 32) >> 6), steps.fraction());
            }
        }
    }
}

/// Values as responses take them: Y, Co, Cg and a zero, twice.
pub(super) fn widen(values: &[Ycc]) -> Vec<Values> {
    values
        .par_iter()
        .map(|&[y, co, cg]| [y, co, cg, 0, y, co, cg, 0])
        .collect()
}

/// The places in a 3³ row of the neighbours that share a face, an edge, or a corner.
const FACES: [usize; 6] = [4, 10, 12, 14, 16, 22];
const EDGES: [usize; 12] = [1, 3, 5, 7, 9, 11, 15, 17, 19, 21, 23, 25];
const CORNERS: [usize; 8] = [0, 2, 6, 8, 18, 20, 24, 26];

/// How neighbours' differences count: lanes 0 to 2 narrow responses of Y, Co and Cg, 4 to 6 wide ones.
pub(super) struct Responses {
    inverses: Lanes,
}

impl Responses {
    pub fn new(steps: Steps) -> Responses {
        let units = steps.units();
        let inverse = |lane: usize| match (lane % 4, if lane < 4 { 7 } else { 28 }) {
            (3, _) => 1 << 16,
            (t, _) if units[t] == 0 => 1 << 16,
            (t, tenths) => ((1 << 24) / (units[t] * tenths / 10).max(1)).min(1 << 16),
        };
        Responses {
            inverses: std::array::from_fn(inverse),
        }
    }

    /// The terms of one voxel.
    #[inline(always)]
    pub fn terms<I: Instructions>(&self, instructions: I, values: &[Values], map: &KernelMap, voxel: usize) -> Terms {
        let (own, row) = (&values[voxel], map.row(voxel));
        let sum = |places: &[usize]| responses(instructions, values, own, row, places, &self.inverses);
        let (faces, face_count) = sum(&FACES);
        let (edges, edge_count) = sum(&EDGES);
        let (corners, corner_count) = sum(&CORNERS);
        let [face, edge, corner] = COUNTS;
        let counts = face_count * face + edge_count * edge + corner_count * corner;
        let inverse = (1 << 16) / i64::from(counts.max(1));
        let mean = |sum: i32| ((i64::from(sum) * inverse) >> 14) as i32;
        std::array::from_fn(|t| {
            [
                mean(face * faces[t]),
                mean(edge * edges[t]),
                mean(corner * corners[t]),
                mean(face * faces[4 + t]),
                mean(edge * edges[4 + t] + corner * corners[4 + t]),
            ]
        })
    }
}

/// Weights in units of 1/16 that solve the normal equations `a·x = b`.
#[allow(clippy::needless_range_loop)] // elimination, as it is written
#[cfg(feature = "encoder")]
pub(super) fn solve(mut a: [[f64; TERMS]; TERMS], mut b: [f64; TERMS]) -> [i8; TERMS] {
    let trace: f64 = (0..TERMS).map(|i| a[i][i]).sum();
    for (i, row) in a.iter_mut().enumerate() {
        row[i] += 1e-4 * trace + 1e-9;
    }
    for i in 0..TERMS {
        for j in i + 1..TERMS {
            let factor = a[j][i] / a[i][i];
            for k in i..TERMS {
                a[j][k] -= factor * a[i][k];
            }
            b[j] -= factor * b[i];
        }
    }
    let mut x = [0.0; TERMS];
    for i in (0..TERMS).rev() {
        let known: f64 = (i + 1..TERMS).map(|j| a[i][j] * x[j]).sum();
        x[i] = (b[i] - known) / a[i][i];
    }
    x.map(|x| (16.0 * x).round().clamp(-127.0, 127.0) as i8)
}
