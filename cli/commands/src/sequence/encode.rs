//! `b2p encode` of many clouds: a sequence.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use b2p::cloud::{ColouredVoxels, CommonGrid, GridNeed};
use b2p::encoder::transform::{GeometryTarget, Options, Outline, QualityTarget, Tune};
use b2p::{Error, Limits, SequenceEncoder, SequenceReader};
use serde_json::json;

use super::super::args::{Colours, Encode};
use super::super::manners::{self, Said};
use super::super::progress::Progress;
use super::super::table::counted;
use super::super::{Failure, Result, cloud, load};
use super::kept::Kept;

/// Codes the clouds that the argument names as a sequence.
pub fn run(args: &Encode, limits: &Limits, progress: &Progress) -> Result<Said> {
    if matches!(args.colours, Colours::Learned) {
        return Err(Failure("sequences are coded with --colours transform".into()));
    }
    let files = match args.clouds.is_empty() {
        true => super::clouds(&args.cloud)?,
        false => args.clouds.clone(),
    };
    let inputs: Vec<_> = files.iter().map(PathBuf::as_path).collect();
    manners::permit(&[&args.output], &inputs)?;
    let (grid, axes) = grid(args, &files, limits, progress)?;
    // Frames of the cloud's own level state their voxels, of which they may have more than the cloud.
    let points: Vec<AtomicU64> = files.iter().map(|_| AtomicU64::new(0)).collect();
    let read = |frame: u64| -> b2p::Result<ColouredVoxels> {
        let path = &files[frame as usize];
        let found = cloud::read(path, &args.read, limits).map_err(|failure| Error::Usage(failure.0))?;
        let cloud = grid.voxelise(&found)?;
        points[frame as usize].store(cloud.voxels.len() as u64, Ordering::Relaxed);
        Ok(cloud)
    };
    let count = files.len() as u64;
    let (timescale, duration) = args.sequence.rate();
    let mut encoder = SequenceEncoder::new()
        .with_options(options(args, grid.bits())?)
        .with_frame_rate(timescale, duration)
        .with_group(args.sequence.gop)
        .with_prediction(!args.sequence.intra)
        .with_scalability(args.sequence.scalable)
        .with_geometry(args.geometry.unwrap_or(GeometryTarget::Visual))
        .with_axes(axes);
    let place = format!("{:?} {}", grid.placement(), grid.bits());
    let kept = Kept::of(&args.output, &files, &place).map(Arc::new);
    if let Some(kept) = &kept {
        encoder = encoder.with_kept_groups(Arc::<Kept>::clone(kept));
    }
    let finished = AtomicU64::new(0);
    let done = |_: u64| {
        let finished = finished.fetch_add(1, Ordering::Relaxed) + 1;
        progress.say(&format!("coded {finished} of {count} frames"));
    };
    let started = std::time::Instant::now();
    let bytes = match target(args, timescale, duration) {
        None => encoder.encode(count, read, done)?,
        Some(target) => encoder.encode_to_rate(count, read, done, target)?,
    };
    let took = started.elapsed().as_secs_f64();
    let to = &args.output;
    manners::write(to, |w| {
        w.write_all(&bytes).map_err(|source| Error::Io {
            path: to.to_path_buf(),
            source,
        })
    })?;
    let before = kept.as_ref().map_or(0, |kept| kept.frames_before(count));
    if let Some(kept) = kept {
        kept.remove();
    }
    let points: Vec<u64> = points.iter().map(|count| count.load(Ordering::Relaxed)).collect();
    Ok(said(args, &bytes, &points, took, before, limits)?.beside(to))
}

/// What was written. `points` are those of each frame's cloud, 0 where it was not read; `before` frames were coded by a
/// run before.
fn said(args: &Encode, bytes: &[u8], points: &[u64], took: f64, before: u64, limits: &Limits) -> Result<Said> {
    let sequence = SequenceReader::new(bytes, limits)?;
    let points = match points.contains(&0) {
        true => super::info::points(&sequence)?,
        false => points.iter().sum(),
    };
    let bits = bytes.len() as f64 * 8.0;
    let (frames, groups, rate) = (sequence.frames(), sequence.groups(), sequence.frame_rate());
    let per_point = bits / points.max(1) as f64;
    let megabits = bits / sequence.seconds().max(f64::MIN_POSITIVE) / 1e6;
    let to = args.output.display();
    let mut report = format!(
        "{to}: {} in {}, {}, {per_point:.4} bits per point, {megabits:.3} Mbit/s at {rate:.2} Hz, {took:.1} s\n",
        counted(frames, "frame"),
        counted(groups as u64, "group"),
        counted(bytes.len() as u64, "byte"),
    );
    if before > 0 {
        report += &format!("{} coded by a run before\n", counted(before, "frame"));
    }
    let json = || {
        json!({
            "output": to.to_string(),
            "frames_kept": before,
            "frames": frames,
            "groups": groups,
            "bytes": bytes.len(),
            "points": points,
            "bits_per_point": per_point,
            "bits_per_second": megabits * 1e6,
            "frame_rate": rate,
            "seconds": took,
        })
    };
    Ok(Said::report(report, json))
}

/// The grid of all frames and the axes of the first.
fn grid(args: &Encode, files: &[PathBuf], limits: &Limits, progress: &Progress) -> Result<(CommonGrid, b2p::Axes)> {
    let first = cloud::read(&files[0], &args.read, limits)?;
    let need = |path: &PathBuf| -> Result<GridNeed> {
        let cloud = cloud::read(path, &args.read, limits)?;
        GridNeed::of(&cloud).map_err(Failure::in_file(path))
    };
    let mut needs = vec![GridNeed::of(&first).map_err(Failure::in_file(&files[0]))?];
    for (i, path) in files.iter().enumerate().skip(1) {
        progress.say(&format!("looked at {i} of {} frames", files.len()));
        needs.push(need(path)?);
    }
    let grid = CommonGrid::new(&first, &needs, args.bits)?;
    Ok((grid, first.axes))
}

/// Options of each frame.
fn options(args: &Encode, bits: u8) -> Result<Options> {
    let mut options = Options {
        levels: args.levels.clone(),
        filter: !args.no_filter,
        isa: Some(load::isa(args.model.isa.as_deref())?),
        ..Options::default()
    };
    if let Some(geometry) = args.geometry {
        options.geometry = geometry;
    }
    if let Some(quality) = args.quality {
        options.set_quality(quality, bits);
    }
    if let Some(effort) = args.effort {
        options.set_effort(effort);
        // Colours that are refined frame by frame would differ from one frame to the next.
        options.rounds = 0;
    }
    options.tune = args.tune.unwrap_or(Tune::Psnr);
    if args.outline == Some(Outline::Cloud) {
        options.outline = Outline::Cloud;
        options.heads = Some(load::heads(None)?);
    }
    match args.step {
        Some(step) => options.fineness = step,
        None if args.lossless => {
            options.fineness = QualityTarget::Lossless;
            // Every voxel, unless other levels are asked for.
            options.levels = options.levels.or(Some(bits.saturating_sub(3)..=bits));
        }
        None => {}
    }
    Ok(options)
}

/// Bits to keep to.
fn target(args: &Encode, timescale: u32, duration: u32) -> Option<b2p::sequence::Rate> {
    let seconds = f64::from(duration) / f64::from(timescale);
    let by_time = args
        .sequence
        .bitrate
        .map(|bits| b2p::sequence::Rate::BitsPerFrame(bits * seconds));
    by_time.or(args.bits_per_point.map(b2p::sequence::Rate::BitsPerPoint))
}
