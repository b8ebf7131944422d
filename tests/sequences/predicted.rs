//! What is predicted from the frame before.

use b2p::cloud::ColouredVoxels;
use b2p::encoder::transform::{GeometryTarget, QualityTarget};
use b2p::geometry::{Voxels, morton};
use b2p::{Decoder, Motion, Placement, SequenceDecoder, SequenceEncoder};

use super::common::Ball;
use super::{Frame, ball, encoder, frame, moving, reader};

/// A number that looks random (the last steps of SplitMix64).
fn mixed(number: u64) -> u64 {
    let x = number.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let x = (x ^ x >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let x = (x ^ x >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ x >> 31
}

/// A ball of level 8 of whose voxels other ones are missing in each frame.
fn still(frame: u64) -> ColouredVoxels {
    let is_there = |key: u64| (key ^ frame << 40).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 56 > 6;
    let mut voxels: Vec<_> = Ball::new(8, 90.0)
        .voxels()
        .into_iter()
        .map(|(at, colour)| (morton::encode(at), colour))
        .filter(|(key, _)| is_there(*key))
        .collect();
    voxels.sort_unstable();
    ColouredVoxels {
        voxels: Voxels::new(8, voxels.iter().map(|voxel| voxel.0).collect()),
        colours: voxels.iter().map(|voxel| voxel.1).collect(),
        placement: Placement::VOXEL_GRID,
    }
}

#[test]
fn a_still_cloud_has_the_same_gaussians_in_every_frame_for_few_bits() {
    let encoder = SequenceEncoder::new().with_levels(4..=7);
    let bytes = encoder.encode(4, |frame| Ok(still(frame)), |_| {}).expect("a sequence");
    let sequence = reader(&bytes);
    let group = sequence.group(0).expect("a group");
    let mut decoder = SequenceDecoder::new(Decoder::new());
    let mut first = None;
    for (at, gaussians) in decoder.gaussians(&sequence, 0..4).enumerate() {
        let gaussians = gaussians.expect("a frame");
        assert_eq!(group.is_whole(at), at == 0);
        let bytes = [0, at].map(|at| group.frame_bytes(at));
        assert!(at == 0 || 9 * bytes[1] < bytes[0], "{bytes:?}");
        assert!(*first.get_or_insert_with(|| gaussians.clone()) == gaussians);
    }
}

#[test]
fn noise_of_colours_is_not_coded_again_but_a_change_is() {
    let cloud = |frame: u64, change: u8| {
        let mut cloud = still(frame);
        let noise = |key: &u64| (mixed(key ^ frame << 40) >> 59) as u8;
        let noisy = |(key, colour): (&u64, &[u8; 3])| colour.map(|c| (c / 2 + noise(key)).saturating_add(change));
        cloud.colours = cloud.voxels.keys().iter().zip(&cloud.colours).map(noisy).collect();
        cloud
    };
    let encoder = SequenceEncoder::new()
        .with_levels(4..=7)
        .with_quality(QualityTarget::Step(8.0));
    let mean = |frame: Frame| {
        let sum: f64 = frame.1.iter().map(|colour| f64::from(colour[1])).sum();
        sum / frame.1.len() as f64
    };
    let encode = |change: u8| {
        let clouds = |frame: u64| Ok(cloud(frame, if frame == 2 { change } else { 0 }));
        encoder.encode(3, clouds, |_| {}).expect("a sequence")
    };
    let bytes = encode(0);
    let sequence = reader(&bytes);
    let group = sequence.group(0).expect("a group");
    let sizes: Vec<u64> = (0..3).map(|at| group.frame_bytes(at)).collect();
    assert!(12 * sizes[1] < sizes[0] && 12 * sizes[2] < sizes[0], "{sizes:?}");
    // All of it becomes lighter by less than the noise.
    let bytes = encode(6);
    let [before, after] = [1, 2].map(|number| mean(frame(&reader(&bytes), number, None).expect("a frame")));
    assert!((after - before - 6.0).abs() < 1.5, "{before} {after}");
}

#[test]
fn a_moved_cloud_takes_fewer_bits_than_a_whole_frame() {
    // By whole voxels of the finest level that is coded.
    let bytes = encoder()
        .encode(3, |frame| Ok(moving(2 * frame)), |_| {})
        .expect("a sequence");
    let sequence = reader(&bytes);
    let group = sequence.group(0).expect("a group");
    for at in 1..3 {
        assert!(!group.is_whole(at));
        let bytes = [0, at].map(|at| group.frame_bytes(at));
        assert!(4 * bytes[1] < 3 * bytes[0], "{bytes:?}");
    }
}

#[test]
fn a_frame_that_the_one_before_tells_nothing_of_is_whole() {
    // Neither shapes nor textures have anything in common.
    let cloud = |frame: u64| {
        let mut voxels: Vec<_> = { Ball::new(8, 50.0 + 20.0 * frame as f32).voxels().into_iter() }
            .map(|(at, colour)| (morton::encode(at), colour))
            .collect();
        voxels.sort_unstable();
        let mut cloud = ColouredVoxels {
            voxels: Voxels::new(8, voxels.iter().map(|voxel| voxel.0).collect()),
            colours: Vec::new(),
            placement: Placement::VOXEL_GRID,
        };
        // In patches of 8³ voxels: what differs from voxel to voxel may be noise.
        let shade = |key: &u64| (mixed(key >> 9 ^ frame << 40) >> 56) as u8;
        cloud.colours = cloud.voxels.keys().iter().map(|key| [shade(key); 3]).collect();
        Ok(cloud)
    };
    let encoder = SequenceEncoder::new().with_levels(4..=7);
    let bytes = encoder.encode(3, cloud, |_| {}).expect("a sequence");
    let sequence = reader(&bytes);
    let group = sequence.group(0).expect("a group");
    let sizes: Vec<u64> = (0..3).map(|at| group.frame_bytes(at)).collect();
    assert!((0..3).all(|at| group.is_whole(at)), "{sizes:?}");
}

#[test]
fn a_moved_surface_of_other_sample_points_takes_a_fraction_of_the_bits() {
    let cloud = |frame: u64| {
        let cloud = still(frame);
        let moved = |key: &u64| {
            let [x, y, z] = morton::decode(*key);
            morton::encode([x + 4 * frame as u32, y + 2 * frame as u32, z])
        };
        let pairs = cloud.voxels.keys().iter().map(moved).zip(cloud.colours.iter().copied());
        let mut voxels: Vec<_> = pairs.collect();
        voxels.sort_unstable();
        ColouredVoxels {
            voxels: Voxels::new(8, voxels.iter().map(|voxel| voxel.0).collect()),
            colours: voxels.iter().map(|voxel| voxel.1).collect(),
            placement: Placement::VOXEL_GRID,
        }
    };
    let encoder = SequenceEncoder::new().with_levels(4..=7);
    let bytes = encoder.encode(3, |frame| Ok(cloud(frame)), |_| {}).expect("a sequence");
    let sequence = reader(&bytes);
    let group = sequence.group(0).expect("a group");
    let sizes: Vec<u64> = (0..3).map(|at| group.frame_bytes(at)).collect();
    assert!(2 * sizes[1] < sizes[0] && 2 * sizes[2] < sizes[0], "{sizes:?}");
    // Each true voxel has one of the frame within one.
    for number in 0..3 {
        let (keys, _) = frame(&sequence, number, None).expect("a frame");
        let near = |key: &u64| {
            let at = morton::decode(key >> 3).map(|x| x as i32);
            (0..27).any(|k| {
                let place = [at[0] + k % 3 - 1, at[1] + k / 3 % 3 - 1, at[2] + k / 9 - 1];
                place.iter().all(|x| *x >= 0) && keys.binary_search(&morton::encode(place.map(|x| x as u32))).is_ok()
            })
        };
        let cloud = cloud(number);
        let far = cloud.voxels.keys().iter().filter(|key| !near(key)).count();
        assert!(1000 * far <= cloud.voxels.len(), "frame {number}: {far} voxels");
    }
}

#[test]
fn a_frame_says_whether_it_is_warped() {
    for motion in [Motion::Warped, Motion::Parts, Motion::Blocks] {
        let encoder = SequenceEncoder::new().with_levels(4..=7).with_motion(motion);
        let bytes = encoder.encode(3, |frame| Ok(still(frame)), |_| {}).expect("a sequence");
        let sequence = reader(&bytes);
        let group = sequence.group(0).expect("a group");
        let kinds: Vec<_> = (0..3).map(|at| (group.is_whole(at), group.is_warped(at))).collect();
        let warped = motion == Motion::Warped;
        assert_eq!(kinds, [(true, false), (false, warped), (false, warped)], "{motion:?}");
    }
}

#[test]
fn frames_of_other_sample_points_are_coded_to_the_level_of_the_cloud() {
    let sampled = |frame: u64| {
        let cloud = moving(0);
        let is_there = |key: &u64| !(key.wrapping_mul(0x9e37_79b9_7f4a_7c15 + 2 * frame) >> 59).is_multiple_of(8);
        let pairs = cloud.voxels.keys().iter().zip(&cloud.colours);
        let there: Vec<_> = pairs.filter(|(key, _)| is_there(key)).collect();
        ColouredVoxels {
            voxels: Voxels::new(6, there.iter().map(|(key, _)| **key).collect()),
            colours: there.iter().map(|(_, colour)| **colour).collect(),
            placement: Placement::VOXEL_GRID,
        }
    };
    let bytes = SequenceEncoder::new().with_levels(4..=6);
    let bytes = bytes
        .encode(4, |number| Ok(sampled(number)), |_| {})
        .expect("a sequence");
    let sequence = reader(&bytes);
    for number in 0..4 {
        let (keys, _) = frame(&sequence, number, None).expect("a frame");
        let cloud = sampled(number);
        // Kept blocks have the voxels of another sample.
        assert!(
            keys.len().abs_diff(cloud.voxels.len()) < cloud.voxels.len() / 4,
            "frame {number}"
        );
    }
}

#[test]
fn frames_that_a_group_is_predicted_from_have_exact_geometry_above_the_clouds_own_level() {
    let encode = |predicted: bool, geometry| {
        let encoder = encoder()
            .with_group(2)
            .with_prediction(predicted)
            .with_geometry(geometry);
        let bytes = encoder
            .encode(2, |frame| Ok(ball(20.0 - 6.0 * frame as f32, frame)), |_| {})
            .expect("a sequence");
        let sequence = reader(&bytes);
        let first = frame(&sequence, 0, None).expect("a frame").0;
        (bytes.len(), first)
    };
    let (exact, lossy) = (
        encode(false, GeometryTarget::Exact),
        encode(false, GeometryTarget::Lambda(0.5)),
    );
    assert!(
        lossy.0 < exact.0 && lossy.1 != exact.1,
        "{} and {} bytes",
        lossy.0,
        exact.0
    );
    let (exact, moved) = (
        encode(true, GeometryTarget::Exact),
        encode(true, GeometryTarget::Lambda(0.5)),
    );
    assert!(exact.1 == moved.1);
    assert!(moved.0 < exact.0, "{} and {} bytes", moved.0, exact.0);
    let alone = b2p::Encoder::new()
        .with_levels(3..=5)
        .with_geometry(GeometryTarget::Lambda(0.5));
    let alone = Decoder::new()
        .whole(&alone.encode(&moving(0)).expect("a frame").bytes)
        .expect("a frame")
        .points()
        .expect("a level")
        .voxels
        .keys()
        .to_vec();
    assert!(alone == lossy.1, "as a single frame has");
}

#[test]
fn at_the_clouds_own_level_voxels_of_all_frames_may_move_by_one() {
    let encode = |geometry| {
        let encoder = SequenceEncoder::new().with_levels(5..=8).with_geometry(geometry);
        encoder.encode(3, |frame| Ok(still(frame)), |_| {}).expect("a sequence")
    };
    let (exact, moved) = (encode(GeometryTarget::Exact), encode(GeometryTarget::Lambda(0.5)));
    let sizes = [moved.len(), exact.len()];
    assert!(3 * sizes[0] < 2 * sizes[1], "{sizes:?} bytes");
    let near = |keys: &[u64], key: u64| {
        let at = morton::decode(key).map(|x| x as i32);
        (0..27).any(|k| {
            let place = [at[0] + k % 3 - 1, at[1] + k / 3 % 3 - 1, at[2] + k / 9 - 1];
            place.iter().all(|x| *x >= 0) && keys.binary_search(&morton::encode(place.map(|x| x as u32))).is_ok()
        })
    };
    let (first, _) = frame(&reader(&moved), 0, None).expect("a frame");
    let cloud = still(0);
    assert!(cloud.voxels.keys().iter().all(|key| near(&first, *key)));
    assert!(first.iter().all(|key| near(cloud.voxels.keys(), *key)));
}

#[test]
fn sparse_clouds_keep_their_own_level_in_predicted_frames_too() {
    let encode = |one_in: u64, geometry| {
        let cloud = |frame: u64| {
            let whole = still(frame);
            let pairs = whole.voxels.keys().iter().zip(&whole.colours);
            let kept: Vec<_> = pairs.filter(|(key, _)| mixed(**key).is_multiple_of(one_in)).collect();
            Ok(ColouredVoxels {
                voxels: Voxels::new(8, kept.iter().map(|pair| *pair.0).collect()),
                colours: kept.iter().map(|pair| *pair.1).collect(),
                placement: whole.placement,
            })
        };
        let encoder = SequenceEncoder::new().with_levels(5..=8).with_geometry(geometry);
        encoder.encode(2, cloud, |_| {}).expect("a sequence")
    };
    assert!(encode(8, GeometryTarget::Visual) == encode(8, GeometryTarget::Exact));
    assert!(encode(1, GeometryTarget::Visual) != encode(1, GeometryTarget::Exact));
}
