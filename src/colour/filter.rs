//! The colour filter: an edge-preserving filter of a level's displayed colours (`docs/format.md`, clause 5.11).
//!
//! It reduces coding noise, as a fitted bilateral or adaptive loop filter does in video codecs. The encoder fits its
//! weights by least squares. Colours of the next level are decoded from unfiltered colours.
//!
//! A pass adds to every voxel's channel a weighted sum of five *terms*. With `d` the difference of an occupied
//! neighbour to the voxel, the *narrow* response is `n(d) = d·(1 − (d/c)²)` where `|d| < c`, and else 0, with c = 0.7
//! quantisation steps. The *wide* response `w(d)` is the same with c = 2.8 steps. Neighbours by a face, an edge and a
//! corner have the weights 20, 12 and 7. The terms are the weighted means over all neighbours of
//!
//! 1. n of faces, 2. n of edges, 3. n of corners, 4. w of faces, 5. w of edges and corners.
//!
//! # Arithmetic
//! Integers as in clause 5.11.3. Products of a sum and an inverse have 64 bits, or 32 where that is enough. Results are
//! clamped as decoded colours.

use b2p_kernels::smooth::{Lanes, Neighbourhood, Responses, Values};
use b2p_kernels::{Instructions, Isa, Work};
use rayon::prelude::*;

use super::LevelColours;
use super::space::{Steps, Ycc, clamp, display};
use crate::error::{Error, Result, Stage};
use crate::geometry::{SiblingMap, Window, place};

/// Number of terms of a pass and channel.
pub(super) const TERMS: usize = 5;
/// Maximum number of passes.
const MAX_PASSES: usize = 2;
/// Bytes of a pass in the payload.
const PASS_BYTES: usize = 3 * TERMS;
/// Weights of neighbours by a face, an edge and a corner.
const CLASS_WEIGHTS: [i32; 3] = [20, 12, 7];
/// Number of voxels filtered by one task.
const BLOCK: usize = 4096;

/// Weights of a pass by channel and term, in units of 1/16.
type Pass = [[i8; TERMS]; 3];
/// Five terms of three channels: four times the mean.
#[cfg(feature = "encoder")]
type Terms = [[i32; TERMS]; 3];

/// The colour filter of a level.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Filter {
    passes: Vec<Pass>,
}

impl Filter {
    /// Parses a payload, which starts at byte `offset` of the stream.
    ///
    /// # Errors
    /// [`Error::Malformed`] if the payload is invalid.
    pub fn parse(bytes: &[u8], offset: usize) -> Result<Filter> {
        let (passes, rest) = bytes
            .split_first()
            .map_or((0, bytes), |(n, rest)| (usize::from(*n), rest));
        if !(1..=MAX_PASSES).contains(&passes) || rest.len() != passes * PASS_BYTES {
            let at = format!("byte {offset}");
            let value = format!("{passes} passes in {} bytes", bytes.len());
            let expected = format!("1 to {MAX_PASSES} passes of {PASS_BYTES} bytes after their number");
            let error = Error::malformed(Stage::Colour, at, "colour filter", value, expected);
            return Err(error.breaks("5.11.1"));
        }
        let pass =
            |bytes: &[u8]| -> Pass { std::array::from_fn(|t| std::array::from_fn(|j| bytes[t * TERMS + j] as i8)) };
        Ok(Filter {
            passes: rest.chunks_exact(PASS_BYTES).map(pass).collect(),
        })
    }

    /// Serialises the filter to a payload.
    pub fn to_bytes(&self) -> Vec<u8> {
        let weights = self.passes.iter().flatten().flatten().map(|w| *w as u8);
        [self.passes.len() as u8].into_iter().chain(weights).collect()
    }

    /// Filtered red, green and blue of every voxel of a level. `map` is the level's, `steps` are those that the filter was
    /// made for.
    ///
    /// # Panics
    /// If `map` belongs to another level.
    pub fn rgb(&self, isa: Isa, colours: &LevelColours, map: &SiblingMap, steps: Steps) -> Vec<[u8; 3]> {
        let fraction = colours.steps().fraction();
        let values = self.apply(isa, colours, map, steps);
        values.par_iter().map(|ycc| display(*ycc, fraction)).collect()
    }

    /// Filtered [`LevelColours::values`] of a level.
    fn apply(&self, isa: Isa, colours: &LevelColours, map: &SiblingMap, steps: Steps) -> Vec<Ycc> {
        assert_eq!(map.len(), colours.values.len(), "the map must be that of the level");
        let mut values: Option<Vec<Ycc>> = None;
        for pass in &self.passes {
            let wide = widen(values.as_deref().unwrap_or(&colours.values));
            // What has been read makes room for what is made of it.
            drop(values.take());
            values = Some(filtered(isa, &wide, map, steps, pass));
        }
        values.unwrap_or_else(|| colours.values.clone())
    }

    /// Fits a filter that minimises the squared error to the original colours `truth`. `None` if all weights round to
    /// 0, or the colours are lossless.
    ///
    /// # Panics
    /// If `truth` does not have one colour per voxel.
    #[cfg(feature = "encoder")]
    pub fn fit(isa: Isa, colours: &LevelColours, map: &SiblingMap, truth: &[Ycc]) -> Option<Filter> {
        assert_eq!(truth.len(), colours.values.len(), "one original colour per voxel");
        if colours.steps.is_lossless() {
            return None;
        }
        let mut values = colours.values.clone();
        let mut passes = Vec::new();
        for _ in 0..MAX_PASSES {
            let pass = super::encode::fit_pass(isa, &values, map, colours.steps, truth);
            if pass == Pass::default() {
                break;
            }
            values = filtered(isa, &widen(&values), map, colours.steps, &pass);
            passes.push(pass);
        }
        (!passes.is_empty()).then_some(Filter { passes })
    }
}

/// Applies one pass to a level.
fn filtered(isa: Isa, values: &[Values], map: &SiblingMap, steps: Steps, pass: &Pass) -> Vec<Ycc> {
    let mut out = vec![[0; 3]; values.len()];
    let tasks = out.par_chunks_mut(BLOCK).enumerate();
    tasks.for_each(|(i, out)| {
        isa.run(FilterBlock {
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

/// One pass over a block of voxels, from voxel `first` on.
struct FilterBlock<'a> {
    first: usize,
    values: &'a [Values],
    map: &'a SiblingMap,
    steps: Steps,
    pass: &'a Pass,
    out: &'a mut [Ycc],
}

impl Work for FilterBlock<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, instructions: I) {
        let FilterBlock {
            first,
            values,
            map,
            steps,
            pass,
            out,
        } = self;
        let responses = responses(steps);
        let weights = by_lane(pass);
        let mut windows = map.windows(first);
        for (voxel, out) in (first..).zip(out) {
            let Some((window, corner)) = windows.next() else {
                return;
            };
            let near = neighbourhood(values, voxel, window, corner);
            let sums = responses.weighted(instructions, near, &weights);
            for t in 0..3 {
                let sum = sums[t].wrapping_add(sums[4 + t]);
                out[t] = clamp(i32::from(values[voxel][t]) + ((sum + 32) >> 6), steps.fraction());
            }
        }
    }
}

/// The weights of a pass for each lane of the [means](Responses::means).
fn by_lane(pass: &Pass) -> [Lanes; 3] {
    let mut weights = [[0; 8]; 3];
    for (t, [a, b, c, d, e]) in pass.map(|weights| weights.map(i32::from)).into_iter().enumerate() {
        (weights[0][t], weights[1][t], weights[2][t]) = (a, b, c);
        (weights[0][4 + t], weights[1][4 + t]) = (d, e);
    }
    weights
}

/// Values in the layout of [`Values`]: Y, Co, Cg and 0, twice.
pub(super) fn widen(values: &[Ycc]) -> Vec<Values> {
    values
        .par_iter()
        .map(|&[y, co, cg]| [y, co, cg, 0, y, co, cg, 0])
        .collect()
}

/// Where the neighbours that share a face, only an edge, and only a corner are in a window, from the first of a row on.
const CLASSES: [u64; 3] = {
    let mut classes = [0; 3];
    let mut k = 0;
    while k < 27 {
        // Steps away from the voxel.
        let steps = (k % 3 != 1) as usize + (k / 3 % 3 != 1) as usize + (k / 9 != 1) as usize;
        if steps > 0 {
            classes[steps - 1] |= 1 << place(k);
        }
        k += 1;
    }
    classes
};

/// Response functions of a level: lanes 0 to 2 are the narrow responses of Y, Co and Cg, lanes 4 to 6 the wide ones. Means
/// are four times those of clause 5.11.3.
pub(super) fn responses(steps: Steps) -> Responses {
    let units = steps.units();
    let inverse = |lane: usize| match (lane % 4, if lane < 4 { 7 } else { 28 }) {
        (3, _) => 1 << 16,
        (t, _) if units[t] == 0 => 1 << 16,
        (t, tenths) => ((1 << 24) / (units[t] * tenths / 10).max(1)).min(1 << 16),
    };
    Responses::new(std::array::from_fn(inverse), CLASS_WEIGHTS)
}

/// A voxel and its neighbours by class. `corner` is where the voxel's row begins in the window.
#[inline(always)]
pub(super) fn neighbourhood<'a>(
    values: &'a [Values],
    voxel: usize,
    window: &'a Window,
    corner: usize,
) -> Neighbourhood<'a> {
    let (around, there) = window.voxels();
    let [faces, edges, corners] = CLASSES;
    Neighbourhood {
        values,
        own: &values[voxel],
        around,
        places: [
            there & faces << corner,
            there & edges << corner,
            there & corners << corner,
        ],
    }
}

/// The terms of the three channels, of what [`Responses::means`] gives.
#[cfg(feature = "encoder")]
pub(super) fn terms([faces, edges, corners]: &[Lanes; 3]) -> Terms {
    std::array::from_fn(|t| [faces[t], edges[t], corners[t], faces[4 + t], edges[4 + t]])
}

/// Solves the normal equations `a·x = b`, regularised, for weights in units of 1/16.
#[allow(clippy::needless_range_loop)] // indices as in Gaussian elimination
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
