//! Gaussians that come in parts: the same as all at once, and no more of them in memory than a part.

mod common;

use b2p::cloud::ColouredVoxels;
use b2p::container::{Header, Stream};
use b2p::encoder::transform::{Options, QualityTarget, encode};
use b2p::gaussians::learned::HeadsModel;
use b2p::gaussians::{Gaussians, HeadSet, Heads};
use b2p::latents::network::Model;
use b2p::log::Log;
use b2p::{Cancel, Decoder, Error, Limits};
use common::{Ball, cloud_of, small_stream, sparse_wall, tiny_model};
use proptest::prelude::*;

/// Gaussians of a part, at most.
const MOST: usize = 1 << 17;

fn stream(cloud: &ColouredVoxels, options: Options) -> Vec<u8> {
    let options = Options {
        fineness: QualityTarget::Step(6.0),
        ..options
    };
    let encoded = encode(cloud, &options, &Log::default());
    encoded.expect("a cloud can be coded").bytes
}

/// A stream whose finest level learned heads draw in several spans where memory is short.
fn large() -> Vec<u8> {
    let options = Options {
        levels: Some(6..=8),
        ..Options::default()
    };
    stream(&Ball::new(8, 100.0).cloud(), options)
}

/// The heads that ship.
fn heads() -> HeadsModel {
    HeadsModel::from_bytes(include_bytes!("../models/heads.safetensors")).unwrap()
}

/// Appends a part.
fn append(whole: &mut Gaussians, part: &Gaussians) {
    whole.position.extend(&part.position);
    whole.scale.extend(&part.scale);
    whole.rotation.extend(&part.rotation);
    whole.opacity.extend(&part.opacity);
    whole.colour.extend(&part.colour);
    (whole.frame, whole.blur, whole.compensated) = (part.frame, part.blur, part.compensated);
}

/// Compares the parts of a stream with what it decodes to at once, and says how many there are.
fn check(decoder: &Decoder, bytes: &[u8]) -> usize {
    let expected = decoder.decode(bytes).expect("a stream decodes");
    let (mut whole, mut parts) = (Gaussians::default(), 0);
    let each = |part: &Gaussians| {
        part.check_lengths()?;
        assert!(part.len() <= MOST, "{} Gaussians in a part", part.len());
        append(&mut whole, part);
        parts += 1;
        Ok(())
    };
    decoder.decode_in_parts(bytes, each).expect("a stream decodes in parts");
    assert!(whole == expected, "{} of {} Gaussians", whole.len(), expected.len());
    let known = decoder.whole(bytes).unwrap().gaussian_count().unwrap();
    assert!(known.is_none_or(|count| count == expected.len()));
    parts
}

/// Decoders with heads of every kind, for one and for more Gaussians of a voxel.
fn decoders() -> Vec<Decoder> {
    let learned = Decoder::new().with_heads_model(heads());
    let of = |(heads, counts): (HeadSet, [usize; 2])| {
        let decoder = learned.clone().with_heads(heads);
        counts.map(|count| decoder.clone().with_per_voxel(count))
    };
    let kinds = [
        (HeadSet::Surfels, [1, 4]),
        (Heads::Quick.into(), [1, 8]),
        (Heads::Best.into(), [1, 8]),
    ];
    kinds.into_iter().flat_map(of).collect()
}

fn on_threads<T: Send>(threads: usize, run: impl FnOnce() -> T + Send) -> T {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(run)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(6))]

    #[test]
    fn parts_are_what_is_decoded_at_once_with_any_heads_at_any_level_on_any_threads(
        keys in prop::collection::vec(0u64..1 << 15, 1..2000), threads in 1usize..4
    ) {
        let bytes = stream(&cloud_of(5, keys), Options::default());
        let header = Header::parse(&bytes, &Limits::default()).unwrap();
        for decoder in decoders() {
            for level in header.base.max(1)..=header.top {
                let decoder = decoder.clone().with_level(level);
                prop_assert_eq!(on_threads(threads, || check(&decoder, &bytes)), 1);
            }
        }
    }
}

#[test]
fn a_large_level_has_the_same_gaussians_in_several_parts_whatever_the_span() {
    let bytes = large();
    for decoder in decoders() {
        for (max_bytes, threads) in [(400 << 20, 2), (2 << 30, 3)] {
            let limits = Limits::default().with_max_bytes(max_bytes);
            let decoder = decoder.clone().with_limits(limits);
            let parts = on_threads(threads, || check(&decoder, &bytes));
            assert!(parts > 2, "{parts} parts");
        }
    }
}

#[test]
fn surfels_among_learned_gaussians_come_after_them() {
    let options = Options {
        heads: Some(heads()),
        ..Options::default()
    };
    let bytes = stream(&Ball::new(8, 100.0).cloud(), options);
    let parsed = Stream::parse(&bytes, &Limits::default()).unwrap();
    let map = |level: &b2p::container::Level| level.colours.as_ref()?.head_map.map(|map| map.bytes.len());
    // Maps of three bytes say the same of all voxels.
    assert!(parsed.levels().iter().filter_map(map).any(|bytes| bytes > 3));
    for decoder in decoders() {
        for level in parsed.header().base..=parsed.header().top {
            check(&decoder.clone().with_level(level), &bytes);
        }
    }
}

#[test]
fn a_sparse_level_has_the_surfels_that_it_has_at_once() {
    let bytes = stream(&sparse_wall(), Options::default());
    for decoder in decoders() {
        check(&decoder, &bytes);
    }
}

#[test]
fn a_stream_of_version_2_comes_in_one_part() {
    let model = Model::from_bytes(&tiny_model(1)).unwrap();
    let bytes = small_stream(&model);
    assert_eq!(check(&Decoder::new().with_model(model), &bytes), 1);
}

#[test]
fn the_error_of_whoever_takes_parts_ends_decoding() {
    let bytes = large();
    for decoder in decoders() {
        let mut calls = 0;
        let refused = decoder.decode_in_parts(&bytes, |_| {
            calls += 1;
            match calls {
                2 => Err(Error::Usage("no more".into())),
                _ => Ok(()),
            }
        });
        assert!(
            matches!(&refused, Err(Error::Usage(why)) if why == "no more"),
            "{refused:?}"
        );
        assert_eq!(calls, 2);
    }
}

#[test]
fn decoding_in_parts_can_be_cancelled_between_them() {
    let bytes = large();
    for decoder in decoders() {
        let cancel = Cancel::default();
        let mut calls = 0;
        let decoder = decoder.with_cancel(cancel.clone());
        let cancelled = decoder.decode_in_parts(&bytes, |_| {
            calls += 1;
            cancel.cancel();
            Ok(())
        });
        assert!(matches!(cancelled, Err(Error::Cancelled)), "{cancelled:?}");
        assert_eq!(calls, 1);
    }
}

#[test]
fn limits_that_refuse_all_gaussians_at_once_may_allow_them_in_parts() {
    let bytes = large();
    let header = Header::parse(&bytes, &Limits::default()).unwrap();
    let mut smaller = 0;
    for decoder in decoders() {
        // Any lower limit has spans of the same size.
        let decoder = decoder.with_limits(Limits::embedded());
        let in_parts = decoder.clone().with_gaussians_in_parts();
        let needed = in_parts.memory(&header, header.top).unwrap();
        let needed_at_once = decoder.memory(&header, header.top).unwrap();
        assert!(needed <= needed_at_once);
        let with = |decoder: &Decoder, max_bytes| {
            let limits = Limits::default().with_max_bytes(max_bytes);
            decoder.clone().with_limits(limits)
        };
        let enough = with(&in_parts, needed);
        assert!(enough.decode_in_parts(&bytes, |_| Ok(())).is_ok());
        let refused = |result: Result<_, Error>| matches!(result, Err(Error::LimitExceeded { .. }));
        // A surfel of each voxel takes no more than decoding does.
        if needed < needed_at_once {
            smaller += 1;
            assert!(refused(with(&decoder, needed).decode(&bytes).map(drop)));
            assert!(refused(
                enough.whole(&bytes).and_then(|decoding| decoding.gaussians().map(drop))
            ));
        }
        let little = with(&in_parts, 1 << 20);
        assert!(refused(little.decode_in_parts(&bytes, |_| Ok(()))));
    }
    assert!(smaller > 4, "{smaller} decoders");
}
