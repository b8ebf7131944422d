//! The lanes of NEON.
//!
//! The methods are inlined into functions compiled for their instruction set, and called from nowhere else.

use std::arch::aarch64::*;

use super::Ellipse;
use super::lanes::{Double, EXP2, LEAST_POWER, Lanes, Mask, ROUND, binary, four, instructions, numbered, polynomial};

/// For each mask of four lanes, the bytes of the lanes that it holds, in order.
static FIRST: [[u8; 16]; 16] = {
    let mut first = [[0; 16]; 16];
    let mut mask = 0;
    while mask < 16 {
        let (mut byte, mut kept) = (0, 0);
        while byte < 16 {
            if mask >> (byte / 4) & 1 == 1 {
                first[mask][kept] = byte as u8;
                kept += 1;
            }
            byte += 1;
        }
        mask += 1;
    }
    first
};

/// Four floats.
#[derive(Clone, Copy)]
pub(super) struct Neon(float32x4_t);

#[derive(Clone, Copy)]
pub(super) struct Mask4(uint32x4_t);

#[derive(Clone, Copy)]
pub(super) struct Double4(float64x2_t, float64x2_t);

impl Neon {
    #[inline(always)]
    fn integers(self) -> uint32x4_t {
        instructions!(vreinterpretq_u32_f32(self.0))
    }

    #[inline(always)]
    fn of_integers(bits: uint32x4_t) -> Self {
        Neon(instructions!(vreinterpretq_f32_u32(bits)))
    }
}

impl Lanes for Neon {
    const COUNT: usize = 4;
    type Mask = Mask4;
    type Double = Double4;

    binary! { add: vaddq_f32, sub: vsubq_f32, mul: vmulq_f32, div: vdivq_f32 }

    #[inline(always)]
    fn splat(x: f32) -> Self {
        Neon(instructions!(vdupq_n_f32(x)))
    }

    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        let from = &from[..4];
        Neon(instructions!(vld1q_f32(from.as_ptr())))
    }

    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        let to = &mut to[..4];
        instructions!(vst1q_f32(to.as_mut_ptr(), self.0));
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Neon(instructions!(vfmaq_f32(term.0, self.0, factor.0)))
    }

    #[inline(always)]
    fn neg_mul_add(self, factor: Self, term: Self) -> Self {
        Neon(instructions!(vfmsq_f32(term.0, self.0, factor.0)))
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        Neon(instructions!(vsqrtq_f32(self.0)))
    }

    #[inline(always)]
    fn abs(self) -> Self {
        Neon(instructions!(vabsq_f32(self.0)))
    }

    // The instructions for the least and the greatest give NaN where either is.
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self::select(self.lt(other), self, other)
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self::select(other.lt(self), self, other)
    }

    #[inline(always)]
    fn ceil(self) -> Self {
        Neon(instructions!(vrndpq_f32(self.0)))
    }

    #[inline(always)]
    fn floor(self) -> Self {
        Neon(instructions!(vrndmq_f32(self.0)))
    }

    #[inline(always)]
    fn lt(self, other: Self) -> Mask4 {
        Mask4(instructions!(vcltq_f32(self.0, other.0)))
    }

    #[inline(always)]
    fn le(self, other: Self) -> Mask4 {
        Mask4(instructions!(vcleq_f32(self.0, other.0)))
    }

    #[inline(always)]
    fn select(mask: Mask4, yes: Self, no: Self) -> Self {
        Neon(instructions!(vbslq_f32(mask.0, yes.0, no.0)))
    }

    #[inline(always)]
    fn keep(self, mask: Mask4) -> Self {
        Self::of_integers(instructions!(vandq_u32(mask.0, self.integers())))
    }

    #[inline(always)]
    fn exp2(self) -> Self {
        let x = self.max(Self::splat(LEAST_POWER));
        let shifted = x.add(Self::splat(ROUND));
        let f = x.sub(shifted.sub(Self::splat(ROUND)));
        let p = polynomial(f, &EXP2);
        p.add_integer(Self::of_integers(instructions!(vshlq_n_u32::<23>(shifted.integers()))))
    }

    #[inline(always)]
    fn to_integer(self) -> Self {
        Self::of_integers(instructions!(vcvtq_u32_f32(self.0)))
    }

    #[inline(always)]
    fn add_integer(self, other: Self) -> Self {
        Self::of_integers(instructions!(vaddq_u32(self.integers(), other.integers())))
    }

    #[inline(always)]
    fn compress(self, which: u32) -> Self {
        let order = &FIRST[which as usize % FIRST.len()];
        let order = instructions!(vld1q_u8(order.as_ptr()));
        Neon(instructions!({
            let bytes = vreinterpretq_u8_f32(self.0);
            vreinterpretq_f32_u8(vqtbl1q_u8(bytes, order))
        }))
    }

    #[inline(always)]
    fn deal3(from: &[[f32; 3]]) -> [Self; 3] {
        let from = from[..4].as_flattened();
        let float32x4x3_t(x, y, z) = instructions!(vld3q_f32(from.as_ptr()));
        [Neon(x), Neon(y), Neon(z)]
    }

    #[inline(always)]
    fn deal4(from: &[[f32; 4]]) -> [Self; 4] {
        let from = from[..4].as_flattened();
        let float32x4x4_t(x, y, z, w) = instructions!(vld4q_f32(from.as_ptr()));
        [Neon(x), Neon(y), Neon(z), Neon(w)]
    }

    #[inline(always)]
    fn collect(fields: &[Self; 16], which: u32, to: &mut [Ellipse]) -> usize {
        let quarters: [[Self; 4]; 4] = four!(q => turn4(four!(k => fields[4 * q + k])));
        let mut kept = 0;
        for lane in 0..4 {
            if which >> lane & 1 == 0 {
                continue;
            }
            let record = to[kept].as_fields_mut();
            for (quarter, part) in quarters.iter().zip(record.chunks_exact_mut(4)) {
                quarter[lane].store(part);
            }
            kept += 1;
        }
        kept
    }

    #[inline(always)]
    fn to_float(self) -> Self {
        Neon(instructions!(vcvtq_f32_u32(self.integers())))
    }

    #[inline(always)]
    fn gather(all: &[Ellipse], keys: &[u64]) -> [Self; 16] {
        let mut fields = [Self::splat(0.0); 16];
        let records = four!(i => all[numbered(keys, i)].fields());
        for q in 0..4 {
            let turned = turn4(four!(i => Self::load(&records[i][4 * q..])));
            fields[4 * q..][..4].copy_from_slice(&turned);
        }
        fields
    }

    #[inline(always)]
    fn split(self) -> (Self, Self) {
        let bits = self.integers();
        let one = Self::splat(1.0).integers();
        let (mantissa, exponent) = instructions!({
            let exponent = vreinterpretq_s32_u32(vshrq_n_u32::<23>(bits));
            let exponent = vsubq_s32(exponent, vdupq_n_s32(127));
            let mantissa = vorrq_u32(vandq_u32(bits, vdupq_n_u32(0x007f_ffff)), one);
            (mantissa, vcvtq_f32_s32(exponent))
        });
        (Self::of_integers(mantissa), Neon(exponent))
    }
}

impl Mask for Mask4 {
    binary! { and: vandq_u32 }

    #[inline(always)]
    fn bits(self) -> u32 {
        const BITS: [u32; 4] = [1, 2, 4, 8];
        let bits = instructions!(vld1q_u32(BITS.as_ptr()));
        instructions!(vaddvq_u32(vandq_u32(self.0, bits)))
    }
}

impl Double for Double4 {
    type Lanes = Neon;
    type Mask = Mask4;

    #[inline(always)]
    fn splat(x: f64) -> Self {
        let x = instructions!(vdupq_n_f64(x));
        Double4(x, x)
    }

    #[inline(always)]
    fn from_lanes(lanes: Neon) -> Self {
        Double4(
            instructions!(vcvt_f64_f32(vget_low_f32(lanes.0))),
            instructions!(vcvt_high_f64_f32(lanes.0)),
        )
    }

    #[inline(always)]
    fn to_lanes(self) -> Neon {
        Neon(instructions!(vcvt_high_f32_f64(vcvt_f32_f64(self.0), self.1)))
    }

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Double4(
            instructions!(vmulq_f64(self.0, other.0)),
            instructions!(vmulq_f64(self.1, other.1)),
        )
    }

    #[inline(always)]
    fn div(self, other: Self) -> Self {
        Double4(
            instructions!(vdivq_f64(self.0, other.0)),
            instructions!(vdivq_f64(self.1, other.1)),
        )
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Double4(
            instructions!(vfmaq_f64(term.0, self.0, factor.0)),
            instructions!(vfmaq_f64(term.1, self.1, factor.1)),
        )
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        let least = |a, b| instructions!(vbslq_f64(vcltq_f64(a, b), a, b));
        Double4(least(self.0, other.0), least(self.1, other.1))
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        let greatest = |a, b| instructions!(vbslq_f64(vcltq_f64(b, a), a, b));
        Double4(greatest(self.0, other.0), greatest(self.1, other.1))
    }

    #[inline(always)]
    fn lt(self, other: Self) -> Mask4 {
        Mask4(instructions!({
            let low = vmovn_u64(vcltq_f64(self.0, other.0));
            vmovn_high_u64(low, vcltq_f64(self.1, other.1))
        }))
    }
}

/// Vector `k` of the result holds element `k` of each of the four.
#[inline(always)]
fn turn4([a, b, c, d]: [Neon; 4]) -> [Neon; 4] {
    instructions!({
        let [ac_low, ac_high] = [vzip1q_f32(a.0, c.0), vzip2q_f32(a.0, c.0)];
        let [bd_low, bd_high] = [vzip1q_f32(b.0, d.0), vzip2q_f32(b.0, d.0)];
        [
            Neon(vzip1q_f32(ac_low, bd_low)),
            Neon(vzip2q_f32(ac_low, bd_low)),
            Neon(vzip1q_f32(ac_high, bd_high)),
            Neon(vzip2q_f32(ac_high, bd_high)),
        ]
    })
}
