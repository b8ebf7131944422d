//! Morton keys: interleaved coordinates, which define the order of voxels (`docs/format.md`, 2.3).
//!
//! Bits of x, y and z are interleaved, x lowest. The lowest three bits of a key are the voxel's octant in its parent
//! (`x + 2y + 4z`); `key >> 3` is the parent's key.

pub use crate::limits::MAX_DEPTH;

/// Interleaves the low 21 bits of each coordinate.
#[inline]
pub fn encode([x, y, z]: [u32; 3]) -> u64 {
    spread(x) | spread(y) << 1 | spread(z) << 2
}

/// De-interleaves the coordinates of a key.
#[inline]
pub fn decode(key: u64) -> [u32; 3] {
    [compact(key), compact(key >> 1), compact(key >> 2)]
}

/// Moves bit `i` to bit `3i`.
#[inline]
fn spread(v: u32) -> u64 {
    let mut v = u64::from(v) & 0x1f_ffff;
    v = (v | v << 32) & 0x001f_0000_0000_ffff;
    v = (v | v << 16) & 0x001f_0000_ff00_00ff;
    v = (v | v << 8) & 0x100f_00f0_0f00_f00f;
    v = (v | v << 4) & 0x10c3_0c30_c30c_30c3;
    (v | v << 2) & 0x1249_2492_4924_9249
}

/// Moves bit `3i` to bit `i`.
#[inline]
fn compact(v: u64) -> u32 {
    let mut v = v & 0x1249_2492_4924_9249;
    v = (v | v >> 2) & 0x10c3_0c30_c30c_30c3;
    v = (v | v >> 4) & 0x100f_00f0_0f00_f00f;
    v = (v | v >> 8) & 0x001f_0000_ff00_00ff;
    v = (v | v >> 16) & 0x001f_0000_0000_ffff;
    ((v | v >> 32) & 0x1f_ffff) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decoding_inverts_encoding() {
        let samples = [0, 1, 2, 3, 77, 1023, 0x10_0000, 0x1f_ffff];
        for x in samples {
            for y in samples {
                for z in samples {
                    assert_eq!(decode(encode([x, y, z])), [x, y, z]);
                }
            }
        }
    }

    #[test]
    fn the_lowest_bits_are_the_octant_and_the_rest_the_parent() {
        let key = encode([5, 2, 7]);
        assert_eq!(key & 7, 1 + 4);
        assert_eq!(key >> 3, encode([2, 1, 3]));
    }
}
