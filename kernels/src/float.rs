//! Sparse convolution in floats: f16 in memory, f32 in between.

use half::f16;

use crate::convert;
use crate::isa::{Isa, dispatch};
use crate::rows::{Arithmetic, Extents, Output, PANEL, TILE, accumulate, energies};
use crate::taps::{Taps, TileTaps};

/// What happens to sums.
#[derive(Debug, Clone)]
pub enum Scale {
    /// Nothing: `sum + bias`.
    Plain,
    /// `sum · (gain / √(Σ weight² + 1e-8)) + bias`, the squares over the output channel's weights in the taps that read
    /// something. One gain per output channel.
    Invariant(Vec<f32>),
}

/// A sparse convolution of f16 activations by f16 weights, summed in f32.
#[derive(Debug, Clone)]
pub struct FloatConv {
    extents: Extents,
    /// Per tap, panel and input channel: 16 output channels.
    weights: Vec<Lanes>,
    bias: Vec<f32>,
    invariant: Option<Invariant>,
}

#[derive(Debug, Clone)]
struct Invariant {
    energy: Vec<f32>,
    gain: Vec<f32>,
}

/// What a layer may write: f16, saturating, or f32 as computed.
pub trait FloatOut: Copy + Send + Sync + sealed::Sealed {
    /// Rounds a row.
    #[doc(hidden)]
    fn store(from: &[f32], to: &mut [Self]);
}

mod sealed {
    pub trait Sealed {}
    impl Sealed for f32 {}
    impl Sealed for half::f16 {}
}

impl FloatOut for f32 {
    #[inline(always)]
    fn store(from: &[f32], to: &mut [f32]) {
        to.copy_from_slice(from);
    }
}

impl FloatOut for f16 {
    #[inline(always)]
    fn store(from: &[f32], to: &mut [f16]) {
        convert::narrow(from, to);
    }
}

/// One panel.
type Lanes = [f32; PANEL];

struct Single;

impl Arithmetic for Single {
    type Value = f16;
    type Factor = f32;
    type Weights = Lanes;
    type Sums = Lanes;

    #[inline(always)]
    fn steps(cin: usize) -> usize {
        cin
    }

    #[inline(always)]
    fn expand(row: &[f16], factors: &mut [f32]) {
        convert::widen(row, factors);
    }

    #[inline(always)]
    fn step(mut sums: Lanes, weights: &Lanes, factor: &f32) -> Lanes {
        let factor = *factor;
        for j in 0..PANEL {
            sums[j] += factor * weights[j];
        }
        sums
    }
}

impl FloatConv {
    /// Packs `weights[tap][input][output]`.
    ///
    /// # Panics
    /// If lengths don't match the extents: the caller has checked what it read.
    pub fn new(
        volume: usize,
        cin: usize,
        cout: usize,
        weights: &[f16],
        bias: Vec<f32>,
        scale: Scale,
    ) -> Self {
        let extents = Extents { volume, cin, cout };
        extents.check(weights.len());
        assert_eq!(bias.len(), cout, "one bias per channel");
        let invariant = match scale {
            Scale::Plain => None,
            Scale::Invariant(gain) => {
                assert_eq!(gain.len(), cout, "one gain per channel");
                let mut energy = vec![0.0; volume * cout];
                for (i, w) in weights.iter().enumerate() {
                    energy[i / (cin * cout) * cout + i % cout] += w.to_f32().powi(2);
                }
                Some(Invariant { energy, gain })
            }
        };
        let mut packed = vec![Lanes::default(); volume * extents.panels() * cin];
        for (i, w) in weights.iter().enumerate() {
            let (k, c, o) = (i / (cin * cout), i / cout % cin, i % cout);
            packed[(k * extents.panels() + o / PANEL) * cin + c][o % PANEL] = w.to_f32();
        }
        FloatConv {
            extents,
            weights: packed,
            bias,
            invariant,
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
    /// # Panics
    /// If `taps` are not this layer's, or name rows that `input` lacks, or `output` does not fit.
    pub fn run<T: FloatOut>(
        &self,
        isa: Isa,
        taps: Taps<'_>,
        input: &[f16],
        first: usize,
        output: Output<'_, T, f16>,
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
        let mut sums = vec![Lanes::default(); TILE * panels];
        let mut norms = vec![0.0; TILE * cout];
        for (t, rows) in rows.chunks_mut(TILE * stride).enumerate() {
            tile.fill(&taps, first + t * TILE, rows.len() / stride);
            accumulate::<Single>(
                isa,
                self.extents,
                &self.weights,
                &tile,
                input,
                &mut factors,
                &mut sums,
            );
            if let Some(Invariant { energy, .. }) = &self.invariant {
                energies(isa, cout, energy, &tile, &mut norms);
            }
            let (conv, norms) = (self, &norms[..]);
            let sums = sums.as_flattened_mut();
            let residual = residual.map(|all| &all[t * TILE * stride..][..rows.len()]);
            let output = Output {
                rows,
                stride,
                column,
                residual,
                relu,
            };
            dispatch!(isa, fn finish_tile<T: FloatOut>(
                conv: &FloatConv, sums: &mut [f32], norms: &[f32], output: Output<'_, T, f16>,
            ));
        }
    }
}

#[inline(always)]
fn finish_tile<T: FloatOut>(
    conv: &FloatConv,
    sums: &mut [f32],
    norms: &[f32],
    output: Output<'_, T, f16>,
) {
    let Output {
        rows,
        stride,
        column,
        residual,
        relu,
    } = output;
    let Extents { cout, .. } = conv.extents;
    let mut skip = vec![0.0; cout];
    let sums = sums.chunks_exact_mut(cout.next_multiple_of(PANEL));
    for (r, (row, sums)) in rows.chunks_exact_mut(stride).zip(sums).enumerate() {
        let sums = &mut sums[..cout];
        if let Some(Invariant { gain, .. }) = &conv.invariant {
            for ((sum, norm), gain) in sums.iter_mut().zip(&norms[r * cout..]).zip(gain) {
                *sum *= gain / (norm + 1e-8).sqrt();
            }
        }
        for (sum, bias) in sums.iter_mut().zip(&conv.bias) {
            *sum += bias;
        }
        if let Some(residual) = residual {
            convert::widen(&residual[r * stride + column..][..cout], &mut skip);
            for (sum, x) in sums.iter_mut().zip(&skip) {
                *sum += x;
            }
        }
        if relu {
            sums.iter_mut().for_each(|sum| *sum = sum.max(0.0));
        }
        T::store(sums, &mut row[column..column + cout]);
    }
}
