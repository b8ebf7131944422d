//! All eight children of voxels by minimal filtering: 64 products a voxel and pair of channels instead of up to 216.
//!
//! F(2³, 3³) after Winograd, as Lavin and Gray use it (arXiv 1509.09308): the window of 4³ positions around a voxel's
//! children is transformed, multiplied position by position with transformed weights, and transformed back to the eight
//! children. Weights are taken eightfold, so that no transform divides, and all is computed modulo 2³²: what comes back
//! is eight times the sum, whatever wrapped on the way. So results are those of the definition to the bit where no sum
//! takes more than 29 bits.

use bytemuck::{must_cast_slice, must_cast_slice_mut};

use super::kernel::{multiply, place};
use super::requantise::LIMIT;
use crate::simd::{I16Vector, I32Vector, Isa, Simd, dispatch, four};
use crate::sparse::accumulate::multiply_rows;
use crate::sparse::children::{copy_mask, window};
use crate::sparse::rows::{Extents, PANEL, Words};
use crate::sparse::taps::ABSENT;

/// Positions of the window.
const WINDOW: usize = 64;
/// Voxels whose children are computed together: their windows and products fit the second cache. A multiple of every
/// [`crate::sparse::accumulate::group`].
const PART: usize = 16;
/// Sums must stay below this, either side of zero.
const SUM_LIMIT: i64 = 1 << 28;

/// A layer's transformed weights.
#[derive(Debug, Clone)]
pub(crate) struct Weights {
    extents: Extents,
    /// Per position of the window, panel and pair of input channels: each output channel's two weights.
    words: Vec<Words>,
}

/// What a thread needs, kept from one call to the next.
#[derive(Default)]
pub(crate) struct Buffers {
    windows: Vec<Words>,
    products: Vec<Words>,
    masks: Vec<u64>,
}

impl Weights {
    /// Transforms the weights, of which `weights(tap, input, panel)` tells those of a panel of outputs; nothing if sums
    /// could be too large, a weight does not fit 16 bits afterwards, or input channels are not whole panels.
    pub fn new(extents: Extents, weights: impl Fn(usize, usize, usize) -> [i16; PANEL]) -> Option<Self> {
        assert_eq!(extents.volume, 27, "a window is that of a 3³ kernel");
        let cin = extents.cin;
        if !cin.is_multiple_of(PANEL) {
            return None;
        }
        let (steps, panels) = (cin / 2, extents.panels());
        let mut words = vec![Words::default(); WINDOW * panels * steps];
        for panel in 0..panels {
            let mut sums = [0; PANEL];
            for c in 0..cin {
                let taps: [[i16; PANEL]; 27] = std::array::from_fn(|k| weights(k, c, panel));
                for (lane, sum) in sums.iter_mut().enumerate() {
                    let taps = taps.map(|weights| i32::from(weights[lane]));
                    *sum += taps.iter().map(|tap| i64::from(tap.abs())).sum::<i64>();
                    for (at, value) in transformed(&taps).into_iter().enumerate() {
                        let value = i16::try_from(value).ok()?;
                        let word = (at * panels + panel) * steps + c / 2;
                        words[word].0[lane] |= place(value, c % 2);
                    }
                }
            }
            if sums.iter().any(|sum| sum * i64::from(LIMIT) >= SUM_LIMIT) {
                return None;
            }
        }
        Some(Weights { extents, words })
    }
}

/// Eightfold transformed weights: (2, 0, 0), (1, 1, 1), (1, −1, 1), (0, 0, 2) along each axis, one after the other.
fn transformed(taps: &[i32; 27]) -> [i32; WINDOW] {
    let along = |[a, b, c]: [i32; 3]| [2 * a, a + b + c, a - b + c, 2 * c];
    let x: [[i32; 4]; 9] = std::array::from_fn(|i| along([taps[3 * i], taps[3 * i + 1], taps[3 * i + 2]]));
    let y: [[[i32; 4]; 4]; 3] =
        std::array::from_fn(|z| std::array::from_fn(|i| along([x[3 * z][i], x[3 * z + 1][i], x[3 * z + 2][i]])));
    std::array::from_fn(|at| {
        let [i, j] = [at & 3, at >> 2 & 3];
        along([y[0][i][j], y[1][i][j], y[2][i][j]])[at >> 4]
    })
}

/// Words between positions of windows and products beyond what they hold: without, all positions of a voxel fall into
/// few sets of the cache.
const GAP: usize = PANEL;

/// The sums of all children of voxels: `sums[child · panels + panel]`, and which taps of each child read something.
///
/// `neighbours` are 27 of each voxel; child `o` of voxel `q` is row `8q + o` of the input.
///
/// # Panics
/// If a child's row lies beyond the input.
pub(crate) fn accumulate<'a>(
    isa: Isa,
    weights: &Weights,
    neighbours: &[u32],
    input: &[i16],
    buffers: &'a mut Buffers,
    sums: &mut Vec<Words>,
) -> &'a [u64] {
    let Extents { cin, cout, .. } = weights.extents;
    let (steps, panels) = (cin / 2, weights.extents.panels());
    let Buffers {
        windows,
        products,
        masks,
    } = buffers;
    let stride = PART * steps + GAP;
    windows.resize(WINDOW * stride / PANEL, Words::default());
    let between = PART * panels + GAP / PANEL;
    products.resize(WINDOW * between, Words::default());
    sums.resize(neighbours.len() / 27 * 8 * panels, Words::default());
    masks.clear();
    let parts = neighbours.chunks(PART * 27);
    for (neighbours, sums) in parts.zip(sums.chunks_mut(PART * 8 * panels)) {
        let to: &mut [i16] = must_cast_slice_mut(windows);
        dispatch!(isa, fn forward(neighbours: &[u32], input: &[i16], cin: usize, to: &mut [i16], masks: &mut Vec<u64>));
        let windows: &[u32] = must_cast_slice(windows);
        let rows = windows.chunks_exact(stride);
        let weights = weights.words.chunks_exact(panels * steps);
        let each = rows.zip(weights).zip(products.chunks_exact_mut(between));
        for ((rows, weights), products) in each {
            let (rows, products) = (&rows[..PART * steps], &mut products[..PART * panels]);
            multiply_rows(isa, multiply, cout, weights, rows, products);
        }
        dispatch!(isa, fn back(products: &[Words], panels: usize, sums: &mut [Words]));
    }
    masks
}

/// Gathers and transforms the windows of up to [`PART`] voxels: `[position][voxel][channel]`, positions [`GAP`] words
/// apart.
#[inline(always)]
fn forward<S: Simd>(simd: S, neighbours: &[u32], input: &[i16], cin: usize, windows: &mut [i16], masks: &mut Vec<u64>) {
    // Rows of whole panels consist of whole vectors of one of both.
    match cin.is_multiple_of(2 * S::LANES) {
        true => forward_by(simd, neighbours, input, cin, windows, masks),
        false => forward_by(simd.narrow(), neighbours, input, cin, windows, masks),
    }
}

/// What a window reads where nothing is.
static NOTHING: [i16; 2 * PANEL] = [0; 2 * PANEL];

#[inline(always)]
fn forward_by<S: Simd>(
    simd: S,
    neighbours: &[u32],
    input: &[i16],
    cin: usize,
    windows: &mut [i16],
    masks: &mut Vec<u64>,
) {
    let (lanes, rows) = (2 * S::LANES, input.len() / cin);
    let stride = PART * cin + 2 * GAP;
    for (voxel, neighbours) in neighbours.chunks_exact(27).enumerate() {
        let window = window(neighbours, |q, octant| q << 3 | octant);
        let end = window.iter().fold(0, |end, at| end.max(at.wrapping_add(1)));
        assert!(
            end as usize <= rows,
            "a tap reads row {}, but the input has {rows}",
            end - 1
        );
        masks.extend((0..8).map(|octant| copy_mask(&window, octant)));
        // Rows that are absent start behind the input.
        let starts = window.map(|q| if q == ABSENT { input.len() } else { q as usize * cin });
        for channel in (0..cin).step_by(lanes) {
            let read = |at: usize| {
                let first = starts[at] + channel;
                S::I16::load(simd, input.get(first..first + lanes).unwrap_or(&NOTHING[..lanes]))
            };
            let mut values = [S::I16::splat(simd, 0); WINDOW];
            for z in (0..WINDOW).step_by(16) {
                for y in (z..z + 16).step_by(4) {
                    let line = [read(y), read(y + 1), read(y + 2), read(y + 3)];
                    values[y..y + 4].copy_from_slice(&differences::<S>(line));
                }
                for x in z..z + 4 {
                    let at = [x, x + 4, x + 8, x + 12];
                    let line = differences::<S>(four!(i => values[at[i]]));
                    for (at, value) in at.into_iter().zip(line) {
                        values[at] = value;
                    }
                }
            }
            for i in 0..16 {
                let at = [i, i + 16, i + 32, i + 48];
                let line = differences::<S>(four!(i => values[at[i]]));
                for (at, value) in at.into_iter().zip(line) {
                    value.store(&mut windows[at * stride + voxel * cin + channel..]);
                }
            }
        }
    }
}

/// a − c, b + c, c − b, b − d.
#[inline(always)]
fn differences<S: Simd>([a, b, c, d]: [S::I16; 4]) -> [S::I16; 4] {
    [a - c, b + c, c - b, b - d]
}

/// Transforms products `[position][voxel][panel]`, positions [`GAP`] words apart, back to the sums of eight children a
/// voxel.
#[inline(always)]
fn back<S: Simd>(simd: S, products: &[Words], panels: usize, sums: &mut [Words]) {
    let stride = PART * panels + GAP / PANEL;
    for (voxel, sums) in sums.chunks_exact_mut(8 * panels).enumerate() {
        for panel in 0..panels {
            let products = &products[voxel * panels + panel..][..63 * stride + 1];
            for lane in (0..PANEL).step_by(S::LANES) {
                let read = |at: usize| S::I32::load(simd, &products[at * stride].i32()[lane..]);
                let [mut low, mut high] = [[S::I32::splat(simd, 0); 16]; 2];
                for i in 0..16 {
                    let line = [read(i), read(i + 16), read(i + 32), read(i + 48)];
                    [low[i], high[i]] = join::<S>(line);
                }
                for (z, plane) in [low, high].iter().enumerate() {
                    let mut lines = [[plane[0]; 4]; 2];
                    for x in 0..4 {
                        let line = [plane[x], plane[x + 4], plane[x + 8], plane[x + 12]];
                        [lines[0][x], lines[1][x]] = join::<S>(line);
                    }
                    for (y, line) in lines.into_iter().enumerate() {
                        for (x, value) in join::<S>(line).into_iter().enumerate() {
                            let child = x + 2 * y + 4 * z;
                            value.shr(3).store(&mut sums[child * panels + panel].i32_mut()[lane..]);
                        }
                    }
                }
            }
        }
    }
}

/// a + b + c, b − c − d.
#[inline(always)]
fn join<S: Simd>([a, b, c, d]: [S::I32; 4]) -> [S::I32; 2] {
    let (sum, difference) = (b + c, b - c);
    [a + sum, difference - d]
}
