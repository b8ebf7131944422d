//! Binary decisions through constriction's range coder.
//!
//! The coder is [`constriction::stream::queue`] with words of 32 bits, a state of 64 bits and probabilities of 16 bits.
//! A decision that is 1 with probability `one / 65536` splits the interval at `65536 − one`: below lies 0, above 1.
//! Words are little-endian.

#[cfg(feature = "encoder")]
use std::borrow::Borrow;
#[cfg(feature = "encoder")]
use std::num::NonZeroU16;

#[cfg(feature = "encoder")]
use constriction::stream::Encode;
#[cfg(feature = "encoder")]
use constriction::stream::model::{EncoderModel, EntropyModel};
#[cfg(feature = "encoder")]
use constriction::stream::queue::RangeEncoder;

use super::ONE;
use crate::error::{Error, Result, Stage};

const PRECISION: usize = 16;
/// Words that a decoder may read beyond the last one: its state holds two.
const LOOKAHEAD: usize = 2;

/// Codes decisions, one way or the other.
pub(crate) trait Coder {
    /// Codes a decision that is 1 with probability `one / 65536`, `one` in `1..=65535`. An encoder takes `bit` and
    /// returns it; a decoder returns what it reads, whatever `bit` is.
    fn code(&mut self, bit: bool, one: u32) -> bool;
}

/// The distribution of one decision.
#[cfg(feature = "encoder")]
#[derive(Clone, Copy)]
struct Decision(u16);

#[cfg(feature = "encoder")]
impl EntropyModel<PRECISION> for Decision {
    type Symbol = bool;
    type Probability = u16;
}

#[cfg(feature = "encoder")]
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

/// Reads decisions. Past the end it reads zeros, and [`Decoder::finish`] says so.
///
/// It reads what [`RangeDecoder`] reads (a test compares them), with a multiplication in place of its division.
///
/// [`RangeDecoder`]: constriction::stream::queue::RangeDecoder
#[derive(Debug)]
pub(crate) struct Decoder<'a> {
    bytes: &'a [u8],
    /// Number of words read, those past the end included.
    read: usize,
    /// `point − lower` of the format, always below `range`.
    offset: u64,
    range: u64,
    damaged: bool,
}

impl<'a> Decoder<'a> {
    /// Reads `bytes`.
    pub fn new(bytes: &'a [u8]) -> Self {
        let mut decoder = Decoder {
            bytes,
            read: 0,
            offset: 0,
            range: u64::MAX,
            damaged: false,
        };
        decoder.offset = decoder.word() << 32;
        decoder.offset |= decoder.word();
        decoder
    }

    /// The next word, little-endian.
    #[inline(always)]
    fn word(&mut self) -> u64 {
        let word = self.bytes.get(4 * self.read..).and_then(|rest| rest.first_chunk());
        self.read += 1;
        word.map_or(0, |word| u32::from_le_bytes(*word)).into()
    }

    /// Sees that everything was read, and no more.
    ///
    /// # Errors
    /// [`Error::Malformed`] if not, with `at` as the place.
    pub fn finish(self, at: &str) -> Result<()> {
        let (words, read) = (self.bytes.len().div_ceil(4), self.read);
        let whole = self.bytes.len().is_multiple_of(4);
        if whole && self.damaged {
            let (field, value) = ("quantile of the range coder", "65536 or more");
            return Err(Error::malformed(Stage::Colour, at, field, value, "less").breaks("5.4.2"));
        }
        if whole && (words..=words + LOOKAHEAD).contains(&read) {
            return Ok(());
        }
        let expected = format!("{} to {read} of 4 bytes", read.saturating_sub(LOOKAHEAD));
        Err(Error::malformed(Stage::Colour, at, "number of words", words, expected).breaks("5.4.3"))
    }
}

impl Coder for Decoder<'_> {
    #[inline(always)]
    fn code(&mut self, _: bool, one: u32) -> bool {
        debug_assert!(0 < one && one < ONE);
        let scale = self.range >> PRECISION;
        if self.offset >= scale << PRECISION {
            self.damaged = true;
            return false;
        }
        let zero = u64::from(ONE - one);
        let split = scale * zero;
        let bit = self.offset >= split;
        self.offset -= if bit { split } else { 0 };
        self.range = scale * if bit { one.into() } else { zero };
        if self.range < 1 << 32 {
            self.range <<= 32;
            self.offset = self.offset << 32 | self.word();
        }
        bit
    }
}

#[cfg(feature = "encoder")]
#[cfg(test)]
mod tests {
    use super::*;
    use constriction::stream::model::DecoderModel;
    use constriction::stream::{Decode, queue::RangeDecoder};
    use proptest::prelude::*;

    impl DecoderModel<PRECISION> for Decision {
        #[inline(always)]
        fn quantile_function(&self, quantile: u16) -> (bool, u16, NonZeroU16) {
            let bit = quantile >= self.0.wrapping_neg();
            let (start, size) = self.interval(bit);
            (bit, start, size)
        }
    }

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

    #[test]
    fn a_range_of_32_bits_is_widened_and_one_more_is_not() {
        // With a range of 2^48 a decision of the least probability, 2^-16, leaves 2^32.
        let after = |range: u64, offset: u64| {
            let mut decoder = Decoder {
                bytes: &[1, 2, 3, 4],
                read: 0,
                offset,
                range,
                damaged: false,
            };
            let bit = decoder.code(false, 1);
            (bit, decoder.range, decoder.offset, decoder.read, decoder.damaged)
        };
        let first = 0xffff << 32;
        assert_eq!(after(1 << 48, first + 5), (true, 1 << 32, 5, 0, false));
        let scale = (1 << 32) - 1;
        let widened = (true, scale << 32, 5 << 32 | 0x0403_0201, 1, false);
        assert_eq!(after((1 << 48) - 1, scale * 0xffff + 5), widened);
        // The last place that is no decision's.
        assert_eq!(after(1 << 48, (1 << 48) - 1), (true, 1 << 32, (1 << 32) - 1, 0, false));
        assert!(after((1 << 48) + 1, 1 << 48).4);
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
        fn any_words_decode_as_constriction_decodes_them(
            words in prop::collection::vec(any::<u32>(), 0..16), decisions in decisions()
        ) {
            let bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
            let mut reference = RangeDecoder::<u32, u64, _>::from_compressed(words).unwrap();
            let mut decoder = Decoder::new(&bytes);
            for (_, one) in decisions {
                let bit = decoder.code(false, one);
                match reference.decode_symbol(Decision(one as u16)) {
                    Ok(expected) => prop_assert_eq!(bit, expected),
                    Err(_) => {
                        prop_assert!(decoder.damaged);
                        break;
                    }
                }
            }
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
