//! NEON as every AArch64 processor has it: four lanes.

use std::arch::aarch64::*;
use std::arch::asm;

use bytemuck::must_cast;
use half::f16;

use super::macros::{define_set, five, four, methods, operators, vectorize};
use super::vector::{
    EXP2, F16_MAX, F32Vector, F64Vector, FIRST, I16Vector, I32Vector, LEAST_EXPONENT, MaskVector, ROUND, Simd, first,
    first_mut, polynomial, sealed,
};

define_set! { $ with_neon, is_aarch64_feature_detected,
    /// Proof of NEON.
    pub struct Neon = "neon";
}

define_set! { $ with_neon_dot, is_aarch64_feature_detected,
    /// Proof of sums of four products of bytes (`dotprod`).
    pub(crate) struct NeonDot = "dotprod";
    extends neon::Neon, with_neon;
}

define_set! { $ with_neon_half, is_aarch64_feature_detected,
    /// Proof of products and sums of f16 (`fp16`).
    pub(crate) struct NeonHalf = "fp16";
    extends neon::Neon, with_neon;
}

impl sealed::Sealed for Neon {}

impl Simd for Neon {
    const LANES: usize = 4;
    type F32 = F32x4;
    type F64 = F64x4;
    type I32 = I32x4;
    type I16 = I16x8;
    type Mask = Mask4;
    type Narrow = Self;

    #[inline(always)]
    fn narrow(self) -> Self {
        self
    }
}

vectorize! { with_neon Neon, narrow: Neon }

/// Four f32.
#[derive(Clone, Copy)]
pub struct F32x4(float32x4_t);

/// Four f64.
#[derive(Clone, Copy)]
pub struct F64x4(float64x2_t, float64x2_t);

/// Four i32.
#[derive(Clone, Copy)]
pub struct I32x4(int32x4_t);

/// Eight i16.
#[derive(Clone, Copy)]
pub struct I16x8(int16x8_t);

/// Four truth values, all bits of each lane equal.
#[derive(Clone, Copy)]
pub struct Mask4(uint32x4_t);

operators!(F32x4: Add::add = vaddq_f32, Sub::sub = vsubq_f32, Mul::mul = vmulq_f32, Div::div = vdivq_f32);
operators!(
    I32x4: Add::add = vaddq_s32, Sub::sub = vsubq_s32, Mul::mul = vmulq_s32, BitAnd::bitand = vandq_s32,
    BitOr::bitor = vorrq_s32,
);
operators!(I16x8: Add::add = vaddq_s16, Sub::sub = vsubq_s16);

methods! { with_neon F32x4: F32Vector<Neon> {
    fn splat(_simd: Neon, x: f32) -> Self {
        F32x4(vdupq_n_f32(x))
    }

    fn load(_simd: Neon, from: &[f32]) -> Self {
        F32x4(must_cast(*first::<f32, 4>(from)))
    }

    fn store(self, to: &mut [f32]) {
        *first_mut::<f32, 4>(to) = must_cast(self.0);
    }

    fn load_f16(_simd: Neon, from: &[f16]) -> Self {
        let narrow: uint16x4_t = must_cast(*first::<f16, 4>(from));
        let wide;
        // SAFETY: an instruction between registers, which any NEON has.
        unsafe {
            asm!(
                "fcvtl {wide:v}.4s, {narrow:v}.4h",
                wide = lateout(vreg) wide, narrow = in(vreg) narrow,
                options(pure, nomem, nostack, preserves_flags),
            );
        }
        F32x4(wide)
    }

    fn store_f16(self, to: &mut [f16]) {
        // Of a NaN and a number, the instruction gives the number.
        let wide = vminnmq_f32(vmaxnmq_f32(self.0, vdupq_n_f32(-F16_MAX)), vdupq_n_f32(F16_MAX));
        let narrow: uint16x4_t;
        // SAFETY: an instruction between registers, which any NEON has.
        unsafe {
            asm!(
                "fcvtn {narrow:v}.4h, {wide:v}.4s",
                narrow = lateout(vreg) narrow, wide = in(vreg) wide,
                options(pure, nomem, nostack, preserves_flags),
            );
        }
        *first_mut::<f16, 4>(to) = must_cast(narrow);
    }

    fn load_deinterleaved3(_simd: Neon, from: &[[f32; 3]]) -> [Self; 3] {
        let from = first::<_, 4>(from).as_flattened();
        // SAFETY: twelve values are read, which are there.
        let float32x4x3_t(x, y, z) = unsafe { vld3q_f32(from.as_ptr()) };
        [F32x4(x), F32x4(y), F32x4(z)]
    }

    fn load_deinterleaved4(_simd: Neon, from: &[[f32; 4]]) -> [Self; 4] {
        let from = first::<_, 4>(from).as_flattened();
        // SAFETY: sixteen values are read, which are there.
        let float32x4x4_t(x, y, z, w) = unsafe { vld4q_f32(from.as_ptr()) };
        [F32x4(x), F32x4(y), F32x4(z), F32x4(w)]
    }

    fn load_records(_simd: Neon, records: &[&[f32; 16]]) -> [Self; 16] {
        let records: &[&[f32; 16]; 4] = first(records);
        let mut fields = [F32x4(vdupq_n_f32(0.0)); 16];
        for q in 0..4 {
            let columns = transpose4(four!(i => F32x4(must_cast(*first::<f32, 4>(&records[i][4 * q..])))));
            for k in 0..4 {
                fields[4 * q + k] = columns[k];
            }
        }
        fields
    }

    fn store_records(fields: &[Self; 16], which: u32, to: &mut [[f32; 16]]) -> usize {
        let quarters: [[F32x4; 4]; 4] = four!(q => transpose4(four!(k => fields[4 * q + k])));
        let mut kept = 0;
        for lane in (0..4).filter(|lane| which >> lane & 1 == 1) {
            let record = &mut to[kept];
            for q in 0..4 {
                *first_mut::<f32, 4>(&mut record[4 * q..]) = must_cast(quarters[q][lane].0);
            }
            kept += 1;
        }
        kept
    }

    fn mul_add(self, factor: Self, term: Self) -> Self {
        F32x4(vfmaq_f32(term.0, self.0, factor.0))
    }

    fn neg_mul_add(self, factor: Self, term: Self) -> Self {
        F32x4(vfmsq_f32(term.0, self.0, factor.0))
    }

    fn sqrt(self) -> Self {
        F32x4(vsqrtq_f32(self.0))
    }

    fn abs(self) -> Self {
        F32x4(vabsq_f32(self.0))
    }

    fn min(self, other: Self) -> Self {
        // The instruction for the least gives NaN where either is.
        F32x4(vbslq_f32(vcltq_f32(self.0, other.0), self.0, other.0))
    }

    fn max(self, other: Self) -> Self {
        F32x4(vbslq_f32(vcltq_f32(other.0, self.0), self.0, other.0))
    }

    fn ceil(self) -> Self {
        F32x4(vrndpq_f32(self.0))
    }

    fn floor(self) -> Self {
        F32x4(vrndmq_f32(self.0))
    }

    fn lt(self, other: Self) -> Mask4 {
        Mask4(vcltq_f32(self.0, other.0))
    }

    fn le(self, other: Self) -> Mask4 {
        Mask4(vcleq_f32(self.0, other.0))
    }

    fn ordered(self, other: Self) -> Mask4 {
        Mask4(vandq_u32(vceqq_f32(self.0, self.0), vceqq_f32(other.0, other.0)))
    }

    fn select(mask: Mask4, yes: Self, no: Self) -> Self {
        F32x4(vbslq_f32(mask.0, yes.0, no.0))
    }

    fn keep(self, mask: Mask4) -> Self {
        F32x4(vreinterpretq_f32_u32(vandq_u32(mask.0, vreinterpretq_u32_f32(self.0))))
    }

    fn exp2(self) -> Self {
        let (round, least) = (F32x4(vdupq_n_f32(ROUND)), vdupq_n_f32(LEAST_EXPONENT));
        let x = F32x4(vbslq_f32(vcltq_f32(least, self.0), self.0, least));
        let shifted = x + round;
        let p = polynomial::<Neon>(x - (shifted - round), five!(i => F32x4(vdupq_n_f32(EXP2[i]))));
        let exponent = vshlq_n_u32::<23>(vreinterpretq_u32_f32(shifted.0));
        F32x4(vreinterpretq_f32_u32(vaddq_u32(vreinterpretq_u32_f32(p.0), exponent)))
    }

    fn split_exponent(self) -> (Self, Self) {
        let bits = vreinterpretq_u32_f32(self.0);
        let one = vreinterpretq_u32_f32(vdupq_n_f32(1.0));
        let mantissa = vorrq_u32(vandq_u32(bits, vdupq_n_u32(0x007f_ffff)), one);
        let exponent = vsubq_s32(vreinterpretq_s32_u32(vshrq_n_u32::<23>(bits)), vdupq_n_s32(127));
        (F32x4(vreinterpretq_f32_u32(mantissa)), F32x4(vcvtq_f32_s32(exponent)))
    }

    fn round_to_i32(self) -> I32x4 {
        I32x4(vcvtnq_s32_f32(self.0))
    }

    fn truncate_to_i32(self) -> I32x4 {
        I32x4(vcvtq_s32_f32(self.0))
    }

    fn to_bits(self) -> I32x4 {
        I32x4(vreinterpretq_s32_f32(self.0))
    }

    fn compress(self, which: u32) -> Self {
        let order = must_cast(FIRST[which as usize % FIRST.len()]);
        F32x4(vreinterpretq_f32_u8(vqtbl1q_u8(vreinterpretq_u8_f32(self.0), order)))
    }
}}

methods! { with_neon F64x4: F64Vector<Neon> {
    fn splat(_simd: Neon, x: f64) -> Self {
        F64x4(vdupq_n_f64(x), vdupq_n_f64(x))
    }

    fn from_f32(x: F32x4) -> Self {
        F64x4(vcvt_f64_f32(vget_low_f32(x.0)), vcvt_high_f64_f32(x.0))
    }

    fn to_f32(self) -> F32x4 {
        F32x4(vcvt_high_f32_f64(vcvt_f32_f64(self.0), self.1))
    }

    fn mul_add(self, factor: Self, term: Self) -> Self {
        F64x4(vfmaq_f64(term.0, self.0, factor.0), vfmaq_f64(term.1, self.1, factor.1))
    }

    fn min(self, other: Self) -> Self {
        F64x4(
            vbslq_f64(vcltq_f64(self.0, other.0), self.0, other.0),
            vbslq_f64(vcltq_f64(self.1, other.1), self.1, other.1),
        )
    }

    fn max(self, other: Self) -> Self {
        F64x4(
            vbslq_f64(vcltq_f64(other.0, self.0), self.0, other.0),
            vbslq_f64(vcltq_f64(other.1, self.1), self.1, other.1),
        )
    }

    fn lt(self, other: Self) -> Mask4 {
        let low = vmovn_u64(vcltq_f64(self.0, other.0));
        Mask4(vmovn_high_u64(low, vcltq_f64(self.1, other.1)))
    }
}}

methods! { with_neon F64x4: std::ops::Mul {
    type Output = Self;

    fn mul(self, other: Self) -> Self {
        F64x4(vmulq_f64(self.0, other.0), vmulq_f64(self.1, other.1))
    }
}}

methods! { with_neon F64x4: std::ops::Div {
    type Output = Self;

    fn div(self, other: Self) -> Self {
        F64x4(vdivq_f64(self.0, other.0), vdivq_f64(self.1, other.1))
    }
}}

methods! { with_neon I32x4: I32Vector<Neon> {
    fn splat(_simd: Neon, x: i32) -> Self {
        I32x4(vdupq_n_s32(x))
    }

    fn load(_simd: Neon, from: &[i32]) -> Self {
        I32x4(must_cast(*first::<i32, 4>(from)))
    }

    fn store(self, to: &mut [i32]) {
        *first_mut::<i32, 4>(to) = must_cast(self.0);
    }

    fn load_i16(_simd: Neon, from: &[i16]) -> Self {
        I32x4(vmovl_s16(must_cast(*first::<i16, 4>(from))))
    }

    fn store_i16(self, to: &mut [i16]) {
        *first_mut::<i16, 4>(to) = must_cast(vqmovn_s32(self.0));
    }

    fn min(self, other: Self) -> Self {
        I32x4(vminq_s32(self.0, other.0))
    }

    fn max(self, other: Self) -> Self {
        I32x4(vmaxq_s32(self.0, other.0))
    }

    fn min_unsigned(self, other: Self) -> Self {
        let least = vminq_u32(vreinterpretq_u32_s32(self.0), vreinterpretq_u32_s32(other.0));
        I32x4(vreinterpretq_s32_u32(least))
    }

    fn abs(self) -> Self {
        I32x4(vabsq_s32(self.0))
    }

    fn shl(self, count: u32) -> Self {
        I32x4(vshlq_s32(self.0, vdupq_n_s32(count as i32)))
    }

    fn shr(self, count: u32) -> Self {
        I32x4(vshlq_s32(self.0, vdupq_n_s32(-(count as i32))))
    }

    fn shr_unsigned(self, count: u32) -> Self {
        let shifted = vshlq_u32(vreinterpretq_u32_s32(self.0), vdupq_n_s32(-(count as i32)));
        I32x4(vreinterpretq_s32_u32(shifted))
    }

    fn shr_each(self, count: Self) -> Self {
        I32x4(vshlq_s32(self.0, vnegq_s32(count.0)))
    }

    fn eq(self, other: Self) -> Mask4 {
        Mask4(vceqq_s32(self.0, other.0))
    }

    fn lt(self, other: Self) -> Mask4 {
        Mask4(vcltq_s32(self.0, other.0))
    }

    fn select(mask: Mask4, yes: Self, no: Self) -> Self {
        I32x4(vbslq_s32(mask.0, yes.0, no.0))
    }

    fn keep(self, mask: Mask4) -> Self {
        I32x4(vandq_s32(self.0, vreinterpretq_s32_u32(mask.0)))
    }

    fn sum(self) -> i32 {
        vaddvq_s32(self.0)
    }

    fn dot_pairs(self, a: I16x8, b: I16x8) -> Self {
        let low = vmull_s16(vget_low_s16(a.0), vget_low_s16(b.0));
        let high = vmull_high_s16(a.0, b.0);
        I32x4(vaddq_s32(self.0, vpaddq_s32(low, high)))
    }

    fn to_f32(self) -> F32x4 {
        F32x4(vcvtq_f32_s32(self.0))
    }

    fn as_f32(self) -> F32x4 {
        F32x4(vreinterpretq_f32_s32(self.0))
    }

    fn as_i16(self) -> I16x8 {
        I16x8(vreinterpretq_s16_s32(self.0))
    }
}}

methods! { with_neon I16x8: I16Vector<Neon> {
    fn splat(_simd: Neon, x: i16) -> Self {
        I16x8(vdupq_n_s16(x))
    }

    fn load(_simd: Neon, from: &[i16]) -> Self {
        I16x8(must_cast(*first::<i16, 8>(from)))
    }

    fn store(self, to: &mut [i16]) {
        *first_mut::<i16, 8>(to) = must_cast(self.0);
    }

    fn load_i8(_simd: Neon, from: &[i8]) -> Self {
        I16x8(vmovl_s8(must_cast(*first::<i8, 8>(from))))
    }

    fn saturating_add(self, other: Self) -> Self {
        I16x8(vqaddq_s16(self.0, other.0))
    }

    fn min(self, other: Self) -> Self {
        I16x8(vminq_s16(self.0, other.0))
    }

    fn max(self, other: Self) -> Self {
        I16x8(vmaxq_s16(self.0, other.0))
    }

    fn mul_high(self, other: Self) -> Self {
        let low = vmull_s16(vget_low_s16(self.0), vget_low_s16(other.0));
        let high = vmull_high_s16(self.0, other.0);
        I16x8(vshrn_high_n_s32::<16>(vshrn_n_s32::<16>(low), high))
    }

    fn shr(self, count: u32) -> Self {
        I16x8(vshlq_s16(self.0, vdupq_n_s16(-(count as i16))))
    }

    fn as_i32(self) -> I32x4 {
        I32x4(vreinterpretq_s32_s16(self.0))
    }
}}

methods! { with_neon Mask4: MaskVector {
    fn and(self, other: Self) -> Self {
        Mask4(vandq_u32(self.0, other.0))
    }

    fn bits(self) -> u32 {
        vaddvq_u32(vandq_u32(self.0, must_cast([1u32, 2, 4, 8])))
    }
}}

with_neon! {
    /// Vector `k` of the result holds element `k` of each of the four.
    #[inline]
    fn transpose4([a, b, c, d]: [F32x4; 4]) -> [F32x4; 4] {
        let [ac_low, ac_high] = [vzip1q_f32(a.0, c.0), vzip2q_f32(a.0, c.0)];
        let [bd_low, bd_high] = [vzip1q_f32(b.0, d.0), vzip2q_f32(b.0, d.0)];
        [
            F32x4(vzip1q_f32(ac_low, bd_low)),
            F32x4(vzip2q_f32(ac_low, bd_low)),
            F32x4(vzip1q_f32(ac_high, bd_high)),
            F32x4(vzip2q_f32(ac_high, bd_high)),
        ]
    }
}
