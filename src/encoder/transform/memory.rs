//! What encoding holds in memory.

use super::Options;
use crate::geometry::Voxels;

/// Pictures of the cloud and of its levels, for head maps, and adaptive contexts.
const FIXED: u64 = 64 << 20;
/// Bytes for each node of the octree: neighbours, colours, the code, and the stream as it is decoded again and drawn.
const NODE: u64 = 320;
/// The same where the encoder looks for a rate: what it found so far beside what it tries, and colours to try.
const NODE_TO_RATE: u64 = 380;
/// Pictures of the cloud from all sides, and of what is compared with them.
const PICTURES: u64 = 88 << 20;
/// Bytes for each node of what pictures tell.
const NODE_OF_PICTURES: u64 = 60;
/// Bytes of a voxel as it came and as a part of a cloud.
const COPIES: u64 = 32;

/// Bytes that [`encode`](super::encode) of these voxels holds at most, beside the cloud itself; with `to_rate`
/// [`encode_to_rate`](super::encode_to_rate). The bytes of a node were measured; `cargo test --test memory` compares the
/// bound with what the allocator gives out.
pub fn encode_memory(voxels: &Voxels, options: &Options, to_rate: bool) -> u64 {
    memory_of(voxels.depth(), voxels.keys().iter().copied(), options, to_rate)
}

/// The same of keys of level `depth` in their order.
pub(crate) fn memory_of(depth: u8, keys: impl Iterator<Item = u64>, options: &Options, to_rate: bool) -> u64 {
    let each = if to_rate { NODE_TO_RATE } else { NODE };
    let (pictures, more) = if options.rounds > 0 {
        (PICTURES, NODE_OF_PICTURES)
    } else {
        (0, 0)
    };
    nodes(depth, keys)
        .saturating_mul(each + more)
        .saturating_add(FIXED + pictures)
}

/// Voxels of a surface that `bytes` of memory suffice to encode: of such, an octree has 1.4 times as many nodes, and of
/// the voxels themselves there are copies.
pub fn surface_within(bytes: u64) -> u64 {
    bytes.saturating_sub(FIXED) / (NODE * 7 / 5 + COPIES)
}

/// Voxels of all levels below the root.
fn nodes(depth: u8, mut keys: impl Iterator<Item = u64>) -> u64 {
    let Some(mut before) = keys.next() else {
        return 0;
    };
    // A key has a node of its own on each level from the first on that tells it from the key before.
    keys.fold(u64::from(depth), |sum, key| {
        let own = (u64::BITS - (key ^ before).leading_zeros()).div_ceil(3);
        before = key;
        sum + u64::from(own)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Octree;

    #[test]
    fn nodes_are_the_voxels_of_all_levels() {
        let scattered = (0..3000u64).map(|i| i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 46);
        for (depth, keys) in [
            (6, scattered.collect::<Vec<_>>()),
            (2, vec![9]),
            (3, (0..512).collect()),
        ] {
            let mut keys = keys;
            keys.sort_unstable();
            keys.dedup();
            let voxels = Voxels::new(depth, keys);
            let octree = Octree::new(voxels.clone()).unwrap();
            let all: usize = (1..=depth).map(|level| octree.level(level).len()).sum();
            assert_eq!(nodes(depth, voxels.keys().iter().copied()), all as u64);
        }
    }
}
