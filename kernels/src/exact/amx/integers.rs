//! Integers in tiles of bytes.
//!
//! Numbers of up to 13 bits are cut into two digits, of which three products make one of numbers ([`digits`]). Of up to
//! 32 channels both digits fit a tile row, and the mixed products come of one multiplication by the weights' digits the
//! other way round.

use std::arch::x86_64::*;

use bytemuck::must_cast;

use super::multiply::{multiply, prepare};
use super::tiles::{LINE, TILE};
use super::weights::{Buffers, Scheme, Weights};
use super::{pairing, pairs};
use crate::exact::digits::{REACH, digits};
use crate::simd::amx::Amx;
use crate::simd::avx512::with_avx512;
use crate::simd::prefetch;
use crate::sparse::plan::PlanTile;
use crate::sparse::rows::{AHEAD, Extents, PANEL, Words};

/// Input channels whose two digits fit a tile row.
const HALF: usize = LINE / 2;
/// Input channels from which on tiles are full enough; and panels of output channels, where a tile row holds one digit.
const WIDE: [usize; 2] = [17, 3];

impl Weights {
    /// Cuts the weights, of which `weights(tap, input, panel)` tells those of a panel of outputs, into digits; nothing,
    /// if one is too large for that, or the layer too narrow to gain.
    pub fn of_integers(extents: Extents, weights: impl Fn(usize, usize, usize) -> [i16; PANEL]) -> Option<Weights> {
        let (cin, panels) = (extents.cin, extents.panels());
        if cin < WIDE[0] || cin > HALF && panels < WIDE[1] {
            return None;
        }
        let scheme = match (cin <= HALF, extents.volume) {
            (true, 1) => Scheme::Both,
            (true, _) => Scheme::Pairs,
            (false, _) => Scheme::Digits,
        };
        let mut packed = Weights::new(extents, scheme);
        for (tap, channel, panel) in extents.each() {
            let weights = weights(tap, channel, panel);
            if weights.iter().any(|w| w.unsigned_abs() > REACH.unsigned_abs()) {
                return None;
            }
            let [high, low] = [weights.map(|w| digits(w).0), weights.map(|w| digits(w).1)];
            let mut put = |pass: usize, byte: usize, column: usize, digits: [i8; PANEL]| {
                add(packed.words(pass, tap, byte, column), byte, digits);
            };
            let sums: [i8; PANEL] = std::array::from_fn(|i| high[i] + low[i]);
            if scheme == Scheme::Pairs {
                let [pair, half] = packed.homes[tap];
                for (product, digits) in [high, low, sums].into_iter().enumerate() {
                    let byte = half * HALF + channel;
                    let tile = pairing::tile(extents, pair, product, panel);
                    add(&mut packed.tiles[tile * TILE + byte / 4].0, byte, digits);
                }
                continue;
            }
            if scheme == Scheme::Both {
                put(0, channel, panel, high);
                put(0, channel, panels + panel, low);
                put(0, HALF + channel, panels + panel, high);
                put(0, HALF + channel, 2 * panels + panel, low);
                continue;
            }
            let (chunk, channel) = (channel / LINE, channel % LINE);
            let (half, channel) = (channel / 32, channel % 32);
            let byte = chunk * LINE + channel / 8 * 16 + 8 * half + channel % 8;
            for (pass, digits) in [high, low, sums].into_iter().enumerate() {
                put(pass, byte, panel, digits);
            }
        }
        Some(packed)
    }
}

/// Puts digits into the words that multiply the bytes from `byte` on.
fn add(words: &mut [u32; PANEL], byte: usize, digits: [i8; PANEL]) {
    for (word, digit) in words.iter_mut().zip(digits) {
        *word |= u32::from(digit as u8) << (8 * (byte % 4));
    }
}

/// The sums over all taps of a tile: `sums[row · panels + panel]`, rows in the plan's order. False, and no sums, if
/// activations are too large for digits.
///
/// # Panics
/// If the plan reads beyond the input.
pub(crate) fn accumulate(
    amx: Amx,
    weights: &Weights,
    plan: &PlanTile,
    input: &[i16],
    buffers: &mut Buffers,
    sums: &mut Vec<Words>,
) -> bool {
    let cin = weights.extents.cin;
    prepare(weights, plan, input.len() / cin, buffers);
    // SAFETY: the token proves AVX-512.
    let small = unsafe {
        match weights.scheme {
            Scheme::Both | Scheme::Pairs => split_short_rows(input, cin, plan.inputs(), &mut buffers.rows),
            _ => split_rows(input, cin, plan.inputs(), &mut buffers.rows),
        }
    };
    if small {
        sums.resize(
            plan.groups() * plan.group() * weights.extents.panels(),
            Words::default(),
        );
        match weights.scheme {
            Scheme::Pairs => pairs::multiply(amx, weights, plan, buffers, sums),
            _ => multiply(amx, weights, plan, buffers, sums),
        }
    }
    small
}

with_avx512! {
    /// Writes rows as tile rows of 64 channels, first the high digits of all rows, then the low ones, then their sums.
    /// Zeros follow each time. Tells whether all were small enough.
    fn split_rows(input: &[i16], cin: usize, rows: &[u32], to: &mut [Words]) -> bool {
        let chunks = cin.div_ceil(LINE);
        let (highs, rest) = to.split_at_mut((rows.len() + 1) * chunks);
        let (lows, both) = rest.split_at_mut(highs.len());
        let mut largest = _mm512_setzero_si512();
        for chunk in 0..chunks {
            let there = u64::MAX >> LINE.saturating_sub(cin - chunk * LINE);
            for (i, &row) in rows.iter().enumerate() {
                let from = &input[row as usize * cin + chunk * LINE..][..(cin - chunk * LINE).min(LINE)];
                // SAFETY: only the values of `from` are read.
                let (a, b) = unsafe {
                    (
                        _mm512_maskz_loadu_epi16(there as u32, from.as_ptr()),
                        _mm512_maskz_loadu_epi16((there >> 32) as u32, from.as_ptr().wrapping_add(32)),
                    )
                };
                largest = _mm512_max_epu16(largest, _mm512_abs_epi16(a));
                largest = _mm512_max_epu16(largest, _mm512_abs_epi16(b));
                let ((high_a, low_a), (high_b, low_b)) = (split(a), split(b));
                let high = _mm512_packs_epi16(high_a, high_b);
                let low = _mm512_packs_epi16(low_a, low_b);
                let at = i * chunks + chunk;
                highs[at] = must_cast(high);
                lows[at] = must_cast(low);
                both[at] = must_cast(_mm512_add_epi8(high, low));
            }
        }
        for zeros in [highs, lows, both] {
            zeros[rows.len() * chunks..].fill(Words::default());
        }
        within_reach(largest)
    }
}

with_avx512! {
    /// Writes rows as a tile row each, first the high digits, then the low ones. A row of zeros follows. Tells whether
    /// all were small enough.
    fn split_short_rows(input: &[i16], cin: usize, rows: &[u32], to: &mut [Words]) -> bool {
        let (to, zeros) = to.split_at_mut(rows.len());
        let mut largest = _mm512_setzero_si512();
        let there = u32::MAX >> (HALF - cin);
        for (i, (to, &row)) in to.iter_mut().zip(rows).enumerate() {
            if let Some(&next) = rows.get(i + AHEAD) {
                prefetch(&input[next as usize * cin..][..cin]);
            }
            let from = &input[row as usize * cin..][..cin.min(HALF)];
            // SAFETY: only the values of `from` are read.
            let x = unsafe { _mm512_maskz_loadu_epi16(there, from.as_ptr()) };
            largest = _mm512_max_epu16(largest, _mm512_abs_epi16(x));
            let (high, low) = split(x);
            *to = must_cast([_mm512_cvtepi16_epi8(high), _mm512_cvtepi16_epi8(low)]);
        }
        zeros.fill(Words::default());
        within_reach(largest)
    }
}

with_avx512! {
    /// [`digits`] of 32 numbers.
    #[inline]
    fn split(x: __m512i) -> (__m512i, __m512i) {
        let high = _mm512_srai_epi16::<6>(_mm512_add_epi16(x, _mm512_set1_epi16(32)));
        (high, _mm512_sub_epi16(x, _mm512_slli_epi16::<6>(high)))
    }
}

with_avx512! {
    #[inline]
    fn within_reach(largest: __m512i) -> bool {
        _mm512_cmpgt_epu16_mask(largest, _mm512_set1_epi16(REACH)) == 0
    }
}
