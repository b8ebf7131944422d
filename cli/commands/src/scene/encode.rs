//! `b2p encode` of a cloud that is larger than a block.

use b2p::cloud::{ColouredVoxels, GridReport};
use b2p::encoder::transform::Options;
use b2p::scene::{BLOCK_VOXELS, ONE_PIECE};
use b2p::{Axes, Error, Limits, SceneEncoder, SceneReader};
use serde_json::json;

use super::super::args::{Colours, Encode};
use super::super::manners::{self, Said};
use super::super::progress::Progress;
use super::super::table::{count, counted, table};
use super::super::{Failure, Result, cloud};

/// Whether a cloud of so many voxels becomes a scene.
pub fn is_wanted(args: &Encode, voxels: usize) -> bool {
    let most = args.block_size.map_or(ONE_PIECE, |size| size as usize);
    matches!(args.colours, Colours::Transform) && !args.no_blocks && voxels > most
}

/// Voxels of a block at most.
pub fn block_voxels(args: &Encode) -> usize {
    args.block_size.map_or(BLOCK_VOXELS, |size| size as usize)
}

/// Codes a cloud as a scene.
pub fn run(
    args: &Encode,
    (cloud, found): (&ColouredVoxels, &GridReport),
    axes: Axes,
    options: Options,
    limits: &Limits,
    progress: &Progress,
) -> Result<Said> {
    let fail = Failure::in_file(&args.cloud);
    let encoder = SceneEncoder::new()
        .with_options(options)
        .with_block_voxels(block_voxels(args))
        .with_memory(limits.max_bytes)
        .with_axes(axes);
    let started = std::time::Instant::now();
    progress.say("code blocks");
    let (bytes, chosen) = match args.bits_per_point {
        Some(most) => {
            let (bytes, how, level) = encoder.encode_to_rate(cloud, most).map_err(fail)?;
            (bytes, format!(" of at most {most}: level {level}, {how}"))
        }
        None => (encoder.encode(cloud).map_err(fail)?, String::new()),
    };
    let took = started.elapsed().as_secs_f64();
    let to = &args.output;
    manners::write(to, |w| {
        w.write_all(&bytes).map_err(|source| Error::Io {
            path: to.to_path_buf(),
            source,
        })
    })?;
    let said = said(args, &bytes, took, &chosen, limits)?;
    let report = format!("{}{}", cloud::describe(found), said.report);
    Ok(Said { report, ..said }.beside(to))
}

/// What was written.
pub fn said(args: &Encode, bytes: &[u8], took: f64, chosen: &str, limits: &Limits) -> Result<Said> {
    let scene = SceneReader::new(bytes, limits)?;
    let header = scene.header();
    let per_point = bytes.len() as f64 * 8.0 / header.points.max(1) as f64;
    let to = args.output.display();
    let levels = (header.base..).zip(&header.voxels);
    let mut rows = vec![["level", "voxels"].map(String::from).to_vec()];
    rows.extend(levels.map(|(level, voxels)| vec![level.to_string(), count((*voxels).into())]));
    let report = format!(
        "{}{to}: {} in {}, {} at {}, {per_point:.4} bits per point, {took:.1} s{chosen}\n",
        table(&rows),
        counted(bytes.len() as u64, "byte"),
        counted(scene.blocks().len() as u64, "block"),
        counted(header.points, "point"),
        counted(header.bits.into(), "bit"),
    );
    let json = || {
        json!({
            "output": to.to_string(),
            "bytes": bytes.len(),
            "blocks": scene.blocks().len(),
            "voxels": header.points,
            "bits": header.bits,
            "levels": [header.base, header.top],
            "bits_per_point": per_point,
            "seconds": took,
        })
    };
    Ok(Said::report(report, json))
}
