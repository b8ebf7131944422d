use super::*;
use crate::cloud::ColouredVoxels;
use crate::geometry::{Voxels, morton};
use crate::limits::Limits;
use crate::placement::Placement;
use crate::sequence::SequenceEncoder;

/// Three frames of a slanted plane that moves by two voxels a frame.
fn sequence(scalable: bool) -> Vec<u8> {
    let cloud = |frame: u64| {
        let voxel = |i: u32| {
            let key = morton::encode([i % 64, i / 64, i % 64 / 2 + 2 * frame as u32]);
            (key, [(i % 64 * 3) as u8, (i / 64 * 3) as u8, 50])
        };
        let mut voxels: Vec<(u64, [u8; 3])> = (0..64 * 64).map(voxel).collect();
        voxels.sort_unstable();
        Ok(ColouredVoxels {
            colours: voxels.iter().map(|voxel| voxel.1).collect(),
            voxels: Voxels::new(6, voxels.iter().map(|voxel| voxel.0).collect()),
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
