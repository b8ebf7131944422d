//! Integers by sums of four products of bytes (NEON with `dotprod`), of which a processor does two a cycle where it
//! does one of the long products that NEON has otherwise.
//!
//! Numbers of up to 13 bits are cut into two digits, of which three products make one of numbers ([`digits`]).

use std::arch::aarch64::*;
use std::arch::asm;

use super::digits::{REACH, digits};
use crate::simd::neon::{NeonDot, with_neon, with_neon_dot};
use crate::simd::prefetch;
use crate::sparse::plan::PlanTile;
use crate::sparse::rows::{AHEAD, Extents, PANEL, Words};

/// `high`, `low` and their sum.
const DIGITS: usize = 3;
/// Input channels of a word of digits.
const STEP: usize = 4;
/// Output channels whose sums of a group's rows fit the registers, in all digits: half a panel, two vectors.
const HALF: usize = PANEL / 2;
const VECTORS: usize = HALF / 4;
/// Rows of a group.
const ROWS: usize = 4;
/// [`Half`]s of weights that the first cache holds besides rows and sums.
const CACHED: usize = 512;

/// For half a panel of outputs, the digits of their weights for four inputs.
#[repr(C, align(32))]
#[derive(Debug, Clone, Copy, Default)]
struct Half([u32; HALF]);

/// A layer's weights in digits.
#[derive(Debug, Clone)]
pub(crate) struct Weights {
    extents: Extents,
    /// `[half][tap][step][digit]`.
    halves: Vec<Half>,
}

/// Memory that a thread reuses.
#[derive(Debug, Default)]
pub(crate) struct Buffers {
    /// The input rows that a tile reads, and one of zeros: `[row][step][digit]`, of an even number of steps; and a word
    /// more.
    rows: Vec<u32>,
}

impl Weights {
    /// Cuts the weights, of which `weights(tap, input, panel)` tells those of a panel of outputs, into digits; nothing,
    /// if one is too large for that.
    pub fn new(extents: Extents, weights: impl Fn(usize, usize, usize) -> [i16; PANEL]) -> Option<Weights> {
        let Extents { volume, cin, cout } = extents;
        let (steps, halves) = (cin.div_ceil(STEP), cout.div_ceil(HALF));
        let mut packed = vec![Half::default(); halves * volume * steps * DIGITS];
        for (tap, channel, panel) in extents.each() {
            for (lane, weight) in weights(tap, channel, panel).into_iter().enumerate() {
                if weight.unsigned_abs() > REACH.unsigned_abs() {
                    return None;
                }
                let half = panel * 2 + lane / HALF;
                if half >= halves {
                    break;
                }
                let (high, low) = digits(weight);
                let step = (half * volume + tap) * steps + channel / STEP;
                for (k, digit) in [high, low, high + low].into_iter().enumerate() {
                    packed[step * DIGITS + k].0[lane % HALF] |= u32::from(digit as u8) << (8 * (channel % STEP));
                }
            }
        }
        Some(Weights {
            extents,
            halves: packed,
        })
    }
}

/// The sums over all taps of a tile: `sums[row · panels + panel]`, rows in the plan's order. False, and no sums, if
/// activations are too large for digits.
///
/// # Panics
/// If the plan is another kernel's, or it reads beyond the input.
pub(crate) fn accumulate(
    _: NeonDot,
    weights: &Weights,
    plan: &PlanTile,
    input: &[i16],
    buffers: &mut Buffers,
    sums: &mut Vec<Words>,
) -> bool {
    assert_eq!(plan.group(), ROWS);
    let Extents { volume, cin, .. } = weights.extents;
    plan.check(volume, input.len() / cin);
    let row = cin.div_ceil(2 * STEP) * 2 * DIGITS;
    let words = plan.inputs().len() * row;
    buffers.rows.resize(words + row + 1, 0);
    let (rows, zeros) = buffers.rows.split_at_mut(words);
    zeros.fill(0);
    // SAFETY: the token proves NEON.
    if !unsafe { split_rows(input, cin, plan.inputs(), rows) } {
        return false;
    }
    let panels = weights.extents.panels();
    sums.resize(plan.groups() * ROWS * panels, Words::default());
    let steps = cin.div_ceil(STEP);
    let tap = steps * DIGITS;
    let taps = (CACHED / tap).max(1);
    for (half, weights) in weights.halves.chunks_exact(volume * tap).enumerate() {
        for first in (0..volume).step_by(taps) {
            for (number, sums) in sums.chunks_exact_mut(ROWS * panels).enumerate() {
                let (taps, places) = plan.steps(number, first..(first + taps).min(volume));
                if first > 0 && taps.is_empty() {
                    continue;
                }
                let block = Block {
                    taps,
                    places: places.all().as_ptr(),
                    rows: buffers.rows.as_ptr(),
                    row,
                    weights: weights.as_ptr(),
                    steps,
                    // SAFETY: the half lies in one of the row's panels.
                    sums: unsafe { sums.as_mut_ptr().cast::<u32>().add(half * HALF) },
                    stride: panels * PANEL,
                    more: first > 0,
                };
                // SAFETY: the processor has the instruction; all places are those of a row, or of the zeros that
                // follow, after which there is a word more; the weights are those of all taps, the sums those of the
                // group's rows.
                unsafe { multiply(&block) };
            }
        }
    }
    true
}

/// A group's rows, some taps and half a panel.
struct Block<'a> {
    taps: &'a [u8],
    /// For each tap and row, which of `rows` it reads.
    places: *const u16,
    /// Input rows, `row` words each.
    rows: *const u32,
    row: usize,
    /// The weights of tap 0.
    weights: *const Half,
    /// Steps of a tap.
    steps: usize,
    /// The sums of the first row; those of the next are `stride` words away.
    sums: *mut u32,
    stride: usize,
    /// Whether there are sums to add to.
    more: bool,
}

with_neon! {
    /// Writes rows as words of digits, and tells whether all were small enough.
    fn split_rows(input: &[i16], cin: usize, rows: &[u32], to: &mut [u32]) -> bool {
        const EIGHT: usize = 2 * STEP;
        const WORDS: usize = 2 * DIGITS;
        let mut largest = vdupq_n_s16(0);
        let each = to.chunks_exact_mut(cin.div_ceil(EIGHT) * WORDS);
        for (i, (to, &row)) in each.zip(rows).enumerate() {
            if let Some(&next) = rows.get(i + AHEAD) {
                prefetch(&input[next as usize * cin..][..cin]);
            }
            let from = &input[row as usize * cin..][..cin];
            let (whole, rest) = from.as_chunks::<EIGHT>();
            let mut last = [0; EIGHT];
            last[..rest.len()].copy_from_slice(rest);
            let (to, _) = to.as_chunks_mut::<WORDS>();
            for (to, from) in to.iter_mut().zip(whole.iter().chain([&last])) {
                // SAFETY: eight values are read, six words written.
                unsafe {
                    let x = vld1q_s16(from.as_ptr());
                    largest = vmaxq_s16(largest, vqabsq_s16(x));
                    let high = vrshrq_n_s16::<6>(x);
                    let low = vmovn_s16(vsubq_s16(x, vshlq_n_s16::<6>(high)));
                    let high = vmovn_s16(high);
                    let digits = uint32x2x3_t(
                        vreinterpret_u32_s8(high),
                        vreinterpret_u32_s8(low),
                        vreinterpret_u32_s8(vadd_s8(high, low)),
                    );
                    vst3_u32(to.as_mut_ptr(), digits);
                }
            }
        }
        vmaxvq_s16(largest) <= REACH
    }
}

with_neon_dot! {
    /// # Safety
    /// The processor must have the instruction, and the block's pointers what they promise.
    unsafe fn multiply(block: &Block) {
        // SAFETY: the caller's promise: a row has so many steps of words and one word behind it, and so many halves
        // each tap.
        unsafe {
            let mut sums = [[[vdupq_n_s32(0); DIGITS]; VECTORS]; ROWS];
            for (t, &tap) in block.taps.iter().enumerate() {
                let mut inputs = [block.rows; ROWS];
                for (r, input) in inputs.iter_mut().enumerate() {
                    let place = usize::from(*block.places.add(t * ROWS + r));
                    *input = input.add(place * block.row);
                }
                let mut weights = block.weights.add(usize::from(tap) * block.steps * DIGITS).cast::<i8>();
                for _ in 0..block.steps {
                    let mut digits = [vdupq_n_s8(0); ROWS];
                    for (digits, input) in digits.iter_mut().zip(&mut inputs) {
                        *digits = vld1q_s8(input.cast());
                        *input = input.add(DIGITS);
                    }
                    for v in 0..VECTORS {
                        let weight = |digit: usize| vld1q_s8(weights.add((digit * VECTORS + v) * 16));
                        let [high, low, both] = [weight(0), weight(1), weight(2)];
                        for (sums, &digits) in sums.iter_mut().zip(&digits) {
                            let [highs, lows, boths] = &mut sums[v];
                            add_products::<0>(highs, high, digits);
                            add_products::<1>(lows, low, digits);
                            add_products::<2>(boths, both, digits);
                        }
                    }
                    weights = weights.add(DIGITS * size_of::<Half>());
                }
            }
            for (r, sums) in sums.iter().enumerate() {
                for (v, &[high, low, both]) in sums.iter().enumerate() {
                    let to = block.sums.add(r * block.stride + v * 4).cast::<i32>();
                    // 4096·high + 64·(both − high − low) + low.
                    let mixed = vsubq_s32(vsubq_s32(both, high), low);
                    let mixed = vaddq_s32(vshlq_n_s32::<6>(high), mixed);
                    let mut sum = vaddq_s32(vshlq_n_s32::<6>(mixed), low);
                    if block.more {
                        sum = vaddq_s32(sum, vld1q_s32(to));
                    }
                    vst1q_s32(to, sum);
                }
            }
        }
    }
}

with_neon_dot! {
    /// To each of four sums, the products of its four weights by the four factors of word `WORD`.
    #[inline]
    fn add_products<const WORD: u32>(sums: &mut int32x4_t, weights: int8x16_t, factors: int8x16_t) {
        // SAFETY: an instruction between registers, which the processor has.
        unsafe {
            asm!(
                "sdot {sums:v}.4s, {weights:v}.16b, {factors:v}.4b[{word}]",
                sums = inout(vreg) *sums,
                weights = in(vreg) weights,
                factors = in(vreg) factors,
                word = const WORD,
                options(pure, nomem, nostack, preserves_flags),
            );
        }
    }
}

/// Multiply-adds for as long as `rounds` say; the result is the number of products of numbers.
pub(super) fn batch(_: NeonDot, rounds: usize) -> usize {
    // SAFETY: the token proves the instruction.
    unsafe { run_batch(rounds) }
}

with_neon_dot! {
    fn run_batch(rounds: usize) -> usize {
        let words: [Words; 1] = crate::sparse::peak::some_words();
        let from: *const i8 = std::hint::black_box(&words).as_ptr().cast();
        let mut sums = [vdupq_n_s32(0); ROWS * VECTORS * DIGITS];
        for _ in 0..rounds {
            let from = std::hint::black_box(from);
            // SAFETY: 32 of the 64 bytes.
            let (weights, factors) = unsafe { (vld1q_s8(from), vld1q_s8(from.add(16))) };
            for sum in &mut sums {
                add_products::<0>(sum, weights, factors);
            }
        }
        std::hint::black_box(sums);
        rounds * sums.len() * 16 / DIGITS
    }
}
