//! The epilogue of a layer: from integer sums to activations or real numbers.

use super::norms::{Gains, Norms};
use super::requantise::LIMIT;
use crate::simd::{F32Vector, I32Vector, Simd, prefetch};
use crate::sparse::rows::{Output, PANEL, Words, part, store_part};

/// By how many rows memory is asked for what is added.
const AHEAD: usize = 16;

/// [`Requantise`](super::requantise::Requantise) in panels.
#[derive(Debug, Clone)]
pub(crate) enum Epilogue {
    Shift {
        bias: Vec<[i32; PANEL]>,
        shift: Vec<[i32; PANEL]>,
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

impl Epilogue {
    /// What each channel of a row is multiplied by, if anything.
    #[inline(always)]
    fn factors<'a, S: Simd>(&'a self, simd: S, norms: &'a mut Norms, mask: u64) -> &'a [[f32; PANEL]] {
        match self {
            Epilogue::Shift { .. } => &[],
            Epilogue::Scale { scale, .. } => scale,
            Epilogue::Invariant { gains, .. } => norms.of(simd, gains, mask),
        }
    }
}

/// Where a tile's `cout` channels go.
pub(crate) struct Tile<'a, T> {
    pub output: Output<'a, T, i16>,
    pub cout: usize,
    /// Where each row's sums are.
    pub positions: &'a [u16],
    /// For each row, the taps that read something.
    pub masks: &'a [u64],
}

/// A row's sums of one panel, and what becomes of them.
#[derive(Clone, Copy)]
pub(crate) struct Panel<'a> {
    layer: &'a Epilogue,
    /// Which panel.
    number: usize,
    sums: &'a Words,
    /// Those of all panels, if sums are multiplied.
    factors: &'a [[f32; PANEL]],
    residual: Option<&'a [i16; PANEL]>,
    relu: bool,
}

/// What a layer ends in.
pub(crate) trait Value: Copy + Default + Send + Sync {
    /// Writes a panel.
    fn write<S: Simd>(simd: S, panel: Panel<'_>, to: &mut [Self; PANEL]);
}

impl Value for i16 {
    #[inline(always)]
    fn write<S: Simd>(simd: S, panel: Panel<'_>, to: &mut [i16; PANEL]) {
        let p = panel.number;
        let limit = S::I32::splat(simd, LIMIT.into());
        let least = S::I32::splat(simd, (-LIMIT).into());
        let floor = S::I32::splat(simd, if panel.relu { 0 } else { (-LIMIT).into() });
        for at in (0..PANEL).step_by(S::LANES) {
            let sum = S::I32::load(simd, &panel.sums.i32()[at..]);
            let mut q = match panel.layer {
                Epilogue::Shift { bias, shift } => {
                    let bias = S::I32::load(simd, &bias[p][at..]);
                    (sum + bias)
                        .shr_each(S::I32::load(simd, &shift[p][at..]))
                        .max(least)
                        .min(limit)
                }
                Epilogue::Scale { bias, .. } | Epilogue::Invariant { bias, .. } => {
                    let factor = S::F32::load(simd, &panel.factors[p][at..]);
                    let value = sum.to_f32() * factor + S::F32::load(simd, &bias[p][at..]);
                    // No number is 0.
                    let value = value.keep(value.ordered(value));
                    let limit = S::F32::splat(simd, LIMIT.into());
                    value
                        .max(S::F32::splat(simd, (-LIMIT).into()))
                        .min(limit)
                        .round_to_i32()
                }
            };
            if let Some(residual) = panel.residual {
                q = (q + S::I32::load_i16(simd, &residual[at..])).min(limit);
            }
            q.max(floor).store_i16(&mut to[at..]);
        }
    }
}

impl Value for f32 {
    #[inline(always)]
    fn write<S: Simd>(_: S, panel: Panel<'_>, to: &mut [f32; PANEL]) {
        let p = panel.number;
        let bias = match panel.layer {
            Epilogue::Shift { .. } => unreachable!("refused above"),
            Epilogue::Scale { bias, .. } | Epilogue::Invariant { bias, .. } => bias,
        };
        let (sums, factors, bias) = (panel.sums.i32(), &panel.factors[p], &bias[p]);
        for (lane, to) in to.iter_mut().enumerate() {
            *to = sums[lane] as f32 * factors[lane] + bias[lane];
        }
        if panel.relu {
            to.iter_mut().for_each(|value| *value = value.max(0.0));
        }
    }
}

/// Writes a tile of the layer.
#[inline(always)]
pub(crate) fn write_tile<S: Simd, T: Value>(
    simd: S,
    layer: &Epilogue,
    sums: &[Words],
    norms: &mut Norms,
    tile: Tile<'_, T>,
) {
    let Tile {
        output,
        cout,
        positions,
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
    for (row, (&position, &mask)) in positions.iter().zip(masks).enumerate() {
        let sums = &sums[usize::from(position) * panels..][..panels];
        let factors = layer.factors(simd, norms, mask);
        let first = row * stride + column;
        let ahead = first + AHEAD * stride;
        if let Some(next) = residual.and_then(|all| all.get(ahead..ahead + cout)) {
            prefetch(next);
        }
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
            T::write(simd, panel, to);
        }
        if !rest.is_empty() {
            let residual = residual.map(|(_, rest)| part(rest));
            (panel.number, panel.sums) = (last, &sums[last]);
            panel.residual = residual.as_ref();
            let mut to = [T::default(); PANEL];
            T::write(simd, panel, &mut to);
            store_part(to, rest);
        }
    }
}
