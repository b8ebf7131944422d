//! What fuzzing starts from: streams of our own encoder, files of our own writers, and a few numbers.

use std::path::Path;

use b2p::cloud::{ColouredVoxels, PointCloud};
use b2p::container::{Level, Stream};
use b2p::encoder::{Options, encode, transform};
use b2p::gaussians::{Gaussians, Harmonics};
use b2p::geometry::Voxels;
use b2p::latents::LatentDecoder;
use b2p::latents::{COLOUR_INPUTS, ColourFilter, ColourResidual, ResidualSteps, Steps};
use b2p::log::Log;
use b2p::{Limits, Motion, Placement, SceneEncoder, SequenceEncoder};
use b2p_formats::splats::{Axes, Format, write};

use crate::MODEL;
use crate::streams::{Colours, rewritten};

/// A stream of these voxels, and the Gaussians of its finest level as a file.
fn coded(depth: u8, keys: Vec<u64>, slice_voxels: u32) -> (Vec<u8>, Option<Vec<u8>>) {
    let voxels = Voxels::new(depth, keys);
    let colour = |key: &u64| [*key as u8, (key >> 3) as u8, (key >> 6) as u8];
    let cloud = ColouredVoxels {
        colours: voxels.keys().iter().map(colour).collect(),
        voxels,
        placement: Placement::VOXEL_GRID,
    };
    let options = Options {
        slice_voxels,
        ..Options::default()
    };
    let log = Log::default();
    let stream = encode(&cloud, &MODEL, &options, &log).expect("a small cloud is coded");
    let gaussians = LatentDecoder::new(&MODEL).decode(&stream.bytes, None, &log);
    let file = gaussians.ok().map(|gaussians| {
        let mut file = Vec::new();
        let name = Path::new("memory");
        gaussians.write_ply(&mut file, name).expect("memory takes it");
        file
    });
    (stream.bytes, file)
}

/// Streams of version 3: of one slice and of several, with exact colours, and of the deepest levels.
fn transformed() -> Vec<Vec<u8>> {
    let coded = |depth: u8, keys: Vec<u64>, levels, slice: u32, fineness| {
        let voxels = Voxels::new(depth, keys);
        let colour = |key: &u64| [*key as u8, (key >> 3) as u8, (key >> 6) as u8];
        let cloud = ColouredVoxels {
            colours: voxels.keys().iter().map(colour).collect(),
            voxels,
            placement: Placement::VOXEL_GRID,
        };
        let options = transform::Options {
            levels: Some(levels),
            fineness,
            slice_voxels: slice,
            colour_slice: slice,
            ..transform::Options::default()
        };
        let stream = transform::encode(&cloud, &options, &Log::default());
        stream.expect("a small cloud is coded").bytes
    };
    let step = transform::QualityTarget::Step;
    let lossless = transform::QualityTarget::Lossless;
    vec![
        coded(1, vec![0, 7], 0..=1, 16_384, step(8.0)),
        coded(2, vec![0, 5, 63], 1..=2, 2, lossless),
        coded(3, (0..512).step_by(5).collect(), 1..=3, 16_384, step(20.0)),
        coded(4, (0..4096).step_by(37).collect(), 2..=4, 16, step(4.0)),
        coded(4, (0..4096).step_by(41).collect(), 0..=4, 16, lossless),
        coded(21, vec![0, 77, (1 << 63) - 1], 18..=21, 16_384, step(30.0)),
    ]
}

/// Scenes of a few voxels in several blocks.
fn scenes() -> Vec<Vec<u8>> {
    let coded = |depth: u8, levels: std::ops::RangeInclusive<u8>, most: usize, lossless: bool| {
        let voxels = Voxels::new(depth, (0..1u64 << (3 * depth)).step_by(7).take(160).collect());
        let colour = |key: &u64| [*key as u8, (key >> 3) as u8, (key >> 6) as u8];
        let cloud = ColouredVoxels {
            colours: voxels.keys().iter().map(colour).collect(),
            voxels,
            placement: Placement::VOXEL_GRID,
        };
        let encoder = SceneEncoder::new().with_levels(levels).with_block_voxels(most);
        let encoder = match lossless {
            true => encoder.with_quality(transform::QualityTarget::Lossless),
            false => encoder,
        };
        encoder.encode(&cloud).expect("a few voxels are coded")
    };
    vec![
        coded(3, 1..=3, 20, false),
        coded(4, 2..=3, 50, false),
        coded(4, 0..=4, 50, false),
        coded(3, 2..=3, 9, true),
    ]
}

/// Sequences of a few voxels that move: in one group and in two, lossless, and of frames that are all alike; with
/// blocks, with parts, whose motion the colours of the coarse levels follow in the last one, and warped.
fn sequences() -> Vec<Vec<u8>> {
    let coded = |levels: std::ops::RangeInclusive<u8>, moves: u64, group: u32, lossless: bool, motion: Motion| {
        let depth = *levels.end();
        let side = 1u64 << depth;
        let cloud = |frame: u64| {
            let key = |i: u64| {
                let at = [i % side, (i / side + moves * frame) % side, (i * i / 7) % side];
                b2p::geometry::morton::encode(at.map(|v| v as u32))
            };
            let voxels = Voxels::new(depth, (0..60).map(key).collect());
            let colour = |key: &u64| [*key as u8, (key >> 3) as u8, (key >> 6) as u8];
            Ok(ColouredVoxels {
                colours: voxels.keys().iter().map(colour).collect(),
                voxels,
                placement: Placement::VOXEL_GRID,
            })
        };
        let encoder = SequenceEncoder::new()
            .with_group(group)
            .with_levels(levels)
            .with_motion(motion);
        let encoder = match lossless {
            true => encoder.with_quality(transform::QualityTarget::Lossless),
            false => encoder,
        };
        encoder.encode(4, cloud, |_| {}).expect("a few voxels are coded")
    };
    vec![
        coded(1..=3, 1, 4, false, Motion::Blocks),
        coded(1..=4, 1, 2, false, Motion::Blocks),
        coded(1..=4, 0, 4, false, Motion::Blocks),
        coded(1..=3, 1, 4, true, Motion::Blocks),
        coded(1..=4, 1, 4, false, Motion::Parts),
        coded(1..=4, 0, 4, false, Motion::Parts),
        coded(1..=3, 1, 4, true, Motion::Parts),
        coded(2..=4, 1, 4, false, Motion::Parts),
        coded(1..=4, 1, 4, false, Motion::Warped),
        coded(2..=5, 0, 3, false, Motion::Warped),
    ]
}

/// The same stream with colour filters, for which small clouds do not pay by themselves, and residuals at every level.
fn coloured(bytes: &[u8]) -> Vec<u8> {
    let stream = Stream::parse(bytes, &Limits::unlimited()).expect("a stream of ours");
    let mut weights = [[0; COLOUR_INPUTS]; 3];
    for (weight, byte) in weights.as_flattened_mut().iter_mut().zip(noise(9, 57)) {
        *weight = byte as i8;
    }
    let filter = ColourFilter { exponent: 7, weights };
    let slice = stream.header().slice_voxels as usize;
    let steps = |luma, chroma| Steps { luma, chroma };
    let precision = ResidualSteps {
        fine: steps(30, 12),
        coarse: steps(10, 4),
        boundary: 3,
    };
    let residual = |level: &Level| {
        let keys: Vec<u64> = (0..level.voxels.into()).collect();
        let noise = noise(4, 3 * keys.len());
        let missing = noise
            .chunks(3)
            .map(|c| [0, 1, 2].map(|k| f32::from(c[k]) / 300.0 - 0.4));
        let missing: Vec<_> = missing.collect();
        ColourResidual::of(&missing, &keys, slice, precision).to_payloads(&keys)
    };
    let colours = Colours {
        filter: filter.to_bytes().to_vec(),
        residual: &residual,
    };
    rewritten(&stream, Some(&colours))
}

/// The Gaussians of a PLY file in each format, and with view-dependent colour.
fn splats(file: &[u8]) -> Vec<Vec<u8>> {
    let mut gaussians = Gaussians::from_ply(file, &Limits::default()).expect("a file of ours");
    let mut seeds = Vec::new();
    for count in [0, 3] {
        let noise = noise(11, 3 * count * gaussians.len());
        let coefficients = noise
            .chunks(3)
            .map(|c| [0, 1, 2].map(|k| f32::from(c[k]) / 128.0 - 1.0));
        gaussians.harmonics = Harmonics {
            count,
            coefficients: coefficients.collect(),
        };
        for (number, format) in (0u8..).zip(Format::all()) {
            let mut bytes = vec![number];
            let written = write(&gaussians, Axes::of(format), format, &mut bytes, Path::new("memory"));
            written.expect("memory takes it");
            seeds.push(bytes);
        }
    }
    seeds
}

/// Pseudo-random bytes.
fn noise(seed: u64, length: usize) -> Vec<u8> {
    let mut state = seed;
    let next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(seed | 1);
        (state >> 40) as u8
    };
    std::iter::repeat_with(next).take(length).collect()
}

/// The seeds of a target.
pub fn seeds(target: &str) -> Vec<Vec<u8>> {
    let clouds = [
        coded(1, vec![0, 7], 16_384),
        coded(2, vec![0, 5, 63], 2),
        coded(3, (0..512).step_by(5).collect(), 16_384),
        coded(4, (0..4096).step_by(37).collect(), 16),
        coded(21, vec![0, 77, (1 << 63) - 1], 16_384),
    ];
    let streams = clouds.iter().map(|(stream, _)| stream.clone());
    match target {
        "header" | "stream" | "chunking" => {
            let coloured = coloured(&clouds[3].0);
            let new = (target == "header").then(transformed);
            streams.chain([coloured]).chain(new.into_iter().flatten()).collect()
        }
        "transform" => transformed(),
        "sequence" => sequences(),
        "scene" => scenes(),
        "ply" => {
            let cloud = PointCloud {
                positions: vec![[0.0, 1.0, 2.0], [3.0, 4.5, -1.0]],
                colours: vec![[1, 2, 3], [250, 0, 9]],
                ..PointCloud::default()
            };
            let ascii = "ply\nformat ascii 1.0\ncomment bits 3\nelement vertex 2\nproperty uchar green\nproperty uchar blue\n\
                         property uchar red\nproperty float z\nproperty float x\nproperty float y\nend_header\n1 2 3 4 5 6\n6 5 4 3 2 1\n";
            let files = clouds.iter().take(2).filter_map(|(_, file)| file.clone());
            files.chain([cloud.to_ply(), ascii.into()]).collect()
        }
        "clouds" => point_files(),
        "splats" => {
            let drawn = clouds.iter().find_map(|(_, file)| file.as_deref());
            splats(drawn.expect("one of the clouds has Gaussians"))
        }
        "model" => vec![vec![], noise(1, 5), noise(2, 40)],
        // No voxels; one at every level, and one level too many.
        "octree" => {
            let deepest = [&[0; 5][..], &[1; 22]].concat();
            [vec![0, 0, 64], deepest].into_iter().chain(noises()).collect()
        }
        "entropy" => faulty_tables().into_iter().chain(noises()).collect(),
        _ => noises().collect(),
    }
}

/// Files of points in the formats whose parsers are this project's own.
fn point_files() -> Vec<Vec<u8>> {
    let pcd = |data: &str| {
        format!(
            "# .PCD v.7\nVERSION .7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\n\
             POINTS 2\nDATA {data}\n"
        )
    };
    let rows = noise(5, 32);
    // One run of literals.
    let packed = [&[33, 0, 0, 0, 32, 0, 0, 0, 31][..], &rows].concat();
    let texts = [
        "x,y,z,red,green,blue\n0,1,2,10,20,30\n5,nan,1,0,0,255\n",
        "2\n1.5 2 3 -100 10 20 30\n4 5 6 7 40 50 60\n",
        "1 2 3 0 0 1\n4 5 6 1 0 0\n",
        "# a\nv 1 2 3 0.5 0 1\nv 2 2 2 1 1 1\nf 1 2 1\n",
        "ply\nformat ascii 1.0\ncomment coordinates local\ncomment offset 500000 4000000 1\nelement vertex 2\nproperty float x\n\
         property float y\nproperty float z\nproperty ushort r\nproperty ushort g\nproperty ushort b\nend_header\n\
         0 1 2 200 3 4\n1 2 3 4 5 6\n",
        "\u{feff}ply\rformat ascii 1.0\rcomment up z\relement vertex 1\rproperty double X\rproperty double Y\rproperty double Z\r\
         property float intensity\rend_header\r1 2 3 0.5\r",
    ];
    let mut files: Vec<Vec<u8>> = texts.iter().map(|text| text.as_bytes().to_vec()).collect();
    files.push((pcd("ascii") + "1 2 3 255\n4 5 6 65280\n").into_bytes());
    files.push([pcd("binary").as_bytes(), &rows].concat());
    files.push([pcd("binary_compressed").as_bytes(), &packed].concat());
    files
}

fn noises() -> impl Iterator<Item = Vec<u8>> {
    let lengths = [0, 7, 60, 300, 1000];
    lengths.into_iter().map(|length| noise(length as u64, length))
}

/// What the target `entropy` reads as tables of one row of three entries, and as symbols under it: one that is sound,
/// and one with each fault that is more than a wrong sum.
fn faulty_tables() -> [Vec<u8>; 5] {
    let table = |how: u8, low: i16, rest: &[u8]| {
        let entries = [0, 1, 2, 3, 4, 5];
        [&[how, 1, 3][..], &entries, &low.to_le_bytes(), rest].concat()
    };
    [
        table(237, -1, &noise(3, 40)),
        table(237, i16::MAX, &[]),
        table(225, 0, &[9, 0]),
        table(229, 0, &[]),
        table(233, 0, &[]),
    ]
}
