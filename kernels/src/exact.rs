//! Sparse convolution in integers: the same bits on every machine.

use std::num::Wrapping;

use crate::isa::{Isa, dispatch};
use crate::rows::{Arithmetic, Extents, Output, PANEL, TILE, accumulate, energies};
use crate::taps::{Taps, TileTaps};

/// The largest magnitude of an activation.
pub const LIMIT: i16 = 2047;

/// How sums become activations again.
#[derive(Debug, Clone)]
pub enum Requantise {
    /// `clamp((sum + bias) >> shift)`, all wrapping; the rounding constant is part of the bias.
    Shift {
        /// One per output channel.
        bias: Vec<i32>,
        /// One per output channel, at most 31.
        shift: Vec<u8>,
    },
    /// `clamp(round(sum · (gain / √D) + bias))` in f32, halves to even, with
    /// `D = max(1, Σ weight²)` over the output channel's weights in the taps that read something.
    Invariant {
        /// One per output channel.
        gain: Vec<f32>,
        /// One per output channel.
        bias: Vec<f32>,
    },
}

/// A sparse convolution of i16 activations by i16 weights, summed in wrapping i32.
#[derive(Debug, Clone)]
pub struct ExactConv {
    extents: Extents,
    /// Per tap, panel and pair of input channels: each of 16 output channels' two weights, side by side.
    weights: Vec<Weights>,
    finish: Finish,
}

type Weights = [[i16; PANEL]; 2];

#[derive(Debug, Clone)]
enum Finish {
    Shift {
        bias: Vec<i32>,
        shift: Vec<u32>,
    },
    Invariant {
        energy: Vec<Wrapping<u32>>,
        gain: Vec<f32>,
        bias: Vec<f32>,
    },
}

/// Multiplies two input channels at a time, which is one instruction on most machines.
struct Pairwise;

impl Arithmetic for Pairwise {
    type Value = i16;
    // The pair of channels repeated: read from memory like this, the compiler sees the pairwise product.
    type Factor = [i16; PANEL];
    type Weights = Weights;
    type Sums = [[i32; PANEL / 2]; 2];

    #[inline(always)]
    fn steps(cin: usize) -> usize {
        cin.div_ceil(2)
    }

    #[inline(always)]
    fn expand(row: &[i16], factors: &mut [[i16; PANEL]]) {
        let pairs = row.chunks_exact(2);
        if let ([last], Some(factor)) = (pairs.remainder(), factors.last_mut()) {
            *factor = std::array::from_fn(|j| if j % 2 == 0 { *last } else { 0 });
        }
        for (pair, factor) in pairs.zip(factors) {
            *factor = std::array::from_fn(|j| pair[j % 2]);
        }
    }

    #[inline(always)]
    fn step(mut sums: Self::Sums, weights: &Weights, factor: &[i16; PANEL]) -> Self::Sums {
        for (sums, weights) in sums.iter_mut().zip(weights) {
            let products = dot_pairs(weights, factor);
            for (sum, product) in sums.iter_mut().zip(products) {
                *sum = sum.wrapping_add(product);
            }
        }
        sums
    }
}

/// The sums of products of neighbours.
#[inline(always)]
fn dot_pairs(a: &[i16; PANEL], b: &[i16; PANEL]) -> [i32; PANEL / 2] {
    let mut dots = [0; PANEL / 2];
    for j in 0..PANEL / 2 {
        let even = i32::from(a[2 * j]) * i32::from(b[2 * j]);
        let odd = i32::from(a[2 * j + 1]) * i32::from(b[2 * j + 1]);
        dots[j] = even.wrapping_add(odd);
    }
    dots
}

impl ExactConv {
    /// Packs `weights[tap][input][output]`.
    ///
    /// # Panics
    /// If lengths don't match the extents, or a shift is above 31: the caller has checked what it read.
    pub fn new(
        volume: usize,
        cin: usize,
        cout: usize,
        weights: &[i16],
        requantise: Requantise,
    ) -> Self {
        let extents = Extents { volume, cin, cout };
        extents.check(weights.len());
        let finish = match requantise {
            Requantise::Shift { bias, shift } => {
                assert!(
                    bias.len() == cout && shift.len() == cout,
                    "one bias and shift per channel"
                );
                assert!(shift.iter().all(|&s| s < 32), "a shift is above 31");
                Finish::Shift {
                    bias,
                    shift: shift.into_iter().map(u32::from).collect(),
                }
            }
            Requantise::Invariant { gain, bias } => {
                assert!(
                    gain.len() == cout && bias.len() == cout,
                    "one gain and bias per channel"
                );
                Finish::Invariant {
                    energy: squares(extents, weights),
                    gain,
                    bias,
                }
            }
        };
        ExactConv {
            extents,
            weights: pack(extents, weights),
            finish,
        }
    }

    /// Output channels.
    pub fn cout(&self) -> usize {
        self.extents.cout
    }

    /// Input channels.
    pub fn cin(&self) -> usize {
        self.extents.cin
    }

    /// Computes the rows `first ..` of the layer that `output` holds, from `input`, whose rows are `cin` activations each.
    ///
    /// The residual is added after requantising, and the sum clamped to ±[`LIMIT`] again.
    ///
    /// # Panics
    /// If `taps` are not this layer's, or name rows that `input` lacks, or `output` does not fit.
    pub fn run(
        &self,
        isa: Isa,
        taps: Taps<'_>,
        input: &[i16],
        first: usize,
        output: Output<'_, i16>,
    ) {
        assert_eq!(
            taps.volume(),
            self.extents.volume,
            "these taps belong to another kernel"
        );
        let Extents { cout, .. } = self.extents;
        let panels = self.extents.panels();
        let Output {
            rows,
            stride,
            column,
            residual,
            relu,
        } = output;
        let mut tile = TileTaps::default();
        let mut factors = Vec::new();
        let mut sums = vec![Default::default(); TILE * panels];
        let mut divisors = vec![Wrapping(0); TILE * cout];
        for (t, rows) in rows.chunks_mut(TILE * stride).enumerate() {
            tile.fill(&taps, first + t * TILE, rows.len() / stride);
            accumulate::<Pairwise>(
                isa,
                self.extents,
                &self.weights,
                &tile,
                input,
                &mut factors,
                &mut sums,
            );
            if let Finish::Invariant { energy, .. } = &self.finish {
                energies(isa, cout, energy, &tile, &mut divisors);
            }
            let (sums, divisors) = (sums.as_flattened().as_flattened(), &divisors[..]);
            let residual = residual.map(|all| &all[t * TILE * stride..][..rows.len()]);
            let (finish, output) = (
                &self.finish,
                Output {
                    rows,
                    stride,
                    column,
                    residual,
                    relu,
                },
            );
            dispatch!(isa, fn finish_tile(
                finish: &Finish, cout: usize, sums: &[i32], divisors: &[Wrapping<u32>], output: Output<'_, i16>,
            ));
        }
    }
}

/// `Σ weight²` over the input channels, per tap and output channel.
fn squares(extents: Extents, weights: &[i16]) -> Vec<Wrapping<u32>> {
    let Extents { volume, cin, cout } = extents;
    let mut energy = vec![Wrapping(0); volume * cout];
    for (i, &w) in weights.iter().enumerate() {
        energy[i / (cin * cout) * cout + i % cout] += Wrapping(u32::from(w.unsigned_abs()).pow(2));
    }
    energy
}

fn pack(extents: Extents, weights: &[i16]) -> Vec<Weights> {
    let Extents { volume, cin, cout } = extents;
    let steps = Pairwise::steps(cin);
    let mut packed = vec![Weights::default(); volume * extents.panels() * steps];
    for (i, &w) in weights.iter().enumerate() {
        let (k, c, o) = (i / (cin * cout), i / cout % cin, i % cout);
        let lane = o % PANEL;
        packed[(k * extents.panels() + o / PANEL) * steps + c / 2][lane / 8]
            [lane % 8 * 2 + c % 2] = w;
    }
    packed
}

#[inline(always)]
fn finish_tile(
    finish: &Finish,
    cout: usize,
    sums: &[i32],
    divisors: &[Wrapping<u32>],
    output: Output<'_, i16>,
) {
    let Output {
        rows,
        stride,
        column,
        residual,
        relu,
    } = output;
    let sums = sums.chunks_exact(cout.next_multiple_of(PANEL));
    let divisors = divisors.chunks_exact(cout);
    for (r, ((row, sums), divisors)) in rows
        .chunks_exact_mut(stride)
        .zip(sums)
        .zip(divisors)
        .enumerate()
    {
        let row = &mut row[column..column + cout];
        match finish {
            Finish::Shift { bias, shift } => shifted(sums, bias, shift, row),
            Finish::Invariant { gain, bias, .. } => scaled(sums, divisors, gain, bias, row),
        }
        if let Some(residual) = residual {
            for (q, &x) in row.iter_mut().zip(&residual[r * stride + column..]) {
                *q = q.saturating_add(x).clamp(-LIMIT, LIMIT);
            }
        }
        if relu {
            row.iter_mut().for_each(|q| *q = (*q).max(0));
        }
    }
}

#[inline(always)]
fn shifted(sums: &[i32], bias: &[i32], shift: &[u32], row: &mut [i16]) {
    for (((q, &sum), &bias), &shift) in row.iter_mut().zip(sums).zip(bias).zip(shift) {
        let value = sum.wrapping_add(bias).wrapping_shr(shift);
        *q = value.clamp(-i32::from(LIMIT), i32::from(LIMIT)) as i16;
    }
}

#[inline(always)]
fn scaled(sums: &[i32], divisors: &[Wrapping<u32>], gain: &[f32], bias: &[f32], row: &mut [i16]) {
    let limit = f32::from(LIMIT);
    for ((((q, &sum), &divisor), &gain), &bias) in
        row.iter_mut().zip(sums).zip(divisors).zip(gain).zip(bias)
    {
        let scale = gain / (divisor.0.max(1) as f32).sqrt();
        let value = sum as f32 * scale + bias;
        *q = value.clamp(-limit, limit).round_ties_even() as i16;
    }
}
