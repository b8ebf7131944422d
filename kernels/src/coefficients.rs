//! Context mixing of the decisions of coefficients: adaptive probabilities, one context a lane, mixed by weights that
//! adapt. All in integers.
//!
//! A *slot* is a word: a count in its lower 10 bits, above them the probability of a 1 in units of 2⁻²². Logits are in
//! units of 1/64.

use crate::simd::{F32Vector, I32Vector, Simd};

/// Number of contexts.
pub const CONTEXTS: usize = 8;
/// Lanes of a mixer: the contexts, [`OTHERS`] more inputs, then zeros.
pub const LANES: usize = 16;
/// Number of inputs after the contexts.
pub const OTHERS: usize = 2;
/// Bits of a slot that hold its count.
pub const COUNT_BITS: u32 = 10;
/// The count saturates here.
pub const MAX_COUNT: u32 = 120;
/// Maximum magnitude of a weight, so that three sets of ten products fit in 32 bits.
pub const MAX_WEIGHT: i32 = 1 << 16;

/// Learning rate of mixer weights.
const MIXER_RATE: i32 = 7;
/// A probability of 1, less 2⁻²².
const ALMOST_ONE: i32 = (1 << 22) - 1;

/// One value for every context.
pub type Slots = [u32; CONTEXTS];
/// One value for every lane of a mixer.
pub type Lanes = [i32; LANES];

/// The inputs of a decision, from which slots and weights adapt.
#[derive(Debug, Clone, Copy)]
pub struct Mixed {
    slots: [i32; CONTEXTS],
    inputs: Lanes,
    /// Σ input · weight, wrapping.
    pub sum: i32,
}

/// Mixes the slots of a decision and `others` by the sum of three sets of weights. A slot's input is its logit
/// `stretch[slot >> 20]`, attenuated while its count `n` is low: times `⌊256·(10n + 2) / (10n + 17)⌋`, divided by 256.
#[inline(always)]
pub fn mix<S: Simd>(
    simd: S,
    slots: &Slots,
    others: [i32; OTHERS],
    stretch: &[i16; 4096],
    weights: [&Lanes; 3],
) -> Mixed {
    let (mut words, mut logits) = ([0; CONTEXTS], [0; CONTEXTS]);
    for i in 0..CONTEXTS {
        words[i] = slots[i] as i32;
        logits[i] = stretch[(slots[i] >> (COUNT_BITS + 10)) as usize].into();
    }
    mix_narrow(simd.narrow(), words, &logits, others, weights)
}

#[inline(always)]
fn mix_narrow<S: Simd>(
    simd: S,
    slots: [i32; CONTEXTS],
    logits: &[i32; CONTEXTS],
    [first, second]: [i32; OTHERS],
    weights: [&Lanes; 3],
) -> Mixed {
    const LANE: [i32; CONTEXTS] = [0, 1, 2, 3, 4, 5, 6, 7];
    let splat = |x| S::I32::splat(simd, x);
    let mut inputs = [0; LANES];
    let mut sum = splat(0);
    for at in (0..CONTEXTS).step_by(S::LANES) {
        let lane = S::I32::load(simd, &LANE[at..]);
        let other = splat(first).keep(lane.eq(splat(0))) + splat(second).keep(lane.eq(splat(1)));
        let count = S::I32::load(simd, &slots[at..]) & splat((1 << COUNT_BITS) - 1);
        let tenfold = count * splat(10);
        // Quotients below 2⁸ that are no integers are at least 1/1217 from the next, far beyond the error of an f32.
        let confidence = (tenfold + splat(2)).shl(8).to_f32() / (tenfold + splat(17)).to_f32();
        let input = (S::I32::load(simd, &logits[at..]) * confidence.truncate_to_i32()).shr(8);
        for (at, input) in [(at, input), (at + CONTEXTS, other)] {
            input.store(&mut inputs[at..]);
            let [a, b, c] = weights.map(|set| S::I32::load(simd, &set[at..]));
            sum = sum + input * (a + b + c);
        }
    }
    Mixed {
        slots,
        inputs,
        sum: sum.sum(),
    }
}

/// Adapts to the coded `bit`, which `mixed` predicted with an error of `error · 2⁻¹⁶`.
///
/// Each weight grows by `(7·error·input + 2¹⁵) >> 16`, and stays within ±[`MAX_WEIGHT`]. The result are the new slots:
/// probabilities move by `⌊distance · ⌊327680 / (5n + 8)⌋ / 2¹⁶⌋` towards the bit, counts `n` grow to [`MAX_COUNT`].
#[inline(always)]
pub fn adapt<S: Simd>(simd: S, mixed: &Mixed, error: i32, bit: bool, weights: [&mut Lanes; 3]) -> Slots {
    let slots = adapt_narrow(simd.narrow(), mixed, error, bit, weights);
    let mut words = [0; CONTEXTS];
    for (word, slot) in words.iter_mut().zip(slots) {
        *word = slot as u32;
    }
    words
}

#[inline(always)]
fn adapt_narrow<S: Simd>(
    simd: S,
    mixed: &Mixed,
    error: i32,
    bit: bool,
    mut weights: [&mut Lanes; 3],
) -> [i32; CONTEXTS] {
    let splat = |x| S::I32::splat(simd, x);
    for at in (0..LANES).step_by(S::LANES) {
        let step = S::I32::load(simd, &mixed.inputs[at..]) * splat(error * MIXER_RATE);
        let step = (step + splat(1 << 15)).shr(16);
        for set in &mut weights {
            let grown = S::I32::load(simd, &set[at..]) + step;
            grown
                .max(splat(-MAX_WEIGHT))
                .min(splat(MAX_WEIGHT))
                .store(&mut set[at..]);
        }
    }
    let up = splat(bit.into()).eq(splat(1));
    let mut slots = [0; CONTEXTS];
    for at in (0..CONTEXTS).step_by(S::LANES) {
        let slot = S::I32::load(simd, &mixed.slots[at..]);
        let (one, count) = (slot.shr_unsigned(COUNT_BITS), slot & splat((1 << COUNT_BITS) - 1));
        // A quotient that is no integer is at least 1/(5n + 8) from the next, an f32 half of 2⁻⁷/n.
        let rate = splat(327_680).to_f32() / (count * splat(5) + splat(8)).to_f32();
        let rate = rate.truncate_to_i32();
        let distance = S::I32::select(up, splat(ALMOST_ONE) - one, one);
        // The 38 bits of the product in two parts, the upper one below 2³².
        let lower = ((distance & splat(63)) * rate).shr_unsigned(6);
        let step = (distance.shr_unsigned(6) * rate + lower).shr_unsigned(10);
        let one = S::I32::select(up, one + step, one - step);
        let count = (count + splat(1)).min(splat(MAX_COUNT as i32));
        (one.shl(COUNT_BITS) | count).store(&mut slots[at..]);
    }
    slots
}

/// The scalar product, wrapping.
#[inline(always)]
pub fn dot<S: Simd>(simd: S, a: &Lanes, b: &Lanes) -> i32 {
    dot_narrow(simd.narrow(), a, b)
}

#[inline(always)]
fn dot_narrow<S: Simd>(simd: S, a: &Lanes, b: &Lanes) -> i32 {
    let mut sum = S::I32::splat(simd, 0);
    for at in (0..LANES).step_by(S::LANES) {
        sum = sum + S::I32::load(simd, &a[at..]) * S::I32::load(simd, &b[at..]);
    }
    sum.sum()
}

/// Each weight grows by `(error · x · rate) >> 8`, and stays within ±`limit`.
#[inline(always)]
pub fn adapt_unit<S: Simd>(simd: S, weights: &mut Lanes, x: &Lanes, [error, rate]: [i32; 2], limit: i32) {
    adapt_unit_narrow(simd.narrow(), weights, x, error * rate, limit);
}

#[inline(always)]
fn adapt_unit_narrow<S: Simd>(simd: S, weights: &mut Lanes, x: &Lanes, factor: i32, limit: i32) {
    let splat = |x| S::I32::splat(simd, x);
    for at in (0..LANES).step_by(S::LANES) {
        let step = (S::I32::load(simd, &x[at..]) * splat(factor)).shr(8);
        let grown = S::I32::load(simd, &weights[at..]) + step;
        grown.max(splat(-limit)).min(splat(limit)).store(&mut weights[at..]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Isa, Work};
    use proptest::prelude::*;

    /// The definition, one lane after the other.
    mod plain {
        use super::*;

        pub fn input(slot: u32, stretch: &[i16; 4096]) -> i32 {
            let count = (slot & 1023) as i32;
            let confidence = 256 * (10 * count + 2) / (10 * count + 17);
            (i32::from(stretch[(slot >> 20) as usize]) * confidence) >> 8
        }

        pub fn sum(slots: &Slots, others: [i32; 2], stretch: &[i16; 4096], weights: &[Lanes; 3]) -> (Lanes, i32) {
            let mut inputs = [0; LANES];
            for i in 0..CONTEXTS {
                inputs[i] = input(slots[i], stretch);
            }
            inputs[CONTEXTS..CONTEXTS + OTHERS].copy_from_slice(&others);
            let weight = |i: usize| weights.iter().map(|set| set[i]).sum::<i32>();
            let sum = (0..LANES).fold(0i32, |sum, i| sum.wrapping_add(inputs[i].wrapping_mul(weight(i))));
            (inputs, sum)
        }

        pub fn slot(slot: u32, bit: bool) -> u32 {
            let (one, count) = (slot >> 10, slot & 1023);
            let rate = u64::from(65536 * 5 / (5 * count + 8));
            let one = if bit {
                one + ((u64::from((1 << 22) - 1 - one) * rate) >> 16) as u32
            } else {
                one - ((u64::from(one) * rate) >> 16) as u32
            };
            one << 10 | (count + 1).min(MAX_COUNT)
        }
    }

    #[derive(Clone, Copy)]
    struct MixAndAdapt<'a> {
        slots: Slots,
        others: [i32; 2],
        stretch: &'a [i16; 4096],
        weights: [Lanes; 3],
        one: i32,
        bit: bool,
    }

    impl MixAndAdapt<'_> {
        fn error(&self) -> i32 {
            if self.bit { 65536 - self.one } else { -self.one }
        }

        fn plain(self) -> (i32, Slots, [Lanes; 3]) {
            let (inputs, sum) = plain::sum(&self.slots, self.others, self.stretch, &self.weights);
            let grow = |set: Lanes| -> Lanes {
                std::array::from_fn(|i| {
                    let step = (self.error() * inputs[i] * 7 + (1 << 15)) >> 16;
                    (set[i] + step).clamp(-MAX_WEIGHT, MAX_WEIGHT)
                })
            };
            (
                sum,
                self.slots.map(|slot| plain::slot(slot, self.bit)),
                self.weights.map(grow),
            )
        }
    }

    impl Work for MixAndAdapt<'_> {
        type Output = (i32, Slots, [Lanes; 3]);

        #[inline(always)]
        fn run<S: Simd>(self, simd: S) -> Self::Output {
            let [mut a, mut b, mut c] = self.weights;
            let mixed = mix(simd, &self.slots, self.others, self.stretch, [&a, &b, &c]);
            let slots = adapt(simd, &mixed, self.error(), self.bit, [&mut a, &mut b, &mut c]);
            (mixed.sum, slots, [a, b, c])
        }
    }

    struct Unit(Lanes, Lanes, [i32; 2]);

    impl Work for Unit {
        type Output = (i32, Lanes);

        #[inline(always)]
        fn run<S: Simd>(self, simd: S) -> Self::Output {
            let Unit(mut weights, x, step) = self;
            let sum = dot(simd, &weights, &x);
            adapt_unit(simd, &mut weights, &x, step, 1 << 20);
            (sum, weights)
        }
    }

    fn stretch() -> [i16; 4096] {
        std::array::from_fn(|i| (i as i16 - 2048) / 3)
    }

    fn a_slot() -> impl Strategy<Value = u32> {
        let one = prop_oneof![0u32..1 << 22, Just(0), Just((1 << 22) - 1)];
        (one, 0..=MAX_COUNT).prop_map(|(one, count)| one << 10 | count)
    }

    fn weights(limit: i32) -> impl Strategy<Value = Lanes> {
        prop::array::uniform16(-limit..=limit)
    }

    proptest! {
        #[test]
        fn every_instruction_set_mixes_and_adapts_as_plain_code_does(
            slots in prop::array::uniform8(a_slot()),
            others in prop::array::uniform2(-320i32..=320),
            weights in prop::array::uniform3(weights(MAX_WEIGHT)),
            one in 24i32..=65512,
            bit: bool,
        ) {
            let stretch = stretch();
            let work = MixAndAdapt { slots, others, stretch: &stretch, weights, one, bit };
            for isa in Isa::available() {
                prop_assert_eq!(isa.run(work), work.plain(), "{}", isa);
            }
        }

        #[test]
        fn every_instruction_set_adapts_a_unit_as_plain_code_does(
            weights in weights(1 << 20),
            x in weights(100),
            error in -4096i32..=4096,
            rate in 4i32..=68,
        ) {
            let sum = (0..LANES).fold(0i32, |sum, i| sum.wrapping_add(weights[i].wrapping_mul(x[i])));
            let grown: Lanes = std::array::from_fn(|i| {
                (weights[i] + ((error * x[i] * rate) >> 8)).clamp(-(1 << 20), 1 << 20)
            });
            for isa in Isa::available() {
                prop_assert_eq!(isa.run(Unit(weights, x, [error, rate])), (sum, grown), "{}", isa);
            }
        }
    }

    #[test]
    fn every_count_has_its_confidence_and_its_rate() {
        let stretch = stretch();
        for isa in Isa::available() {
            for count in 0..=MAX_COUNT {
                for (one, bit) in [(0, true), (ALMOST_ONE as u32, false), (4_000_000, false), (5, true)] {
                    let work = MixAndAdapt {
                        slots: [one << 10 | count; CONTEXTS],
                        others: [0; 2],
                        stretch: &stretch,
                        weights: [[1; LANES]; 3],
                        one: 40_000,
                        bit,
                    };
                    assert_eq!(isa.run(work), work.plain(), "{isa}: count {count}");
                }
            }
        }
    }
}
