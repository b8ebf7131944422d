//! The micro-kernel of AVX512_BF16: pairs of bf16, summed in f32.

use bytemuck::{must_cast_slice, must_cast_slice_mut};
use half::f16;

use crate::simd::avx512::{Avx512, Bf16, Bf16Vectors};
use crate::simd::{F32Vector, I32Vector, Isa, Simd, Work};
use crate::sparse::microkernel::{Block, MIN_GROUP, Microkernel, WIDE, columns};
use crate::sparse::peak;

/// Pairs of bf16.
#[derive(Clone, Copy)]
struct Pairs<S>(Bf16, S);

impl<S: Bf16Vectors> Microkernel for Pairs<S> {
    type Sum = S::F32;
    type Weight = S::I32;
    type Factor = S::I32;
    const LANES: usize = S::LANES;

    #[inline(always)]
    fn zero(self) -> S::F32 {
        S::F32::splat(self.1, 0.0)
    }

    #[inline(always)]
    fn load(self, from: &[u32]) -> S::F32 {
        S::F32::load(self.1, must_cast_slice(from))
    }

    #[inline(always)]
    fn store(self, sum: S::F32, to: &mut [u32]) {
        sum.store(must_cast_slice_mut(to));
    }

    #[inline(always)]
    fn weight(self, from: &[u32]) -> S::I32 {
        S::I32::load(self.1, must_cast_slice(from))
    }

    #[inline(always)]
    fn factor(self, word: u32) -> S::I32 {
        S::I32::splat(self.1, word as i32)
    }

    #[inline(always)]
    fn add(self, a: S::F32, b: S::F32) -> S::F32 {
        a + b
    }

    #[inline(always)]
    fn add_product(self, sum: S::F32, weight: S::I32, factor: S::I32) -> S::F32 {
        S::dot_bf16(self.0, sum, weight, factor)
    }
}

/// The token, of a set that has been asked for it.
fn token(isa: Isa) -> Bf16 {
    isa.bf16().expect("asked for before")
}

/// Multiplies a block in bf16: see [`crate::sparse::accumulate::Multiply`]. Only where [`Isa::has_bf16`].
pub(super) fn multiply(isa: Isa, block: &mut Block<'_>, whole: usize) {
    let bf16 = token(isa);
    let work = MultiplyBlock { bf16, block, whole };
    bf16.vectorize(work);
}

struct MultiplyBlock<'a, 'b> {
    bf16: Bf16,
    block: &'a mut Block<'b>,
    whole: usize,
}

impl Work for MultiplyBlock<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let (bf16, avx512) = (self.bf16, self.bf16.base());
        let (kernel, narrow) = (Pairs(bf16, avx512), Pairs(bf16, avx512.narrow()));
        match self.whole {
            0 => columns::<_, 8, 1, 1>(narrow, self.block),
            1 => columns::<_, 8, 1, 1>(kernel, self.block),
            2..WIDE => columns::<_, 8, 2, 1>(kernel, self.block),
            _ => columns::<_, MIN_GROUP, WIDE, 1>(kernel, self.block),
        }
    }
}

/// Multiply-adds in bf16 for as long as `rounds` say; the result is their number.
pub(super) fn batch(isa: Isa, rounds: usize) -> usize {
    let bf16 = token(isa);
    let kernel = Pairs(bf16, bf16.base());
    2 * bf16.vectorize(Batch { kernel, rounds })
}

struct Batch {
    kernel: Pairs<Avx512>,
    rounds: usize,
}

impl Work for Batch {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> usize {
        peak::rounds(self.kernel, self.rounds)
    }
}

/// Rows of f16 as pairs of bf16, rounded to even; an odd row's last pair has a zero.
pub(super) fn expand(isa: Isa, input: &[f16], rows: &[u32], cin: usize, to: &mut [u32]) {
    token(isa).round_rows(input, rows, cin, to);
}
