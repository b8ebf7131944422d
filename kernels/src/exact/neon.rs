//! The integer micro-kernel of NEON, by hand: first and second values of pairs apart, for its long multiplication
//! multiplies like by like.

use std::arch::aarch64::*;

use bytemuck::{must_cast, must_cast_ref};

use crate::simd::macros::methods;
use crate::simd::neon::Neon;
use crate::simd::neon::with_neon;
use crate::simd::{Simd, Work};
use crate::sparse::microkernel::{Block, MIN_GROUP, Microkernel, columns};
use crate::sparse::peak;

/// Pairs of i16, eight at a time.
#[derive(Clone, Copy)]
struct Pairs(Neon);

methods! { with_neon Pairs: Microkernel {
    type Sum = [int32x4_t; 2];
    type Weight = int16x8x2_t;
    type Factor = int16x4_t;
    const LANES: usize = 8;

    fn zero(self) -> [int32x4_t; 2] {
        [vdupq_n_s32(0); 2]
    }

    fn load(self, from: &[u32]) -> [int32x4_t; 2] {
        must_cast(*from.first_chunk::<8>().expect("eight words"))
    }

    fn store(self, sum: [int32x4_t; 2], to: &mut [u32]) {
        *to.first_chunk_mut::<8>().expect("room for eight words") = must_cast(sum);
    }

    fn weight(self, from: &[u32]) -> int16x8x2_t {
        let from: &[i16; 16] = must_cast_ref(from.first_chunk::<8>().expect("eight words"));
        // SAFETY: sixteen values are read, which are there.
        unsafe { vld2q_s16(from.as_ptr()) }
    }

    fn factor(self, word: u32) -> int16x4_t {
        vreinterpret_s16_u32(vdup_n_u32(word))
    }

    fn add(self, a: [int32x4_t; 2], b: [int32x4_t; 2]) -> [int32x4_t; 2] {
        [vaddq_s32(a[0], b[0]), vaddq_s32(a[1], b[1])]
    }

    fn add_product(self, sum: [int32x4_t; 2], weight: int16x8x2_t, factor: int16x4_t) -> [int32x4_t; 2] {
        let low = vmlal_lane_s16::<0>(sum[0], vget_low_s16(weight.0), factor);
        let high = vmlal_high_lane_s16::<0>(sum[1], weight.0, factor);
        [
            vmlal_lane_s16::<1>(low, vget_low_s16(weight.1), factor),
            vmlal_high_lane_s16::<1>(high, weight.1, factor),
        ]
    }
}}

/// Multiplies a block: see [`crate::sparse::accumulate::Multiply`].
pub(super) struct Multiply<'a, 'b> {
    pub neon: Neon,
    pub block: &'a mut Block<'b>,
    pub whole: usize,
}

impl Work for Multiply<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        match self.whole {
            0 => columns::<_, MIN_GROUP, 1, 1>(Pairs(self.neon), self.block),
            _ => columns::<_, MIN_GROUP, 2, 1>(Pairs(self.neon), self.block),
        }
    }
}

/// Multiply-adds for as long as `rounds` say; the result is their number in words.
pub(super) struct Batch {
    pub neon: Neon,
    pub rounds: usize,
}

impl Work for Batch {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> usize {
        peak::rounds(Pairs(self.neon), self.rounds)
    }
}
