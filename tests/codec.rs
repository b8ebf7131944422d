//! Clouds through encoder and decoder: scalable, exact, the same for any number of threads.

mod common;

use b2p::cloud::ColouredVoxels;
use b2p::container::{Header, Stream, Writer};
use b2p::encoder::{Encoded, Options, encode};
use b2p::gaussians::Heads;
use b2p::geometry::Octree;
use b2p::latents::LatentDecoder;
use b2p::latents::network::{Model, Shape, untrained};
use b2p::log::Log;
use b2p::{Error, Limits, Placement};
use common::{Ball, cloud_of, tiny_model};

fn model() -> Model {
    Model::from_bytes(&tiny_model(0)).expect("an untrained model loads")
}

fn ball(bits: u8, radius: f32) -> ColouredVoxels {
    Ball::new(bits, radius).cloud()
}

fn coded(cloud: &ColouredVoxels, model: &Model) -> Encoded {
    encode(cloud, model, &Options::default(), &Log::default()).unwrap()
}

#[test]
fn every_level_decodes_to_the_voxels_that_were_encoded() {
    let (model, cloud) = (model(), ball(7, 45.0));
    let bytes = coded(&cloud, &model).bytes;
    let octree = Octree::new(cloud.voxels.clone()).unwrap();
    for level in 4..=6 {
        let exact = LatentDecoder::new(&model)
            .exact(&bytes, level, &Log::default())
            .unwrap();
        assert_eq!(exact.octree, octree.truncated(level));
    }
}

#[test]
fn a_head_gives_one_gaussian_per_voxel_or_one_per_child() {
    let (model, cloud) = (model(), ball(7, 45.0));
    let bytes = coded(&cloud, &model).bytes;
    let octree = Octree::new(cloud.voxels.clone()).unwrap();
    let decoder = LatentDecoder::new(&model);
    let count = |level| decoder.decode(&bytes, Some(level), &Log::default()).unwrap().len();
    assert_eq!(count(5), 8 * octree.level(5).len());
    assert_eq!(count(6), octree.level(6).len());
    assert_eq!(decoder.levels(&bytes).unwrap(), [5, 6]);
}

#[test]
fn whichever_heads_are_used_the_same_is_decoded_and_only_gaussians_differ() {
    let shape = Shape::tiny().with_quick_heads();
    let both = Model::from_bytes(&untrained(&shape, 0)).unwrap();
    let bytes = coded(&ball(6, 20.0), &model()).bytes;
    let log = &Log::default();
    let best = LatentDecoder::new(&both);
    let quick = best.clone().with_heads(Heads::Quick).unwrap();
    for level in quick.levels(&bytes).unwrap() {
        let exact = |decoder: &LatentDecoder| decoder.exact(&bytes, level, &Log::default());
        assert_eq!(exact(&quick).unwrap(), exact(&best).unwrap());
        let thin = quick.decode(&bytes, Some(level), log).unwrap();
        let thick = best.decode(&bytes, Some(level), log).unwrap();
        assert_eq!(thin.len(), thick.len());
        assert!(thin.position != thick.position);
        let model = model();
        let before = LatentDecoder::new(&model).decode(&bytes, Some(level), log);
        assert_eq!(before.unwrap(), thick, "quick heads change nothing else");
        let mut decoding = best.start(Some(level));
        decoding.push(&bytes);
        decoding.finish(log).unwrap();
        for (heads, gaussians) in [(Heads::Quick, &thin), (Heads::Best, &thick)] {
            decoding.set_heads(heads).unwrap();
            assert_eq!(&decoding.gaussians(log).unwrap(), gaussians);
        }
    }
    let header = Header::parse(&bytes, &Limits::default()).unwrap();
    assert!(quick.memory(&header, 5).unwrap() < best.memory(&header, 5).unwrap());
    let model = model();
    let error = LatentDecoder::new(&model).with_heads(Heads::Quick).err().unwrap();
    assert!(matches!(error, Error::Unsupported { .. }), "{error}");
}

#[test]
fn levels_without_latents_cost_their_geometry_alone_and_are_not_predicted() {
    for (roles, fr_roles) in [(1, 1), (1, 3), (2, 2), (2, 3), (3, 3)] {
        let shape = Shape {
            latent_roles: roles,
            fr_roles,
            near_channels: [0, 0],
            ..Shape::tiny()
        };
        let model = Model::from_bytes(&untrained(&shape, 0)).unwrap();
        let options = Options {
            filter: false,
            ..Options::default()
        };
        let log = Log::default();
        let encoded = encode(&ball(7, 45.0), &model, &options, &log).unwrap();
        let decoder = LatentDecoder::new(&model);
        let log = Log::default();
        assert!(!decoder.decode(&encoded.bytes, None, &log).unwrap().is_empty());
        for (role, rate) in encoded.rates.iter().enumerate() {
            let has = role < roles;
            assert_eq!(rate.colour_bytes > 0, has, "role {role} of {roles}");
            let exact = decoder.exact(&encoded.bytes, rate.level, &Log::default());
            assert_eq!(exact.unwrap().latents.is_empty(), !has);
            let asked = |step: &str| {
                let name = format!("{step} of level {}", rate.level);
                log.steps().iter().any(|step| step.name == name)
            };
            assert_eq!(asked("latents"), has);
            assert_eq!(asked("probabilities"), has && role > 0);
            assert_eq!(asked("features"), role < fr_roles);
        }
    }
}

#[test]
fn latents_where_the_model_has_none_are_refused_and_so_is_their_absence_elsewhere() {
    for (roles, found, expected) in [(1, 1, 0), (3, 0, 1)] {
        let shape = Shape {
            latent_roles: roles,
            near_channels: [0, 0],
            ..Shape::tiny()
        };
        let model = Model::from_bytes(&untrained(&shape, 0)).unwrap();
        let bytes = coded(&ball(6, 20.0), &model).bytes;
        let stream = Stream::parse(&bytes, &Limits::unlimited()).unwrap();
        let mut writer = Writer::new(stream.header().clone()).unwrap();
        for level in stream.levels() {
            for part in &level.geometry {
                let slices = part.slices.iter().map(|s| (s.voxels, s.bytes.to_vec()));
                let slices: Vec<_> = slices.collect();
                writer.geometry(part.level, &slices).unwrap();
            }
            let slices: Vec<_> = level.features.iter().map(|s| s.bytes).collect();
            match level.level {
                3 => writer.features(3, level.latent_hash, &slices).unwrap(),
                level if found > 0 => writer.features(level, 0, &[b"more"]).unwrap(),
                _ => {}
            }
        }
        let claims = writer.finish().unwrap();
        let (decoder, log) = (LatentDecoder::new(&model), &Log::default());
        assert!(decoder.exact(&claims, 3, log).is_ok());
        let error = decoder.decode(&claims, None, log).unwrap_err();
        assert!(matches!(error, Error::Malformed { .. }), "{error}");
        let said = format!("level 4: number of feature slices is {found}, expected {expected}");
        assert!(error.to_string().contains(&said), "{error}");
    }
}

#[test]
fn a_stream_cut_after_a_level_is_the_coarser_stream() {
    let (model, cloud) = (model(), ball(7, 45.0));
    let encoded = coded(&cloud, &model);
    let decoder = LatentDecoder::new(&model);
    let stream = b2p::container::Header::parse(&encoded.bytes, &Limits::default()).unwrap();
    let whole = decoder.decode(&encoded.bytes, Some(5), &Log::default()).unwrap();
    let cut = &encoded.bytes[..stream.prefix_bytes(5).unwrap() as usize];
    assert_eq!(decoder.decode(cut, Some(5), &Log::default()).unwrap(), whole);
    assert_eq!(
        decoder.decode(cut, None, &Log::default()).unwrap(),
        whole,
        "the default is the finest there is"
    );
    let error = decoder.decode(cut, Some(6), &Log::default()).unwrap_err();
    assert!(matches!(error, Error::Truncated { .. }), "{error}");
    let rates: usize = encoded.rates.iter().map(|r| r.geometry_bytes + r.colour_bytes).sum();
    assert!(
        rates < encoded.bytes.len() && encoded.bytes.len() < rates + 200,
        "rates account for all but the header"
    );
}

#[test]
fn streams_and_decoded_latents_are_the_same_for_any_number_of_threads() {
    let (model, cloud) = (model(), ball(8, 100.0));
    assert!(
        Octree::new(cloud.voxels.clone()).unwrap().level(7).len() > 16_384,
        "more than one slice"
    );
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let bytes = coded(&cloud, &model).bytes;
            let exact = LatentDecoder::new(&model).exact(&bytes, 7, &Log::default()).unwrap();
            let gaussians = LatentDecoder::new(&model)
                .decode(&bytes, Some(7), &Log::default())
                .unwrap();
            (bytes, exact, gaussians)
        })
    };
    let one = run(1);
    assert_eq!(run(2), one);
    assert_eq!(run(7), one);
}

#[test]
fn the_exact_zone_is_the_same_on_every_instruction_set_of_this_machine() {
    let cloud = ball(7, 45.0);
    let bytes = coded(&cloud, &model()).bytes;
    let exact = |isa| {
        let model = model().with_isa(isa);
        LatentDecoder::new(&model).exact(&bytes, 6, &Log::default()).unwrap()
    };
    let plain = exact(b2p_kernels::Isa::SCALAR);
    for isa in b2p_kernels::Isa::available() {
        assert_eq!(exact(isa), plain, "{isa}");
    }
}

#[test]
fn unusual_clouds_survive() {
    let model = model();
    let corner = |depth: u8| (1u64 << (3 * depth)) - 1;
    let full: Vec<u64> = (0..512).collect();
    let checkerboard = (0..4096u64).filter(|k| (k ^ k >> 1 ^ k >> 2) & 1 == 0).collect();
    let clouds = [
        ("one voxel", cloud_of(10, vec![123])),
        ("two far corners", cloud_of(10, vec![0, corner(10)])),
        ("a full cube", cloud_of(3, full)),
        ("a checkerboard", cloud_of(4, checkerboard)),
        (
            "the deepest octree",
            cloud_of(21, vec![0, 77, corner(21) - 1, corner(21)]),
        ),
        ("two bits", cloud_of(2, vec![0, 5, 63])),
    ];
    for (name, cloud) in clouds {
        let bytes = coded(&cloud, &model).bytes;
        let decoder = LatentDecoder::new(&model);
        let top = *decoder.levels(&bytes).unwrap().last().expect("a level with Gaussians");
        let gaussians = decoder
            .decode(&bytes, None, &Log::default())
            .unwrap_or_else(|e| panic!("{name}: {e}"));
        assert!(!gaussians.is_empty(), "{name}");
        assert!(gaussians.position.iter().flatten().all(|v| v.abs() <= 1.5), "{name}");
        assert_eq!(top, cloud.voxels.depth() - 1, "{name}");
    }
}

#[test]
fn a_cloud_of_one_bit_has_no_level_with_gaussians() {
    let model = model();
    let bytes = coded(&cloud_of(1, vec![0, 7]), &model).bytes;
    let error = LatentDecoder::new(&model)
        .decode(&bytes, None, &Log::default())
        .unwrap_err();
    assert!(matches!(error, Error::Unsupported { .. }), "{error}");
}

#[test]
fn fewer_levels_make_a_shorter_stream_that_still_draws() {
    let (model, cloud) = (model(), ball(7, 45.0));
    let options = Options {
        levels: Some(4..=5),
        ..Options::default()
    };
    let short = encode(&cloud, &model, &options, &Log::default()).unwrap();
    assert!(short.bytes.len() < coded(&cloud, &model).bytes.len());
    assert_eq!(LatentDecoder::new(&model).levels(&short.bytes).unwrap(), [5]);
}

#[test]
fn a_stream_of_another_model_is_detected() {
    let bytes = coded(&ball(6, 20.0), &model()).bytes;
    let other = Model::from_bytes(&tiny_model(1)).unwrap();
    let error = LatentDecoder::new(&other)
        .decode(&bytes, None, &Log::default())
        .unwrap_err();
    assert!(matches!(error, Error::ModelMismatch { .. }), "{error}");
}

#[test]
fn memory_over_the_limit_is_refused_before_it_is_reserved() {
    let model = model();
    let bytes = coded(&ball(7, 45.0), &model).bytes;
    let limits = Limits::default().with_max_bytes(1 << 16);
    let error = LatentDecoder::new(&model)
        .with_limits(limits)
        .decode(&bytes, None, &Log::default())
        .unwrap_err();
    assert!(matches!(error, Error::LimitExceeded { .. }), "{error}");
}

#[test]
fn the_placement_of_the_cloud_comes_back_with_the_gaussians() {
    let model = model();
    let mut cloud = ball(6, 20.0);
    cloud.placement = Placement {
        origin: [1e6, -3.5, 0.25],
        voxel_size: 0.125,
    };
    let bytes = coded(&cloud, &model).bytes;
    let gaussians = LatentDecoder::new(&model)
        .decode(&bytes, None, &Log::default())
        .unwrap();
    assert_eq!(gaussians.frame.placement, cloud.placement);
    assert_eq!(gaussians.frame.bits, 6);
}

#[test]
fn a_bit_costs_nothing_where_the_model_does_not_say() {
    let (model, cloud) = (model(), ball(7, 45.0));
    let bytes = |bit_price| {
        let options = Options {
            bit_price,
            ..Options::default()
        };
        encode(&cloud, &model, &options, &Log::default()).unwrap().bytes
    };
    assert!(bytes(1.0) == bytes(0.0));
}

#[test]
fn levels_left_out_at_the_fine_end_change_nothing_above_them() {
    let (model, cloud) = (model(), ball(7, 45.0));
    let features = |top| {
        let options = Options {
            levels: Some(4..=top),
            filter: false,
            ..Options::default()
        };
        let coded = encode(&cloud, &model, &options, &Log::default()).unwrap();
        let decoder = LatentDecoder::new(&model);
        decoder.exact(&coded.bytes, 4, &Log::default()).unwrap().features
    };
    let all = features(6);
    assert!(features(5) == all && features(4) == all);
}

#[test]
fn nothing_may_follow_the_last_level() {
    let model = model();
    let mut bytes = coded(&ball(5, 10.0), &model).bytes;
    bytes.push(0);
    let decoder = LatentDecoder::new(&model);
    assert!(decoder.decode(&bytes, None, &Log::default()).is_err());
    assert!(
        decoder.decode(&bytes, Some(4), &Log::default()).is_ok(),
        "asked for, a whole level decodes"
    );
}
