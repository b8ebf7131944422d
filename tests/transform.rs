//! Streams of version 3 from cloud to colours and Gaussians.

mod common;

use std::collections::BTreeMap;

use b2p::cloud::{ColouredVoxels, voxelise};
use b2p::container::{self, Header, Stream};
use b2p::encoder::transform::{GeometryTarget, Options, QualityTarget, encode, encode_to_rate};
use b2p::gaussians::HeadSet;
use b2p::gaussians::Heads;
use b2p::latents::network::Model;
use b2p::log::Log;
use b2p::{Axes, Cancel, Error, Isa, Limits, Up};
use b2p::{Decoder, Decoding};
use common::{Ball, cloud_of, sparse_wall, tiny_model};

fn stream(cloud: &ColouredVoxels, options: &Options) -> Vec<u8> {
    let encoded = encode(cloud, options, &Log::default());
    encoded.expect("a cloud can be coded").bytes
}

fn with(fineness: QualityTarget) -> Options {
    Options {
        fineness,
        ..Options::default()
    }
}

/// Small slices, so that a small cloud has several.
fn sliced() -> Options {
    Options {
        slice_voxels: 24,
        colour_slice: 30,
        ..Options::default()
    }
}

/// Small slices, and optimised geometry of the finest level.
fn visual(lambda: f32) -> Options {
    Options {
        geometry: GeometryTarget::Lambda(lambda),
        ..sliced()
    }
}

/// Clouds of every kind: surfaces, solids, the deepest chains of lone voxels, one voxel.
fn clouds() -> Vec<ColouredVoxels> {
    let far = |i: u64| i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 1;
    vec![
        Ball::new(6, 25.0).cloud(),
        cloud_of(4, (0..1 << 12).collect()),
        cloud_of(21, (0..200).map(far).collect()),
        cloud_of(10, vec![12345]),
        cloud_of(1, vec![0, 3, 5]),
    ]
}

/// Voxels and colours of `level`, or of the finest.
fn points(bytes: &[u8], level: Option<u8>) -> Result<(Vec<u64>, Vec<[u8; 3]>), String> {
    let decoding = Decoder::new().with_level(level).whole(bytes);
    let decoding = decoding.map_err(|error| error.to_string())?;
    Ok(told(&decoding).expect("a level"))
}

fn told(decoding: &Decoding) -> Option<(Vec<u64>, Vec<[u8; 3]>)> {
    let points = decoding.points()?;
    Some((points.voxels.keys().to_vec(), points.colours.to_vec()))
}

/// The mean colour of the cloud's voxels in each of a level's, each channel rounded, halves up.
fn means(cloud: &ColouredVoxels, level: u8) -> (Vec<u64>, Vec<[u8; 3]>) {
    let mut sums: BTreeMap<u64, ([u32; 3], u32)> = BTreeMap::new();
    for (key, colour) in cloud.voxels.keys().iter().zip(&cloud.colours) {
        let (sum, count) = sums.entry(key >> (3 * (cloud.voxels.depth() - level))).or_default();
        for (sum, c) in sum.iter_mut().zip(colour) {
            *sum += u32::from(*c);
        }
        *count += 1;
    }
    let mean = |(sum, count): ([u32; 3], u32)| sum.map(|s| ((2 * s + count) / (2 * count)) as u8);
    sums.into_iter().map(|(key, sum)| (key, mean(sum))).unzip()
}

/// The mean squared error of decoded colours.
fn error(decoded: &[[u8; 3]], truth: &[[u8; 3]]) -> f64 {
    let squares = decoded.iter().flatten().zip(truth.iter().flatten());
    let squares = squares.map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2));
    squares.sum::<f64>() / (3 * truth.len()) as f64
}

#[test]
fn lossless_streams_decode_to_the_mean_colours_of_the_finest_level() {
    for cloud in clouds() {
        let bits = cloud.voxels.depth();
        for top in [bits, bits - 1] {
            let options = Options {
                levels: Some(top.saturating_sub(2)..=top),
                ..with(QualityTarget::Lossless)
            };
            let bytes = stream(&cloud, &options);
            let decoded = points(&bytes, None).unwrap();
            assert!(decoded == means(&cloud, top), "{bits} bits, level {top}");
        }
    }
}

#[test]
fn smaller_steps_take_more_bytes_and_are_nearer() {
    let cloud = Ball::new(7, 50.0).cloud();
    let (keys, truth) = means(&cloud, 6);
    let mut last = (0, f64::INFINITY);
    for step in [128.0, 32.0, 8.0, 2.0] {
        let bytes = stream(&cloud, &with(QualityTarget::Step(step)));
        let decoded = points(&bytes, None).unwrap();
        assert_eq!(decoded.0, keys);
        let own = (bytes.len(), error(&decoded.1, &truth));
        assert!(own.0 > last.0 && own.1 < last.1, "{step}: {own:?}, {last:?}");
        assert!(own.1 < f64::from(step).powi(2), "{step}: {own:?}");
        last = own;
    }
}

#[test]
fn every_prefix_that_ends_after_a_level_is_that_level() {
    for cloud in clouds() {
        let bytes = stream(&cloud, &sliced());
        let header = Header::parse(&bytes, &Limits::default()).unwrap();
        for level in header.base..=header.top {
            let end = header.prefix_bytes(level).unwrap() as usize;
            let prefix = points(&bytes[..end], None).unwrap();
            assert_eq!(Ok(&prefix), points(&bytes, Some(level)).as_ref());
            assert_eq!(prefix.0.len(), header.voxels(level).unwrap() as usize);
            let drawn = |bytes: &[u8], level: Option<u8>| {
                let decoder = Decoder::new();
                decoder.with_level(level).decode(bytes).unwrap()
            };
            assert_eq!(drawn(&bytes[..end], None), drawn(&bytes, Some(level)));
        }
    }
}

#[test]
fn streams_are_the_same_for_any_threads_and_instructions_and_so_is_what_they_decode_to() {
    let cloud = Ball::new(6, 25.0).cloud();
    let all = |isa: Isa| {
        let options = Options {
            isa: Some(isa),
            ..sliced()
        };
        let bytes = stream(&cloud, &options);
        let decoder = Decoder::new().with_isa(isa);
        let gaussians = decoder.decode(&bytes).unwrap();
        (points(&bytes, None).unwrap(), gaussians, bytes)
    };
    let scalar = all(Isa::SCALAR);
    for isa in Isa::available() {
        assert!(all(isa) == scalar, "{isa}");
    }
    for threads in [1, 2, 7] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        let pool = pool.build().unwrap();
        assert!(pool.install(|| all(Isa::detect())) == scalar, "{threads} threads");
    }
}

#[test]
fn points_are_a_cloud_on_the_grid_of_their_level() {
    let mut cloud = Ball::new(6, 25.0).cloud();
    cloud.placement.origin = [1.0, -2.0, 0.5];
    cloud.placement.voxel_size = 0.25;
    let bytes = stream(&cloud, &Options::default());
    let decoding = Decoder::new().with_level(4).whole(&bytes).unwrap();
    let points = decoding.points().unwrap().to_cloud();
    let grid = voxelise(&points, None).unwrap();
    assert_eq!(grid.voxels.depth(), 4);
    assert_eq!(grid.placement.origin, cloud.placement.origin);
    assert_eq!(grid.placement.voxel_size, 1.0);
    assert_eq!(told(&decoding).unwrap().1, grid.colours);
}

#[test]
fn axes_in_a_stream_leave_what_is_decoded_unchanged() {
    let axes = Axes {
        up: Some(Up::Z),
        metres_per_unit: Some(1.0),
        crs: "EPSG:32633".into(),
    };
    for cloud in clouds() {
        let levels = 0..=cloud.voxels.depth();
        let from_root = Options {
            levels: (cloud.voxels.depth() < 21).then_some(levels),
            ..Options::default()
        };
        for options in [Options::default(), from_root] {
            let plain = stream(&cloud, &options);
            let marked = container::with_axes(&plain, &axes).unwrap();
            assert_eq!(container::axes(&marked).unwrap(), axes);
            assert_eq!(points(&marked, None), points(&plain, None));
        }
    }
}

#[test]
fn as_many_bits_as_asked_for_are_used_and_more_bits_are_never_worse_but_for_a_finer_level() {
    let cloud = Ball::new(7, 50.0).cloud();
    let finest = cloud.voxels.depth();
    let (mut last, mut last_level) = (f64::INFINITY, 0);
    let mut lossless = false;
    for most in [0.3, 0.6, 1.2, 2.4, 5.0, 20.0] {
        let found = encode_to_rate(&cloud, &Options::default(), most, &Log::default());
        let (encoded, chosen) = found.unwrap();
        let bits = encoded.bytes.len() as f64 * 8.0 / cloud.voxels.len() as f64;
        assert!(bits <= most, "{bits} of {most}");
        assert_eq!(encoded.bytes, stream(&cloud, &chosen), "{chosen:?}");
        lossless = chosen.fineness == QualityTarget::Lossless;
        // Colours of the cloud as the finest level of the stream has them.
        let (keys, colours) = points(&encoded.bytes, None).unwrap();
        let level = *chosen.levels.unwrap().end();
        let shift = 3 * (finest - level);
        let seen = cloud.voxels.keys().iter().map(|key| {
            let place = keys.binary_search(&(key >> shift)).unwrap();
            colours[place]
        });
        let off = error(&seen.collect::<Vec<_>>(), &cloud.colours);
        assert!(level >= last_level, "{most}: level {level} after {last_level}");
        if level == last_level {
            assert!(off <= last * 1.02, "{most}: {off} after {last}");
        }
        (last, last_level) = (off, level);
    }
    assert!(lossless, "20 bits are enough for exact colours");
    let found = encode_to_rate(&cloud, &Options::default(), 0.001, &Log::default());
    assert!(matches!(found, Err(Error::TooFewBits { .. })));
}

#[test]
fn levels_and_steps_that_do_not_exist_are_refused() {
    let cloud = Ball::new(4, 5.0).cloud();
    let refused = |options: Options| encode(&cloud, &options, &Log::default()).is_err();
    for levels in [3..=5, 5..=5] {
        let options = Options {
            levels: Some(levels),
            ..Options::default()
        };
        assert!(refused(options));
    }
    for step in [0.0, 0.4, 1001.0, f32::NAN] {
        assert!(refused(with(QualityTarget::Step(step))), "{step}");
    }
    assert!(refused(Options {
        slice_voxels: 16_385,
        ..Options::default()
    }));
    assert!(refused(Options {
        colour_slice: 0,
        ..Options::default()
    }));
}

#[test]
fn one_decoder_decodes_both_versions_and_says_which_model_version_2_needs() {
    let cloud = Ball::new(5, 12.0).cloud();
    let model = Model::from_bytes(&tiny_model(3)).unwrap();
    let log = &Log::default();
    let options = b2p::encoder::Options::default();
    let old = b2p::encoder::encode(&cloud, &model, &options, log).unwrap().bytes;
    let new = stream(&cloud, &Options::default());
    let without = Decoder::new();
    assert!(without.decode(&new).is_ok());
    let id: String = model.id().iter().map(|b| format!("{b:02x}")).collect();
    let missing = without.decode(&old).unwrap_err();
    assert!(matches!(&missing, Error::ModelMissing { expected } if *expected == id));
    let both = without.with_model(model.clone());
    let expected = b2p::latents::LatentDecoder::new(&model);
    assert_eq!(both.decode(&old).unwrap(), expected.decode(&old, None, log).unwrap());
    assert!(both.decode(&new).is_ok());
    let surfels = both.clone().with_heads(HeadSet::Surfels);
    assert!(matches!(surfels.decode(&old), Err(Error::Unsupported { .. })));
    assert!(matches!(
        expected.decode(&new, None, log),
        Err(Error::Unsupported { .. })
    ));
    assert_eq!(
        HeadSet::from(Heads::Quick).to_string().parse::<HeadSet>().unwrap(),
        HeadSet::Quick
    );
}

#[test]
fn a_cancelled_decode_ends_with_cancelled() {
    let bytes = stream(&Ball::new(5, 12.0).cloud(), &Options::default());
    let cancel = Cancel::default();
    cancel.cancel();
    let decoder = Decoder::new().with_cancel(cancel);
    let decoded = decoder.decode(&bytes);
    assert!(matches!(decoded, Err(Error::Cancelled)));
}

#[test]
fn steps_of_luma_are_2_38_times_finer_with_each_of_two_levels_above_the_last() {
    let bytes = stream(&Ball::new(8, 100.0).cloud(), &with(QualityTarget::Step(32.0)));
    let stream = Stream::parse(&bytes, &Limits::default()).unwrap();
    let coded = stream.levels().iter().map(|level| {
        let colours = level.colours.as_ref().unwrap();
        let last = colours.levels.last().map(|level| level.slices[0].bytes[0]);
        last.unwrap_or_else(|| colours.trunk.as_ref().unwrap().slice.bytes[0])
    });
    // Eight indices are a factor of two, and 48 is a step of 32.
    assert_eq!(coded.collect::<Vec<u8>>(), [28, 38, 48]);
}

#[test]
fn sections_are_whole_and_hold_what_the_header_tells() {
    for cloud in clouds() {
        let bytes = stream(&cloud, &sliced());
        let stream = Stream::parse(&bytes, &Limits::default()).unwrap();
        assert!(stream.damage().is_none());
        let colours = stream.levels()[0].colours.as_ref().unwrap();
        assert!(colours.trunk.is_some());
        for level in &stream.levels()[1..] {
            let colours = level.colours.as_ref().unwrap();
            assert_eq!(colours.levels.len(), 1);
            assert_eq!(colours.levels[0].level, level.level);
        }
    }
}

#[test]
fn optimised_geometry_takes_fewer_bytes_and_moves_voxels_of_the_finest_level_by_at_most_one() {
    let cloud = Ball::new(7, 50.0).cloud();
    let exact = stream(&cloud, &sliced());
    let coordinates = |keys: &[u64]| -> Vec<[u32; 3]> {
        let voxels = b2p::Voxels::new(6, keys.to_vec());
        (0..voxels.len()).map(|i| voxels.coordinate(i)).collect()
    };
    let near = |a: &[[u32; 3]], b: &[[u32; 3]]| {
        let is_near = |x: &[u32; 3], y: &[u32; 3]| (0..3).all(|c| x[c].abs_diff(y[c]) <= 1);
        a.iter().all(|x| b.iter().any(|y| is_near(x, y)))
    };
    let truth = points(&exact, None).unwrap().0;
    for lambda in [0.1, 1.0, 100.0] {
        let bytes = stream(&cloud, &visual(lambda));
        assert!(bytes.len() < exact.len(), "{lambda}");
        let coded = points(&bytes, None).unwrap().0;
        assert_ne!(coded, truth);
        let [coded, truth] = [&coded, &truth].map(|keys| coordinates(keys));
        assert!(near(&coded, &truth) && near(&truth, &coded), "{lambda}");
        assert_eq!(points(&bytes, Some(5)).unwrap().0, points(&exact, Some(5)).unwrap().0);
    }
}

#[test]
fn geometry_stays_exact_where_nothing_else_is_asked_for_and_with_lossless_colours() {
    let cloud = Ball::new(6, 25.0).cloud();
    let default = stream(&cloud, &sliced());
    let exact = Options {
        geometry: GeometryTarget::Exact,
        ..sliced()
    };
    assert_eq!(stream(&cloud, &exact), default);
    assert_eq!(stream(&cloud, &visual(0.0)), default);
    let lossless = |options: Options| Options {
        levels: Some(3..=5),
        fineness: QualityTarget::Lossless,
        ..options
    };
    assert_eq!(
        stream(&cloud, &lossless(visual(1.0))),
        stream(&cloud, &lossless(sliced()))
    );
}

#[test]
fn optimised_geometry_is_the_same_for_any_number_of_threads() {
    let cloud = Ball::new(6, 25.0).cloud();
    let with_threads = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.unwrap().install(|| stream(&cloud, &visual(0.5)))
    };
    assert_eq!(with_threads(1), with_threads(5));
}

#[test]
fn the_own_level_of_a_dense_cloud_may_move_and_that_of_a_sparse_one_stays() {
    for (cloud, stays) in [(Ball::new(6, 25.0).cloud(), false), (sparse_wall(), true)] {
        let depth = cloud.voxels.depth();
        let with = |geometry| {
            let options = Options {
                levels: Some(depth - 2..=depth),
                fineness: QualityTarget::Step(40.0),
                geometry,
                ..Options::default()
            };
            stream(&cloud, &options)
        };
        let [exact, visual] = [GeometryTarget::Exact, GeometryTarget::Visual].map(with);
        assert_eq!(visual.len() == exact.len(), stays, "{depth}");
        let (voxels, _) = points(&visual, Some(depth)).unwrap();
        assert_eq!(voxels == cloud.voxels.keys(), stays, "{depth}");
    }
}

#[test]
fn optimised_geometry_keeps_to_a_rate() {
    let cloud = Ball::new(7, 50.0).cloud();
    let options = Options {
        geometry: GeometryTarget::Visual,
        ..sliced()
    };
    for bits in [0.7, 1.0, 2.0] {
        let (encoded, chosen) = encode_to_rate(&cloud, &options, bits, &Log::default()).unwrap();
        let most = bits * cloud.voxels.len() as f64 / 8.0;
        assert!(encoded.bytes.len() as f64 <= most, "{bits}");
        assert_eq!(stream(&cloud, &chosen), encoded.bytes, "{bits}");
    }
}
