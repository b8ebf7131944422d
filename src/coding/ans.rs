//! The coder: a range asymmetric numeral system (Duda, [arXiv 1311.2540](https://arxiv.org/abs/1311.2540)) with a state of 64 bits
//! and words of 32. What is put on last comes off first.

/// Probabilities are in units of 2⁻¹⁶.
pub(crate) const PRECISION: u32 = 16;

/// The part `start..start + size` of 0..2¹⁶ that stands for a symbol; `size` is neither 0 nor 2¹⁶.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Interval {
    pub start: u16,
    pub size: u16,
}

/// One of two symbols that are equally likely.
const HALF: u16 = 1 << (PRECISION - 1);

/// Symbols, one on the other.
#[derive(Debug, Clone)]
pub(crate) struct Stack {
    /// At least 2³², unless the words were used up.
    state: u64,
    /// The next to be read is the last.
    words: Vec<u32>,
}

impl Stack {
    pub fn new(state: u64, words: Vec<u32>) -> Stack {
        Stack { state, words }
    }

    pub fn into_parts(self) -> (u64, Vec<u32>) {
        (self.state, self.words)
    }

    #[inline]
    pub fn push(&mut self, Interval { start, size }: Interval) {
        let size = u64::from(size);
        // Else the state would outgrow its 64 bits.
        if self.state >> (u64::BITS - PRECISION) >= size {
            self.words.push(self.state as u32);
            self.state >>= u32::BITS;
        }
        self.state = (self.state / size) << PRECISION | (self.state % size + u64::from(start));
    }

    /// Takes off the symbol whose interval `find` names, the one that the number it is given lies in.
    #[inline]
    pub fn pop<T>(&mut self, find: impl FnOnce(u16) -> (T, Interval)) -> T {
        let quantile = self.state as u16;
        let (symbol, Interval { start, size }) = find(quantile);
        self.state = (self.state >> PRECISION) * u64::from(size) + u64::from(quantile.wrapping_sub(start));
        if self.state >> u32::BITS == 0
            && let Some(word) = self.words.pop()
        {
            self.state = self.state << u32::BITS | u64::from(word);
        }
        symbol
    }

    pub fn push_bit(&mut self, bit: bool) {
        let start = if bit { HALF } else { 0 };
        self.push(Interval { start, size: HALF });
    }

    pub fn pop_bit(&mut self) -> bool {
        self.pop(|quantile| {
            let bit = quantile >= HALF;
            let start = if bit { HALF } else { 0 };
            (bit, Interval { start, size: HALF })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use constriction::stream::model::{DecoderModel, EncoderModel, EntropyModel, UniformModel};
    use constriction::stream::stack::AnsCoder;
    use constriction::stream::{Decode, Encode};
    use proptest::prelude::*;
    use std::borrow::Borrow;
    use std::num::NonZeroU16;

    const BITS: usize = PRECISION as usize;

    /// The symbol of one interval, or another.
    #[derive(Clone, Copy)]
    struct Lone(Interval);

    impl EntropyModel<BITS> for Lone {
        type Symbol = bool;
        type Probability = u16;
    }

    impl EncoderModel<BITS> for Lone {
        fn left_cumulative_and_probability(&self, _: impl Borrow<bool>) -> Option<(u16, NonZeroU16)> {
            Some((self.0.start, NonZeroU16::new(self.0.size)?))
        }
    }

    impl DecoderModel<BITS> for Lone {
        fn quantile_function(&self, quantile: u16) -> (bool, u16, NonZeroU16) {
            let (inside, Interval { start, size }) = self.0.find(quantile);
            (inside, start, NonZeroU16::new(size).expect("not empty"))
        }
    }

    impl Interval {
        /// Whether the number lies within, and the interval that it lies in: this, what is below, or what is above.
        fn find(self, quantile: u16) -> (bool, Interval) {
            let Interval { start, size } = self;
            let end = start.wrapping_add(size);
            if quantile < start {
                (false, Interval { start: 0, size: start })
            } else if quantile - start < size {
                (true, self)
            } else {
                (
                    false,
                    Interval {
                        start: end,
                        size: 0u16.wrapping_sub(end),
                    },
                )
            }
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
                stack.push(*interval);
                stack.push_bit(interval.start % 3 == 0);
            }
            for interval in pushed.iter().rev() {
                prop_assert_eq!(stack.pop_bit(), interval.start % 3 == 0);
                prop_assert!(stack.pop(|quantile| interval.find(quantile)));
            }
            prop_assert_eq!(stack.into_parts(), (state, vec![]));
        }

        #[test]
        fn another_implementation_makes_the_same_words_and_reads_them_alike(
            pushed in intervals(), state in 1u64 << 32.., others in intervals()
        ) {
            let mut ours = Stack::new(state, Vec::new());
            let mut theirs = AnsCoder::<u32, u64>::from_raw_parts(Vec::new(), state);
            let bit = UniformModel::<u16, BITS>::new(2);
            for interval in &pushed {
                ours.push(*interval);
                theirs.encode_symbol(true, Lone(*interval)).unwrap();
                ours.push_bit(interval.size % 2 == 0);
                theirs.encode_symbol(usize::from(interval.size % 2 == 0), bit).unwrap();
            }
            prop_assert_eq!(ours.clone().into_parts(), {
                let (words, state) = theirs.clone().into_raw_parts();
                (state, words)
            });
            // Under intervals that these are not, beyond the end as well.
            for interval in &others {
                let found = ours.pop(|quantile| interval.find(quantile));
                prop_assert_eq!(Ok(found), theirs.decode_symbol(Lone(*interval)));
            }
            prop_assert_eq!(ours.into_parts(), {
                let (words, state) = theirs.into_raw_parts();
                (state, words)
            });
        }
    }
}
