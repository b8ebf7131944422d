//! What several contexts have shown, mixed in the logistic domain by weights that learn, in integers: each context with what it says in a lane of its own.
//!
//! An entry of a context is a word: the probability of a 1 in units of 2⁻¹⁶, from bit 16 on how often it was *seen*, from bit 24 on a check. Logits are in
//! units of 1/64.

use crate::work::Instructions;

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

/// Mixes what `entries` say, of each if the low byte of `checks` is the entry's check: `((stretch[one >> 4] − logit)·⌊1024·seen / (4·seen + 1)⌋) >> 8`;
/// the inputs of [`OTHERS`] are `logit` and `bias`.
#[inline(always)]
pub fn mix<I: Instructions>(
    _: I,
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
    #[cfg(target_arch = "x86_64")]
    if I::AVX2 {
        // SAFETY: an `I` that has AVX2 is only made where the processor does.
        return unsafe { avx2::mix(said, asked, stretched, [logit, bias], weights) };
    }
    plain::mix(said, asked, stretched, [logit, bias], weights)
}

/// Learns from a prediction that was `error` off, in units of 2⁻¹⁶: each weight grows by `(3·error·input + 32768) >> 16`, and stays within ±[`HEAVIEST`].
/// The result are the entries to come, for a bit of probability `truth`, 0 or 2¹⁶: each *seen* once more, up to [`MOST`], its probability, at first `first`,
/// grown by `((truth − one)·⌊65536 / (4·seen + 1)⌋) >> 14`, within 16 to 65520.
#[inline(always)]
pub fn learn<I: Instructions>(
    _: I,
    mixed: &Mixed,
    error: i32,
    [truth, first]: [i32; 2],
    weights: &mut Lanes,
) -> [u32; CONTEXTS] {
    #[cfg(target_arch = "x86_64")]
    let entries = match I::AVX2 {
        // SAFETY: an `I` that has AVX2 is only made where the processor does.
        true => unsafe { avx2::learn(mixed, error, [truth, first], weights) },
        false => plain::learn(mixed, error, [truth, first], weights),
    };
    #[cfg(not(target_arch = "x86_64"))]
    let entries = plain::learn(mixed, error, [truth, first], weights);
    let mut first = [0; CONTEXTS];
    for (to, entry) in first.iter_mut().zip(entries) {
        *to = entry as u32;
    }
    first
}

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

    #[inline(always)]
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

    #[inline(always)]
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

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use super::{HEAVIEST, Lanes, MOST, Mixed, OTHERS};
    use std::arch::x86_64::*;

    #[inline]
    #[target_feature(enable = "avx2")]
    fn vector(lanes: Lanes) -> __m256i {
        let [a, b, c, d, e, f, g, h] = lanes;
        _mm256_setr_epi32(a, b, c, d, e, f, g, h)
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn load(lanes: &Lanes) -> __m256i {
        // SAFETY: eight words are read.
        unsafe { _mm256_loadu_si256(lanes.as_ptr().cast()) }
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn store(vector: __m256i) -> Lanes {
        let mut lanes = [0; 8];
        // SAFETY: eight words are written.
        unsafe { _mm256_storeu_si256(lanes.as_mut_ptr().cast(), vector) };
        lanes
    }

    /// `⌊factor / (4·seen + 1)⌋` for *seen* up to [`MOST`] and quotients up to 2¹⁶: a quotient that is no whole number is at least 1/121 from
    /// the next, and an f32's error below 1/256, so that it is rounded down to the same.
    #[inline]
    #[target_feature(enable = "avx2")]
    fn by_four_seen(factor: __m256i, seen: __m256i) -> __m256i {
        let divisor = _mm256_add_epi32(_mm256_slli_epi32::<2>(seen), _mm256_set1_epi32(1));
        let (factor, divisor) = (_mm256_cvtepi32_ps(factor), _mm256_cvtepi32_ps(divisor));
        _mm256_cvttps_epi32(_mm256_div_ps(factor, divisor))
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    pub fn mix(entries: Lanes, checks: Lanes, stretched: Lanes, [logit, bias]: [i32; 2], weights: &Lanes) -> Mixed {
        const LOGIT: i32 = 1 << OTHERS[0];
        const BIAS: i32 = 1 << OTHERS[1];
        let (entries, checks) = (vector(entries), vector(checks));
        let byte = _mm256_and_si256(checks, _mm256_set1_epi32(255));
        let same = _mm256_cmpeq_epi32(_mm256_srli_epi32::<24>(entries), byte);
        let seen = _mm256_and_si256(_mm256_srli_epi32::<16>(entries), _mm256_set1_epi32(31));
        let seen = _mm256_and_si256(seen, same);
        let ones = _mm256_and_si256(entries, _mm256_set1_epi32(0xffff));
        let trust = by_four_seen(_mm256_slli_epi32::<10>(seen), seen);
        let logit = _mm256_set1_epi32(logit);
        let apart = _mm256_sub_epi32(vector(stretched), logit);
        let inputs = _mm256_srai_epi32::<8>(_mm256_mullo_epi32(apart, trust));
        let inputs = _mm256_blend_epi32::<LOGIT>(inputs, logit);
        let inputs = _mm256_blend_epi32::<BIAS>(inputs, _mm256_set1_epi32(bias));
        let products = _mm256_mullo_epi32(inputs, load(weights));
        let sum = _mm_add_epi32(
            _mm256_castsi256_si128(products),
            _mm256_extracti128_si256::<1>(products),
        );
        let sum = _mm_add_epi32(sum, _mm_shuffle_epi32::<0b1110>(sum));
        let sum = _mm_add_epi32(sum, _mm_shuffle_epi32::<0b01>(sum));
        Mixed {
            checks: store(checks),
            seen: store(seen),
            ones: store(ones),
            inputs: store(inputs),
            sum: _mm_cvtsi128_si32(sum),
        }
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    pub fn learn(mixed: &Mixed, error: i32, [truth, first]: [i32; 2], weights: &mut Lanes) -> Lanes {
        let steps = _mm256_mullo_epi32(_mm256_set1_epi32(3 * error), load(&mixed.inputs));
        let steps = _mm256_srai_epi32::<16>(_mm256_add_epi32(steps, _mm256_set1_epi32(1 << 15)));
        let grown = _mm256_add_epi32(load(weights), steps);
        let grown = _mm256_max_epi32(grown, _mm256_set1_epi32(-HEAVIEST));
        *weights = store(_mm256_min_epi32(grown, _mm256_set1_epi32(HEAVIEST)));

        let (seen, ones) = (load(&mixed.seen), load(&mixed.ones));
        let new = _mm256_cmpeq_epi32(seen, _mm256_setzero_si256());
        let ones = _mm256_blendv_epi8(ones, _mm256_set1_epi32(first), new);
        let seen = _mm256_add_epi32(seen, _mm256_set1_epi32(1));
        let seen = _mm256_min_epi32(seen, _mm256_set1_epi32(MOST));
        let rate = by_four_seen(_mm256_set1_epi32(65536), seen);
        let apart = _mm256_sub_epi32(_mm256_set1_epi32(truth), ones);
        let steps = _mm256_srai_epi32::<14>(_mm256_mullo_epi32(apart, rate));
        let ones = _mm256_max_epi32(_mm256_add_epi32(ones, steps), _mm256_set1_epi32(16));
        let ones = _mm256_min_epi32(ones, _mm256_set1_epi32(65_520));
        let rest = _mm256_or_si256(
            _mm256_slli_epi32::<16>(seen),
            _mm256_slli_epi32::<24>(load(&mixed.checks)),
        );
        store(_mm256_or_si256(ones, rest))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::work::Baseline;
    #[cfg(target_arch = "x86_64")]
    use proptest::prelude::*;

    #[cfg(target_arch = "x86_64")]
    fn an_entry() -> impl Strategy<Value = u32> {
        (16u32..=65_520, 0..=MOST as u32, 0u32..4).prop_map(|(one, seen, check)| one | seen << 16 | check << 24)
    }

    #[cfg(target_arch = "x86_64")]
    proptest! {
        #[test]
        fn avx2_mixes_and_learns_as_plain_code_does(
            entries in prop::array::uniform5(an_entry()),
            checks in prop::array::uniform5((0u32..4, any::<u32>()).prop_map(|(check, more)| check | more << 8)),
            logit in -720i32..=720,
            weights in prop::array::uniform7(-HEAVIEST..=HEAVIEST),
            bit: bool,
            one in 1i32..65536,
            first in 1i32..65536,
        ) {
            let Some(avx2) = crate::work::Avx2::here() else {
                return Ok(());
            };
            let stretch: [i16; 4096] = std::array::from_fn(|i| (i as i16 - 2048) / 3);
            let [a, b, c, d, e, f, g] = weights;
            let weights = [a, b, c, d, e, f, g, 0];
            let truth = if bit { 65536 } else { 0 };
            let [mixed, plain] = [
                mix(avx2, entries, checks, [logit, 20], &stretch, &weights),
                mix(Baseline, entries, checks, [logit, 20], &stretch, &weights),
            ];
            prop_assert_eq!(mixed.sum, plain.sum);
            let (mut learned, mut expected) = (weights, weights);
            let entries = learn(avx2, &mixed, truth - one, [truth, first], &mut learned);
            prop_assert_eq!(entries, learn(Baseline, &plain, truth - one, [truth, first], &mut expected));
            prop_assert_eq!(learned, expected);
        }
    }

    fn every_count_gives_its_trust_and_its_rate_with<I: Instructions>(instructions: I) {
        for seen in 0..=MOST {
            let entry = 65_520 | (seen as u32) << 16;
            let mut weights = [0, 0, 0, 0, 1, 0, 0, 0];
            let (entries, checks) = ([entry; CONTEXTS], [0; CONTEXTS]);
            let mixed = mix(instructions, entries, checks, [-256, 0], &[0; 4096], &weights);
            assert_eq!(mixed.sum, 1024 * seen / (4 * seen + 1));
            let next = learn(instructions, &mixed, 0, [0, 16384], &mut weights)[4];
            let (one, count) = (if seen == 0 { 16384 } else { 65_520 }, (seen + 1).min(MOST));
            let expected = one + ((-one * (65536 / (4 * count + 1))) >> 14);
            assert_eq!(next, (expected.max(16) | count << 16) as u32);
        }
    }

    #[test]
    fn every_count_gives_its_trust_and_its_rate() {
        every_count_gives_its_trust_and_its_rate_with(Baseline);
        #[cfg(target_arch = "x86_64")]
        if let Some(avx2) = crate::work::Avx2::here() {
            every_count_gives_its_trust_and_its_rate_with(avx2);
        }
    }
}
