//! The coder of version 2's symbols: constriction's range asymmetric numeral system
//! ([`constriction::stream::stack`]; Duda, [arXiv 1311.2540](https://arxiv.org/abs/1311.2540)) with a state of
//! 64 bits, words of 32 bits and probabilities of 16 bits. The last symbol encoded is the first decoded.

use std::borrow::Borrow;
use std::num::NonZeroU16;

use constriction::stream::model::{DecoderModel, EncoderModel, EntropyModel};
use constriction::stream::stack::AnsCoder;
use constriction::stream::{Decode, Encode};

/// Probabilities are in units of 2⁻¹⁶.
pub(crate) const PRECISION: u32 = 16;

/// The same, as constriction's types take it.
pub(crate) const BITS: usize = PRECISION as usize;

/// The part `start..start + size` of 0..2¹⁶ that stands for a symbol; `size` is neither 0 nor 2¹⁶.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Interval {
    pub start: u16,
    pub size: u16,
}

impl Interval {
    /// Start and size as constriction's models give them.
    #[inline(always)]
    pub fn parts(self) -> (u16, NonZeroU16) {
        debug_assert!(self.size != 0, "no symbol is impossible");
        (self.start, NonZeroU16::new(self.size).unwrap_or(NonZeroU16::MIN))
    }
}

/// The one symbol that the interval stands for.
impl EntropyModel<BITS> for Interval {
    type Symbol = ();
    type Probability = u16;
}

impl EncoderModel<BITS> for Interval {
    #[inline(always)]
    fn left_cumulative_and_probability(&self, _: impl Borrow<()>) -> Option<(u16, NonZeroU16)> {
        Some(self.parts())
    }
}

/// Two symbols that are equally likely.
#[derive(Debug, Clone, Copy)]
struct Even;

impl EntropyModel<BITS> for Even {
    type Symbol = bool;
    type Probability = u16;
}

impl Even {
    const HALF: NonZeroU16 = NonZeroU16::new(1 << (PRECISION - 1)).unwrap();

    #[inline(always)]
    fn start(bit: bool) -> u16 {
        if bit { Self::HALF.get() } else { 0 }
    }
}

impl EncoderModel<BITS> for Even {
    #[inline(always)]
    fn left_cumulative_and_probability(&self, bit: impl Borrow<bool>) -> Option<(u16, NonZeroU16)> {
        Some((Self::start(*bit.borrow()), Self::HALF))
    }
}

impl DecoderModel<BITS> for Even {
    #[inline(always)]
    fn quantile_function(&self, quantile: u16) -> (bool, u16, NonZeroU16) {
        let bit = quantile >= Self::HALF.get();
        (bit, Self::start(bit), Self::HALF)
    }
}

/// A stack of symbols in memory. Reading past its end gives symbols, too: who reads compares the final state.
#[derive(Debug, Clone)]
pub(crate) struct Stack(AnsCoder<u32, u64>);

impl Stack {
    /// A coder in this state, at least 2³², over these words, of which the last is read first.
    pub fn new(state: u64, words: Vec<u32>) -> Stack {
        Stack(AnsCoder::from_raw_parts(words, state))
    }

    /// State and words.
    pub fn into_parts(self) -> (u64, Vec<u32>) {
        let (words, state) = self.0.into_raw_parts();
        (state, words)
    }

    /// Encodes a symbol that the model has an interval for.
    #[inline]
    pub fn push<M>(&mut self, symbol: M::Symbol, model: M)
    where
        M: EncoderModel<BITS, Probability = u16>,
    {
        // Writing to memory does not fail, and our models have an interval for each symbol they are given.
        let written = self.0.encode_symbol(symbol, model);
        debug_assert!(written.is_ok());
    }

    /// Decodes a symbol.
    #[inline]
    pub fn pop<M>(&mut self, model: M) -> M::Symbol
    where
        M: DecoderModel<BITS, Probability = u16>,
    {
        let Ok(symbol) = self.0.decode_symbol(model);
        symbol
    }

    /// Encodes one of two equally likely symbols.
    pub fn push_bit(&mut self, bit: bool) {
        self.push(bit, Even);
    }

    /// Decodes one of two equally likely symbols.
    pub fn pop_bit(&mut self) -> bool {
        self.pop(Even)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The coder as the format defines it, written out.
    #[derive(Clone)]
    struct Definition {
        state: u64,
        words: Vec<u32>,
    }

    impl Definition {
        fn push(&mut self, Interval { start, size }: Interval) {
            let size = u64::from(size);
            // Else the state would outgrow its 64 bits.
            if self.state >> (u64::BITS - PRECISION) >= size {
                self.words.push(self.state as u32);
                self.state >>= u32::BITS;
            }
            self.state = (self.state / size) << PRECISION | (self.state % size + u64::from(start));
        }

        /// Decodes the symbol whose interval `find` gives for a quantile.
        fn pop<T>(&mut self, find: impl FnOnce(u16) -> (T, Interval)) -> T {
            let quantile = self.state as u16;
            let (symbol, Interval { start, size }) = find(quantile);
            self.state = (self.state >> PRECISION) * u64::from(size) + u64::from(quantile - start);
            if self.state >> u32::BITS == 0
                && let Some(word) = self.words.pop()
            {
                self.state = self.state << u32::BITS | u64::from(word);
            }
            symbol
        }

        fn push_bit(&mut self, bit: bool) {
            let start = if bit { 1 << 15 } else { 0 };
            self.push(Interval { start, size: 1 << 15 });
        }

        fn into_parts(self) -> (u64, Vec<u32>) {
            (self.state, self.words)
        }
    }

    impl Interval {
        /// Whether the quantile lies within, and the interval that it lies in: this, what is below, or what is above.
        fn find(self, quantile: u16) -> (bool, Interval) {
            let Interval { start, size } = self;
            let end = start.wrapping_add(size);
            if quantile < start {
                (false, Interval { start: 0, size: start })
            } else if quantile - start < size {
                (true, self)
            } else {
                let size = 0u16.wrapping_sub(end);
                (false, Interval { start: end, size })
            }
        }
    }

    /// Whether a quantile lies in one interval.
    #[derive(Clone, Copy)]
    struct Within(Interval);

    impl EntropyModel<BITS> for Within {
        type Symbol = bool;
        type Probability = u16;
    }

    impl DecoderModel<BITS> for Within {
        fn quantile_function(&self, quantile: u16) -> (bool, u16, NonZeroU16) {
            let (inside, interval) = self.0.find(quantile);
            let (start, size) = interval.parts();
            (inside, start, size)
        }
    }

    fn intervals() -> impl Strategy<Value = Vec<Interval>> {
        let one = (any::<u16>(), any::<u16>()).prop_map(|(a, b)| {
            let (start, last) = (a.min(b), a.max(b));
            let size = (last - start).saturating_add(1);
            Interval { start, size }
        });
        let extreme = prop_oneof![
            Just(Interval { start: 0, size: 1 }),
            Just(Interval {
                start: u16::MAX,
                size: 1
            }),
            Just(Interval {
                start: 0,
                size: u16::MAX
            }),
            Just(Interval {
                start: 1,
                size: u16::MAX
            }),
        ];
        prop::collection::vec(prop_oneof![4 => one, 1 => extreme], 0..300)
    }

    proptest! {
        #[test]
        fn what_was_put_on_comes_off(pushed in intervals(), state in 1u64 << 32..) {
            let mut stack = Stack::new(state, Vec::new());
            for interval in &pushed {
                stack.push((), *interval);
                stack.push_bit(interval.start % 3 == 0);
            }
            for interval in pushed.iter().rev() {
                prop_assert_eq!(stack.pop_bit(), interval.start % 3 == 0);
                prop_assert!(stack.pop(Within(*interval)));
            }
            prop_assert_eq!(stack.into_parts(), (state, vec![]));
        }

        #[test]
        fn the_definition_written_out_makes_the_same_words_and_reads_them_alike(
            pushed in intervals(), state in 1u64 << 32.., others in intervals()
        ) {
            let mut stack = Stack::new(state, Vec::new());
            let mut definition = Definition { state, words: Vec::new() };
            for interval in &pushed {
                stack.push((), *interval);
                definition.push(*interval);
                stack.push_bit(interval.size % 2 == 0);
                definition.push_bit(interval.size % 2 == 0);
            }
            prop_assert_eq!(stack.clone().into_parts(), definition.clone().into_parts());
            // Under intervals that these are not, beyond the end as well.
            for interval in &others {
                let found = stack.pop(Within(*interval));
                prop_assert_eq!(found, definition.pop(|quantile| interval.find(quantile)));
            }
            prop_assert_eq!(stack.into_parts(), definition.into_parts());
        }
    }
}
