//! Numbers of 16 bits, for storage: whatever computes widens them first.

use std::fmt;

use crate::convert::{MAX, narrow_one, widen_one};

/// A number of IEEE 754's binary16: 5 bits of exponent, 11 of mantissa.
#[expect(non_camel_case_types, reason = "named as Rust names its floats")]
#[derive(Clone, Copy, Default)]
#[repr(transparent)]
pub struct f16(u16);

// SAFETY: all of its bits zero are 0.
unsafe impl bytemuck::Zeroable for f16 {}

impl f16 {
    /// 0.
    pub const ZERO: f16 = f16(0);
    /// 1.
    pub const ONE: f16 = f16(0x3c00);
    /// 65504, the largest finite number.
    pub const MAX: f16 = f16(0x7bff);
    /// −65504.
    pub const MIN: f16 = f16(0xfbff);
    /// ∞.
    pub const INFINITY: f16 = f16(0x7c00);
    /// Not a number.
    pub const NAN: f16 = f16(0x7e00);

    /// The number with these bits.
    pub const fn from_bits(bits: u16) -> f16 {
        f16(bits)
    }

    /// Its bits.
    pub const fn to_bits(self) -> u16 {
        self.0
    }

    /// The number with these bits, lowest first.
    pub const fn from_le_bytes(bytes: [u8; 2]) -> f16 {
        f16(u16::from_le_bytes(bytes))
    }

    /// Its bits, lowest first.
    pub const fn to_le_bytes(self) -> [u8; 2] {
        self.0.to_le_bytes()
    }

    /// The nearest number, ties to even; infinite from 65520 on.
    pub fn from_f32(from: f32) -> f16 {
        // Half a step beyond the largest.
        const BEYOND: f32 = MAX + 16.0;
        if from.is_nan() {
            f16::NAN
        } else if from.abs() >= BEYOND {
            f16(f16::INFINITY.0 | if from < 0.0 { 0x8000 } else { 0 })
        } else {
            narrow_one(from)
        }
    }

    /// The same number.
    pub fn to_f32(self) -> f32 {
        widen_one(self)
    }

    /// The same number.
    pub fn to_f64(self) -> f64 {
        self.to_f32().into()
    }

    /// Whether it is neither infinite nor NaN.
    pub const fn is_finite(self) -> bool {
        self.0 & 0x7c00 != 0x7c00
    }
}

impl From<f16> for f32 {
    fn from(half: f16) -> f32 {
        half.to_f32()
    }
}

impl From<f16> for f64 {
    fn from(half: f16) -> f64 {
        half.to_f64()
    }
}

impl PartialEq for f16 {
    fn eq(&self, other: &f16) -> bool {
        self.to_f32() == other.to_f32()
    }
}

impl fmt::Debug for f16 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(&self.to_f32(), f)
    }
}

impl fmt::Display for f16 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.to_f32(), f)
    }
}

/// The bits of the nearest bf16, the upper half of an f32, ties to even.
pub(crate) fn to_bf16(from: f32) -> u16 {
    const QUIET: u16 = 1 << 6;
    let bits = from.to_bits();
    if from.is_nan() {
        return (bits >> 16) as u16 | QUIET;
    }
    ((bits + 0x7fff + (bits >> 16 & 1)) >> 16) as u16
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_f16_is_the_number_that_the_format_says() {
        for bits in 0..=u16::MAX {
            let (ours, theirs) = (f16::from_bits(bits), half::f16::from_bits(bits));
            assert_eq!(ours.is_finite(), theirs.is_finite());
            if theirs.is_nan() {
                assert!(ours.to_f32().is_nan());
                continue;
            }
            assert_eq!(ours.to_f32().to_bits(), theirs.to_f32().to_bits());
            assert_eq!(ours.to_f64(), theirs.to_f64());
            assert_eq!(f16::from_f32(ours.to_f32()).to_bits(), bits);
            assert_eq!(f16::from_le_bytes(ours.to_le_bytes()), ours);
        }
    }

    #[test]
    fn every_f32_becomes_the_nearest() {
        // A prime step, so that all exponents and every pattern of low bits are met.
        for bits in (0..=u32::MAX).step_by(4099) {
            let wide = f32::from_bits(bits);
            let (ours, theirs) = (f16::from_f32(wide), half::f16::from_f32(wide));
            if wide.is_nan() {
                assert!(ours.to_f32().is_nan());
                assert!(f32::from_bits(u32::from(to_bf16(wide)) << 16).is_nan());
                continue;
            }
            assert_eq!(ours.to_bits(), theirs.to_bits(), "{wide}");
            assert_eq!(
                to_bf16(wide),
                half::bf16::from_f32(wide).to_bits(),
                "{wide}"
            );
        }
        for wide in [65519.99, 65520.0, f32::INFINITY, f32::MAX, 2.98e-8, 2.99e-8] {
            for wide in [wide, -wide] {
                let theirs = half::f16::from_f32(wide);
                assert_eq!(f16::from_f32(wide).to_bits(), theirs.to_bits(), "{wide}");
            }
        }
    }
}
