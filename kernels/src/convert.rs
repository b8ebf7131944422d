//! f16 ↔ f32, exact one way and rounded to even the other.

use crate::f16;

use crate::exact::LIMIT;
use crate::finish::scaled;
use crate::machine::with_halves;
use crate::rows::{Lanes, PANEL, panel, store};
use crate::simd::Isa;
use crate::winograd::Registers;

/// The largest finite f16.
pub(crate) const MAX: f32 = 65504.0;
/// The difference of the two formats' exponent biases, in an f32's place.
const REBIAS: u32 = (127 - 15) << 23;
/// The f32 whose last mantissa bit weighs as much as the smallest f16.
const DENORMAL: u32 = (127 - 15 + 23 - 10 + 1) << 23;

/// Widens, exactly. Infinities and NaN stay what they are.
///
/// # Panics
/// If the lengths differ.
pub fn to_f32(isa: Isa, from: &[f16], to: &mut [f32]) {
    assert_eq!(from.len(), to.len());
    with_halves!(isa, fn widen<>(from: &[f16], to: &mut [f32]));
}

/// Rounds to the nearest f16, ties to even; beyond ±65504, and for NaN, to the nearest end (NaN to −65504): the result is
/// always finite.
///
/// # Panics
/// If the lengths differ.
pub fn to_f16(isa: Isa, from: &[f32], to: &mut [f16]) {
    assert_eq!(from.len(), to.len());
    with_halves!(isa, fn narrow<>(from: &[f32], to: &mut [f16]));
}

/// Conversion of a panel between f32 and f16, as [`to_f32`] and [`to_f16`], and from sums to i16.
///
/// # Safety
/// Its functions may use instructions that not every processor has; they must only be called where it has them.
pub(crate) unsafe trait Halves: Registers {
    /// Exactly.
    unsafe fn widen(from: &[f16; PANEL], to: &mut [f32; PANEL]);
    /// Rounding, saturating.
    unsafe fn narrow(from: &[f32; PANEL], to: &mut [f16; PANEL]);

    /// `(sum + bias) >> shift`, wrapping, and clamped to ±[`LIMIT`].
    #[inline(always)]
    unsafe fn shift(sums: &Lanes, bias: &[i32; PANEL], shift: &[u32; PANEL]) -> [i16; PANEL] {
        let sums = sums.i32();
        std::array::from_fn(|j| {
            let value = sums[j].wrapping_add(bias[j]).wrapping_shr(shift[j]);
            value.clamp(-i32::from(LIMIT), i32::from(LIMIT)) as i16
        })
    }

    /// `sum · factor + bias` rounded, halves to even, and clamped to ±[`LIMIT`]; no number is 0.
    #[inline(always)]
    unsafe fn round(sums: &Lanes, factor: &[f32; PANEL], bias: &[f32; PANEL]) -> [i16; PANEL] {
        let (values, limit) = (scaled(sums, factor, bias), f32::from(LIMIT));
        std::array::from_fn(|j| {
            // As by `as`, which would keep the compiler from using vectors.
            let value = if values[j].is_nan() { 0.0 } else { values[j] };
            let value = value.clamp(-limit, limit).round_ties_even();
            // SAFETY: it is a number, and no larger than the limit.
            (unsafe { value.to_int_unchecked::<i32>() }) as i16
        })
    }

    /// Adds what is given, and clamps between `floor` and [`LIMIT`].
    #[inline(always)]
    unsafe fn settle(mut q: [i16; PANEL], residual: Option<&[i16; PANEL]>, floor: i16) -> [i16; PANEL] {
        if let Some(residual) = residual {
            for (q, x) in q.iter_mut().zip(residual) {
                *q = q.saturating_add(*x).min(LIMIT);
            }
        }
        for q in &mut q {
            *q = (*q).max(floor);
        }
        q
    }
}

/// The conversions of an instruction set.
pub(crate) trait HasHalves {
    type Halves: Halves;
}

impl HasHalves for crate::simd::Scalar {
    type Halves = Portable;
}

#[cfg(target_arch = "x86_64")]
impl HasHalves for crate::simd::Avx2 {
    type Halves = crate::machine::avx2::Convert;
}

#[cfg(target_arch = "x86_64")]
impl HasHalves for crate::simd::Avx512 {
    type Halves = crate::machine::avx512::Convert;
}

#[cfg(target_arch = "aarch64")]
impl HasHalves for crate::simd::Neon {
    type Halves = crate::machine::neon::Convert;
}

/// In integer steps that any compiler turns into SIMD.
pub(crate) struct Portable;

// SAFETY: plain Rust.
unsafe impl Halves for Portable {
    #[inline(always)]
    unsafe fn widen(from: &[f16; PANEL], to: &mut [f32; PANEL]) {
        for (to, &from) in to.iter_mut().zip(from) {
            *to = widen_one(from);
        }
    }

    #[inline(always)]
    unsafe fn narrow(from: &[f32; PANEL], to: &mut [f16; PANEL]) {
        for (to, &from) in to.iter_mut().zip(from) {
            *to = narrow_one(from);
        }
    }
}

// SAFETY: reads and writes 16 bytes, wherever they are.
unsafe impl Registers for Portable {
    type Register = [u16; 8];
    type Narrow = Self;
    const BYTES: usize = 16;

    #[inline(always)]
    unsafe fn read(at: *const u8) -> [u16; 8] {
        // SAFETY: the caller's promise.
        unsafe { at.cast::<[u16; 8]>().read_unaligned() }
    }

    #[inline(always)]
    unsafe fn write(at: *mut u8, register: [u16; 8]) {
        // SAFETY: the caller's promise.
        unsafe { at.cast::<[u16; 8]>().write_unaligned(register) }
    }

    #[inline(always)]
    unsafe fn add16(a: [u16; 8], b: [u16; 8]) -> [u16; 8] {
        std::array::from_fn(|j| a[j].wrapping_add(b[j]))
    }

    #[inline(always)]
    unsafe fn sub16(a: [u16; 8], b: [u16; 8]) -> [u16; 8] {
        std::array::from_fn(|j| a[j].wrapping_sub(b[j]))
    }

    #[inline(always)]
    unsafe fn add32(a: [u16; 8], b: [u16; 8]) -> [u16; 8] {
        let (a, b) = (wide(a), wide(b));
        halves(std::array::from_fn(|j| a[j].wrapping_add(b[j])))
    }

    #[inline(always)]
    unsafe fn sub32(a: [u16; 8], b: [u16; 8]) -> [u16; 8] {
        let (a, b) = (wide(a), wide(b));
        halves(std::array::from_fn(|j| a[j].wrapping_sub(b[j])))
    }

    #[inline(always)]
    unsafe fn eighth(a: [u16; 8]) -> [u16; 8] {
        halves(wide(a).map(|a| a >> 3))
    }
}

/// The same memory in 32 bits.
#[inline(always)]
fn wide(register: [u16; 8]) -> [i32; 4] {
    // SAFETY: the same bytes, of which all are values of both.
    unsafe { std::mem::transmute(register) }
}

/// The same memory in 16 bits.
#[inline(always)]
fn halves(register: [i32; 4]) -> [u16; 8] {
    // SAFETY: the same bytes, of which all are values of both.
    unsafe { std::mem::transmute(register) }
}

/// Widens by whole panels.
///
/// # Safety
/// The processor must have `H`'s instructions.
#[inline(always)]
pub(crate) unsafe fn widen<H: Halves>(from: &[f16], to: &mut [f32]) {
    let ((panels, rest), (to, last)) = (from.as_chunks(), to.as_chunks_mut());
    for (from, to) in panels.iter().zip(to) {
        // SAFETY: the caller's promise.
        unsafe { H::widen(from, to) };
    }
    if !rest.is_empty() {
        let mut wide = [0.0; PANEL];
        // SAFETY: the caller's promise.
        unsafe { H::widen(&panel(rest), &mut wide) };
        store(wide, last);
    }
}

/// Narrows by whole panels.
///
/// # Safety
/// The processor must have `H`'s instructions.
#[inline(always)]
pub(crate) unsafe fn narrow<H: Halves>(from: &[f32], to: &mut [f16]) {
    let ((panels, rest), (to, last)) = (from.as_chunks(), to.as_chunks_mut());
    for (from, to) in panels.iter().zip(to) {
        // SAFETY: the caller's promise.
        unsafe { H::narrow(from, to) };
    }
    if !rest.is_empty() {
        let mut narrow = [f16::ZERO; PANEL];
        // SAFETY: the caller's promise.
        unsafe { H::narrow(&panel(rest), &mut narrow) };
        store(narrow, last);
    }
}

#[inline(always)]
pub(crate) fn widen_one(from: f16) -> f32 {
    let bits = u32::from(from.to_bits());
    let magnitude = (bits & 0x7fff) << 13;
    let sign = (bits & 0x8000) << 16;
    let exponent = magnitude & (0x1f << 23);
    // Infinity and NaN keep the largest exponent: it moves up by the rest of the way.
    let normal = magnitude + REBIAS + if exponent == 0x1f << 23 { REBIAS } else { 0 };
    // A subnormal's mantissa is read as a normal number's, and the implied one taken off again.
    let subnormal = f32::from_bits(magnitude + REBIAS + (1 << 23)) - f32::from_bits(REBIAS + (1 << 23));
    let value = if exponent == 0 { subnormal.to_bits() } else { normal };
    f32::from_bits(value | sign)
}

#[inline(always)]
#[expect(
    clippy::manual_clamp,
    reason = "`max` gives the number of a number and NaN, `clamp` keeps NaN"
)]
pub(crate) fn narrow_one(from: f32) -> f16 {
    let value = from.max(-MAX).min(MAX);
    let sign = (value.to_bits() >> 16) & 0x8000;
    let bits = value.to_bits() & 0x7fff_ffff;
    // Adding half an even step less one rounds to nearest; the parity of the kept mantissa breaks ties to even.
    let normal = (bits - REBIAS.min(bits) + 0xfff + ((bits >> 13) & 1)) >> 13;
    // The floating-point adder rounds at the weight of the smallest f16.
    let subnormal = (f32::from_bits(bits) + f32::from_bits(DENORMAL))
        .to_bits()
        .wrapping_sub(DENORMAL);
    let magnitude = if bits < REBIAS + (1 << 23) { subnormal } else { normal };
    f16::from_bits((magnitude | sign) as u16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn widening_agrees_with_the_format_for_every_value() {
        let all: Vec<f16> = (0..=u16::MAX).map(f16::from_bits).collect();
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
        for bits in 0..0x7bffu16 {
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
                let expected = f16::from_f32(wide.clamp(-MAX, MAX));
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
