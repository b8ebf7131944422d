//! What tests of several stages share.

use crate::container::Slice;

/// A linear congruential generator: what tests draw from.
pub(crate) struct Random(pub u64);

impl Random {
    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        self.0 >> 33
    }
}

/// Codes as slices of a stream, wherever they lie in it.
pub(crate) fn slices_of(codes: &[Vec<u8>]) -> Vec<Slice<'_>> {
    let slice = |bytes| Slice {
        voxels: 0,
        bytes,
        offset: 0,
    };
    codes.iter().map(Vec::as_slice).map(slice).collect()
}
