//! Sparse convolution in integers: the same bits on every machine.

use std::cell::RefCell;
use std::sync::OnceLock;

use bytemuck::must_cast_slice_mut;

#[cfg(target_arch = "x86_64")]
use super::amx;
#[cfg(target_arch = "aarch64")]
use super::dot;
use super::epilogue::{Epilogue, Tile, Value, write_tile};
use super::kernel::{multiply, place};
use super::norms::{Energy, Gains, Norms};
use super::requantise::Requantise;
use super::winograd;
use crate::simd::{Isa, Simd, dispatch, prefetch};
use crate::sparse::accumulate::{accumulate, group};
use crate::sparse::plan::PlanTile;
use crate::sparse::rows::{AHEAD, Extents, IN_ORDER, Output, PANEL, Words, panels};
use crate::sparse::scratch::{Scratch, with_scratch};
use crate::sparse::taps::Taps;

/// A sparse convolution of i16 activations by i16 weights, summed in wrapping i32.
#[derive(Debug, Clone)]
pub struct ExactConv {
    extents: Extents,
    /// Per tap, panel and pair of input channels: each output channel's two weights, side by side.
    weights: Vec<Words>,
    epilogue: Epilogue,
    /// What [`Isa::has_tiles`] multiplies, once it is needed: nothing, if weights are too large for it.
    #[cfg(target_arch = "x86_64")]
    tiles: OnceLock<Option<amx::Weights>>,
    /// What `dotprod` multiplies, likewise.
    #[cfg(target_arch = "aarch64")]
    digits: OnceLock<Option<dot::Weights>>,
    /// For all children of voxels, once it is needed: nothing, if sums could be too large for it.
    winograd: OnceLock<Option<winograd::Weights>>,
}

impl ExactConv {
    /// Packs `weights[tap][input][output]`.
    ///
    /// # Panics
    /// If lengths don't match the extents, there are more than 54 taps, or a shift is above 31: the caller has checked
    /// what it read.
    pub fn new(volume: usize, cin: usize, cout: usize, weights: &[i16], requantise: Requantise) -> Self {
        let extents = Extents { volume, cin, cout };
        extents.check(weights.len());
        let epilogue = match requantise {
            Requantise::Shift { bias, shift } => {
                assert!(
                    bias.len() == cout && shift.len() == cout,
                    "one bias and shift per channel"
                );
                assert!(shift.iter().all(|&s| s < 32), "a shift is above 31");
                let shift: Vec<i32> = shift.into_iter().map(i32::from).collect();
                Epilogue::Shift {
                    bias: panels(&bias),
                    shift: panels(&shift),
                }
            }
            Requantise::Scale { scale, bias } => {
                assert!(
                    scale.len() == cout && bias.len() == cout,
                    "one scale and bias per channel"
                );
                Epilogue::Scale {
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
                Epilogue::Invariant {
                    gains: Gains::new(energy, panels(&gain)),
                    bias: panels(&bias),
                }
            }
        };
        let steps = cin.div_ceil(2);
        let mut packed = vec![Words::default(); volume * extents.panels() * steps];
        extents.place(weights, |w, panel, c, lane| {
            packed[panel * steps + c / 2].0[lane] |= place(w, c % 2);
        });
        ExactConv {
            extents,
            weights: packed,
            epilogue,
            #[cfg(target_arch = "x86_64")]
            tiles: OnceLock::new(),
            #[cfg(target_arch = "aarch64")]
            digits: OnceLock::new(),
            winograd: OnceLock::new(),
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

    /// Computes the rows `first ..` of the layer that `output` holds, from `input`, whose rows are `cin` activations
    /// each, within ±[`LIMIT`](super::requantise::LIMIT).
    ///
    /// The residual is added after requantising, and the sum clamped to ±[`LIMIT`](super::requantise::LIMIT) again.
    ///
    /// # Panics
    /// If `taps` are not this layer's, or name rows that `input` lacks, or `output` does not fit.
    pub fn run(&self, isa: Isa, taps: Taps<'_>, input: &[i16], first: usize, output: Output<'_, i16>) {
        self.each_tile(isa, taps, input, first, output);
    }

    /// As [`ExactConv::run`], but gives what would be rounded and clamped as it is.
    ///
    /// # Panics
    /// As `run` does, and if the layer requantises by [`Requantise::Shift`], or there is a residual.
    pub fn run_f32(&self, isa: Isa, taps: Taps<'_>, input: &[i16], first: usize, output: Output<'_, f32, i16>) {
        assert!(output.residual.is_none(), "nothing is added to real results");
        assert!(
            !matches!(self.epilogue, Epilogue::Shift { .. }),
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
        if let Taps::AllChildren { neighbours, .. } = taps
            && first.is_multiple_of(8)
            && output.len().is_multiple_of(8)
            && let Some(weights) = self.winograd()
        {
            return self.each_parent(isa, weights, neighbours, input, first, output);
        }
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
                    let tile = Tile {
                        output,
                        cout: self.extents.cout,
                        positions: plan.positions(),
                        masks: plan.masks(),
                    };
                    self.write(isa, sums, &mut own.norms, tile);
                }
            });
        });
    }

    /// The sums of a tile.
    fn sum(
        &self,
        isa: Isa,
        plan: &PlanTile,
        input: &[i16],
        expanded: &mut Vec<Words>,
        own: &mut Own,
        sums: &mut Vec<Words>,
    ) {
        #[cfg(target_arch = "x86_64")]
        if let Some(amx) = isa.tiles()
            && let Some(weights) = self.tiles()
            && amx::integers::accumulate(amx, weights, plan, input, &mut own.tiles, sums)
        {
            return;
        }
        #[cfg(target_arch = "aarch64")]
        if let Some(token) = isa.dot()
            && let Some(weights) = self.digits()
            && dot::accumulate(token, weights, plan, input, &mut own.digits, sums)
        {
            return;
        }
        let _ = own;
        accumulate(
            isa,
            multiply,
            self.extents,
            &self.weights,
            plan,
            (input, pair_up),
            expanded,
            sums,
        );
    }

    /// Writes a tile's results.
    fn write<T: Value>(&self, isa: Isa, sums: &[Words], norms: &mut Norms, tile: Tile<'_, T>) {
        let layer = &self.epilogue;
        dispatch!(isa, fn write_tile<T: Value>(
            layer: &Epilogue, sums: &[Words], norms: &mut Norms, tile: Tile<'_, T>,
        ));
    }

    /// The weights of a tap, from an input channel to a panel of output channels.
    fn weights(&self, tap: usize, channel: usize, panel: usize) -> [i16; PANEL] {
        let (steps, panels) = (self.extents.cin.div_ceil(2), self.extents.panels());
        let pairs = self.weights[(tap * panels + panel) * steps + channel / 2].0;
        let which = (channel % 2) ^ usize::from(cfg!(target_endian = "big"));
        pairs.map(|pair| (pair >> (16 * which)) as i16)
    }

    /// All children of voxels, by minimal filtering.
    fn each_parent<T: Value>(
        &self,
        isa: Isa,
        weights: &winograd::Weights,
        neighbours: &[u32],
        input: &[i16],
        first: usize,
        mut output: Output<'_, T, i16>,
    ) {
        with_scratch(|Scratch { sums, .. }| {
            with_own(|own| {
                for (row, output) in output.tiles() {
                    let voxels = (first + row) / 8..(first + row + output.len()) / 8;
                    let neighbours = &neighbours[voxels.start * 27..voxels.end * 27];
                    let masks = winograd::accumulate(isa, weights, neighbours, input, &mut own.winograd, sums);
                    let tile = Tile {
                        output,
                        cout: self.extents.cout,
                        positions: &IN_ORDER[..masks.len()],
                        masks,
                    };
                    self.write(isa, sums, &mut own.norms, tile);
                }
            });
        });
    }

    /// The weights for minimal filtering.
    fn winograd(&self) -> Option<&winograd::Weights> {
        let weights = |tap, channel, panel| self.weights(tap, channel, panel);
        let make = || winograd::Weights::new(self.extents, weights);
        self.winograd.get_or_init(make).as_ref()
    }

    /// The weights in digits.
    #[cfg(target_arch = "aarch64")]
    fn digits(&self) -> Option<&dot::Weights> {
        let weights = |tap, channel, panel| self.weights(tap, channel, panel);
        let pack = || dot::Weights::new(self.extents, weights);
        self.digits.get_or_init(pack).as_ref()
    }

    /// The weights in tiles.
    #[cfg(target_arch = "x86_64")]
    fn tiles(&self) -> Option<&amx::Weights> {
        let weights = |tap, channel, panel| self.weights(tap, channel, panel);
        let pack = || amx::Weights::of_integers(self.extents, weights);
        self.tiles.get_or_init(pack).as_ref()
    }
}

/// Per-thread scratch of integer layers, besides [`Scratch`].
#[derive(Default)]
struct Own {
    norms: Norms,
    winograd: winograd::Buffers,
    #[cfg(target_arch = "x86_64")]
    tiles: amx::Buffers,
    #[cfg(target_arch = "aarch64")]
    digits: dot::Buffers,
}

/// Lends this thread's [`Own`].
fn with_own(run: impl FnOnce(&mut Own)) {
    thread_local!(static OWN: RefCell<Own> = RefCell::default());
    OWN.with_borrow_mut(run);
}

/// Rows of activations as pairs; the last has a zero if their number is odd.
fn pair_up(isa: Isa, input: &[i16], rows: &[u32], cin: usize, to: &mut [u32]) {
    dispatch!(isa, fn pair_rows(input: &[i16], rows: &[u32], cin: usize, to: &mut [u32]));
}

#[inline(always)]
fn pair_rows<S: Simd>(_: S, input: &[i16], rows: &[u32], cin: usize, to: &mut [u32]) {
    let to = must_cast_slice_mut::<_, i16>(to).chunks_exact_mut(cin.next_multiple_of(2));
    for (i, (to, &row)) in to.zip(rows).enumerate() {
        if let Some(&next) = rows.get(i + AHEAD) {
            prefetch(&input[next as usize * cin..][..cin]);
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
