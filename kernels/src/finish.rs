//! From integer sums to activations or real numbers.

use crate::convert::Halves;
use crate::exact::LIMIT;
use crate::norms::{Gains, Norms};
use crate::rows::{Lanes, Output, PANEL, part, store_part};
use crate::simd::prefetch;
use crate::winograd::Registers;

/// By how many rows memory is asked for what is added.
const AHEAD: usize = 16;

/// [`Requantise`] in panels.
#[derive(Debug, Clone)]
pub(crate) enum Finish {
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
    ///
    /// # Safety
    /// The processor must have `R`'s instructions.
    #[inline(always)]
    unsafe fn factors<'a, R: Registers>(&'a self, norms: &'a mut Norms, mask: u64) -> &'a [[f32; PANEL]] {
        match self {
            Finish::Shift { .. } => &[],
            Finish::Scale { scale, .. } => scale,
            // SAFETY: the caller's promise.
            Finish::Invariant { gains, .. } => unsafe { norms.of::<R, _>(gains, mask) },
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
pub(crate) trait Value: Copy + Send + Sync {
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
pub(crate) unsafe fn finish_tile<H: Halves, T: Value>(
    layer: &Finish,
    sums: &[Lanes],
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
        // SAFETY: the caller's promise.
        let factors = unsafe { layer.factors::<H>(norms, mask) };
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
