//! Reads little-endian numbers from bytes, with an error where they end early (`docs/format.md`, clause 1.4).

use super::malformed;
use crate::error::{Error, Result, Stage};

/// A position in a byte string.
#[derive(Debug, Clone)]
pub struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

macro_rules! numbers {
    ($($number:ident),*) => {$(
        /// The next number of this type.
        ///
        /// # Errors
        /// [`Error::Truncated`], naming `field`.
        pub fn $number(&mut self, field: &'static str) -> Result<$number> {
            Ok($number::from_le_bytes(self.array(field)?))
        }
    )*};
}

impl<'a> Reader<'a> {
    /// Starts at byte `at`. Offsets in errors count from byte 0.
    pub fn new(bytes: &'a [u8], at: usize) -> Self {
        Reader { bytes, at }
    }

    /// The offset of the next byte.
    pub fn at(&self) -> usize {
        self.at
    }

    /// The bytes from `start` to the current position.
    pub(super) fn since(&self, start: usize) -> &'a [u8] {
        &self.bytes[start..self.at]
    }

    /// The next `count` bytes.
    ///
    /// # Errors
    /// [`Error::Truncated`], naming `field`.
    pub fn take(&mut self, count: usize, field: &'static str) -> Result<&'a [u8]> {
        let rest = self.bytes.get(self.at..);
        let Some(taken) = rest.and_then(|rest| rest.get(..count)) else {
            return Err(Error::Truncated {
                stage: Stage::Bitstream,
                offset: self.bytes.len() as u64,
                field,
                needed: self.at as u64 + count as u64 - self.bytes.len() as u64,
            });
        };
        self.at += count;
        Ok(taken)
    }

    /// The next `N` bytes.
    ///
    /// # Errors
    /// [`Error::Truncated`], naming `field`.
    pub fn array<const N: usize>(&mut self, field: &'static str) -> Result<[u8; N]> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N, field)?);
        Ok(array)
    }

    /// The next varint: an unsigned LEB128 number below 2³² in its shortest form (`docs/format.md`, 1.4.2).
    ///
    /// # Errors
    /// [`Error::Truncated`], [`Error::Malformed`] for a number that is too large or not in its shortest form. Both name
    /// `field`.
    pub fn varint(&mut self, field: &'static str) -> Result<u32> {
        let (start, mut number) = (self.at, 0u64);
        for shift in (0..35).step_by(7) {
            let byte = self.u8(field)?;
            number |= u64::from(byte & 0x7f) << shift;
            if byte < 0x80 {
                match u32::try_from(number) {
                    Ok(number) if byte > 0 || shift == 0 => return Ok(number),
                    _ => break,
                }
            }
        }
        let expected = "a number below 2^32 in its shortest form";
        let value = format!("{:02x?}", &self.bytes[start..self.at]);
        Err(malformed("1.4.2", start, field, value, expected))
    }

    numbers!(u8, u16, u32, u64, f64);
}

/// Appends a varint in the form that [`Reader::varint`] reads.
pub fn put_varint(out: &mut Vec<u8>, mut number: u32) {
    while number >= 0x80 {
        out.push(number as u8 | 0x80);
        number >>= 7;
    }
    out.push(number as u8);
}
