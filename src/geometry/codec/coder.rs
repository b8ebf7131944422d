//! Carry-less binary arithmetic coder of 32 bits with byte-wise renormalisation (`docs/format.md`, clause 4.2).
//!
//! The state is an interval `low..=high` of `u32`, at first all of it. A bit that is 1 with probability `one / 65536`
//! splits it at `mid = low + ((high − low) · one >> 16)` (64-bit product): 1 keeps `low..=mid`, 0 keeps `mid+1..=high`.
//! Then, while the top bytes of `low` and `high` agree, that byte is emitted, and `low = low << 8`, `high = high << 8 |
//! 255`. The encoder ends with the four bytes of `low`, most significant first. The decoder keeps the 32 bits of the
//! input that correspond to the interval. It starts by reading four bytes, and reads one more for every byte that the
//! encoder emitted.
//!
//! So the decoder reads exactly the bytes that the encoder wrote, and its value ends equal to `low`. Every truncation
//! makes it read past the end. Other damage goes unnoticed only if the number of bytes and the last 32 bits both match.

use crate::coding::ONE;
use crate::error::{Error, Result, Stage};

/// Encodes or decodes bits.
pub(super) trait Coder {
    /// Codes a bit that is 1 with probability `one / 65536`, with `one` in `1..=65535`. An encoder writes `bit` and
    /// returns it. A decoder ignores `bit` and returns the bit that it read.
    fn code(&mut self, bit: bool, one: u32) -> bool;
}

#[derive(Debug, Clone, Copy)]
struct Interval {
    low: u32,
    high: u32,
}

impl Interval {
    const ALL: Interval = Interval { low: 0, high: u32::MAX };

    #[inline(always)]
    fn split(self, one: u32) -> u32 {
        debug_assert!(0 < one && one < ONE);
        let width = u64::from(self.high - self.low);
        self.low + ((width * u64::from(one)) >> 16) as u32
    }

    #[inline(always)]
    fn narrow(&mut self, bit: bool, mid: u32) {
        if bit {
            self.high = mid;
        } else {
            self.low = mid + 1;
        }
    }

    #[inline(always)]
    fn top_byte_is_settled(self) -> bool {
        (self.low ^ self.high) >> 24 == 0
    }

    #[inline(always)]
    fn shift(&mut self) {
        self.low <<= 8;
        self.high = self.high << 8 | 255;
    }
}

/// Encodes bits to bytes.
#[derive(Debug)]
pub(super) struct Encoder {
    interval: Interval,
    bytes: Vec<u8>,
}

impl Encoder {
    pub fn new() -> Self {
        Encoder {
            interval: Interval::ALL,
            bytes: Vec::new(),
        }
    }

    pub fn finish(mut self) -> Vec<u8> {
        self.bytes.extend(self.interval.low.to_be_bytes());
        self.bytes
    }
}

impl Coder for Encoder {
    #[inline(always)]
    fn code(&mut self, bit: bool, one: u32) -> bool {
        let mid = self.interval.split(one);
        self.interval.narrow(bit, mid);
        while self.interval.top_byte_is_settled() {
            self.bytes.push((self.interval.low >> 24) as u8);
            self.interval.shift();
        }
        bit
    }
}

/// Decodes bits from bytes. Bytes past the end read as zeros; [`Decoder::finish`] reports them.
#[derive(Debug)]
pub(super) struct Decoder<'a> {
    interval: Interval,
    value: u32,
    bytes: &'a [u8],
    next: usize,
    /// Byte offset of `bytes` in the stream.
    offset: usize,
}

impl<'a> Decoder<'a> {
    /// A decoder of `bytes`, which start at byte `offset` of the stream.
    pub fn new(bytes: &'a [u8], offset: usize) -> Self {
        let mut decoder = Decoder {
            interval: Interval::ALL,
            value: 0,
            bytes,
            next: 0,
            offset,
        };
        for _ in 0..4 {
            decoder.read();
        }
        decoder
    }

    #[inline(always)]
    fn read(&mut self) {
        let byte = self.bytes.get(self.next).copied().unwrap_or(0);
        self.value = self.value << 8 | u32::from(byte);
        self.next += 1;
    }

    /// Checks that no bytes past the end were read.
    ///
    /// # Errors
    /// [`Error::Truncated`] if some were.
    pub fn check_not_past_end(&self) -> Result<()> {
        if self.next <= self.bytes.len() {
            return Ok(());
        }
        Err(Error::Truncated {
            stage: Stage::Geometry,
            offset: self.offset as u64 + self.bytes.len() as u64,
            field: "occupancy",
            needed: (self.next - self.bytes.len()) as u64,
        })
    }

    /// Checks that all bytes were read, and that the final state is that of an encoder.
    ///
    /// # Errors
    /// [`Error::Truncated`] or [`Error::Malformed`] if not.
    pub fn finish(self) -> Result<()> {
        self.check_not_past_end()?;
        if self.next < self.bytes.len() {
            return Err(Error::malformed(
                Stage::Geometry,
                format!("byte {}", self.offset + self.next),
                "length of the occupancy",
                self.bytes.len(),
                self.next,
            )
            .breaks("4.2.3"));
        }
        if self.value != self.interval.low {
            return Err(Error::malformed(
                Stage::Geometry,
                format!("byte {}", self.offset + self.next - 4),
                "end of the occupancy",
                format!("{:#010x}", self.value),
                format!("{:#010x}", self.interval.low),
            )
            .breaks("4.2.3"));
        }
        Ok(())
    }
}

impl Coder for Decoder<'_> {
    #[inline(always)]
    fn code(&mut self, _: bool, one: u32) -> bool {
        let mid = self.interval.split(one);
        let bit = self.value <= mid;
        self.interval.narrow(bit, mid);
        while self.interval.top_byte_is_settled() {
            self.interval.shift();
            self.read();
        }
        bit
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn encode(bits: &[(bool, u32)]) -> Vec<u8> {
        let mut encoder = Encoder::new();
        for &(bit, one) in bits {
            encoder.code(bit, one);
        }
        encoder.finish()
    }

    fn decode(bytes: &[u8], bits: &[(bool, u32)]) -> Result<Vec<bool>> {
        let mut decoder = Decoder::new(bytes, 0);
        let decoded = bits.iter().map(|&(_, one)| decoder.code(false, one));
        let decoded = decoded.collect();
        decoder.finish()?;
        Ok(decoded)
    }

    fn some_bits() -> impl Strategy<Value = Vec<(bool, u32)>> {
        let one = prop_oneof![1..ONE, Just(1), Just(ONE - 1), Just(ONE / 2)];
        prop::collection::vec((any::<bool>(), one), 0..400)
    }

    proptest! {
        #[test]
        fn decoding_inverts_encoding(bits in some_bits()) {
            let read = decode(&encode(&bits), &bits).unwrap();
            prop_assert!(read.iter().eq(bits.iter().map(|(bit, _)| bit)));
        }

        #[test]
        fn every_truncation_is_detected(bits in some_bits()) {
            let bytes = encode(&bits);
            for end in 0..bytes.len() {
                let noticed = matches!(decode(&bytes[..end], &bits), Err(Error::Truncated { .. }));
                prop_assert!(noticed);
            }
        }

        #[test]
        fn a_byte_too_many_is_noticed(bits in some_bits(), more in any::<u8>()) {
            let mut bytes = encode(&bits);
            bytes.push(more);
            prop_assert!(decode(&bytes, &bits).is_err());
        }

        #[test]
        fn any_bytes_decode_to_something_or_an_error(
            bytes in prop::collection::vec(any::<u8>(), 0..64), bits in some_bits()
        ) {
            if let Ok(read) = decode(&bytes, &bits) {
                let again: Vec<_> = read.iter().zip(&bits).map(|(&bit, &(_, one))| (bit, one)).collect();
                prop_assert_eq!(encode(&again), bytes);
            }
        }
    }

    #[test]
    fn the_length_is_the_entropy() {
        let mut state = 1u32;
        let bits: Vec<_> = (0..100_000)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 16 < 6554, 6554)
            })
            .collect();
        let ones = bits.iter().filter(|b| b.0).count() as f64;
        let p = 6554.0 / 65536.0f64;
        let entropy = -ones * p.log2() - (1e5 - ones) * (1.0 - p).log2();
        let length = 8.0 * encode(&bits).len() as f64;
        assert!(entropy < length && length < 1.001 * entropy + 32.0);
    }
}
