//! bf16 in tiles.

use std::arch::x86_64::*;

use ::half::{bf16, f16};

use super::{Buffers, LINE, Scheme, Weights, multiply, prepare};
use crate::plan::PlanTile;
use crate::rows::{Extents, Lanes, PANEL};

/// Input channels of a tile row.
const CHANNELS: usize = LINE / 2;

impl Weights {
    /// Rounds the weights, of which `weights(tap, input, panel)` tells those of a panel of outputs, to bf16.
    pub fn of_brain(extents: Extents, weights: impl Fn(usize, usize, usize) -> [f32; PANEL]) -> Weights {
        let mut packed = Weights::new(extents, Scheme::Brain);
        for (tap, channel, panel) in extents.each() {
            let words = packed.words(0, tap, 2 * channel, panel);
            for (word, w) in words.iter_mut().zip(weights(tap, channel, panel)) {
                *word |= u32::from(bf16::from_f32(w).to_bits()) << (16 * (channel % 2));
            }
        }
        packed
    }
}

/// The sums over all taps of a tile: `sums[row · panels + panel]`, rows in the plan's order.
///
/// # Panics
/// If the processor lacks AMX, or the plan reads beyond the input.
pub(crate) fn accumulate(
    isa: crate::Isa,
    weights: &Weights,
    plan: &PlanTile,
    input: &[f16],
    buffers: &mut Buffers,
    sums: &mut Vec<Lanes>,
) {
    let cin = weights.extents.cin;
    prepare(isa, weights, plan, input.len() / cin, buffers);
    sums.resize(
        plan.groups() * plan.group() * weights.extents.panels(),
        Lanes::default(),
    );
    // SAFETY: an `Isa` with tiles is only made where the processor has AMX, AVX-512 and AVX512_BF16. All rows of the plan lie below its
    // end, and `rows` is filled for this plan and these weights.
    unsafe {
        round(input, cin, plan.inputs(), &mut buffers.rows);
        multiply(weights, plan, buffers, sums);
    }
}

/// Writes rows as tile rows of [`CHANNELS`] channels, rounded to even. Zeros follow.
///
/// # Safety
/// The processor must have AVX-512 F, BW, VL and BF16; the input must have the rows.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
unsafe fn round(input: &[f16], cin: usize, rows: &[u32], to: &mut [Lanes]) {
    let chunks = cin.div_ceil(CHANNELS);
    let (to, zeros) = to.split_at_mut(rows.len() * chunks);
    for (&row, to) in rows.iter().zip(to.chunks_exact_mut(chunks)) {
        for (chunk, to) in to.iter_mut().enumerate() {
            let first = chunk * CHANNELS;
            let here = u32::MAX >> CHANNELS.saturating_sub(cin - first);
            // SAFETY: of the row's values only those that are there are read, and a whole line written. The types are 512 bits of
            // anything.
            unsafe {
                let from = input.as_ptr().add(row as usize * cin + first);
                let halves = _mm512_maskz_loadu_epi16(here, from.cast());
                let low = _mm512_cvtph_ps(_mm512_castsi512_si256(halves));
                let high = _mm512_cvtph_ps(_mm512_extracti64x4_epi64::<1>(halves));
                let pairs = std::mem::transmute::<__m512bh, __m512i>(_mm512_cvtne2ps_pbh(high, low));
                _mm512_store_si512(std::ptr::from_mut(to).cast(), pairs);
            }
        }
    }
    zeros.fill(Lanes::default());
}
