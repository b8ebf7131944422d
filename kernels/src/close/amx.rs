//! bf16 in tiles.

use ::half::{bf16, f16};

use crate::exact::amx::{Buffers, LINE, Scheme, Weights, multiply, prepare};
use crate::simd::amx::Amx;
use crate::simd::avx512::Bf16;
use crate::sparse::plan::PlanTile;
use crate::sparse::rows::{Extents, PANEL, Words};

/// Input channels of a tile row.
const CHANNELS: usize = LINE / 2;

/// Rounds the weights, of which `values(tap, input, panel)` tells those of a panel of outputs, to bf16.
pub(super) fn weights(extents: Extents, values: impl Fn(usize, usize, usize) -> [f32; PANEL]) -> Weights {
    let mut packed = Weights::new(extents, Scheme::Bf16);
    for (tap, channel, panel) in extents.each() {
        let words = packed.words(0, tap, 2 * channel, panel);
        for (word, w) in words.iter_mut().zip(values(tap, channel, panel)) {
            *word |= u32::from(bf16::from_f32(w).to_bits()) << (16 * (channel % 2));
        }
    }
    packed
}

/// The sums over all taps of a tile: `sums[row · panels + panel]`, rows in the plan's order.
///
/// # Panics
/// If the plan reads beyond the input.
pub(super) fn accumulate(
    (amx, rounding): (Amx, Bf16),
    weights: &Weights,
    plan: &PlanTile,
    input: &[f16],
    buffers: &mut Buffers,
    sums: &mut Vec<Words>,
) {
    let cin = weights.extents.cin;
    prepare(weights, plan, input.len() / cin, buffers);
    sums.resize(
        plan.groups() * plan.group() * weights.extents.panels(),
        Words::default(),
    );
    round(rounding, input, cin, plan.inputs(), &mut buffers.rows);
    multiply(amx, weights, plan, buffers, sums);
}

/// Writes rows as tile rows of [`CHANNELS`] channels, rounded to even. Zeros follow.
fn round(rounding: Bf16, input: &[f16], cin: usize, rows: &[u32], to: &mut [Words]) {
    let chunks = cin.div_ceil(CHANNELS);
    let (to, zeros) = to.split_at_mut(rows.len() * chunks);
    for (&row, to) in rows.iter().zip(to.chunks_exact_mut(chunks)) {
        let from = &input[row as usize * cin..][..cin];
        for (to, from) in to.iter_mut().zip(from.chunks(CHANNELS)) {
            to.0 = rounding.round(from);
        }
    }
    zeros.fill(Words::default());
}
