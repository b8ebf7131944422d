//! The micro-kernels in floats: f32, and pairs of bf16.

use bytemuck::{must_cast_slice, must_cast_slice_mut};

use crate::simd::{F32Vector, Isa, Simd, Work, dispatch};
use crate::sparse::microkernel::{Block, MIN_GROUP, Microkernel, WIDE, columns};
use crate::sparse::peak;

/// f32.
#[derive(Clone, Copy)]
struct Float<S>(S);

impl<S: Simd> Microkernel for Float<S> {
    type Sum = S::F32;
    type Weight = S::F32;
    type Factor = S::F32;
    const LANES: usize = S::LANES;

    #[inline(always)]
    fn zero(self) -> S::F32 {
        S::F32::splat(self.0, 0.0)
    }

    #[inline(always)]
    fn load(self, from: &[u32]) -> S::F32 {
        S::F32::load(self.0, must_cast_slice(from))
    }

    #[inline(always)]
    fn store(self, sum: S::F32, to: &mut [u32]) {
        sum.store(must_cast_slice_mut(to));
    }

    #[inline(always)]
    fn weight(self, from: &[u32]) -> S::F32 {
        S::F32::load(self.0, must_cast_slice(from))
    }

    #[inline(always)]
    fn factor(self, word: u32) -> S::F32 {
        S::F32::splat(self.0, f32::from_bits(word))
    }

    #[inline(always)]
    fn add(self, a: S::F32, b: S::F32) -> S::F32 {
        a + b
    }

    #[inline(always)]
    fn add_product(self, sum: S::F32, weight: S::F32, factor: S::F32) -> S::F32 {
        weight.mul_add(factor, sum)
    }
}

/// Multiplies a block in f32: see [`crate::sparse::accumulate::Multiply`].
pub(super) fn multiply(isa: Isa, block: &mut Block<'_>, whole: usize) {
    dispatch!(isa, fn multiply_with(block: &mut Block<'_>, whole: usize));
}

#[inline(always)]
fn multiply_with<S: Simd>(simd: S, block: &mut Block<'_>, whole: usize) {
    let (kernel, narrow) = (Float(simd), Float(simd.narrow()));
    match (S::LANES, whole) {
        (16, 0) => columns::<_, 8, 1, 1>(narrow, block),
        (16, 1) => columns::<_, 8, 1, 1>(kernel, block),
        (16, ..WIDE) => columns::<_, 8, 2, 1>(kernel, block),
        (16, _) => columns::<_, MIN_GROUP, WIDE, 1>(kernel, block),
        (8, 0) => columns::<_, MIN_GROUP, 1, 1>(kernel, block),
        (8, _) => columns::<_, MIN_GROUP, 2, 1>(kernel, block),
        (_, 0) => columns::<_, ROWS, 2, 1>(kernel, block),
        _ => columns::<_, ROWS, 4, 1>(kernel, block),
    }
}

/// Rows that sets of four lanes multiply at once: NEON has registers for twice as many as the baseline of x86.
const ROWS: usize = if cfg!(target_arch = "aarch64") { MIN_GROUP } else { 2 };

/// Multiply-adds in f32 for as long as `rounds` say; the result is their number.
pub(super) fn batch(isa: Isa, rounds: usize) -> usize {
    isa.run(Batch(rounds))
}

struct Batch(usize);

impl Work for Batch {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> usize {
        peak::rounds(Float(simd), self.0)
    }
}
