//! What a slice has shown so far, context by context, and how far to trust it beside the network.
//!
//! # Memory
//! Each context (`surroundings`) has a table of its own. With `n` parents in the slice, a table has 2ᵇ entries, 2ᵇ the least power of two of at least n, but at
//! least 16; a hash `h` has the entry `h >> (64 − b)`, and the check `h & 255`. An entry holds a check, how often its context was *seen*, and `one`, the
//! probability of a 1 in units of 2⁻¹⁶. An entry that was never used, or has another check, begins anew when it is met: seen 0 times.
//!
//! # Prediction
//! Logits are in units of 1/64. From the network's `s` seven inputs: `s` itself, 20, and for each context
//! `((stretch(one) − s)·⌊1024·seen / (4·seen + 1)⌋) >> 8`, which is 0 for what was never seen. Their products with seven weights are summed (`i32`, wrapping); the
//! logit is the sum `>> 16`, the probability `squash` of it. Weights start with 65536, 0, and five of 9830.
//!
//! # Learning
//! With `error = 65536·bit − probability`, each weight grows by `(3·error·input + 32768) >> 16`, and stays within ±131072. In the entry of each context, `one`, if it was never seen, first is the probability of
//! the network alone; then `seen` grows by 1, to 30 at most, and `one` by `((65536·bit − one)·⌊65536 / (4·seen + 1)⌋) >> 14`, within 16 to 65520.
//! All shifts of negative numbers round down.

use crate::coding::ONE;
use crate::coding::probability::{STRETCH, squash};
use b2p_kernels::Instructions;
use b2p_kernels::mixing::{self, CONTEXTS, Lanes, OTHERS};

/// The input that is always the same.
const BIAS: i32 = 20;

/// What a slice has shown, and the weights of it.
#[derive(Debug)]
pub(super) struct Mixer<I> {
    instructions: I,
    tables: Vec<u32>,
    /// Entries of a table are 2 to this.
    bits: u32,
    weights: Lanes,
}

/// One prediction, to be learned from.
#[derive(Debug)]
pub(super) struct Mixed {
    /// Where the entries of its contexts lie.
    at: [usize; CONTEXTS],
    mixed: mixing::Mixed,
    /// The probability of a 1.
    pub one: u32,
}

impl<I: Instructions> Mixer<I> {
    /// That of a slice of so many parents.
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

    /// What to expect in these contexts, if the network's logit is `logit`.
    #[inline(always)]
    pub fn predict(&self, logit: i32, contexts: [u64; CONTEXTS]) -> Mixed {
        // Loops: `map` becomes a call.
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

    /// Learns what it was; `network` is the probability that the network gave alone.
    #[inline(always)]
    pub fn learn(&mut self, mixed: &Mixed, network: u32, bit: bool) {
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

    /// What a bit costs, in bits.
    fn cost(one: u32, bit: bool) -> f64 {
        let one = f64::from(one) / 65536.0;
        -(if bit { one } else { 1.0 - one }).log2()
    }

    /// Bits per decision that a network without a clue and one with the mixer behind it take, where the first context tells all but `noise` in 100.
    fn costs(noise: u64, network: i32) -> [f64; 2] {
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
            sums[0] += cost(squash(network), bit);
            sums[1] += cost(mixed.one, bit);
            mixer.learn(&mixed, squash(network), bit);
        }
        sums.map(|sum| sum / 4000.0)
    }

    #[test]
    fn what_one_context_tells_is_learned_though_the_others_are_noise() {
        for (noise, network) in [(0, 0), (0, -300), (5, 0), (5, 100)] {
            let [network, mixed] = costs(noise, network);
            assert!(mixed < 0.55 * network, "{mixed} instead of {network}");
        }
    }

    #[test]
    fn where_contexts_tell_nothing_the_network_is_believed() {
        let [network, mixed] = costs(50, 0);
        assert!(mixed < 1.02 * network, "{mixed} instead of {network}");
    }

    #[test]
    fn nothing_seen_changes_nothing() {
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
            mixer.learn(&mixed, squash(logit), i % 2 == 0);
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
