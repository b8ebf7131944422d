//! The integer micro-kernel: pairs of i16, multiplied and added in 32 bits.

use bytemuck::{must_cast_slice, must_cast_slice_mut};

use crate::simd::{I32Vector, Isa, Simd, Work, dispatch};
use crate::sparse::microkernel::{Block, MIN_GROUP, Microkernel, WIDE, columns};
use crate::sparse::peak;

/// Pairs of i16.
#[derive(Clone, Copy)]
struct Pairs<S>(S);

impl<S: Simd> Microkernel for Pairs<S> {
    type Sum = S::I32;
    type Weight = S::I16;
    type Factor = S::I16;
    const LANES: usize = S::LANES;

    #[inline(always)]
    fn zero(self) -> S::I32 {
        S::I32::splat(self.0, 0)
    }

    #[inline(always)]
    fn load(self, from: &[u32]) -> S::I32 {
        S::I32::load(self.0, must_cast_slice(from))
    }

    #[inline(always)]
    fn store(self, sum: S::I32, to: &mut [u32]) {
        sum.store(must_cast_slice_mut(to));
    }

    #[inline(always)]
    fn weight(self, from: &[u32]) -> S::I16 {
        S::I32::load(self.0, must_cast_slice(from)).as_i16()
    }

    #[inline(always)]
    fn factor(self, word: u32) -> S::I16 {
        S::I32::splat(self.0, word as i32).as_i16()
    }

    #[inline(always)]
    fn add(self, a: S::I32, b: S::I32) -> S::I32 {
        a + b
    }

    #[inline(always)]
    fn add_product(self, sum: S::I32, weight: S::I16, factor: S::I16) -> S::I32 {
        sum.dot_pairs(weight, factor)
    }
}

/// Multiplies a block: see [`crate::sparse::accumulate::Multiply`].
pub(super) fn multiply(isa: Isa, block: &mut Block<'_>, whole: usize) {
    #[cfg(target_arch = "x86_64")]
    if let Some(vnni) = isa.vnni() {
        return vnni.vectorize(MultiplyVnni { block, whole });
    }
    #[cfg(target_arch = "aarch64")]
    if let Some(neon) = isa.neon() {
        return neon.vectorize(super::neon::Multiply { neon, block, whole });
    }
    dispatch!(isa, fn multiply_with(block: &mut Block<'_>, whole: usize));
}

#[inline(always)]
fn multiply_with<S: Simd>(simd: S, block: &mut Block<'_>, whole: usize) {
    let (kernel, narrow) = (Pairs(simd), Pairs(simd.narrow()));
    match (S::LANES, whole) {
        (16, 0) => columns::<_, 8, 1, 2>(narrow, block),
        (16, 1) => columns::<_, 8, 1, 2>(kernel, block),
        (16, ..WIDE) => columns::<_, 8, 2, 1>(kernel, block),
        (16, _) => columns::<_, MIN_GROUP, WIDE, 1>(kernel, block),
        (8, 0) => columns::<_, MIN_GROUP, 1, 1>(kernel, block),
        (8, _) => columns::<_, MIN_GROUP, 2, 1>(kernel, block),
        (_, 0) => columns::<_, 2, 2, 1>(kernel, block),
        _ => columns::<_, 2, 4, 1>(kernel, block),
    }
}

/// As [`multiply_with`] for AVX2, but half a panel in two parts: a sum is ready for the next product later.
#[cfg(target_arch = "x86_64")]
struct MultiplyVnni<'a, 'b> {
    block: &'a mut Block<'b>,
    whole: usize,
}

#[cfg(target_arch = "x86_64")]
impl Work for MultiplyVnni<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        match self.whole {
            0 => columns::<_, MIN_GROUP, 1, 2>(Pairs(simd), self.block),
            _ => columns::<_, MIN_GROUP, 2, 1>(Pairs(simd), self.block),
        }
    }
}

/// Multiply-adds for as long as `rounds` say; the result is their number.
pub(super) fn batch(isa: Isa, rounds: usize) -> usize {
    #[cfg(target_arch = "x86_64")]
    if let Some(vnni) = isa.vnni() {
        return 2 * vnni.vectorize(Batch(rounds));
    }
    #[cfg(target_arch = "aarch64")]
    if let Some(neon) = isa.neon() {
        return 2 * neon.vectorize(super::neon::Batch { neon, rounds });
    }
    2 * isa.run(Batch(rounds))
}

struct Batch(usize);

impl Work for Batch {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> usize {
        peak::rounds(Pairs(simd), self.0)
    }
}

/// The half of a word that the pair's first or second value takes.
pub(super) fn place(value: i16, which: usize) -> u32 {
    u32::from(value as u16) << (16 * (which ^ usize::from(cfg!(target_endian = "big"))))
}
