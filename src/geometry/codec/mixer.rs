//! Context mixing: combines the network's logit with adaptive contexts (`docs/format.md`, clause 4.7).
//!
//! # Tables
//! Each context has a hash table of its own. With `n` parents in the slice, a table has 2ᵇ entries: the least power of
//! two that is at least n and at least 16. A hash `h` selects the entry `h >> (64 − b)` and has the check `h & 255`. An
//! entry holds a check, a count `seen`, and `one`, the probability of a 1 in units of 2⁻¹⁶. An unused entry, or one
//! with another check, counts as new: `seen = 0`.
//!
//! # Prediction
//! Logits are in units of 1/64. The seven inputs are the network's logit `s`, the constant 20, and for each context
//! `((stretch(one) − s)·⌊1024·seen / (4·seen + 1)⌋) >> 8`, which is 0 for a new entry. The mixed logit is the sum of
//! inputs times weights (`i32`, wrapping), `>> 16`; the probability is `squash` of it. The initial weights are 65536,
//! 0, and 9830 for each context.
//!
//! # Adaptation
//! With `error = 65536·bit − probability`, each weight grows by `(3·error·input + 32768) >> 16`, clamped to ±131072. In
//! the entry of each context, a new `one` first becomes the probability of the network alone. Then `seen` grows by 1,
//! to 30 at most, and `one` by `((65536·bit − one)·⌊65536 / (4·seen + 1)⌋) >> 14`, clamped to 16..=65520. All shifts of
//! negative numbers round down.

use crate::coding::ONE;
use crate::coding::probability::{LIMIT, STRETCH, squash};
use b2p_kernels::Instructions;
use b2p_kernels::mixing::{self, CONTEXTS, Lanes, OTHERS};

/// The constant input.
const BIAS: i32 = 20;

/// Mixer of one slice: context tables and weights.
#[derive(Debug)]
pub(super) struct Mixer<I> {
    instructions: I,
    tables: Vec<u32>,
    /// Binary logarithm of the number of entries of a table.
    bits: u32,
    weights: Lanes,
}

/// One prediction, with what [`Mixer::adapt`] needs afterwards.
#[derive(Debug)]
pub(super) struct Mixed {
    /// Index of each context's entry.
    at: [usize; CONTEXTS],
    mixed: mixing::Mixed,
    /// Probability of a 1 in units of 2⁻¹⁶.
    pub one: u32,
}

impl Mixed {
    /// The logit of the prediction.
    pub fn logit(&self) -> i32 {
        (self.mixed.sum >> 16).clamp(-LIMIT, LIMIT)
    }
}

impl<I: Instructions> Mixer<I> {
    /// The initial mixer of a slice of `parents` parents.
    pub fn new(instructions: I, parents: usize) -> Self {
        let entries = parents.next_power_of_two().max(16);
        let mut weights = [0; 8];
        weights[..CONTEXTS].fill(9830);
        weights[OTHERS[0]] = 1 << 16;
        Mixer {
            instructions,
            tables: vec![0; CONTEXTS * entries],
            bits: entries.ilog2(),
            weights,
        }
    }

    /// Predicts a decision with the context hashes `contexts`. `logit` is the network's prediction.
    #[inline(always)]
    pub fn predict(&self, logit: i32, contexts: [u64; CONTEXTS]) -> Mixed {
        // A loop, since the compiler does not inline `map` here.
        let (mut at, mut entries, mut checks) = ([0; CONTEXTS], [0; CONTEXTS], [0; CONTEXTS]);
        for (i, hash) in contexts.into_iter().enumerate() {
            at[i] = i << self.bits | (hash >> (u64::BITS - self.bits)) as usize;
            entries[i] = self.tables[at[i]];
            checks[i] = hash as u32;
        }
        let inputs = [logit, BIAS];
        let mixed = mixing::mix(self.instructions, entries, checks, inputs, &STRETCH, &self.weights);
        let one = squash(mixed.sum >> 16);
        Mixed { at, mixed, one }
    }

    /// Adapts weights and entries to the coded `bit`. `network` is the probability predicted by the network alone.
    #[inline(always)]
    pub fn adapt(&mut self, mixed: &Mixed, network: u32, bit: bool) {
        let truth = if bit { ONE as i32 } else { 0 };
        let (error, truths) = (truth - mixed.one as i32, [truth, network as i32]);
        let weights = &mut self.weights;
        let entries = mixing::learn(self.instructions, &mixed.mixed, error, truths, weights);
        for (at, entry) in mixed.at.into_iter().zip(entries) {
            self.tables[at] = entry;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Random;
    use b2p_kernels::Scalar;
    use b2p_kernels::mixing::HEAVIEST;

    /// Code length of a bit, in bits.
    fn code_length(one: u32, bit: bool) -> f64 {
        let one = f64::from(one) / 65536.0;
        -(if bit { one } else { 1.0 - one }).log2()
    }

    /// Mean code length of a decision for an uninformed network alone, and with the mixer. The first context determines
    /// the bit but for noise of `noise` percent.
    fn code_lengths(noise: u64, network: i32) -> [f64; 2] {
        let (mut mixer, mut random) = (Mixer::new(Scalar::TOKEN, 1 << 12), Random(5));
        let mut sums = [0.0; 2];
        for _ in 0..4000 {
            let context = random.next() % 64;
            let flip = random.next() % 100 < noise;
            let bit = (context % 3 == 0) != flip;
            let mut contexts: [u64; CONTEXTS] = std::array::from_fn(|_| random.next());
            contexts[0] = context << 58 | 7;
            let mixed = mixer.predict(network, contexts);
            assert!((1..ONE).contains(&mixed.one));
            sums[0] += code_length(squash(network), bit);
            sums[1] += code_length(mixed.one, bit);
            mixer.adapt(&mixed, squash(network), bit);
        }
        sums.map(|sum| sum / 4000.0)
    }

    #[test]
    fn one_informative_context_among_noise_is_learned() {
        for (noise, network) in [(0, 0), (0, -300), (5, 0), (5, 100)] {
            let [network, mixed] = code_lengths(noise, network);
            assert!(mixed < 0.55 * network, "{mixed} instead of {network}");
        }
    }

    #[test]
    fn uninformative_contexts_leave_the_network_unchanged() {
        let [network, mixed] = code_lengths(50, 0);
        assert!(mixed < 1.02 * network, "{mixed} instead of {network}");
    }

    #[test]
    fn new_entries_do_not_change_the_network() {
        let mixer = Mixer::new(Scalar::TOKEN, 1);
        for logit in [-384, -1, 0, 77] {
            assert_eq!(mixer.predict(logit, [3; CONTEXTS]).one, squash(logit));
        }
    }

    #[test]
    fn extremes_stay_within_their_ranges() {
        let mut mixer = Mixer::new(Scalar::TOKEN, 4);
        for i in 0..5000u64 {
            let logit = if i % 2 == 0 { -720 } else { 720 };
            let mixed = mixer.predict(logit, [(i % 3) << 60; CONTEXTS]);
            mixer.adapt(&mixed, squash(logit), i % 2 == 0);
            assert!(mixer.weights.iter().all(|w| w.abs() <= HEAVIEST));
            assert!(
                mixer
                    .tables
                    .iter()
                    .all(|e| e >> 16 & 255 == 0 || (16..=65_520).contains(&(e & 0xffff)))
            );
        }
    }

    #[test]
    fn tables_grow_with_the_slice() {
        for (parents, bits) in [(1, 4), (16, 4), (17, 5), (16_384, 14)] {
            let mixer = Mixer::new(Scalar::TOKEN, parents);
            assert_eq!((mixer.bits, mixer.tables.len()), (bits, CONTEXTS << bits));
        }
    }
}
