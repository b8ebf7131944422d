//! The suite of version 3, in `tests/data/conformance/version-3`.
//!
//! `suite.txt` has a line for each stream: its name, then for every level `level=` and the SHA-256 of its geometry (Morton keys, u64), of its
//! colours (red, green, blue, u8) and of its surfels (positions, scales, rotations, opacities, colours, f32), all little-endian.

use std::path::PathBuf;

use b2p::container::Header;
use b2p::decoder::{StreamDecoder, StreamDecoding};
use b2p::gaussians::HeadSet;
use b2p::log::Log;
use b2p::{Error, Isa};

use crate::digest::{Levels, gaussians_hash, hash};
use crate::{folder, pools};

fn own_folder() -> PathBuf {
    folder().join("version-3")
}

fn stream(name: &str) -> Vec<u8> {
    std::fs::read(own_folder().join(format!("{name}.b2p"))).expect("every line has a stream")
}

/// The digest of the level reached.
fn reached(decoding: &StreamDecoding, log: &mut Log) -> b2p::Result<String> {
    let points = decoding.points().expect("a level has been reached");
    let (level, keys) = (points.voxels.depth(), points.voxels.keys());
    Ok(format!(
        "{level}={},{},{}",
        hash(keys.iter().flat_map(|key| key.to_le_bytes())),
        hash(points.colours.iter().flatten().copied()),
        gaussians_hash(&decoding.gaussians(log)?),
    ))
}

/// The digests of all levels, each decoded on its own from the whole stream.
fn whole(decoder: &StreamDecoder, bytes: &[u8]) -> Levels {
    let of = |level: u8| {
        let log = &mut Log::default();
        reached(&decoder.whole(bytes, Some(level), log)?, log)
    };
    let header = Header::parse(bytes, &Default::default());
    let levels = header.and_then(|header| (header.base..=header.top).map(of).collect());
    levels.map_err(|error: Error| error.to_string())
}

/// The same, each as it becomes whole while the stream comes in pieces.
fn in_pieces(decoder: &StreamDecoder, bytes: &[u8]) -> Levels {
    let (mut decoding, mut log) = (decoder.start(None), Log::default());
    let mut decode = || {
        let mut levels = Vec::new();
        for piece in bytes.chunks(61) {
            decoding.push(piece);
            while decoding.advance(&mut log)?.is_some() {
                levels.push(reached(&decoding, &mut log)?);
            }
        }
        decoding.finish(&mut log)?;
        Ok(levels)
    };
    decode().map_err(|error: Error| error.to_string())
}

#[test]
fn every_stream_of_version_3_decodes_to_its_digests_with_every_instruction_set_and_number_of_threads() {
    let text = std::fs::read_to_string(own_folder().join("suite.txt")).expect("the suite is there");
    assert!(text.lines().count() >= 8);
    let pools = pools();
    for isa in Isa::available() {
        let decoder = StreamDecoder::new().with_isa(isa).with_heads(HeadSet::Surfels);
        for line in text.lines() {
            let mut words = line.split(' ').map(str::to_owned);
            let name = words.next().expect("a name");
            let levels: Vec<String> = words.collect();
            let bytes = stream(&name);
            for (threads, pool) in &pools {
                let decode = || [whole(&decoder, &bytes), in_pieces(&decoder, &bytes)];
                let found = match pool {
                    Some(pool) => pool.install(decode),
                    None => decode(),
                };
                for (found, how) in found.into_iter().zip(["whole", "in pieces"]) {
                    let of = format!("{name} with {isa} and {threads} threads, {how}");
                    assert_eq!(found, Ok(levels.clone()), "{of}");
                }
            }
        }
    }
}

#[cfg(feature = "encoder")]
mod make {
    use b2p::cloud::ColouredVoxels;
    use b2p::encoder::transform::{Fineness, Options, encode};

    use super::*;
    use crate::common::{Ball, cloud_of};

    /// A stream of the suite, what is unusual about it in its name, and whether no float had a part in it, so that every machine makes the
    /// same bytes.
    fn cases() -> Vec<(&'static str, Vec<u8>, bool)> {
        let code = |cloud: &ColouredVoxels, levels, fineness, slice: u32, filter| {
            let options = Options {
                levels: Some(levels),
                fineness,
                filter,
                slice_voxels: slice.min(16_384),
                colour_slice: slice,
                ..Options::default()
            };
            let encoded = encode(cloud, &options, &mut Log::default());
            encoded.expect("a small cloud is coded").bytes
        };
        let (step, lossless) = (Fineness::Step, Fineness::Lossless);
        let (ball, large) = (Ball::new(5, 11.5).cloud(), Ball::new(6, 24.0).cloud());
        let far = |i: u64| i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 1;
        let lone = cloud_of(21, (0..40).map(far).collect());
        let solid = cloud_of(4, (0..1 << 12).collect());
        let one = cloud_of(10, vec![12_345]);
        let root = cloud_of(1, vec![0, 3, 5]);
        let mut grey = Ball::new(5, 9.5).cloud();
        for colour in &mut grey.colours {
            *colour = [colour[1]; 3];
        }
        vec![
            ("ball", code(&large, 3..=5, step(20.0), 32_768, true), false),
            ("fine-steps", code(&ball, 2..=4, step(0.5), 100, true), false),
            ("coarse-steps", code(&ball, 2..=4, step(400.0), 100, true), false),
            ("no-filter", code(&ball, 2..=5, step(10.0), 60, false), false),
            ("grey", code(&grey, 2..=4, step(10.0), 60, true), false),
            ("lone-voxels", code(&lone, 18..=20, step(10.0), 7, true), false),
            ("all-levels", code(&ball, 0..=5, step(10.0), 32_768, true), false),
            ("slices-of-1", code(&root, 0..=1, step(3.0), 1, true), false),
            ("exact", code(&ball, 2..=4, lossless, 32_768, true), true),
            ("exact-slices", code(&ball, 2..=5, lossless, 20, true), true),
            ("exact-solid", code(&solid, 0..=4, lossless, 300, true), true),
            ("exact-one-voxel", code(&one, 7..=10, lossless, 9, true), true),
            ("exact-deepest", code(&lone, 21..=21, lossless, 16, true), true),
        ]
    }

    #[test]
    fn the_generator_makes_the_same_streams_of_version_3_again() {
        for (name, bytes, anywhere) in cases() {
            assert!(!anywhere || bytes == stream(name), "{name} has changed");
        }
    }

    #[test]
    #[ignore = "overwrites the suite of version 3"]
    fn make_the_suite_of_version_3_anew() {
        let folder = own_folder();
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir_all(&folder).expect("a folder for the suite");
        let decoder = StreamDecoder::new().with_heads(HeadSet::Surfels);
        let mut text = String::new();
        for (name, bytes, _) in cases() {
            let levels = whole(&decoder, &bytes).unwrap_or_else(|e| panic!("{name}: {e}"));
            text += &format!("{name} {}\n", levels.join(" "));
            std::fs::write(folder.join(format!("{name}.b2p")), bytes).expect("a stream");
        }
        std::fs::write(folder.join("suite.txt"), text).expect("a list");
    }
}
