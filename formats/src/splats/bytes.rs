//! Bytes of a file, read from the front.

use b2p::error::Stage;
use b2p::{Error, Result};

/// What is left of a file.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bytes<'a> {
    rest: &'a [u8],
    at: u64,
}

impl<'a> Bytes<'a> {
    pub fn new(bytes: &'a [u8]) -> Self {
        Bytes { rest: bytes, at: 0 }
    }

    /// Offset from the start of the file.
    pub fn at(&self) -> u64 {
        self.at
    }

    pub fn len(&self) -> u64 {
        self.rest.len() as u64
    }

    /// The next `count` bytes.
    pub fn take(&mut self, count: u64, field: &'static str) -> Result<&'a [u8]> {
        let split = usize::try_from(count)
            .ok()
            .and_then(|count| self.rest.split_at_checked(count));
        let Some((taken, rest)) = split else {
            return Err(Error::Truncated {
                stage: Stage::Gaussians,
                offset: self.at + self.len(),
                field,
                needed: count.saturating_sub(self.len()),
            });
        };
        self.rest = rest;
        self.at += count;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self, field: &'static str) -> Result<[u8; N]> {
        let taken = self.take(N as u64, field)?;
        Ok(std::array::from_fn(|i| taken[i]))
    }

    pub fn u8(&mut self, field: &'static str) -> Result<u8> {
        self.array::<1>(field).map(|[byte]| byte)
    }

    pub fn u16(&mut self, field: &'static str) -> Result<u16> {
        self.array(field).map(u16::from_le_bytes)
    }

    pub fn u32(&mut self, field: &'static str) -> Result<u32> {
        self.array(field).map(u32::from_le_bytes)
    }

    pub fn u64(&mut self, field: &'static str) -> Result<u64> {
        self.array(field).map(u64::from_le_bytes)
    }
}

/// An error in a file of splats.
pub(super) fn malformed(
    at: impl ToString,
    field: impl ToString,
    value: impl ToString,
    expected: impl ToString,
) -> Error {
    Error::malformed(Stage::Gaussians, at, field, value, expected)
}

/// A float of 4 bytes, the least significant first, at the start of `bytes`.
pub(super) fn f32_at(bytes: &[u8], index: usize) -> f64 {
    let bytes = &bytes[4 * index..][..4];
    f32::from_le_bytes(std::array::from_fn(|i| bytes[i])).into()
}

/// The byte that is nearest to `value`, of 255ths.
pub(super) fn to_byte(value: f64) -> u8 {
    (value * 255.0).round().clamp(0.0, 255.0) as u8
}
