//! Sequences of frames: index, groups, seeking, cutting and joining.

#[path = "../common/mod.rs"]
mod common;
mod kept;

use b2p::cloud::ColouredVoxels;
use b2p::encoder::transform::{GeometryTarget, QualityTarget};
use b2p::geometry::{Voxels, morton};
use b2p::sequence::{Rate, join};
use b2p::{Decoder, Error, Limits, Placement, SequenceDecoder, SequenceEncoder, SequenceReader};
use common::Ball;

/// A ball that moves by a voxel a frame, and starts again after eight frames.
fn moving(frame: u64) -> ColouredVoxels {
    let moved = |([x, y, z], colour): ([u32; 3], [u8; 3])| (morton::encode([x + (frame % 8) as u32, y, z]), colour);
    let mut voxels: Vec<_> = Ball::new(6, 20.0).voxels().into_iter().map(moved).collect();
    voxels.sort_unstable();
    ColouredVoxels {
        voxels: Voxels::new(6, voxels.iter().map(|voxel| voxel.0).collect()),
        colours: voxels.iter().map(|voxel| voxel.1).collect(),
        placement: Placement::VOXEL_GRID,
    }
}

fn encoder() -> SequenceEncoder {
    SequenceEncoder::new().with_levels(3..=5).with_group(3)
}

fn encoded(frames: u64) -> Vec<u8> {
    let sequence = encoder().encode(frames, |frame| Ok(moving(frame)), |_| {});
    sequence.expect("a ball can be coded")
}

fn reader(bytes: &[u8]) -> SequenceReader<'_> {
    SequenceReader::new(bytes, &Limits::default()).expect("a sequence")
}

type Frame = (Vec<u64>, Vec<[u8; 3]>);

fn frame(sequence: &SequenceReader, frame: u64, level: Option<u8>) -> Result<Frame, Error> {
    let mut decoder = SequenceDecoder::new(Decoder::new().with_level(level));
    let decoded = decoder.frame(sequence, frame)?;
    let points = decoded.points().expect("a level");
    Ok((points.voxels.keys().to_vec(), points.colours.to_vec()))
}

#[test]
fn every_frame_decodes_alone_and_in_order_at_every_level() {
    let bytes = encoded(7);
    let sequence = reader(&bytes);
    assert_eq!((sequence.frames(), sequence.groups()), (7, 3));
    for level in 3..=5 {
        let mut decoder = SequenceDecoder::new(Decoder::new().with_level(level));
        for (number, decoded) in decoder.frames(&sequence, 0..7).enumerate() {
            let decoded = decoded.expect("a frame");
            assert_eq!(decoded.number, number as u64);
            let points = decoded.points().expect("a level");
            let alone = frame(&sequence, number as u64, Some(level)).expect("a frame");
            assert_eq!((points.voxels.keys(), points.colours), (&alone.0[..], &alone.1[..]));
        }
    }
}

#[test]
fn every_level_of_a_scalable_sequence_decodes_for_more_bits() {
    let encode = |scalable| {
        let encoder = encoder().with_scalability(scalable);
        encoder
            .encode(3, |frame| Ok(moving(frame)), |_| {})
            .expect("a sequence")
    };
    let (usual, scalable) = (encode(false), encode(true));
    assert!(usual.len() < scalable.len(), "{} and {}", usual.len(), scalable.len());
    for level in 3..=5 {
        for number in 0..3 {
            let (keys, _) = frame(&reader(&scalable), number, Some(level)).expect("a frame");
            let (same, _) = frame(&reader(&usual), number, Some(level)).expect("a frame");
            assert!(
                keys.len().abs_diff(same.len()) < same.len() / 8,
                "level {level}, frame {number}"
            );
        }
    }
}

#[test]
fn another_level_from_any_frame_on_does_not_change_what_is_decoded() {
    let bytes = encoded(7);
    let sequence = reader(&bytes);
    let mut decoder = SequenceDecoder::new(Decoder::new());
    for (number, level) in [5, 4, 5, 3, 4, 5, 3].into_iter().enumerate() {
        decoder.set_decoder(Decoder::new().with_level(level));
        let decoded = decoder.frame(&sequence, number as u64).expect("a frame");
        let points = decoded.points().expect("a level");
        let alone = frame(&sequence, number as u64, Some(level)).expect("a frame");
        assert_eq!((points.voxels.keys(), points.colours), (&alone.0[..], &alone.1[..]));
    }
}

#[test]
fn a_sequence_does_not_depend_on_the_number_of_threads() {
    let bytes = encoded(7);
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("threads");
        assert!(pool.install(|| encoded(7)) == bytes);
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
            .encode(2, |frame| Ok(moving(frame)), |_| {})
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

#[test]
fn frames_are_found_by_their_time() {
    let encoder = encoder().with_frame_rate(30_000, 1001);
    let bytes = encoder
        .encode(7, |frame| Ok(moving(frame)), |_| {})
        .expect("a sequence");
    let sequence = reader(&bytes);
    for number in 0..7 {
        let time = sequence.time_of(number).expect("a time");
        assert!((time - number as f64 * 1001.0 / 30_000.0).abs() < 1e-9);
        assert_eq!(sequence.frame_at(time).expect("a frame"), number);
        assert_eq!(sequence.frame_at(time + 0.03).expect("a frame"), number);
    }
    assert!((sequence.seconds() - 7.0 * 1001.0 / 30_000.0).abs() < 1e-9);
    assert_eq!(sequence.frame_at(-1.0).expect("a frame"), 0);
    assert_eq!(sequence.frame_at(1e300).expect("a frame"), 6);
    assert!(matches!(sequence.frame_at(f64::NAN), Err(Error::Usage(_))));
    assert!(matches!(sequence.time_of(7), Err(Error::Usage(_))));
}

#[test]
fn cutting_and_joining_keep_groups_bit_for_bit() {
    let bytes = encoded(8);
    let sequence = reader(&bytes);
    assert!(sequence.cut(0..8).expect("all") == bytes);
    let parts = [0..3, 3..6, 6..8].map(|frames| sequence.cut(frames).expect("groups"));
    for (part, first) in parts.iter().zip([0, 3, 6]) {
        let part = reader(part);
        assert_eq!(part.time_of(0).expect("a time"), 0.0);
        for number in 0..part.frames() {
            let same = frame(&sequence, first + number, None).expect("a frame");
            assert!(frame(&part, number, None).expect("a frame") == same);
        }
    }
    let joined = join(&parts.iter().map(|part| reader(part)).collect::<Vec<_>>());
    assert!(joined.expect("a sequence") == bytes);
}

#[test]
fn a_cut_within_a_group_is_refused_and_says_where_groups_are() {
    let bytes = encoded(8);
    let refused = reader(&bytes).cut(1..5).expect_err("a cut within groups");
    assert!(refused.to_string().contains("0..6"), "{refused}");
    assert!(reader(&bytes).cut(3..3).is_err());
    assert!(reader(&bytes).cut(6..9).is_err());
}

#[test]
fn sequences_on_different_grids_are_not_joined() {
    let here = encoded(3);
    let coarser = encoder().with_levels(3..=4);
    let there = coarser
        .encode(3, |frame| Ok(moving(frame)), |_| {})
        .expect("a sequence");
    let refused = join(&[reader(&here), reader(&there)]).expect_err("other levels");
    assert!(refused.to_string().contains("levels"), "{refused}");
}

#[test]
fn frames_on_different_grids_are_refused_naming_the_frame() {
    let cloud = |frame| {
        let mut cloud = moving(frame);
        cloud.placement.voxel_size += if frame == 4 { 0.5 } else { 0.0 };
        Ok(cloud)
    };
    let refused = encoder().encode(6, cloud, |_| {}).expect_err("another grid");
    assert!(refused.to_string().contains("frame 4"), "{refused}");
}

#[test]
fn a_decoder_of_one_frame_refuses_a_sequence_and_names_the_feature() {
    let bytes = encoded(3);
    let refused = Decoder::new().decode(&bytes).expect_err("a sequence");
    assert!(matches!(refused, Error::Unsupported { .. }));
    assert!(refused.to_string().contains("sequence of frames"), "{refused}");
    let alone = b2p::Encoder::new()
        .with_levels(3..=5)
        .encode(&moving(0))
        .expect("a frame")
        .bytes;
    let refused = SequenceReader::new(&alone, &Limits::default()).expect_err("one frame");
    assert!(matches!(refused, Error::Unsupported { .. }));
    assert!(SequenceReader::is_sequence(&bytes) && !SequenceReader::is_sequence(&alone));
}

#[test]
fn a_damaged_group_leaves_the_others_and_a_cut_file_its_first_groups() {
    let bytes = encoded(7);
    let sequence = reader(&bytes);
    let start = bytes.len() - 40;
    let mut damaged = bytes.clone();
    damaged[start] ^= 4;
    let damaged = reader(&damaged);
    let cut = reader(&bytes[..start]);
    for number in 0..6 {
        let whole = frame(&sequence, number, None).expect("a frame");
        assert!(frame(&damaged, number, None).expect("a frame") == whole);
        assert!(frame(&cut, number, None).expect("a frame") == whole);
    }
    assert!(matches!(frame(&damaged, 6, None), Err(Error::Malformed { .. })));
    assert!(matches!(frame(&cut, 6, None), Err(Error::Truncated { .. })));
    assert!(matches!(cut.check_end(), Err(Error::Truncated { .. })));
    assert!(sequence.check_end().is_ok());
}

#[test]
fn more_frames_than_the_limit_are_refused() {
    let bytes = encoded(7);
    let limits = Limits::default().with_max_frames(6);
    let refused = SequenceReader::new(&bytes[..], &limits).expect_err("too many");
    assert!(matches!(
        refused,
        Error::LimitExceeded {
            option: "max_frames",
            ..
        }
    ));
}

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
    assert!(15 * sizes[1] < sizes[0] && 15 * sizes[2] < sizes[0], "{sizes:?}");
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
fn lossless_frames_have_exactly_their_voxels_and_colours() {
    let encoder = SequenceEncoder::new()
        .with_levels(3..=6)
        .with_quality(b2p::QualityTarget::Lossless);
    let bytes = encoder
        .encode(5, |frame| Ok(moving(frame)), |_| {})
        .expect("a sequence");
    let sequence = reader(&bytes);
    for number in 0..5 {
        let (keys, colours) = frame(&sequence, number, None).expect("a frame");
        let cloud = moving(number);
        assert_eq!((&keys[..], &colours), (cloud.voxels.keys(), &cloud.colours));
    }
}

#[test]
fn frames_are_coded_alone_without_prediction() {
    let encoder = encoder().with_prediction(false);
    let bytes = encoder
        .encode(3, |frame| Ok(moving(frame)), |_| {})
        .expect("a sequence");
    let sequence = reader(&bytes);
    let group = sequence.group(0).expect("a group");
    let sizes: Vec<u64> = (0..3).map(|at| group.frame_bytes(at)).collect();
    assert!((0..3).all(|at| group.is_whole(at)), "{sizes:?}");
    // A whole frame is what a stream of one frame decodes to, but for colours that are tuned to what is drawn.
    let alone = b2p::Encoder::new()
        .with_levels(3..=5)
        .with_tune(b2p::Tune::Psnr)
        .encode(&moving(1))
        .expect("a frame")
        .bytes;
    let alone = Decoder::new().whole(&alone).expect("a frame");
    let points = alone.points().expect("a level");
    let (keys, colours) = frame(&sequence, 1, None).expect("a frame");
    assert_eq!((points.voxels.keys(), points.colours), (&keys[..], &colours[..]));
}

#[test]
fn a_rate_is_kept_to_and_too_few_bits_are_refused() {
    let cloud = |frame| Ok(moving(frame));
    let most = Rate::BitsPerPoint(0.9);
    let bytes = encoder().encode_to_rate(4, cloud, |_| {}, most).expect("a sequence");
    let sequence = reader(&bytes);
    let points = (0..4).map(|frame| moving(frame).voxels.len()).sum::<usize>();
    assert_eq!(sequence.frames(), 4);
    assert!(bytes.len() as f64 * 8.0 <= 0.9 * points as f64);
    let refused = encoder().encode_to_rate(4, cloud, |_| {}, Rate::BitsPerFrame(10.0));
    assert!(matches!(refused, Err(Error::TooFewBits { .. })));
}
