//! Files that are not streams.

use std::path::Path;
use std::sync::LazyLock;

use b2p::Limits;
use b2p::cloud::{PointCloud, ReadOptions, voxelise, voxelise_closed};
use b2p::gaussians::Gaussians;
use b2p::geometry::{KernelMap, Octree, Voxels};
use b2p::latents::entropy::UNPREDICTED;
use b2p::latents::network::{Model, Pass, Shape, untrained};
use b2p_formats::clouds::{self, PointFormat, WriteOptions};
use b2p_formats::detect::Kind;
use b2p_formats::splats;

use crate::{one_in, within};

/// A model file that bytes are edits of.
static FILE: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let mut shape = Shape {
        channels: 4,
        latents: 2,
        base_channels: 4,
        near_channels: [4, 4],
        learning: true,
        ..Shape::tiny()
    };
    shape.gg.iter_mut().for_each(|head| head.channels = 4);
    untrained(&shape, 0)
});

/// Any bytes as a model, and as edits of one: an error, or a model whose identity depends on nothing but the bytes, and
/// that computes finite numbers.
pub fn model(bytes: &[u8]) {
    load(bytes);
    let mut file = FILE.clone();
    // The text at the start is a twentieth of the file, and half of the edits are meant for it.
    let text = 8 + usize::from(u16::from_le_bytes([file[0], file[1]]));
    for edit in bytes.chunks_exact(5) {
        let [place @ .., value] = edit else { continue };
        let place = place.iter().fold(0, |sum, byte| sum << 8 | usize::from(*byte));
        let end = if place.is_multiple_of(2) { text } else { file.len() };
        file[place / 2 % end] = *value;
    }
    load(&file);
}

fn load(bytes: &[u8]) {
    let Ok(model) = Model::from_bytes(bytes) else {
        return;
    };
    let rarely = one_in(8, bytes);
    if rarely {
        let again = Model::from_bytes(bytes).expect("what loaded once loads again");
        assert_eq!(model.id(), again.id());
    }
    let shape = model.shape();
    let octree = Octree::new(Voxels::new(2, vec![0, 1, 9, 63])).expect("four voxels");
    let map = octree.kernel_map(2);
    let one = usize::from(bytes.iter().copied().fold(0, u8::wrapping_add)) % 3;
    for role in 0..3 {
        if role != one && !rarely {
            continue;
        }
        if model.has_passes(role) {
            passes(&model, role, &octree, &map);
        }
        let latents = vec![shape.latent_max; 4 * shape.latents_of(role)];
        let context = vec![2047i16; 4 * shape.channels];
        let context = (role > 0).then_some(&context[..]);
        let features = model.reconstruct(role, &latents, context, &map);
        assert!(features.iter().all(|f| f.unsigned_abs() <= 2047));
        if let Ok(raw) = model.generate(role, &features, &map) {
            assert!(raw.iter().all(|x| x.is_finite()));
        }
    }
}

/// Every pass over the voxels, after latents that no encoder makes and parameters at the ends of their range.
fn passes(model: &Model, role: usize, octree: &Octree, map: &KernelMap) {
    let octants = octree.level(2).octants();
    let count = octants.len() * model.shape().latents;
    let (mu, sigma) = (vec![-2047; count], vec![63; count]);
    let level = (role > 0).then_some((&mu[..], &sigma[..]));
    for octant in 0..8 {
        let voxels = 0..octants.len() as u32;
        let voxels: Vec<u32> = voxels.filter(|&v| octants[v as usize] == octant).collect();
        let pass = Pass {
            octants: &octants,
            map,
            slice: 0..octants.len(),
            voxels: &voxels,
            latents: &vec![i16::MIN; count],
        };
        let (mu, sigma) = model.pass_parameters(role, &pass, level);
        assert!(mu.iter().all(|mu| mu.unsigned_abs() <= 2047));
        assert!(sigma.iter().all(|&s| s < 64 || s == UNPREDICTED));
    }
}

/// Any bytes as a file of points that a parser of this project reads: an error, or finite points of which every format
/// that holds the grid gives back the same voxels.
pub fn clouds(bytes: &[u8]) {
    let limits = Limits::default().with_max_points(1 << 16);
    // Other crates' parsers may panic inside of the reader, which a fuzzer counts.
    if matches!(Kind::of(bytes), Kind::Las | Kind::E57 | Kind::Glb | Kind::Gltf) {
        return;
    }
    let options = ReadOptions {
        drop_outliers: one_in(2, bytes),
        drop_hidden: one_in(5, bytes),
        vertices: one_in(3, bytes),
        ..ReadOptions::default()
    };
    let Ok(read) = clouds::read(bytes.to_vec(), None, &limits, &options) else {
        return;
    };
    let cloud = read.cloud;
    assert_eq!(cloud.positions.len(), cloud.colours.len());
    assert!(cloud.positions.as_flattened().iter().all(|x| x.is_finite()));
    let Ok((voxels, _)) = voxelise_closed(&cloud) else {
        return;
    };
    let format = PointFormat::Ply;
    for local in [false, true] {
        let options = WriteOptions { double: true, local };
        let file = clouds::encode(&voxels, &cloud.axes, format, options).expect("PLY holds all voxels");
        // Points may be so far from the origin that numbers do not separate them.
        if let Ok(again) = PointCloud::from_ply(&file.bytes, &limits) {
            assert_eq!(again.colours, voxels.colours);
        }
    }
}

/// Any bytes as a point cloud and as Gaussians: an error, or arrays of equal length that are the same after writing and
/// reading again.
pub fn ply(bytes: &[u8]) {
    let limits = Limits::default().with_max_points(1 << 16);
    if let Ok(cloud) = PointCloud::from_ply(bytes, &limits) {
        assert_eq!(cloud.positions.len(), cloud.colours.len());
        let again = PointCloud::from_ply(&cloud.to_ply(), &limits).expect("what is written is read");
        assert_eq!(again.colours, cloud.colours);
        if let Ok(voxels) = voxelise(&cloud, None) {
            assert_eq!(voxels.voxels.len(), voxels.colours.len());
            assert!(voxels.voxels.len() <= cloud.positions.len());
            // A coarser grid may be larger than numbers can express.
            if let Ok((closed, report)) = voxelise_closed(&cloud) {
                assert_eq!(report.finest, voxels.voxels.depth());
                assert_eq!(report.voxels, closed.voxels.len() as u64);
                assert!(closed.voxels.len() <= cloud.positions.len());
            }
        }
    }
    if let Ok(gaussians) = Gaussians::from_ply(bytes, &limits) {
        gaussians.check_lengths().expect("arrays of one length");
        let mut file = Vec::new();
        gaussians
            .write_ply(&mut file, Path::new("memory"))
            .expect("memory takes it");
        let again = Gaussians::from_ply(&file, &limits).expect("what is written is read");
        assert_eq!(again.len(), gaussians.len());
    }
}

/// Memory that a file of splats may ask for, and what its reader takes besides, of which the tables of compressed data
/// are most.
const SPLAT_MEMORY: u64 = 1 << 20;
const SPLAT_OVERHEAD: u64 = 16 << 20;

/// Any bytes as splats, of the format that the first byte names: an error, or Gaussians that are as many after writing
/// and reading again, for memory within the limits.
pub fn splats(bytes: &[u8]) {
    let [first, file @ ..] = bytes else { return };
    let format = splats::Format::all().nth(usize::from(*first) % 9).expect("one of nine");
    let limits = Limits::default().with_max_points(1 << 12).with_max_bytes(SPLAT_MEMORY);
    let options = splats::Options::default();
    let _ = splats::Format::of_bytes(file);
    let read = within((SPLAT_MEMORY + SPLAT_OVERHEAD) as usize + 8 * bytes.len(), || {
        splats::read(file, format, &options, &limits)
    });
    let Ok(read) = read else { return };
    read.gaussians.check_lengths().expect("arrays of one length");
    let whole = read.gaussians.len();
    for to in splats::Format::all() {
        if !one_in(4, bytes) && to != format {
            continue;
        }
        let mut written = Vec::new();
        let Ok(warnings) = splats::write(&read.gaussians, read.axes, to, &mut written, Path::new("memory")) else {
            // Coordinates may be outside what the format holds.
            continue;
        };
        let limits = Limits::default();
        let again = splats::read(&written, to, &options, &limits)
            .expect("what is written is read")
            .gaussians;
        assert!(again.len() <= whole && (again.len() == whole || !warnings.is_empty()));
    }
}
