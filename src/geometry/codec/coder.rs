//! A binary arithmetic coder: 32-bit interval, no carries, 16-bit probabilities.
//!
//! The interval `[low, high]` starts as all 32-bit numbers. A bit whose probability of being 1 is `p / 65536` splits it at
//! `mid = low + ⌊(high − low)·p / 65536⌋`: 1 keeps `[low, mid]`, 0 keeps `[mid + 1, high]`. Whenever low and high share their
//! highest byte, that byte is written and shifted out, zeros following in `low` and ones in `high`. The end writes the four bytes of
//! `low`. So a decoder that has read every bit has read every byte, which it checks.

use crate::error::{Error, Result, Stage};

/// Writes bits.
pub(super) struct Encoder {
    low: u32,
    high: u32,
    bytes: Vec<u8>,
}

impl Encoder {
    pub fn new() -> Self {
        Encoder {
            low: 0,
            high: u32::MAX,
            bytes: Vec::new(),
        }
    }

    pub fn finish(mut self) -> Vec<u8> {
        self.bytes.extend(self.low.to_be_bytes());
        self.bytes
    }
}

/// Reads bits.
pub(super) struct Decoder<'a> {
    low: u32,
    high: u32,
    code: u32,
    bytes: std::slice::Iter<'a, u8>,
    missing: u64,
}

impl<'a> Decoder<'a> {
    pub fn new(bytes: &'a [u8]) -> Self {
        let mut decoder = Decoder {
            low: 0,
            high: u32::MAX,
            code: 0,
            bytes: bytes.iter(),
            missing: 0,
        };
        for _ in 0..4 {
            decoder.code = decoder.code << 8 | u32::from(decoder.byte());
        }
        decoder
    }

    fn byte(&mut self) -> u8 {
        self.bytes.next().copied().unwrap_or_else(|| {
            self.missing += 1;
            0
        })
    }

    /// Whether more was read than there is: what follows is of no use.
    pub fn exhausted(&self) -> bool {
        self.missing > 0
    }

    /// Fails unless exactly all bytes were read.
    pub fn finish(self, at: &str) -> Result<()> {
        if self.missing > 0 {
            return Err(Error::malformed(
                Stage::Geometry,
                at,
                "code length",
                format!("at least {} bytes short", self.missing),
                "as long as its occupancies take",
            ));
        }
        match self.bytes.len() {
            0 => Ok(()),
            left => Err(Error::malformed(
                Stage::Geometry,
                at,
                "bytes after the last occupancy",
                left,
                0,
            )),
        }
    }
}

/// Either end of the wire: codes a bit, and says which it was.
pub(super) trait Coder {
    /// Codes `bit` (ignored when decoding), whose probability of being 1 is `p / 65536`, `0 < p < 65536`.
    fn code(&mut self, bit: bool, p: u32) -> bool;
}

fn split(low: u32, high: u32, p: u32) -> u32 {
    low + ((u64::from(high - low) * u64::from(p)) >> 16) as u32
}

impl Coder for Encoder {
    #[inline]
    fn code(&mut self, bit: bool, p: u32) -> bool {
        let mid = split(self.low, self.high, p);
        if bit {
            self.high = mid;
        } else {
            self.low = mid + 1;
        }
        while (self.low ^ self.high) >> 24 == 0 {
            self.bytes.push((self.high >> 24) as u8);
            self.low <<= 8;
            self.high = self.high << 8 | 0xff;
        }
        bit
    }
}

impl Coder for Decoder<'_> {
    #[inline]
    fn code(&mut self, _: bool, p: u32) -> bool {
        let mid = split(self.low, self.high, p);
        let bit = self.code <= mid;
        if bit {
            self.high = mid;
        } else {
            self.low = mid + 1;
        }
        while (self.low ^ self.high) >> 24 == 0 {
            self.low <<= 8;
            self.high = self.high << 8 | 0xff;
            self.code = self.code << 8 | u32::from(self.byte());
        }
        bit
    }
}
