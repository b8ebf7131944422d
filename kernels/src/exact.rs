//! Sparse convolution in integers: the same bits on every machine.

#[cfg(target_arch = "x86_64")]
use std::sync::OnceLock;

use crate::isa::{Isa, dispatch};
#[cfg(target_arch = "x86_64")]
use crate::machine::amx;
use crate::norms::{Energy, Gains, Norms};
use crate::rows::{Extents, Lanes, Output, PANEL, Scratch, panel, panels, store, with_scratch};
use crate::taps::Taps;
use crate::tile::{Arithmetic, Input, accumulate};

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
        self.each_tile(
            isa,
            taps,
            input,
            first,
            output,
            |finish, sums, norms, output| {
                dispatch!(isa, fn finish_tile(
                    finish: &Finish, sums: &[Lanes], norms: &mut Norms, output: Tile<'_, i16>,
                ));
            },
        );
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
        self.each_tile(
            isa,
            taps,
            input,
            first,
            output,
            |finish, sums, norms, output| {
                dispatch!(isa, fn finish_real_tile(
                    finish: &Finish, sums: &[Lanes], norms: &mut Norms, output: Tile<'_, f32>,
                ));
            },
        );
    }

    fn each_tile<T>(
        &self,
        isa: Isa,
        taps: Taps<'_>,
        input: &[i16],
        first: usize,
        mut output: Output<'_, T, i16>,
        finish: impl Fn(&Finish, &[Lanes], &mut Norms, Tile<'_, T>),
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
                    #[cfg(target_arch = "x86_64")]
                    planner,
                    #[cfg(target_arch = "x86_64")]
                    tiles,
                    ..
                } = scratch;
                #[cfg(target_arch = "x86_64")]
                if isa.has_tiles()
                    && let Some(weights) = self.tiles()
                {
                    let plan = planner.plan(isa, &taps, [first, output.len()], tile);
                    if amx::integers::accumulate(isa, weights, plan, input, tiles, sums) {
                        let masks = plan.masks();
                        finish(
                            &self.finish,
                            sums,
                            norms,
                            Tile {
                                output,
                                cout,
                                masks,
                            },
                        );
                        continue;
                    }
                }
                let inputs = input.len() / self.extents.cin;
                tile.fill(isa, &taps, first, output.len(), inputs);
                let input = match self.extents.cin % 2 {
                    0 => Input::Ready(input),
                    _ => Input::Expand(input, pair_up),
                };
                accumulate(
                    isa,
                    Arithmetic::Integer,
                    self.extents,
                    &self.weights,
                    tile,
                    input,
                    expanded,
                    sums,
                );
                let masks = tile.masks();
                finish(
                    &self.finish,
                    sums,
                    norms,
                    Tile {
                        output,
                        cout,
                        masks,
                    },
                );
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
    /// For each row, the taps that read something.
    masks: &'a [u64],
}

/// The half of a word that the pair's first or second value takes.
fn place(value: i16, which: usize) -> u32 {
    u32::from(value as u16) << (16 * (which ^ usize::from(cfg!(target_endian = "big"))))
}

/// An odd number of activations as pairs, each row's last having a zero.
fn pair_up(_: Isa, input: &[i16], rows: &[u32], cin: usize, to: &mut [u32]) {
    for (to, &row) in to.chunks_exact_mut(cin.div_ceil(2)).zip(rows) {
        let from = &input[row as usize * cin..][..cin];
        for (to, pair) in to.iter_mut().zip(from.chunks(2)) {
            *to = place(pair[0], 0) | pair.get(1).map_or(0, |&value| place(value, 1));
        }
    }
}

#[inline(always)]
fn finish_tile(finish: &Finish, sums: &[Lanes], norms: &mut Norms, tile: Tile<'_, i16>) {
    let Tile {
        output,
        cout,
        masks,
    } = tile;
    let Output {
        rows,
        stride,
        column,
        residual,
        relu,
    } = output;
    let panels = cout.div_ceil(PANEL);
    let floor = if relu { 0 } else { -LIMIT };
    let rows = rows.chunks_exact_mut(stride);
    for (r, (row, sums)) in rows.zip(sums.chunks_exact(panels)).enumerate() {
        let row = &mut row[column..column + cout];
        let factors = finish.factors(norms, masks[r]);
        let residual = residual.map(|all| &all[r * stride + column..][..cout]);
        for (p, (row, sums)) in row.chunks_mut(PANEL).zip(sums).enumerate() {
            let sums = sums.i32();
            let mut q = match finish {
                Finish::Shift { bias, shift } => shifted(sums, &bias[p], &shift[p]),
                Finish::Scale { bias, .. } | Finish::Invariant { bias, .. } => {
                    rounded(scaled(sums, &factors[p], &bias[p]))
                }
            };
            if let Some(residual) = residual {
                let x = panel(&residual[p * PANEL..][..row.len()]);
                for (q, x) in q.iter_mut().zip(x) {
                    *q = q.saturating_add(x).min(LIMIT);
                }
            }
            for q in &mut q {
                *q = (*q).max(floor);
            }
            store(q, row);
        }
    }
}

#[inline(always)]
fn finish_real_tile(finish: &Finish, sums: &[Lanes], norms: &mut Norms, tile: Tile<'_, f32>) {
    let Tile {
        output,
        cout,
        masks,
    } = tile;
    let panels = cout.div_ceil(PANEL);
    let rows = output.rows.chunks_exact_mut(output.stride);
    for (r, (row, sums)) in rows.zip(sums.chunks_exact(panels)).enumerate() {
        let row = &mut row[output.column..output.column + cout];
        let factors = finish.factors(norms, masks[r]);
        for (p, (row, sums)) in row.chunks_mut(PANEL).zip(sums).enumerate() {
            let bias = match finish {
                Finish::Shift { .. } => unreachable!("refused above"),
                Finish::Scale { bias, .. } | Finish::Invariant { bias, .. } => bias,
            };
            let mut values = scaled(sums.i32(), &factors[p], &bias[p]);
            if output.relu {
                values.iter_mut().for_each(|value| *value = value.max(0.0));
            }
            store(values, row);
        }
    }
}

#[inline(always)]
fn shifted(sums: [i32; PANEL], bias: &[i32; PANEL], shift: &[u32; PANEL]) -> [i16; PANEL] {
    std::array::from_fn(|j| {
        let value = sums[j].wrapping_add(bias[j]).wrapping_shr(shift[j]);
        value.clamp(-i32::from(LIMIT), i32::from(LIMIT)) as i16
    })
}

#[inline(always)]
fn scaled(sums: [i32; PANEL], factor: &[f32; PANEL], bias: &[f32; PANEL]) -> [f32; PANEL] {
    std::array::from_fn(|j| sums[j] as f32 * factor[j] + bias[j])
}

#[inline(always)]
fn rounded(values: [f32; PANEL]) -> [i16; PANEL] {
    let limit = f32::from(LIMIT);
    std::array::from_fn(|j| {
        // Becomes 0, as by `as`, which would keep the compiler from using vectors.
        let value = if values[j].is_nan() { 0.0 } else { values[j] };
        let value = value.clamp(-limit, limit).round_ties_even();
        // SAFETY: it is a number, and no larger than the limit.
        (unsafe { value.to_int_unchecked::<i32>() }) as i16
    })
}
