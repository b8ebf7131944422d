//! The parts held to their stated errors, on every instruction set that this machine has.

use super::project::log2;
use crate::simd::{F32Vector, Isa, Simd, dispatch};

/// Relative error of [`F32Vector::exp2`].
const EXP2_ERROR: f64 = 3.1e-6;

#[inline(always)]
fn powers<S: Simd>(simd: S, x: &[f32], to: &mut [f32]) {
    for (x, to) in x.chunks_exact(16).zip(to.chunks_exact_mut(16)) {
        for at in (0..16).step_by(S::LANES) {
            S::F32::load(simd, &x[at..]).exp2().store(&mut to[at..]);
        }
    }
}

#[inline(always)]
fn logarithms<S: Simd>(simd: S, x: &[f32], to: &mut [f32]) {
    for (x, to) in x.chunks_exact(16).zip(to.chunks_exact_mut(16)) {
        for at in (0..16).step_by(S::LANES) {
            log2(simd, S::F32::load(simd, &x[at..])).store(&mut to[at..]);
        }
    }
}

#[test]
fn powers_are_within_their_error_and_exact_for_integers() {
    let x: Vec<f32> = (0..127 * 5008).map(|i| 1.0 - i as f32 / 5008.0).collect();
    for isa in Isa::available() {
        let (x, mut to) = (&x[..], vec![0.0; x.len()]);
        let out = &mut to[..];
        dispatch!(isa, fn powers(x: &[f32], out: &mut [f32]));
        let mut largest = 0.0f64;
        for (x, y) in x.iter().zip(&to) {
            let exact = f64::from(*x).exp2();
            largest = largest.max((f64::from(*y) / exact - 1.0).abs());
            assert!(x.fract() != 0.0 || f64::from(*y) == exact, "{isa}: {x}");
        }
        assert!(largest < EXP2_ERROR, "{isa}: {largest:e}");
    }
}

#[test]
fn logarithms_are_within_their_error_and_exact_for_powers_of_two() {
    let x: Vec<f32> = (0..1 << 16)
        .map(|i| (1.0 + (i % 4096) as f32 / 4096.0) / (1 << (i / 4096)) as f32)
        .collect();
    for isa in Isa::available() {
        let (x, mut to) = (&x[..], vec![0.0; x.len()]);
        let out = &mut to[..];
        dispatch!(isa, fn logarithms(x: &[f32], out: &mut [f32]));
        for (x, y) in x.iter().zip(&to) {
            let exact = f64::from(*x).log2();
            let error = (f64::from(*y) - exact).abs();
            assert!(error <= 3e-7 * exact.abs().max(1.0), "{isa}: {x} {error:e}");
            assert!(exact.fract() != 0.0 || f64::from(*y) == exact, "{isa}: {x}");
        }
    }
}
