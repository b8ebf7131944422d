//! f16 ↔ f32, exact one way and rounded to even the other.

use crate::simd::{F32Vector, Isa, Simd, dispatch};
use ::half::f16;

/// Values of the longest vector.
const LONGEST: usize = 16;

/// Widens, exactly. Infinities and NaN stay what they are.
///
/// # Panics
/// If the lengths differ.
pub fn to_f32(isa: Isa, from: &[f16], to: &mut [f32]) {
    assert_eq!(from.len(), to.len());
    dispatch!(isa, fn widen(from: &[f16], to: &mut [f32]));
}

/// Rounds to the nearest f16, ties to even; beyond ±65504, and for NaN, to the nearest end (NaN to −65504): the result
/// is always finite.
///
/// # Panics
/// If the lengths differ.
pub fn to_f16(isa: Isa, from: &[f32], to: &mut [f16]) {
    assert_eq!(from.len(), to.len());
    dispatch!(isa, fn narrow(from: &[f32], to: &mut [f16]));
}

/// As [`to_f32`], of slices of one length.
#[inline(always)]
pub(super) fn widen<S: Simd>(simd: S, from: &[f16], to: &mut [f32]) {
    let whole = from.len() - from.len() % S::LANES;
    for at in (0..whole).step_by(S::LANES) {
        S::F32::load_f16(simd, &from[at..]).store(&mut to[at..]);
    }
    if whole < from.len() {
        let (mut last, mut wide) = ([f16::ZERO; LONGEST], [0.0; LONGEST]);
        last[..from.len() - whole].copy_from_slice(&from[whole..]);
        S::F32::load_f16(simd, &last).store(&mut wide);
        to[whole..].copy_from_slice(&wide[..from.len() - whole]);
    }
}

/// As [`to_f16`], of slices of one length.
#[inline(always)]
pub(super) fn narrow<S: Simd>(simd: S, from: &[f32], to: &mut [f16]) {
    let whole = from.len() - from.len() % S::LANES;
    for at in (0..whole).step_by(S::LANES) {
        S::F32::load(simd, &from[at..]).store_f16(&mut to[at..]);
    }
    if whole < from.len() {
        let (mut last, mut narrow) = ([0.0; LONGEST], [f16::ZERO; LONGEST]);
        last[..from.len() - whole].copy_from_slice(&from[whole..]);
        S::F32::load(simd, &last).store_f16(&mut narrow);
        to[whole..].copy_from_slice(&narrow[..from.len() - whole]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::F16_MAX;

    /// An interpreter has no time for all numbers.
    const STEP: usize = if cfg!(miri) { 509 } else { 1 };

    #[test]
    fn widening_agrees_with_the_format_for_every_value() {
        let all: Vec<f16> = (0..=u16::MAX).step_by(STEP).map(f16::from_bits).collect();
        for isa in Isa::available() {
            println!("ran on {isa}");
            let mut wide = vec![0.0; all.len()];
            to_f32(isa, &all, &mut wide);
            for (narrow, wide) in all.iter().zip(wide) {
                let expected = narrow.to_f32();
                assert!(
                    wide.to_bits() == expected.to_bits() || (wide.is_nan() && expected.is_nan()),
                    "{narrow:?} became {wide}"
                );
            }
        }
    }

    #[test]
    fn narrowing_rounds_to_even_and_saturates() {
        // Every f16, every midpoint between two, and their neighbours in f32.
        let mut samples = vec![f32::INFINITY, 1e30, 65519.9, 65520.0, f32::MIN_POSITIVE, 1e-45, 0.0];
        for bits in (0..0x7bffu16).step_by(STEP) {
            let low = f16::from_bits(bits).to_f32();
            let middle = (low + f16::from_bits(bits + 1).to_f32()) / 2.0;
            for at in [low, middle] {
                samples.extend([at.next_down(), at, at.next_up()]);
            }
        }
        samples.extend(samples.clone().iter().map(|x| -x));
        for isa in Isa::available() {
            println!("ran on {isa}");
            let mut narrow = vec![f16::ZERO; samples.len()];
            to_f16(isa, &samples, &mut narrow);
            for (wide, narrow) in samples.iter().zip(narrow) {
                let expected = f16::from_f32(wide.clamp(-F16_MAX, F16_MAX));
                assert_eq!(narrow.to_bits(), expected.to_bits(), "{wide} became {narrow}");
            }
        }
    }

    #[test]
    fn narrowing_always_gives_a_finite_number() {
        for isa in Isa::available() {
            let mut narrow = [f16::ZERO; 2];
            to_f16(isa, &[f32::NAN, f32::NEG_INFINITY], &mut narrow);
            assert_eq!(narrow, [f16::MIN, f16::MIN]);
        }
    }
}
