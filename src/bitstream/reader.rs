//! Little-endian numbers from bytes that may end too early.

use crate::error::{Error, Result, Stage};

/// A place in a byte string.
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
    /// Starts at byte `at`; errors count from byte 0.
    pub fn new(bytes: &'a [u8], at: usize) -> Self {
        Reader { bytes, at }
    }

    /// The offset of the next byte.
    pub fn at(&self) -> usize {
        self.at
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

    numbers!(u8, u16, u32, u64, f64);
}
