//! The streams of the suite of version 3: what is unusual about them is in their names.

use b2p::Limits;
use b2p::cloud::ColouredVoxels;
use b2p::container::{Level, Slice, Stream, Writer};
use b2p::encoder::transform::{Options, QualityTarget, encode};
use b2p::gaussians::HeadMap;
use b2p::log::Log;

use crate::common::{Ball, cloud_of, sparse_wall};

/// A stream of the suite, what is unusual about it in its name, and whether no float had a part in it, so that every
/// machine makes the same bytes.
pub fn cases() -> Vec<(&'static str, Vec<u8>, bool)> {
    let code = |cloud: &ColouredVoxels, levels, fineness, slice: u32, filter| {
        let options = Options {
            levels: Some(levels),
            fineness,
            filter,
            slice_voxels: slice.min(16_384),
            colour_slice: slice,
            ..Options::default()
        };
        let encoded = encode(cloud, &options, &Log::default());
        encoded.expect("a small cloud is coded").bytes
    };
    let (step, lossless) = (QualityTarget::Step, QualityTarget::Lossless);
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
        (
            "exact-sparse",
            code(&sparse_wall(), 6..=7, lossless, 32_768, true),
            true,
        ),
        ("exact-deepest", code(&lone, 21..=21, lossless, 16, true), true),
        (
            "exact-head-maps",
            with_head_maps(&code(&large, 4..=6, lossless, 32_768, true), &large, [0; 2]),
            true,
        ),
        (
            "exact-thicker",
            with_head_maps(&code(&large, 4..=6, lossless, 32_768, true), &large, [23, 101]),
            true,
        ),
    ]
}

/// The stream of a cloud with head maps: some blocks of its levels are surfels, and all of level 5. Learned Gaussians and
/// surfels are so much thicker.
fn with_head_maps(bytes: &[u8], cloud: &ColouredVoxels, thickness: [u8; 2]) -> Vec<u8> {
    let stream = Stream::parse(bytes, &Limits::default()).expect("a stream of the encoder");
    let mut writer = Writer::new(stream.header().clone()).expect("the header of a stream");
    for level in stream.levels() {
        copy(&mut writer, level).expect("a level of the stream");
        let up = 3 * (cloud.voxels.depth() - (level.level - 3));
        let mut blocks: Vec<u64> = cloud.voxels.keys().iter().map(|key| key >> up).collect();
        blocks.dedup();
        let surfels = blocks.iter().map(|block| level.level == 5 || block % 3 == 0);
        let map = HeadMap::new(80, 70 - level.level, surfels.collect());
        let added = writer.head_map(level.level, thickness, &map.to_bytes());
        added.expect("a level of the stream");
    }
    writer.finish().expect("all levels of a stream")
}

/// Writes a level as it was read.
fn copy(writer: &mut Writer, level: &Level<'_>) -> b2p::Result<()> {
    let of = |slices: &[Slice<'_>]| {
        slices
            .iter()
            .map(|slice| (slice.voxels, slice.bytes.to_vec()))
            .collect()
    };
    let colours = level.colours.as_ref().expect("a stream of version 3");
    let (finest, trunk) = level.geometry.split_last().expect("a level has geometry");
    let trunk: Vec<(u32, Vec<u8>)> = trunk.iter().flat_map(|part| -> Vec<_> { of(&part.slices) }).collect();
    writer.geometry_trunk(&trunk)?;
    let finest: Vec<(u32, Vec<u8>)> = of(&finest.slices);
    writer.geometry(level.level, &finest)?;
    if let Some(trunk) = &colours.trunk {
        writer.colour_trunk(trunk.level, trunk.slice.voxels, colours.hash, trunk.slice.bytes)?;
    }
    for part in &colours.levels {
        let hash = colours.trunk.is_none().then_some(colours.hash);
        let slices: Vec<(u32, Vec<u8>)> = of(&part.slices);
        writer.colours(part.level, hash, &slices)?;
    }
    Ok(())
}
