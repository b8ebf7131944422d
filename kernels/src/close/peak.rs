//! Peak throughput of products of floats.

use super::kernel;
use crate::simd::Isa;
use crate::sparse::peak::{ROUNDS, best};

/// f32 multiply-adds: the bound of [`crate::FloatConv`].
pub fn f32(isa: Isa) -> f64 {
    best(|| kernel::batch(isa, ROUNDS))
}

/// bf16 by bf16, summed in f32: the bound of [`crate::Precision::Bf16`]. Where that falls back to f32, so does this.
pub fn bf16(isa: Isa) -> f64 {
    #[cfg(target_arch = "x86_64")]
    if let Some(amx) = isa.tiles() {
        return best(|| crate::exact::amx::peak::bf16(amx, ROUNDS));
    }
    #[cfg(target_arch = "x86_64")]
    if isa.has_bf16() {
        return best(|| super::bf16::batch(isa, ROUNDS));
    }
    f32(isa)
}

/// f16 by f16, summed in f16: the bound of [`crate::Precision::Half`], whose sums in f32 come on top. Where that falls
/// back to f32, so does this.
pub fn half(isa: Isa) -> f64 {
    #[cfg(target_arch = "aarch64")]
    if let Some(half) = isa.half() {
        return best(|| 2 * super::half::batch(half, ROUNDS));
    }
    f32(isa)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg_attr(miri, ignore = "an interpreter is too slow")]
    fn every_instruction_set_has_a_peak() {
        for isa in Isa::available() {
            for rate in [f32(isa), crate::exact::peak::i16(isa), bf16(isa), half(isa)] {
                assert!(rate.is_finite() && rate > 0.0, "{isa}: {rate}");
            }
        }
    }
}
