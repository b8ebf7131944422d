//! Sequences of frames: index, groups, seeking, cutting and joining.

#[path = "../common/mod.rs"]
mod common;
mod kept;
mod predicted;

use b2p::cloud::ColouredVoxels;
use b2p::encoder::transform::{Options, Outline};
use b2p::gaussians::learned::HeadsModel;
use b2p::geometry::{Voxels, morton};
use b2p::sequence::{Rate, join};
use b2p::{Decoder, Error, Limits, Placement, SequenceDecoder, SequenceEncoder, SequenceReader};
use common::Ball;

/// A ball that moves by a voxel a frame, and starts again after eight frames.
fn moving(frame: u64) -> ColouredVoxels {
    ball(20.0, frame)
}

/// A ball of `radius` voxels that has moved to a place of `frame`.
fn ball(radius: f32, frame: u64) -> ColouredVoxels {
    let moved = |([x, y, z], colour): ([u32; 3], [u8; 3])| (morton::encode([x + (frame % 8) as u32, y, z]), colour);
    let mut voxels: Vec<_> = Ball::new(6, radius).voxels().into_iter().map(moved).collect();
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
fn frames_that_reach_as_far_as_the_cloud_are_all_as_thick_as_its_first() {
    let coded = |outline| {
        let heads = HeadsModel::from_bytes(include_bytes!("../../models/heads.safetensors"));
        let options = Options {
            // They make head maps of other kinds for single frames.
            heads: heads.ok().filter(|_| outline == Outline::Cloud),
            tune: b2p::Tune::Psnr,
            outline,
            ..Options::default()
        };
        let encoder = SequenceEncoder::new()
            .with_options(options)
            .with_levels(3..=5)
            .with_group(3);
        encoder
            .encode(5, |frame| Ok(moving(frame)), |_| {})
            .expect("a sequence")
    };
    let [surface, cloud] = [Outline::Surface, Outline::Cloud].map(coded);
    for level in 3..=5 {
        let mut variance = None;
        for frame in 0..5 {
            let [usual, drawn] = [&surface, &cloud].map(|bytes| {
                let sequence = reader(bytes);
                let mut decoder = SequenceDecoder::new(Decoder::new().with_level(level));
                let mut gaussians = decoder.gaussians(&sequence, frame..frame + 1);
                gaussians.next().expect("a frame").expect("Gaussians")
            });
            assert_eq!(usual.position, drawn.position);
            let squares = |scale: &[f32; 3]| scale.iter().map(|s| f64::from(*s).powi(2)).sum::<f64>();
            for (usual, drawn) in usual.scale.iter().zip(&drawn.scale) {
                let added = squares(drawn) - squares(usual);
                let first = *variance.get_or_insert(added);
                assert!(
                    (added - first).abs() < 1e-7,
                    "level {level}, frame {frame}: {added}, {first}"
                );
            }
        }
        assert!(variance.is_some_and(|variance| variance > 1e-6), "level {level}");
    }
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
