//! Binary decisions through constriction's range coder.
//!
//! The coder is [`constriction::stream::queue`] with words of 32 bits, a state of 64 bits and probabilities of 16 bits. A decision that is 1
//! with probability `one / 65536` splits the interval at `65536 − one`: below lies 0, above 1. Words are little-endian.

#[cfg(feature = "encoder")]
use std::borrow::Borrow;
use std::convert::Infallible;
use std::num::NonZeroU16;

use constriction::Queue;
use constriction::backends::ReadWords;
#[cfg(feature = "encoder")]
use constriction::stream::Encode;
#[cfg(feature = "encoder")]
use constriction::stream::model::EncoderModel;
use constriction::stream::model::{DecoderModel, EntropyModel};
#[cfg(feature = "encoder")]
use constriction::stream::queue::RangeEncoder;
use constriction::stream::{Decode, queue::RangeDecoder};

use super::ONE;
use crate::error::{Error, Result, Stage};

const PRECISION: usize = 16;
/// Words that a decoder may read beyond the last one: its state holds two.
const LOOKAHEAD: usize = 2;

/// Codes decisions, one way or the other.
pub(crate) trait Coder {
    /// Codes a decision that is 1 with probability `one / 65536`, `one` in `1..=65535`. An encoder takes `bit` and returns it; a decoder
    /// returns what it reads, whatever `bit` is.
    fn code(&mut self, bit: bool, one: u32) -> bool;
}

/// The distribution of one decision.
#[derive(Clone, Copy)]
struct Decision(u16);

impl EntropyModel<PRECISION> for Decision {
    type Symbol = bool;
    type Probability = u16;
}

impl Decision {
    #[inline(always)]
    fn interval(self, bit: bool) -> (u16, NonZeroU16) {
        let (start, size) = match bit {
            true => (self.0.wrapping_neg(), self.0),
            false => (0, self.0.wrapping_neg()),
        };
        (start, NonZeroU16::new(size).unwrap_or(NonZeroU16::MIN))
    }
}

#[cfg(feature = "encoder")]
impl EncoderModel<PRECISION> for Decision {
    #[inline(always)]
    fn left_cumulative_and_probability(&self, bit: impl Borrow<bool>) -> Option<(u16, NonZeroU16)> {
        Some(self.interval(*bit.borrow()))
    }
}

impl DecoderModel<PRECISION> for Decision {
    #[inline(always)]
    fn quantile_function(&self, quantile: u16) -> (bool, u16, NonZeroU16) {
        let bit = quantile >= self.0.wrapping_neg();
        let (start, size) = self.interval(bit);
        (bit, start, size)
    }
}

/// Writes decisions.
#[cfg(feature = "encoder")]
#[derive(Debug, Default)]
pub(crate) struct Encoder(RangeEncoder<u32, u64>);

#[cfg(feature = "encoder")]
impl Encoder {
    /// The bytes.
    pub fn finish(self) -> Vec<u8> {
        let Ok(words) = self.0.into_compressed();
        words.into_iter().flat_map(u32::to_le_bytes).collect()
    }
}

#[cfg(feature = "encoder")]
impl Coder for Encoder {
    #[inline(always)]
    fn code(&mut self, bit: bool, one: u32) -> bool {
        debug_assert!(0 < one && one < ONE);
        // Writing to memory does not fail, and no decision is impossible.
        let written = self.0.encode_symbol(bit, Decision(one as u16));
        debug_assert!(written.is_ok());
        bit
    }
}

/// Little-endian words; zeros after the last.
#[derive(Debug)]
struct Words<'a> {
    bytes: &'a [u8],
    next: usize,
}

impl ReadWords<u32, Queue> for Words<'_> {
    type ReadError = Infallible;

    #[inline(always)]
    fn read(&mut self) -> Result<Option<u32>, Infallible> {
        let word = self.bytes.get(4 * self.next..).and_then(|rest| rest.first_chunk());
        self.next += 1;
        Ok(Some(word.map_or(0, |word| u32::from_le_bytes(*word))))
    }

    fn maybe_exhausted(&self) -> bool {
        4 * self.next >= self.bytes.len()
    }
}

/// Reads decisions. Past the end it reads zeros, and [`Decoder::finish`] says so.
#[derive(Debug)]
pub(crate) struct Decoder<'a> {
    coder: RangeDecoder<u32, u64, Words<'a>>,
    words: usize,
    damaged: bool,
}

impl<'a> Decoder<'a> {
    /// Reads `bytes`.
    pub fn new(bytes: &'a [u8]) -> Self {
        let Ok(coder) = RangeDecoder::with_backend(Words { bytes, next: 0 });
        Decoder {
            coder,
            words: bytes.len().div_ceil(4),
            damaged: !bytes.len().is_multiple_of(4),
        }
    }

    /// Sees that everything was read, and no more.
    ///
    /// # Errors
    /// [`Error::Malformed`] if not, with `at` as the place.
    pub fn finish(self, at: &str) -> Result<()> {
        let (Words { next: read, .. }, ..) = self.coder.into_raw_parts();
        if !self.damaged && (self.words..=self.words + LOOKAHEAD).contains(&read) {
            return Ok(());
        }
        let expected = format!("{} to {read} of 4 bytes", read.saturating_sub(LOOKAHEAD));
        Err(Error::malformed(
            Stage::Colour,
            at,
            "number of words",
            self.words,
            expected,
        ))
    }
}

impl Coder for Decoder<'_> {
    #[inline(always)]
    fn code(&mut self, _: bool, one: u32) -> bool {
        debug_assert!(0 < one && one < ONE);
        match self.coder.decode_symbol(Decision(one as u16)) {
            Ok(bit) => bit,
            Err(_) => {
                self.damaged = true;
                false
            }
        }
    }
}

#[cfg(feature = "encoder")]
#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn decisions() -> impl Strategy<Value = Vec<(bool, u32)>> {
        let one = prop_oneof![1..ONE, Just(1), Just(ONE - 1), Just(ONE / 2)];
        prop::collection::vec((any::<bool>(), one), 0..400)
    }

    fn encode(decisions: &[(bool, u32)]) -> Vec<u8> {
        let mut encoder = Encoder::default();
        for &(bit, one) in decisions {
            encoder.code(bit, one);
        }
        encoder.finish()
    }

    fn decode(bytes: &[u8], decisions: &[(bool, u32)]) -> Result<Vec<bool>> {
        let mut decoder = Decoder::new(bytes);
        let bits = decisions.iter().map(|&(_, one)| decoder.code(false, one));
        let bits = bits.collect();
        decoder.finish("a test")?;
        Ok(bits)
    }

    proptest! {
        #[test]
        fn what_was_written_is_read(decisions in decisions()) {
            let read = decode(&encode(&decisions), &decisions).unwrap();
            prop_assert!(read.iter().eq(decisions.iter().map(|(bit, _)| bit)));
        }

        #[test]
        fn a_word_too_many_or_half_a_word_too_few_is_noticed(decisions in decisions()) {
            let mut bytes = encode(&decisions);
            if let Some(short) = bytes.len().checked_sub(2) {
                prop_assert!(decode(&bytes[..short], &decisions).is_err());
            }
            bytes.extend([0; 12]);
            prop_assert!(decode(&bytes, &decisions).is_err());
        }

        #[test]
        fn any_bytes_decode_to_something_or_an_error(
            bytes in prop::collection::vec(any::<u8>(), 0..64), decisions in decisions()
        ) {
            let _ = decode(&bytes, &decisions);
        }
    }

    #[test]
    fn the_length_is_the_entropy() {
        let mut state = 1u32;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 16 < 6554, 6554)
        };
        let decisions: Vec<_> = (0..100_000).map(|_| next()).collect();
        let ones = decisions.iter().filter(|d| d.0).count() as f64;
        let p = 6554.0 / 65536.0f64;
        let entropy = -ones * p.log2() - (1e5 - ones) * (1.0 - p).log2();
        let length = 8.0 * encode(&decisions).len() as f64;
        assert!(entropy < length + 1.0 && length < 1.001 * entropy + 64.0);
    }
}
