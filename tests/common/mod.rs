//! Small objects and helpers that several test files share.
#![allow(dead_code)] // each test file uses its part

use std::path::Path;

use b2p::cloud::ColouredVoxels;
use b2p::container::{Stream, Writer};
use b2p::encoder::{Options, encode};
use b2p::gaussians::Heads;
use b2p::geometry::{Voxels, morton};
use b2p::latents::network::Model;
use b2p::latents::{ResidualSteps, Steps};
use b2p::log::Log;
use b2p::{Limits, Placement};

/// A slanted wall on a grid of 7 bits of which one voxel in five is there, beside the whole of a wall.
pub fn sparse_wall() -> ColouredVoxels {
    let is_there = |i: u32| u64::from(i).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32 & 0xff < 51;
    let sparse = (0..96 * 96u32)
        .filter(|&i| is_there(i))
        .map(|i| [i % 96, i / 96, 20 + i % 96 / 5]);
    let whole = (0..48 * 48u32).map(|i| [60 + i % 48, 60 + i / 48, 120]);
    cloud_of(7, sparse.chain(whole).map(morton::encode).collect())
}

/// A coloured ball's surface on a voxel grid.
pub struct Ball {
    bits: u8,
    radius: f32,
}

impl Ball {
    /// A ball of `radius` voxels in the middle of a cube of `2^bits`.
    pub fn new(bits: u8, radius: f32) -> Self {
        Ball { bits, radius }
    }

    /// Surface voxels with their colours.
    pub fn voxels(&self) -> Vec<([u32; 3], [u8; 3])> {
        let side = 1u32 << self.bits;
        let middle = side as f32 / 2.0;
        let mut voxels = Vec::new();
        for z in 0..side {
            for y in 0..side {
                for x in 0..side {
                    let p = [x, y, z].map(|v| v as f32 + 0.5 - middle);
                    let distance = p.iter().map(|v| v * v).sum::<f32>().sqrt();
                    if (distance - self.radius).abs() < 0.6 {
                        let colour = p.map(|v| (127.5 + 120.0 * v / self.radius) as u8);
                        voxels.push(([x, y, z], colour));
                    }
                }
            }
        }
        voxels
    }

    /// The ball on its grid.
    pub fn cloud(&self) -> ColouredVoxels {
        let mut voxels = self.voxels();
        voxels.sort_by_key(|(at, _)| morton::encode(*at));
        ColouredVoxels {
            voxels: Voxels::new(self.bits, voxels.iter().map(|(at, _)| morton::encode(*at)).collect()),
            colours: voxels.iter().map(|(_, colour)| *colour).collect(),
            placement: Placement::VOXEL_GRID,
        }
    }

    /// The ball as an ascii PLY whose properties are not in the usual order.
    pub fn to_ply(&self) -> String {
        let voxels = self.voxels();
        let mut text = format!(
            "ply\nformat ascii 1.0\ncomment bits {}\nelement vertex {}\nproperty uchar green\nproperty uchar blue\n\
             property uchar red\nproperty float z\nproperty float x\nproperty float y\nend_header\n",
            self.bits,
            voxels.len()
        );
        for ([x, y, z], [r, g, b]) in voxels {
            text += &format!("{g} {b} {r} {z} {x} {y}\n");
        }
        text
    }
}

/// A small model with random weights.
pub fn tiny_model(seed: u64) -> Vec<u8> {
    b2p::latents::network::untrained(&b2p::latents::network::Shape::tiny(), seed)
}

/// A cloud of these voxels, its colours from their places.
pub fn cloud_of(depth: u8, keys: Vec<u64>) -> ColouredVoxels {
    let voxels = Voxels::new(depth, keys);
    let colours = voxels
        .keys()
        .iter()
        .map(|k| [*k as u8, (k >> 3) as u8, (k >> 7) as u8])
        .collect();
    ColouredVoxels {
        voxels,
        colours,
        placement: Placement::VOXEL_GRID,
    }
}

/// A stream of about half a kilobyte for [`tiny_model`]`(0)`: the levels 1 to 3, the finest ones in several slices.
pub fn small_stream(model: &Model) -> Vec<u8> {
    let options = Options {
        slice_voxels: 24,
        ..Options::default()
    };
    let cloud = Ball::new(4, 4.5).cloud();
    let encoded = encode(&cloud, model, &options, &Log::default());
    encoded.expect("a ball can be coded").bytes
}

/// Everything in a folder, sorted.
pub fn names_in(folder: &Path) -> Vec<std::ffi::OsString> {
    let mut names: Vec<_> = std::fs::read_dir(folder)
        .expect("a readable folder")
        .map(|entry| entry.expect("a readable entry").file_name())
        .collect();
    names.sort();
    names
}

/// The same stream, its last level with this colour filter for one set of heads.
pub fn with_filter(bytes: &[u8], heads: Heads, filter: &[u8]) -> Vec<u8> {
    with_more(bytes, |writer, top| {
        let written = writer.filter(top, heads as usize, filter);
        written.expect("a level of the stream");
    })
}

/// The same stream, its last level with these slices of a colour residual.
pub fn with_residual(bytes: &[u8], slices: &[Vec<u8>]) -> Vec<u8> {
    with_more(bytes, |writer, top| {
        let written = writer.residual(top, slices);
        written.expect("a level of the stream, and its slices");
    })
}

/// The same step for luma and chromas.
pub fn steps(step: u8) -> Steps {
    Steps {
        luma: step,
        chroma: step,
    }
}

/// Everything in the same step.
pub fn all_in(step: u8) -> ResidualSteps {
    ResidualSteps {
        fine: steps(step),
        coarse: steps(step),
        boundary: 9,
    }
}

/// The same stream with what `add` adds to its last level, and without what levels said of their colours.
fn with_more(bytes: &[u8], add: impl Fn(&mut Writer, u8)) -> Vec<u8> {
    let stream = Stream::parse(bytes, &Limits::default()).expect("a header");
    let mut writer = Writer::new(stream.header().clone()).expect("a header that was read");
    for level in stream.levels() {
        for part in &level.geometry {
            let slices = part.slices.iter().map(|slice| (slice.voxels, slice.bytes));
            let slices: Vec<_> = slices.collect();
            writer.geometry(part.level, &slices).expect("geometry");
        }
        let slices: Vec<_> = level.features.iter().map(|slice| slice.bytes).collect();
        let (number, hash) = (level.level, level.latent_hash);
        writer.features(number, hash, &slices).expect("features");
    }
    add(&mut writer, stream.header().top);
    writer.finish().expect("the parts of a whole stream")
}
