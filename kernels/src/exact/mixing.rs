//! What several contexts have shown, mixed in the logistic domain by weights that learn, in integers: each context with
//! what it says in a lane of its own.
//!
//! An entry of a context is a word: the probability of a 1 in units of 2⁻¹⁶, from bit 16 on how often it was *seen*,
//! from bit 24 on a check. Logits are in units of 1/64.

use crate::simd::{F32Vector, I32Vector, Simd};

/// How many contexts there are.
pub const CONTEXTS: usize = 5;
/// Up to where an entry counts how often it was seen.
pub const MOST: i32 = 30;
/// The largest magnitude of a weight, so that seven products stay within 32 bits.
pub const HEAVIEST: i32 = 1 << 17;

/// A number for each context, then two of inputs that are none, and a zero.
pub type Lanes = [i32; 8];

/// Which lanes hold the other inputs.
pub const OTHERS: [usize; 2] = [CONTEXTS, CONTEXTS + 1];

/// One prediction, to be learned from.
#[derive(Debug, Clone, Copy)]
pub struct Mixed {
    checks: Lanes,
    seen: Lanes,
    ones: Lanes,
    inputs: Lanes,
    /// Σ input·weight, wrapping.
    pub sum: i32,
}

/// Mixes what `entries` say, of each if the low byte of `checks` is the entry's check: `((stretch[one >> 4] −
/// logit)·⌊1024·seen / (4·seen + 1)⌋) >> 8`; the inputs of [`OTHERS`] are `logit` and `bias`.
#[inline(always)]
pub fn mix<S: Simd>(
    simd: S,
    entries: [u32; CONTEXTS],
    checks: [u32; CONTEXTS],
    [logit, bias]: [i32; 2],
    stretch: &[i16; 4096],
    weights: &Lanes,
) -> Mixed {
    let (mut said, mut stretched, mut asked) = ([0; 8], [0; 8], [0; 8]);
    for i in 0..CONTEXTS {
        said[i] = entries[i] as i32;
        stretched[i] = stretch[(entries[i] >> 4 & 4095) as usize].into();
        asked[i] = checks[i] as i32;
    }
    mix_narrow(simd.narrow(), &said, asked, &stretched, [logit, bias], weights)
}

/// Learns from a prediction that was `error` off, in units of 2⁻¹⁶: each weight grows by `(3·error·input + 32768) >>
/// 16`, and stays within ±[`HEAVIEST`]. The result are the entries to come, for a bit of probability `truth`, 0 or 2¹⁶:
/// each *seen* once more, up to [`MOST`], its probability, at first `first`, grown by `((truth − one)·⌊65536 /
/// (4·seen + 1)⌋) >> 14`, within 16 to 65520.
#[inline(always)]
pub fn learn<S: Simd>(
    simd: S,
    mixed: &Mixed,
    error: i32,
    [truth, first]: [i32; 2],
    weights: &mut Lanes,
) -> [u32; CONTEXTS] {
    let entries = learn_narrow(simd.narrow(), mixed, error, [truth, first], weights);
    let mut first = [0; CONTEXTS];
    for (to, entry) in first.iter_mut().zip(entries) {
        *to = entry as u32;
    }
    first
}

/// `⌊factor / (4·seen + 1)⌋` for *seen* up to [`MOST`] and quotients up to 2¹⁶: a quotient that is no whole number is
/// at least 1/121 from the next, and an f32's error below 1/256, so that it is rounded down to the same.
#[inline(always)]
fn by_four_seen<S: Simd>(simd: S, factor: S::I32, seen: S::I32) -> S::I32 {
    let divisor = seen.shl(2) + S::I32::splat(simd, 1);
    (factor.to_f32() / divisor.to_f32()).truncate_to_i32()
}

#[inline(always)]
fn mix_narrow<S: Simd>(
    simd: S,
    entries: &Lanes,
    checks: Lanes,
    stretched: &Lanes,
    [logit, bias]: [i32; 2],
    weights: &Lanes,
) -> Mixed {
    const LANE: Lanes = [0, 1, 2, 3, 4, 5, 6, 7];
    let splat = |x| S::I32::splat(simd, x);
    let (mut seen, mut ones, mut inputs) = ([0; 8], [0; 8], [0; 8]);
    let mut sum = splat(0);
    for at in (0..8).step_by(S::LANES) {
        let load = |from: &Lanes| S::I32::load(simd, &from[at..]);
        let entry = load(entries);
        let same = entry.shr_unsigned(24).eq(load(&checks) & splat(255));
        let known = (entry.shr_unsigned(16) & splat(31)).keep(same);
        known.store(&mut seen[at..]);
        (entry & splat(0xffff)).store(&mut ones[at..]);
        let trust = by_four_seen(simd, known.shl(10), known);
        let input = ((load(stretched) - splat(logit)) * trust).shr(8);
        let lane = load(&LANE);
        let input = S::I32::select(lane.eq(splat(OTHERS[0] as i32)), splat(logit), input);
        let input = S::I32::select(lane.eq(splat(OTHERS[1] as i32)), splat(bias), input);
        input.store(&mut inputs[at..]);
        sum = sum + input * load(weights);
    }
    Mixed {
        checks,
        seen,
        ones,
        inputs,
        sum: sum.sum(),
    }
}

#[inline(always)]
fn learn_narrow<S: Simd>(simd: S, mixed: &Mixed, error: i32, [truth, first]: [i32; 2], weights: &mut Lanes) -> Lanes {
    let splat = |x| S::I32::splat(simd, x);
    let mut entries = [0; 8];
    for at in (0..8).step_by(S::LANES) {
        let load = |from: &Lanes| S::I32::load(simd, &from[at..]);
        let steps = (splat(3 * error) * load(&mixed.inputs) + splat(1 << 15)).shr(16);
        let grown = (load(weights) + steps).max(splat(-HEAVIEST)).min(splat(HEAVIEST));
        grown.store(&mut weights[at..]);

        let (seen, ones) = (load(&mixed.seen), load(&mixed.ones));
        let ones = S::I32::select(seen.eq(splat(0)), splat(first), ones);
        let seen = (seen + splat(1)).min(splat(MOST));
        let rate = by_four_seen(simd, splat(65536), seen);
        let ones = ones + ((splat(truth) - ones) * rate).shr(14);
        let ones = ones.max(splat(16)).min(splat(65_520));
        let entry = ones | seen.shl(16) | load(&mixed.checks).shl(24);
        entry.store(&mut entries[at..]);
    }
    entries
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Isa, Work};
    use proptest::prelude::*;

    /// The definition, one context after the other.
    mod plain {
        use super::{HEAVIEST, Lanes, MOST, Mixed, OTHERS};

        /// How much an entry that was seen so often says, in units of 1/256.
        const TRUST: Lookup = lookup(1024, true);
        /// How fast it follows, in units of 2⁻¹⁴.
        const RATE: Lookup = lookup(65536, false);

        type Lookup = [i32; MOST as usize + 1];

        /// `⌊factor / (4·seen + 1)⌋`, or that times `seen` before it is rounded down.
        const fn lookup(factor: usize, times: bool) -> Lookup {
            let (mut table, mut seen) = ([0; MOST as usize + 1], 0);
            while seen < table.len() {
                let factor = if times { factor * seen } else { factor };
                table[seen] = (factor / (4 * seen + 1)) as i32;
                seen += 1;
            }
            table
        }

        pub fn mix(entries: Lanes, checks: Lanes, stretched: Lanes, others: [i32; 2], weights: &Lanes) -> Mixed {
            let (mut seen, mut ones, mut inputs) = ([0; 8], [0; 8], [0; 8]);
            for i in 0..8 {
                let entry = entries[i] as u32;
                let same = entry >> 24 == checks[i] as u32 & 255;
                seen[i] = if same { (entry >> 16 & 31) as i32 } else { 0 };
                ones[i] = (entry & 0xffff) as i32;
                let trust = TRUST[seen[i].min(MOST) as usize];
                inputs[i] = ((stretched[i] - others[0]) * trust) >> 8;
            }
            for (lane, other) in OTHERS.into_iter().zip(others) {
                inputs[lane] = other;
            }
            let products = inputs.iter().zip(weights);
            let sum = products.fold(0i32, |sum, (input, weight)| {
                sum.wrapping_add(input.wrapping_mul(*weight))
            });
            Mixed {
                checks,
                seen,
                ones,
                inputs,
                sum,
            }
        }

        pub fn learn(mixed: &Mixed, error: i32, [truth, first]: [i32; 2], weights: &mut Lanes) -> Lanes {
            for (weight, input) in weights.iter_mut().zip(mixed.inputs) {
                let step = (3 * error * input + (1 << 15)) >> 16;
                *weight = (*weight + step).clamp(-HEAVIEST, HEAVIEST);
            }
            std::array::from_fn(|i| {
                let one = match mixed.seen[i] {
                    0 => first,
                    _ => mixed.ones[i],
                };
                let seen = (mixed.seen[i] + 1).min(MOST);
                let one = one + (((truth - one) * RATE[seen as usize]) >> 14);
                one.clamp(16, 65_520) | seen << 16 | mixed.checks[i] << 24
            })
        }
    }

    fn plain_mix(
        entries: [u32; CONTEXTS],
        checks: [u32; CONTEXTS],
        others: [i32; 2],
        stretch: &[i16; 4096],
        weights: &Lanes,
    ) -> Mixed {
        let (mut said, mut stretched, mut asked) = ([0; 8], [0; 8], [0; 8]);
        for i in 0..CONTEXTS {
            said[i] = entries[i] as i32;
            stretched[i] = stretch[(entries[i] >> 4 & 4095) as usize].into();
            asked[i] = checks[i] as i32;
        }
        plain::mix(said, asked, stretched, others, weights)
    }

    /// A prediction, and what is learned from it.
    #[derive(Clone, Copy)]
    struct MixAndLearn<'a> {
        entries: [u32; CONTEXTS],
        checks: [u32; CONTEXTS],
        others: [i32; 2],
        stretch: &'a [i16; 4096],
        weights: Lanes,
        error: i32,
        target: [i32; 2],
    }

    impl Work for MixAndLearn<'_> {
        type Output = (i32, [u32; CONTEXTS], Lanes);

        #[inline(always)]
        fn run<S: Simd>(self, simd: S) -> Self::Output {
            let mut weights = self.weights;
            let mixed = mix(simd, self.entries, self.checks, self.others, self.stretch, &weights);
            let entries = learn(simd, &mixed, self.error, self.target, &mut weights);
            (mixed.sum, entries, weights)
        }
    }

    fn an_entry() -> impl Strategy<Value = u32> {
        (16u32..=65_520, 0..=MOST as u32, 0u32..4).prop_map(|(one, seen, check)| one | seen << 16 | check << 24)
    }

    proptest! {
        #[test]
        fn every_instruction_set_mixes_and_learns_as_plain_code_does(
            entries in prop::array::uniform5(an_entry()),
            checks in prop::array::uniform5((0u32..4, any::<u32>()).prop_map(|(check, more)| check | more << 8)),
            logit in -720i32..=720,
            weights in prop::array::uniform7(-HEAVIEST..=HEAVIEST),
            bit: bool,
            one in 1i32..65536,
            first in 1i32..65536,
        ) {
            let stretch: [i16; 4096] = std::array::from_fn(|i| (i as i16 - 2048) / 3);
            let [a, b, c, d, e, f, g] = weights;
            let weights = [a, b, c, d, e, f, g, 0];
            let truth = if bit { 65536 } else { 0 };
            let work = MixAndLearn {
                entries, checks, others: [logit, 20], stretch: &stretch, weights, error: truth - one, target: [truth, first],
            };
            let mixed = plain_mix(entries, checks, [logit, 20], &stretch, &weights);
            let mut learned = weights;
            let next = plain::learn(&mixed, truth - one, [truth, first], &mut learned);
            let next = std::array::from_fn(|i| next[i] as u32);
            for isa in Isa::available() {
                prop_assert_eq!(isa.run(work), (mixed.sum, next, learned), "{}", isa);
            }
        }
    }

    #[test]
    fn every_count_gives_its_trust_and_its_rate() {
        for isa in Isa::available() {
            for seen in 0..=MOST {
                let entry = 65_520 | (seen as u32) << 16;
                let work = MixAndLearn {
                    entries: [entry; CONTEXTS],
                    checks: [0; CONTEXTS],
                    others: [-256, 0],
                    stretch: &[0; 4096],
                    weights: [0, 0, 0, 0, 1, 0, 0, 0],
                    error: 0,
                    target: [0, 16384],
                };
                let (sum, next, _) = isa.run(work);
                assert_eq!(sum, 1024 * seen / (4 * seen + 1), "{isa}");
                let (one, count) = (if seen == 0 { 16384 } else { 65_520 }, (seen + 1).min(MOST));
                let expected = one + ((-one * (65536 / (4 * count + 1))) >> 14);
                assert_eq!(next[4], (expected.max(16) | count << 16) as u32, "{isa}");
            }
        }
    }
}
