//! Sparse convolution in floats: f16 in memory, f32 in between.

use std::cell::RefCell;
#[cfg(target_arch = "x86_64")]
use std::sync::OnceLock;

use ::half::{bf16, f16};
use bytemuck::must_cast_slice_mut;

#[cfg(target_arch = "aarch64")]
use super::half;
use super::{convert, kernel};
#[cfg(target_arch = "x86_64")]
use crate::exact::amx;
use crate::exact::norms::{Gains, Norms};
use crate::simd::{F32Vector, Isa, Simd, dispatch};
use crate::sparse::accumulate::{Expand, Multiply, accumulate, group};
use crate::sparse::plan::PlanTile;
use crate::sparse::rows::{Extents, Output, PANEL, Words, panel, panels, store_part};
use crate::sparse::scratch::{Scratch, with_scratch};
use crate::sparse::taps::Taps;

/// What happens to sums.
#[derive(Debug, Clone)]
pub enum Scale {
    /// Nothing: `sum + bias`.
    Plain,
    /// `sum · (gain / √(Σ weight² + 1e-8)) + bias`, the squares over the output channel's weights in the taps that read
    /// something. One gain per output channel.
    Invariant(Vec<f32>),
}

/// What products are computed in.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub enum Precision {
    /// f32: a sum's error is that of adding in f32.
    #[default]
    F32,
    /// Activations and weights are rounded to bf16 (8 significant bits) first; products are added in f32. A sum's error
    /// is at most 2⁻⁷ of its terms' magnitudes. Needs [`Isa::has_bf16`]; elsewhere it is [`Precision::F32`].
    Bf16,
    /// As [`Precision::Bf16`] where it is many times as fast, with [`Isa::has_tiles`]; elsewhere [`Precision::F32`].
    Fastest,
    /// Products are summed in f16 with fused multiply-adds, 16 at a time, and then in f32. Besides what f32 loses, a
    /// sum is off by at most 1.004 · 2⁻⁷ of its terms' magnitudes, and by 1.01 · 2⁻¹⁹ · w · (|x| + 1) for each
    /// activation x that it reads, w being the output channel's largest weight. Of finite activations and weights no
    /// sum overflows. Needs [`Isa::has_half`]; elsewhere it is [`Precision::F32`].
    Half,
}

/// A sparse convolution of f16 activations by f16 weights, summed in f32.
#[derive(Debug, Clone)]
pub struct FloatConv {
    extents: Extents,
    /// Per tap, panel and input channel: each output channel's weight.
    weights: Vec<Words>,
    /// Per tap, panel and pair of input channels: each output channel's two weights in bf16. Empty unless asked for.
    bf16_weights: Vec<Words>,
    /// What [`Isa::has_half`] multiplies, if it was asked for.
    #[cfg(target_arch = "aarch64")]
    half: Option<half::Weights>,
    precision: Precision,
    /// What [`Isa::has_tiles`] multiplies, once it is needed.
    #[cfg(target_arch = "x86_64")]
    tiles: OnceLock<amx::Weights>,
    bias: Vec<[f32; PANEL]>,
    invariant: Option<Gains<f32>>,
}

/// What a layer may write: f16, saturating, or f32 as computed.
pub trait FloatOut: Copy + Send + Sync + sealed::Sealed {}

impl FloatOut for f32 {}
impl FloatOut for f16 {}

mod sealed {
    use super::{F32Vector, Simd};
    use ::half::f16;

    pub trait Sealed: Default {
        /// Writes a vector.
        fn store<S: Simd>(simd: S, from: S::F32, to: &mut [Self]);
    }

    impl Sealed for f32 {
        #[inline(always)]
        fn store<S: Simd>(_: S, from: S::F32, to: &mut [f32]) {
            from.store(to);
        }
    }

    impl Sealed for f16 {
        #[inline(always)]
        fn store<S: Simd>(_: S, from: S::F32, to: &mut [f16]) {
            from.store_f16(to);
        }
    }
}

impl FloatConv {
    /// Packs `weights[tap][input][output]`.
    ///
    /// # Panics
    /// If lengths don't match the extents, or there are more than 54 taps: the caller has checked what it read.
    pub fn new(volume: usize, cin: usize, cout: usize, weights: &[f16], bias: Vec<f32>, scale: Scale) -> Self {
        let extents = Extents { volume, cin, cout };
        extents.check(weights.len());
        assert_eq!(bias.len(), cout, "one bias per channel");
        let invariant = match scale {
            Scale::Plain => None,
            Scale::Invariant(gain) => {
                assert_eq!(gain.len(), cout, "one gain per channel");
                let mut energy = vec![[0.0; PANEL]; volume * extents.panels()];
                extents.place(weights, |w, panel, _, lane| {
                    energy[panel][lane] += w.to_f32().powi(2);
                });
                Some(Gains::new(energy, panels(&gain)))
            }
        };
        let mut packed = vec![Words::default(); volume * extents.panels() * cin];
        extents.place(weights, |w, panel, c, lane| {
            packed[panel * cin + c].0[lane] = w.to_f32().to_bits();
        });
        FloatConv {
            extents,
            weights: packed,
            bf16_weights: Vec::new(),
            #[cfg(target_arch = "aarch64")]
            half: None,
            precision: Precision::F32,
            #[cfg(target_arch = "x86_64")]
            tiles: OnceLock::new(),
            bias: panels(&bias),
            invariant,
        }
    }

    /// Computes in that precision from now on.
    pub fn with_precision(mut self, precision: Precision) -> Self {
        let Extents { volume, cin, .. } = self.extents;
        let pairs = cin.div_ceil(2);
        self.precision = precision;
        self.bf16_weights = match precision {
            Precision::F32 | Precision::Fastest | Precision::Half => Vec::new(),
            Precision::Bf16 => vec![Words::default(); volume * self.extents.panels() * pairs],
        };
        let panels = self.bf16_weights.chunks_exact_mut(pairs);
        for (to, from) in panels.zip(self.weights.chunks_exact(cin)) {
            for (c, from) in from.iter().enumerate() {
                for (to, from) in to[c / 2].0.iter_mut().zip(from.f32()) {
                    // The only machines with bf16 keep the first value in the low half.
                    *to |= u32::from(bf16::from_f32(*from).to_bits()) << (c % 2 * 16);
                }
            }
        }
        #[cfg(target_arch = "aarch64")]
        {
            let half = || half::Weights::new(self.extents, |tap, c, panel| self.weight(tap, c, panel));
            self.half = (precision == Precision::Half).then(half);
        }
        self
    }

    /// The weights of a panel of outputs.
    #[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
    fn weight(&self, tap: usize, channel: usize, panel: usize) -> [f32; PANEL] {
        let Extents { cin, .. } = self.extents;
        *self.weights[(tap * self.extents.panels() + panel) * cin + channel].f32()
    }

    /// What it computes in, where the machine can.
    pub fn precision(&self) -> Precision {
        self.precision
    }

    /// Output channels.
    pub fn cout(&self) -> usize {
        self.extents.cout
    }

    /// Input channels.
    pub fn cin(&self) -> usize {
        self.extents.cin
    }

    /// What to multiply by which micro-kernel, and how to prepare what it is multiplied by.
    fn chosen(&self, isa: Isa) -> (Multiply, &[Words], Expand<f16>) {
        #[cfg(target_arch = "x86_64")]
        if self.precision() == Precision::Bf16 && isa.has_bf16() {
            return (super::bf16::multiply, &self.bf16_weights, super::bf16::expand);
        }
        #[cfg(target_arch = "aarch64")]
        if let Some(half) = self.half(isa) {
            return (half::multiply, &half.words, half::gather);
        }
        let _ = isa;
        (kernel::multiply, &self.weights, widen)
    }

    /// Computes the rows `first ..` of the layer that `output` holds, from `input`, whose rows are `cin` activations
    /// each.
    ///
    /// # Panics
    /// If `taps` are not this layer's, or name rows that `input` lacks, or `output` does not fit.
    pub fn run<T: FloatOut>(
        &self,
        isa: Isa,
        taps: Taps<'_>,
        input: &[f16],
        first: usize,
        mut output: Output<'_, T, f16>,
    ) {
        assert_eq!(
            taps.volume(),
            self.extents.volume,
            "these taps belong to another kernel"
        );
        let group = group(isa, self.extents.cout);
        with_scratch(|scratch| {
            let Scratch {
                taps: tile,
                planner,
                expanded,
                sums,
            } = scratch;
            with_own(|own| {
                for (row, output) in output.tiles() {
                    let plan = planner.plan(isa, group, &taps, [first + row, output.len()], tile);
                    self.sum(isa, plan, input, expanded, own, sums);
                    #[cfg(target_arch = "aarch64")]
                    let units = self.half(isa).map(|half| &half.units[..]);
                    #[cfg(not(target_arch = "aarch64"))]
                    let units = None;
                    let (conv, norms, sums) = (self, &mut own.norms, &sums[..]);
                    dispatch!(isa, fn write_tile<T: FloatOut>(
                        conv: &FloatConv, units: Option<&[[f32; PANEL]]>, norms: &mut Norms, sums: &[Words], plan: &PlanTile,
                        output: Output<'_, T, f16>,
                    ));
                }
            });
        });
    }

    /// The sums of a tile.
    fn sum(
        &self,
        isa: Isa,
        plan: &PlanTile,
        input: &[f16],
        expanded: &mut Vec<Words>,
        own: &mut Own,
        sums: &mut Vec<Words>,
    ) {
        #[cfg(target_arch = "x86_64")]
        if let Some(tokens) = isa.tiles().zip(isa.bf16())
            && matches!(self.precision, Precision::Bf16 | Precision::Fastest)
        {
            super::amx::accumulate(tokens, self.tiles(), plan, input, &mut own.tiles, sums);
            return;
        }
        let _ = own;
        let (multiply, weights, expand) = self.chosen(isa);
        accumulate(
            isa,
            multiply,
            self.extents,
            weights,
            plan,
            (input, expand),
            expanded,
            sums,
        );
    }
}

/// Per-thread scratch of float layers, besides [`Scratch`].
#[derive(Default)]
struct Own {
    norms: Norms,
    #[cfg(target_arch = "x86_64")]
    tiles: amx::Buffers,
}

/// Lends this thread's [`Own`].
fn with_own(run: impl FnOnce(&mut Own)) {
    thread_local!(static OWN: RefCell<Own> = RefCell::default());
    OWN.with_borrow_mut(run);
}

#[cfg(target_arch = "aarch64")]
impl FloatConv {
    /// The weights in f16, if it is to be multiplied by these instructions.
    fn half(&self, isa: Isa) -> Option<&half::Weights> {
        self.half.as_ref().filter(|_| isa.has_half())
    }
}

#[cfg(target_arch = "x86_64")]
impl FloatConv {
    /// The weights in tiles.
    fn tiles(&self) -> &amx::Weights {
        self.tiles
            .get_or_init(|| super::amx::weights(self.extents, |tap, c, panel| self.weight(tap, c, panel)))
    }
}

/// Rows as f32.
fn widen(isa: Isa, input: &[f16], rows: &[u32], cin: usize, to: &mut [u32]) {
    dispatch!(isa, fn widen_rows(input: &[f16], rows: &[u32], cin: usize, to: &mut [u32]));
}

#[inline(always)]
fn widen_rows<S: Simd>(simd: S, input: &[f16], rows: &[u32], cin: usize, to: &mut [u32]) {
    let to: &mut [f32] = must_cast_slice_mut(to);
    for (to, &row) in to.chunks_exact_mut(cin).zip(rows) {
        convert::widen(simd, &input[row as usize * cin..][..cin], to);
    }
}

/// Sums are multiplied by their channels' `units`, if they have any, before all else.
#[inline(always)]
fn write_tile<S: Simd, T: FloatOut>(
    simd: S,
    conv: &FloatConv,
    units: Option<&[[f32; PANEL]]>,
    norms: &mut Norms,
    sums: &[Words],
    plan: &PlanTile,
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
    let panels = conv.extents.panels();
    for (row, (&position, &mask)) in plan.positions().iter().zip(plan.masks()).enumerate() {
        let sums = &sums[usize::from(position) * panels..][..panels];
        let residual = residual.map(|all| &all[row * stride + column..][..cout]);
        let row = &mut rows[row * stride + column..][..cout];
        let factors = conv.invariant.as_ref().map(|gains| norms.of(simd, gains, mask));
        let panels = row.chunks_mut(PANEL).zip(sums).zip(&conv.bias);
        for (p, ((row, sums), bias)) in panels.enumerate() {
            let (sums, units) = (sums.f32(), units.map(|units| &units[p]));
            let factors = factors.map(|factors| &factors[p]);
            let skip = residual.map(|residual| panel(&residual[p * PANEL..][..row.len()]));
            let mut part = [T::default(); PANEL];
            let (whole, to) = match row.as_mut_array::<PANEL>() {
                Some(row) => (true, row),
                None => (false, &mut part),
            };
            for at in (0..PANEL).step_by(S::LANES) {
                let mut sum = S::F32::load(simd, &sums[at..]);
                if let Some(units) = units {
                    sum = sum * S::F32::load(simd, &units[at..]);
                }
                if let Some(factors) = factors {
                    sum = sum * S::F32::load(simd, &factors[at..]);
                }
                sum = sum + S::F32::load(simd, &bias[at..]);
                if let Some(skip) = &skip {
                    sum = sum + S::F32::load_f16(simd, &skip[at..]);
                }
                if relu {
                    sum = sum.max(S::F32::splat(simd, 0.0));
                }
                T::store(simd, sum, &mut to[at..]);
            }
            if !whole {
                store_part(part, row);
            }
        }
    }
}
