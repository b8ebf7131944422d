//! Head maps: which voxels surfels draw, and how wide surfels are, through the public interface.

mod common;

use b2p::Decoder;
use b2p::Limits;
use b2p::cloud::ColouredVoxels;
use b2p::container::Stream;
use b2p::encoder::transform::{Options, Outline, QualityTarget, encode, encode_to_rate};
use b2p::gaussians::learned::HeadsModel;
use b2p::gaussians::{Gaussians, HeadSet};
use b2p::log::Log;
use common::{Ball, sparse_wall};

fn stream(cloud: &ColouredVoxels, options: &Options) -> Vec<u8> {
    let encoded = encode(cloud, options, &Log::default());
    encoded.expect("a cloud can be coded").bytes
}

fn points(bytes: &[u8], level: Option<u8>) -> (Vec<u64>, Vec<[u8; 3]>) {
    let decoding = Decoder::new().with_level(level).whole(bytes).unwrap();
    let points = decoding.points().expect("a level");
    (points.voxels.keys().to_vec(), points.colours.to_vec())
}

/// The shipped heads.
fn heads() -> HeadsModel {
    HeadsModel::from_bytes(include_bytes!("../models/heads.safetensors")).unwrap()
}

fn with(fineness: QualityTarget) -> Options {
    Options {
        fineness,
        ..Options::default()
    }
}

#[test]
fn a_stream_with_head_maps_keeps_its_points_and_its_rate_and_mixes_surfels_with_learned_gaussians() {
    let cloud = Ball::new(8, 100.0).cloud();
    let heads = heads();
    let options = Options {
        heads: Some(heads.clone()),
        ..Options::default()
    };
    let found = encode_to_rate(&cloud, &options, 1.0, &Log::default());
    let (encoded, chosen) = found.unwrap();
    assert!(encoded.bytes.len() * 8 <= cloud.voxels.len());
    assert_eq!(encoded.bytes, stream(&cloud, &chosen));
    let without = Options {
        head_maps: false,
        ..chosen
    };
    let plain = stream(&cloud, &without);
    let parsed = Stream::parse(&encoded.bytes, &Limits::default()).unwrap();
    assert!(parsed.damage().is_none());
    let map = |level: &b2p::container::Level| level.colours.as_ref().is_some_and(|colours| colours.head_map.is_some());
    let mut most = 0.0;
    for level in parsed.levels() {
        assert!(map(level), "level {}", level.level);
        let level = Some(level.level);
        assert_eq!(points(&encoded.bytes, level), points(&plain, level));
        let decoder = Decoder::new().with_level(level).with_heads_model(heads.clone());
        let learned = decoder.decode(&plain).unwrap();
        let surfels = Decoder::new().with_level(level).decode(&plain).unwrap();
        // A ball is smooth: most of it, if not all, is better as surfels.
        let mixed = decoder.decode(&encoded.bytes).unwrap();
        let from = |of: &b2p::gaussians::Gaussians| {
            let positions: Vec<_> = of.position.iter().map(|p| p.map(f32::to_bits)).collect();
            let all: std::collections::HashSet<_> = positions.into_iter().collect();
            let count = mixed
                .position
                .iter()
                .filter(|p| all.contains(&p.map(f32::to_bits)))
                .count();
            count as f64 / mixed.len() as f64
        };
        let (learned, surfels) = (from(&learned), from(&surfels));
        assert!(learned + surfels > 0.999, "{level:?}: {learned} + {surfels}");
        most = f64::max(most, if learned < 1.0 { surfels } else { 0.0 });
    }
    assert!(most > 0.3, "{most}");
}

/// In single parts of a level.
fn in_parts(decoder: &Decoder, bytes: &[u8]) -> Vec<[f32; 3]> {
    let mut scales = Vec::new();
    let parts = decoder.clone().with_gaussians_in_parts();
    let done = parts.decode_in_parts(bytes, |part| {
        scales.extend_from_slice(&part.scale);
        Ok(())
    });
    done.unwrap();
    scales
}

#[test]
fn gaussians_that_reach_as_far_as_the_cloud_s_surfels_are_thicker_and_else_the_same() {
    let cloud = Ball::new(8, 60.0).cloud();
    let heads = heads();
    let [surface, reaching] = [Outline::Surface, Outline::Cloud].map(|outline| {
        let options = Options {
            heads: Some(heads.clone()),
            outline,
            ..with(QualityTarget::Step(20.0))
        };
        stream(&cloud, &options)
    });
    assert_eq!(points(&surface, None), points(&reaching, None));
    // A byte more for each of the three levels that has surfels which are thicker.
    assert!((surface.len()..=surface.len() + 3).contains(&reaching.len()));
    let mut thicker = [0, 0];
    for level in 5..=7 {
        for (thicker, heads_of) in thicker.iter_mut().zip([HeadSet::Best, HeadSet::Surfels]) {
            let decoder = Decoder::new().with_heads_model(heads.clone());
            let decoder = decoder.with_heads(heads_of).with_level(level);
            let usual = decoder.decode(&surface).unwrap();
            let drawn = decoder.decode(&reaching).unwrap();
            for (usual, drawn) in usual.scale.iter().zip(&drawn.scale) {
                let axis = (0..3).find(|&axis| usual[axis] != drawn[axis]);
                *thicker += usize::from(axis.is_some());
                let least = usual.iter().copied().fold(f32::INFINITY, f32::min);
                assert!(axis.is_none_or(|axis| usual[axis] == least && drawn[axis] > least));
                assert!((0..3).all(|other| Some(other) == axis || usual[other] == drawn[other]));
            }
            assert_eq!(in_parts(&decoder, &reaching), drawn.scale);
            let scale = usual.scale.clone();
            assert!(Gaussians { scale, ..drawn } == usual, "level {level}, {heads_of}");
        }
    }
    assert!(thicker.iter().all(|&thicker| thicker > 1000), "{thicker:?}");
}

#[test]
fn learned_heads_leave_sparse_levels_to_surfels() {
    let options = Options {
        levels: Some(5..=7),
        ..with(QualityTarget::Lossless)
    };
    let bytes = stream(&sparse_wall(), &options);
    let model = heads();
    let draw = |heads: HeadSet, level| {
        let decoder = Decoder::new()
            .with_heads_model(HeadsModel::clone(&model))
            .with_heads(heads);
        decoder.with_level(level).decode(&bytes).unwrap()
    };
    for heads in [HeadSet::Best, HeadSet::Quick] {
        assert!(draw(heads, 7) == draw(HeadSet::Surfels, 7), "{heads}");
        // Half of the grid's resolution leaves hardly a voxel without neighbours.
        assert!(draw(heads, 5) != draw(HeadSet::Surfels, 5), "{heads}");
    }
}

#[test]
fn streams_state_how_wide_surfels_of_the_cloud_s_own_level_should_be() {
    let heads = heads();
    let usual = Options {
        levels: Some(5..=7),
        ..with(QualityTarget::Step(20.0))
    };
    let mapped = Options {
        heads: Some(heads),
        ..usual.clone()
    };
    let radii = |cloud: &ColouredVoxels, options: &Options| {
        let decoder = Decoder::new().with_heads(HeadSet::Surfels).with_level(7);
        let gaussians = decoder.decode(&stream(cloud, options)).unwrap();
        gaussians.scale.iter().map(|[radius, ..]| *radius).collect::<Vec<_>>()
    };
    // What closes the wall, and what looks most like the ball.
    for (cloud, sizes) in [(sparse_wall(), 1.1..1.41), (Ball::new(7, 50.0).cloud(), 0.84..1.16)] {
        let factors = radii(&cloud, &mapped).into_iter().zip(radii(&cloud, &usual));
        let mut factors = factors.map(|(stated, usual)| stated / usual);
        let first = factors.next().unwrap();
        assert!(sizes.contains(&first), "{first}");
        assert!(factors.all(|factor| (factor - first).abs() < 1e-5));
    }
}

#[test]
fn the_two_finest_levels_of_a_dense_cloud_have_the_size_of_surfels_and_no_map_of_blocks() {
    let heads = heads();
    let cloud = Ball::new(7, 50.0).cloud();
    let maps = |top: u8| {
        let options = Options {
            levels: Some(5..=top),
            heads: Some(heads.clone()),
            ..with(QualityTarget::Step(20.0))
        };
        let bytes = stream(&cloud, &options);
        let stream = Stream::parse(&bytes, &Limits::default()).unwrap();
        let map = |level: &b2p::container::Level| {
            level
                .colours
                .as_ref()
                .unwrap()
                .head_map
                .as_ref()
                .unwrap()
                .bytes
                .to_vec()
        };
        stream.levels().iter().map(map).collect::<Vec<_>>()
    };
    // The third byte is 0 where no block is surfels, 1 where all are. A ball is smooth.
    let how = |map: &Vec<u8>| (map.len(), map[2]);
    assert_ne!(maps(6)[0][2], 0);
    assert_eq!(how(&maps(6)[1]), (3, 0));
    assert_eq!(maps(7)[1..].iter().map(how).collect::<Vec<_>>(), [(3, 0); 2]);
}

#[test]
fn the_level_above_a_sparse_cloud_s_own_has_a_head_map() {
    let heads = heads();
    let options = Options {
        levels: Some(5..=6),
        heads: Some(heads),
        ..with(QualityTarget::Step(20.0))
    };
    let bytes = stream(&sparse_wall(), &options);
    let stream = Stream::parse(&bytes, &Limits::default()).unwrap();
    let finest = stream.levels().last().unwrap();
    assert_eq!(finest.level, 6);
    assert!(finest.colours.as_ref().unwrap().head_map.is_some());
}
