//! Peak throughput of integer products.

use super::kernel;
use crate::simd::Isa;
use crate::sparse::peak::{ROUNDS, best};

/// i16 by i16, summed in i32: the bound of [`crate::ExactConv`]. With tiles, a third of the products of bytes that they
/// can do: three make one of what a layer multiplies.
pub fn i16(isa: Isa) -> f64 {
    #[cfg(target_arch = "x86_64")]
    if let Some(amx) = isa.tiles() {
        return best(|| super::amx::peak::bytes(amx, ROUNDS)) / 3.0;
    }
    #[cfg(target_arch = "aarch64")]
    if let Some(dot) = isa.dot() {
        return best(|| super::dot::batch(dot, ROUNDS));
    }
    best(|| kernel::batch(isa, ROUNDS))
}
