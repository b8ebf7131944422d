use super::*;
use crate::cloud::ColouredVoxels;
use crate::geometry::{Voxels, morton};
use crate::limits::Limits;
use crate::placement::Placement;
use crate::sequence::SequenceEncoder;

/// Three frames of a slanted plane that moves by a voxel a frame.
fn sequence(scalable: bool) -> Vec<u8> {
    let cloud = |frame: u64| {
        let key = |i: u32| morton::encode([i % 64, i / 64, i % 64 / 2 + frame as u32]);
        let mut keys: Vec<u64> = (0..64 * 64).map(key).collect();
        keys.sort_unstable();
        let colour = |key: &u64| [(key % 251) as u8, 100, 50];
        Ok(ColouredVoxels {
            colours: keys.iter().map(colour).collect(),
            voxels: Voxels::new(6, keys),
            placement: Placement::VOXEL_GRID,
        })
    };
    let encoder = SequenceEncoder::new().with_levels(3..=5).with_scalability(scalable);
    encoder.encode(3, cloud, |_| {}).unwrap()
}

#[test]
fn a_coarse_level_needs_finer_ones_of_the_frames_before_unless_the_sequence_is_scalable() {
    for (scalable, expected) in [(true, [4, 4]), (false, [5, 5])] {
        let bytes = sequence(scalable);
        let reader = SequenceReader::new(&bytes[..], &Limits::default()).unwrap();
        assert_eq!(needed(&reader.group(0).unwrap(), 0..2, 4).unwrap(), expected);
    }
}
