//! f16 by f16 (NEON with `fp16`): twice as many products to an instruction as of f32.
//!
//! Products are summed in f16 in blocks of [`BLOCK`], blocks in f32, tap by tap.
//!
//! **No sum overflows.** An f16 ends at 65504. Each output channel's weights are divided by a power of two, its unit,
//! that brings the largest, w, to at least 1/64 and below 1/32. Finite activations are below 2¹⁶, so the first k
//! products of a block come to less than k · 2¹¹ together, which f16 holds exactly for every k up to 16; and as
//! rounding keeps the order of numbers, no rounded sum is beyond it.
//!
//! **What is lost.** An addition gives (s + p)(1 + ε) + η, |ε| ≤ 2⁻¹¹ and |η| ≤ 2⁻²⁵, so that a block of products p is
//! off by at most (1 + 2⁻¹¹)¹⁶ − 1 < 1.004 · 2⁻⁷ of Σ|p|, and by 1.008 · 2⁻²⁵ a product. A weight that division takes
//! below f16's normal numbers loses up to 2⁻²⁵, which takes up to 1.008 · 2⁻²⁵ · |x| from its product. Since the unit
//! is at most 64 w, sums that are multiplied by it again have lost no more than 1.004 · 2⁻⁷ of their terms' magnitudes,
//! and 1.01 · 2⁻¹⁹ · w · (|x| + 1) a product. Adding blocks in f32 comes on top.

use std::arch::aarch64::*;
use std::arch::asm;

use bytemuck::{must_cast, must_cast_slice_mut};

use crate::simd::Isa;
use crate::simd::neon::{NeonHalf, with_neon_half};
use crate::sparse::microkernel::Block;
use crate::sparse::peak::some_words;
use crate::sparse::rows::{Extents, PANEL, Words};
use ::half::f16;

/// Products that are summed in f16.
const BLOCK: usize = 16;
/// No weight that was divided by its unit reaches the inverse.
const HEADROOM: f32 = 2.0 * BLOCK as f32;
/// Values of a vector.
const EIGHT: usize = 8;
/// Rows whose sums, of a panel, stay in the registers.
const ROWS: usize = 4;

/// A layer's weights, divided by their units.
#[derive(Debug, Clone)]
pub(crate) struct Weights {
    /// Per tap, panel and two input channels, in whole blocks: the weights of the one for all outputs, then those of
    /// the other.
    pub words: Vec<Words>,
    /// What a sum of each output channel is to be multiplied by: powers of two.
    pub units: Vec<[f32; PANEL]>,
}

impl Weights {
    /// Divides the weights, of which `weights(tap, input, panel)` tells those of a panel of outputs, by their units.
    pub fn new(extents: Extents, weights: impl Fn(usize, usize, usize) -> [f32; PANEL]) -> Weights {
        let panels = extents.panels();
        let mut peaks = vec![[0.0f32; PANEL]; panels];
        for (tap, channel, panel) in extents.each() {
            for (peak, weight) in peaks[panel].iter_mut().zip(weights(tap, channel, panel)) {
                *peak = peak.max(weight.abs());
            }
        }
        let units: Vec<_> = peaks.into_iter().map(|peaks| peaks.map(unit)).collect();
        let steps = steps(extents.cin);
        let mut words = vec![Words::default(); extents.volume * panels * steps];
        for (tap, channel, panel) in extents.each() {
            let step = &mut words[(tap * panels + panel) * steps + channel / 2].0;
            let weights = weights(tap, channel, panel).into_iter().zip(units[panel]);
            for (lane, (weight, unit)) in weights.enumerate() {
                let bits = f16::from_f32(weight / unit).to_bits();
                step[(channel % 2 * PANEL + lane) / 2] |= u32::from(bits) << (lane % 2 * 16);
            }
        }
        Weights { words, units }
    }
}

/// The power of two by which weights up to this one are to be divided.
fn unit(peak: f32) -> f32 {
    let power = f32::from_bits(peak.min(f16::MAX.to_f32()).to_bits() & f32::INFINITY.to_bits());
    match power > 0.0 {
        true => power * 2.0 * HEADROOM,
        false => 1.0,
    }
}

/// Words of a row, two values each, in whole blocks.
fn steps(cin: usize) -> usize {
    cin.div_ceil(BLOCK) * BLOCK / 2
}

/// Writes rows as they are, and zeros up to whole blocks.
pub(crate) fn gather(_: Isa, input: &[f16], rows: &[u32], cin: usize, to: &mut [u32]) {
    let each = must_cast_slice_mut::<_, i16>(to).chunks_exact_mut(2 * steps(cin));
    for (to, &row) in each.zip(rows) {
        let (to, rest) = to.split_at_mut(cin);
        for (to, from) in to.iter_mut().zip(&input[row as usize * cin..][..cin]) {
            *to = from.to_bits() as i16;
        }
        rest.fill(0);
    }
}

/// A panel's products of the rows' factors, in two vectors each.
type Products = [[uint16x8_t; 2]; ROWS];

/// Sums a block's products for a panel; of half a panel the rest is zeros.
///
/// # Panics
/// If the block reads or writes beyond its slices, or has no whole blocks of [`BLOCK`] inputs.
pub(super) fn multiply(isa: Isa, block: &mut Block<'_>, _whole: usize) {
    assert!(isa.has_half() && (2 * block.steps).is_multiple_of(BLOCK));
    for first in (0..block.group).step_by(ROWS) {
        // SAFETY: the processor has `fp16`.
        unsafe { multiply_rows(block, first) };
    }
}

with_neon_half! {
    /// The sums of the rows from `first` on.
    fn multiply_rows(block: &mut Block<'_>, first: usize) {
        let mut sums = [[vdupq_n_f32(0.0); 4]; ROWS];
        if block.more {
            for (r, sums) in sums.iter_mut().enumerate() {
                *sums = must_cast(block.sums[(first + r) * block.stride]);
            }
        }
        let mut products: Products = [[vdupq_n_u16(0); 2]; ROWS];
        for (t, &tap) in block.taps.iter().enumerate() {
            let mut inputs = [std::ptr::null::<u16>(); ROWS];
            for (r, input) in inputs.iter_mut().enumerate() {
                let place = usize::from(block.places()[t * block.group + first + r]);
                *input = block.inputs[place * block.steps..][..block.steps].as_ptr().cast();
            }
            let mut weights = block.weights[usize::from(tap) * block.tap..][..block.steps].as_ptr().cast::<u16>();
            for _ in 0..block.steps * 2 / BLOCK {
                // SAFETY: of each row and of the weights, as many inputs are read as they were just cut to: whole
                // blocks.
                unsafe {
                    begin(&mut products, &mut inputs, &mut weights);
                    for _ in 1..BLOCK / EIGHT {
                        add(&mut products, &mut inputs, &mut weights);
                    }
                }
                for (sums, &[left, right]) in sums.iter_mut().zip(&products) {
                    let [a, b] = widened(left);
                    let [c, d] = widened(right);
                    for (sum, block) in sums.iter_mut().zip([a, b, c, d]) {
                        *sum = vaddq_f32(*sum, block);
                    }
                }
            }
        }
        for (r, sums) in sums.into_iter().enumerate() {
            block.sums[(first + r) * block.stride] = must_cast(sums);
        }
    }
}

with_neon_half! {
    /// Eight f16 as f32.
    #[inline]
    fn widened(narrow: uint16x8_t) -> [float32x4_t; 2] {
        let (low, high);
        // SAFETY: instructions between registers, which any NEON has.
        unsafe {
            asm!(
                "fcvtl {low:v}.4s, {narrow:v}.4h",
                "fcvtl2 {high:v}.4s, {narrow:v}.8h",
                low = out(vreg) low, high = lateout(vreg) high, narrow = in(vreg) narrow,
                options(pure, nomem, nostack, preserves_flags),
            );
        }
        [low, high]
    }
}

/// To the products of a row, in one of two vectors, a lane of its factors times weights.
macro_rules! row {
    ($instruction:literal, $products:literal, $weights:literal, $factors:literal, $lane:literal) => {
        concat!(
            $instruction,
            " {",
            $products,
            ":v}.8h, {",
            $weights,
            ":v}.8h, {",
            $factors,
            ":v}.h[",
            $lane,
            "]\n"
        )
    };
}

/// One of eight input channels, of which the weights are in two vectors, for all rows.
macro_rules! channel {
    ($instruction:literal, $lane:literal, $left:literal, $right:literal) => {
        concat!(
            row!($instruction, "al", $left, "a", $lane),
            row!($instruction, "ar", $right, "a", $lane),
            row!($instruction, "bl", $left, "b", $lane),
            row!($instruction, "br", $right, "b", $lane),
            row!($instruction, "cl", $left, "c", $lane),
            row!($instruction, "cr", $right, "c", $lane),
            row!($instruction, "dl", $left, "d", $lane),
            row!($instruction, "dr", $right, "d", $lane),
        )
    };
}

/// The next eight input channels. All in one piece, with as many registers as are left beside the sums: of single
/// instructions compilers make an order that takes more.
macro_rules! eight {
    ($(#[$doc:meta])* $name:ident, $first:literal) => { with_neon_half! {
        $(#[$doc])*
        ///
        /// # Safety
        /// There must be eight inputs of each row, and eight panels of weights, which it steps over.
        #[inline]
        unsafe fn $name(products: &mut Products, inputs: &mut [*const u16; ROWS], weights: &mut *const u16) {
            let [[al, ar], [bl, br], [cl, cr], [dl, dr]] = products;
            // SAFETY: it reads what the caller promises, and changes registers.
            unsafe {
                let [a, b, c, d] = inputs.map(|input| vld1q_u16(input));
                *inputs = inputs.map(|input| input.add(EIGHT));
                asm!(
                    "ldr {l:q}, [{weights}, #0]",
                    "ldr {r:q}, [{weights}, #16]",
                    "ldr {m:q}, [{weights}, #32]",
                    "ldr {s:q}, [{weights}, #48]",
                    channel!($first, 0, "l", "r"),
                    "ldr {l:q}, [{weights}, #64]",
                    "ldr {r:q}, [{weights}, #80]",
                    channel!("fmla", 1, "m", "s"),
                    "ldr {m:q}, [{weights}, #96]",
                    "ldr {s:q}, [{weights}, #112]",
                    channel!("fmla", 2, "l", "r"),
                    "ldr {l:q}, [{weights}, #128]",
                    "ldr {r:q}, [{weights}, #144]",
                    channel!("fmla", 3, "m", "s"),
                    "ldr {m:q}, [{weights}, #160]",
                    "ldr {s:q}, [{weights}, #176]",
                    channel!("fmla", 4, "l", "r"),
                    "ldr {l:q}, [{weights}, #192]",
                    "ldr {r:q}, [{weights}, #208]",
                    channel!("fmla", 5, "m", "s"),
                    "ldr {m:q}, [{weights}, #224]",
                    "ldr {s:q}, [{weights}, #240]",
                    channel!("fmla", 6, "l", "r"),
                    channel!("fmla", 7, "m", "s"),
                    al = inout(vreg) *al, ar = inout(vreg) *ar, bl = inout(vreg) *bl, br = inout(vreg) *br,
                    cl = inout(vreg) *cl, cr = inout(vreg) *cr, dl = inout(vreg) *dl, dr = inout(vreg) *dr,
                    // A lane can be taken of the first sixteen registers.
                    a = in(vreg_low16) a, b = in(vreg_low16) b, c = in(vreg_low16) c, d = in(vreg_low16) d,
                    l = out(vreg) _, r = out(vreg) _, m = out(vreg) _, s = out(vreg) _,
                    weights = in(reg) *weights,
                    options(readonly, nostack, preserves_flags),
                );
                *weights = weights.add(EIGHT * PANEL);
            }
        }
    } };
}

eight! {
    /// Makes their products a block's first.
    begin, "fmul"
}
eight! {
    /// Adds their products to a block, each rounded once.
    add, "fmla"
}

/// Multiply-adds for as long as `rounds` say; the result is the number of words multiplied, two products each.
pub(super) fn batch(_: NeonHalf, rounds: usize) -> usize {
    // SAFETY: the token proves `fp16`.
    unsafe { run_batch(rounds) }
}

with_neon_half! {
    fn run_batch(rounds: usize) -> usize {
        let words: [Words; EIGHT / 2] = some_words();
        let from: *const u16 = words.as_ptr().cast();
        let mut sums: Products = [[vdupq_n_u16(0); 2]; ROWS];
        for _ in 0..rounds {
            let from = std::hint::black_box(from);
            // SAFETY: the words are eight panels of weights, of which any eight are factors too.
            unsafe { add(&mut sums, &mut [from; ROWS], &mut { from }) };
        }
        std::hint::black_box(sums);
        rounds * EIGHT * ROWS * PANEL / 2
    }
}
