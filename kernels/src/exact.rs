//! Sparse convolution in integers: the same bits on every machine.

#[cfg(target_arch = "x86_64")]
use std::sync::OnceLock;

use crate::convert::Halves;
use crate::isa::{Isa, dispatch};
#[cfg(target_arch = "x86_64")]
use crate::machine::amx;
use crate::machine::{fetch, halves_mut, with_halves};
use crate::norms::{Energy, Gains, Norms};
use crate::plan::PlanTile;
use crate::rows::{
    AHEAD, Extents, Lanes, Output, PANEL, Scratch, panels, part, store_part, with_scratch,
};
use crate::taps::Taps;
use crate::tile::{Arithmetic, accumulate};

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
    /// `clamp(round(sum · scale + bias))` in f32, halves to even.
    Scale {
        /// One per output channel.
        scale: Vec<f32>,
        /// One per output channel.
        bias: Vec<f32>,
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
    /// Per tap, panel and pair of input channels: each output channel's two weights, side by side.
    weights: Vec<Lanes>,
    finish: Finish,
    /// What [`Isa::has_tiles`] multiplies, once it is needed: nothing, if weights are too large for it.
    #[cfg(target_arch = "x86_64")]
    tiles: OnceLock<Option<amx::Weights>>,
}

/// [`Requantise`] in panels.
#[derive(Debug, Clone)]
enum Finish {
    Shift {
        bias: Vec<[i32; PANEL]>,
        shift: Vec<[u32; PANEL]>,
    },
    Scale {
        scale: Vec<[f32; PANEL]>,
        bias: Vec<[f32; PANEL]>,
    },
    Invariant {
        gains: Gains<u32>,
        bias: Vec<[f32; PANEL]>,
    },
}

impl Finish {
    /// What each channel of a row is multiplied by, if anything.
    #[inline(always)]
    fn factors<'a>(&'a self, norms: &'a mut Norms, mask: u64) -> &'a [[f32; PANEL]] {
        match self {
            Finish::Shift { .. } => &[],
            Finish::Scale { scale, .. } => scale,
            Finish::Invariant { gains, .. } => norms.of(gains, mask),
        }
    }
}

impl ExactConv {
    /// Packs `weights[tap][input][output]`.
    ///
    /// # Panics
    /// If lengths don't match the extents, there are more than 63 taps, or a shift is above 31: the caller has checked what it
    /// read.
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
                let shift: Vec<u32> = shift.into_iter().map(u32::from).collect();
                Finish::Shift {
                    bias: panels(&bias),
                    shift: panels(&shift),
                }
            }
            Requantise::Scale { scale, bias } => {
                assert!(
                    scale.len() == cout && bias.len() == cout,
                    "one scale and bias per channel"
                );
                Finish::Scale {
                    scale: panels(&scale),
                    bias: panels(&bias),
                }
            }
            Requantise::Invariant { gain, bias } => {
                assert!(
                    gain.len() == cout && bias.len() == cout,
                    "one gain and bias per channel"
                );
                let mut energy = vec![[0u32; PANEL]; volume * extents.panels()];
                extents.place(weights, |w, panel, _, lane| {
                    let sum = &mut energy[panel][lane];
                    *sum = sum.add(u32::from(w.unsigned_abs()).pow(2));
                });
                Finish::Invariant {
                    gains: Gains::new(energy, panels(&gain)),
                    bias: panels(&bias),
                }
            }
        };
        let steps = cin.div_ceil(2);
        let mut packed = vec![Lanes::default(); volume * extents.panels() * steps];
        extents.place(weights, |w, panel, c, lane| {
            packed[panel * steps + c / 2].0[lane] |= place(w, c % 2);
        });
        ExactConv {
            extents,
            weights: packed,
            finish,
            #[cfg(target_arch = "x86_64")]
            tiles: OnceLock::new(),
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
        self.each_tile(isa, taps, input, first, output);
    }

    /// As [`ExactConv::run`], but gives what would be rounded and clamped as it is.
    ///
    /// # Panics
    /// As `run` does, and if the layer requantises by [`Requantise::Shift`], or there is a residual.
    pub fn run_f32(
        &self,
        isa: Isa,
        taps: Taps<'_>,
        input: &[i16],
        first: usize,
        output: Output<'_, f32, i16>,
    ) {
        assert!(
            output.residual.is_none(),
            "nothing is added to real results"
        );
        assert!(
            !matches!(self.finish, Finish::Shift { .. }),
            "shifted results are no real numbers"
        );
        self.each_tile(isa, taps, input, first, output);
    }

    fn each_tile<T: Value>(
        &self,
        isa: Isa,
        taps: Taps<'_>,
        input: &[i16],
        first: usize,
        mut output: Output<'_, T, i16>,
    ) {
        assert_eq!(
            taps.volume(),
            self.extents.volume,
            "these taps belong to another kernel"
        );
        with_scratch(|scratch| {
            for (row, output) in output.tiles() {
                let (first, cout) = (first + row, self.extents.cout);
                let Scratch {
                    taps: tile,
                    sums,
                    expanded,
                    norms,
                    planner,
                    #[cfg(target_arch = "x86_64")]
                    tiles,
                } = scratch;
                let plan = planner.plan(isa, &taps, [first, output.len()], tile);
                #[cfg(target_arch = "x86_64")]
                let done = isa.has_tiles()
                    && self.tiles().is_some_and(|weights| {
                        amx::integers::accumulate(isa, weights, plan, input, tiles, sums)
                    });
                #[cfg(not(target_arch = "x86_64"))]
                let done = false;
                if !done {
                    accumulate(
                        isa,
                        Arithmetic::Integer,
                        self.extents,
                        &self.weights,
                        plan,
                        (input, pair_up),
                        expanded,
                        sums,
                    );
                }
                let (layer, tile) = (&self.finish, Tile { output, cout, plan });
                let sums = &sums[..];
                with_halves!(isa, fn finish_tile<T: Value>(
                    layer: &Finish, sums: &[Lanes], norms: &mut Norms, tile: Tile<'_, T>,
                ));
            }
        });
    }

    /// The weights in tiles.
    #[cfg(target_arch = "x86_64")]
    fn tiles(&self) -> Option<&amx::Weights> {
        let pack = || {
            let (steps, panels) = (self.extents.cin.div_ceil(2), self.extents.panels());
            amx::Weights::of_integers(self.extents, |tap, channel, out| {
                let panel = tap * panels + out / PANEL;
                let pair = self.weights[panel * steps + channel / 2].0[out % PANEL];
                (pair >> (16 * (channel % 2))) as i16
            })
        };
        self.tiles.get_or_init(pack).as_ref()
    }
}

/// Where a tile's `cout` channels go.
struct Tile<'a, T> {
    output: Output<'a, T, i16>,
    cout: usize,
    /// Which rows the sums are of, and the taps that read something for each.
    plan: &'a PlanTile,
}

/// The half of a word that the pair's first or second value takes.
fn place(value: i16, which: usize) -> u32 {
    u32::from(value as u16) << (16 * (which ^ usize::from(cfg!(target_endian = "big"))))
}

/// Rows of activations as pairs; the last has a zero if their number is odd.
fn pair_up(isa: Isa, input: &[i16], rows: &[u32], cin: usize, to: &mut [u32]) {
    dispatch!(isa, fn pair_rows(input: &[i16], rows: &[u32], cin: usize, to: &mut [u32]));
}

#[inline(always)]
fn pair_rows(input: &[i16], rows: &[u32], cin: usize, to: &mut [u32]) {
    let to = halves_mut(to).chunks_exact_mut(cin.next_multiple_of(2));
    for (i, (to, &row)) in to.zip(rows).enumerate() {
        if let Some(&next) = rows.get(i + AHEAD) {
            fetch(&input[next as usize * cin..][..cin]);
        }
        let (to, odd) = to.split_at_mut(cin);
        let from = &input[row as usize * cin..][..cin];
        let ((whole, rest), (to, last)) = (from.as_chunks::<8>(), to.as_chunks_mut::<8>());
        for (to, from) in to.iter_mut().zip(whole) {
            *to = *from;
        }
        if !rest.is_empty() {
            last.copy_from_slice(rest);
        }
        odd.fill(0);
    }
}

/// A row's sums of one panel, and what becomes of them.
#[derive(Clone, Copy)]
struct Panel<'a> {
    layer: &'a Finish,
    /// Which panel.
    number: usize,
    sums: &'a Lanes,
    /// Those of all panels, if sums are multiplied.
    factors: &'a [[f32; PANEL]],
    residual: Option<&'a [i16; PANEL]>,
    relu: bool,
}

/// What a layer ends in.
trait Value: Copy + Send + Sync {
    /// # Safety
    /// The processor must have `H`'s instructions.
    unsafe fn of<H: Halves>(panel: Panel<'_>) -> [Self; PANEL];
}

impl Value for i16 {
    #[inline(always)]
    unsafe fn of<H: Halves>(panel: Panel<'_>) -> [i16; PANEL] {
        let (p, sums) = (panel.number, panel.sums);
        let floor = if panel.relu { 0 } else { -LIMIT };
        // SAFETY: the caller's promise.
        unsafe {
            let q = match panel.layer {
                Finish::Shift { bias, shift } => H::shift(sums, &bias[p], &shift[p]),
                Finish::Scale { bias, .. } | Finish::Invariant { bias, .. } => {
                    H::round(sums, &panel.factors[p], &bias[p])
                }
            };
            H::settle(q, panel.residual, floor)
        }
    }
}

impl Value for f32 {
    #[inline(always)]
    unsafe fn of<H: Halves>(panel: Panel<'_>) -> [f32; PANEL] {
        let p = panel.number;
        let bias = match panel.layer {
            Finish::Shift { .. } => unreachable!("refused above"),
            Finish::Scale { bias, .. } | Finish::Invariant { bias, .. } => bias,
        };
        let mut values = scaled(panel.sums, &panel.factors[p], &bias[p]);
        if panel.relu {
            values.iter_mut().for_each(|value| *value = value.max(0.0));
        }
        values
    }
}

/// # Safety
/// The processor must have `H`'s instructions.
#[inline(always)]
unsafe fn finish_tile<H: Halves, T: Value>(
    layer: &Finish,
    sums: &[Lanes],
    norms: &mut Norms,
    tile: Tile<'_, T>,
) {
    let Tile { output, cout, plan } = tile;
    let Output {
        rows,
        stride,
        column,
        residual,
        relu,
    } = output;
    let panels = cout.div_ceil(PANEL);
    for (row, (&position, &mask)) in plan.positions().iter().zip(plan.masks()).enumerate() {
        let sums = &sums[usize::from(position) * panels..][..panels];
        let factors = layer.factors(norms, mask);
        let first = row * stride + column;
        let residual = residual.map(|all| all[first..][..cout].as_chunks::<PANEL>());
        let (whole, rest) = rows[first..][..cout].as_chunks_mut::<PANEL>();
        let mut panel = Panel {
            layer,
            number: 0,
            sums: &sums[0],
            factors,
            residual: None,
            relu,
        };
        let last = whole.len();
        for (p, to) in whole.iter_mut().enumerate() {
            (panel.number, panel.sums) = (p, &sums[p]);
            panel.residual = residual.map(|(whole, _)| &whole[p]);
            // SAFETY: the caller's promise.
            *to = unsafe { T::of::<H>(panel) };
        }
        if !rest.is_empty() {
            let residual = residual.map(|(_, rest)| part(rest));
            (panel.number, panel.sums) = (last, &sums[last]);
            panel.residual = residual.as_ref();
            // SAFETY: the caller's promise.
            store_part(unsafe { T::of::<H>(panel) }, rest);
        }
    }
}

#[inline(always)]
pub(crate) fn scaled(sums: &Lanes, factor: &[f32; PANEL], bias: &[f32; PANEL]) -> [f32; PANEL] {
    let sums = sums.i32();
    std::array::from_fn(|j| sums[j] as f32 * factor[j] + bias[j])
}
