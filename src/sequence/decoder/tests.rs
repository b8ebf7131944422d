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

#[test]
fn a_coarse_level_taken_on_the_way_to_a_finer_one_is_that_decoded_by_itself() {
    let bytes = sequence(false);
    let reader = SequenceReader::new(&bytes[..], &Limits::default()).unwrap();
    let group = reader.group(0).unwrap();
    let decoder = SequenceDecoder::new(Decoder::new());
    let mut last = None;
    for at in 0..2 {
        let alone = decoder.decoded(&group, at, last.as_ref(), 4).unwrap();
        let (shown, next) = decoder.on_the_way(&group, at, last.as_ref(), 4..5).unwrap();
        assert_eq!(shown.level(), Some(4));
        let [alone, shown] = [alone, shown].map(|decoding| {
            let points = decoding.points().unwrap();
            (
                points.voxels.clone(),
                points.colours.to_vec(),
                decoding.gaussians().unwrap(),
            )
        });
        assert_eq!(alone, shown);
        assert_eq!(next.as_ref().map(|next| next.level), Some(5));
        last = next;
    }
}
