//! `b2p decode`: stream to Gaussians in a file.

use std::path::{Path, PathBuf};
use std::time::Duration;

use super::budget::{Chosen, Task};
use b2p::Limits;
use b2p::container::version;
use b2p::gaussians::Gaussians;
use b2p::log::Log;
use b2p_formats::splats::Axes;
use serde_json::json;

use super::args::Decode;
use super::manners::{self, Said};
use super::many::Kind;
use super::progress::Progress;
use super::table::{counted, steps, steps_json};
use super::{Failure, Result, budget, cloud, convert, kinds, load, pipe, points, scene, sequence};

/// What is taken from folders, and what becomes of it.
pub fn kind(args: &Decode) -> Kind<'_> {
    Kind {
        command: "decode",
        takes: &["b2p"],
        ending: args
            .format
            .map_or("ply", |format| format.extension().trim_start_matches('.')),
        instead: None,
        gathers: false,
    }
}

/// Decodes a stream into a file of Gaussians.
pub fn run(args: &Decode, limits: &Limits, progress: &Progress) -> Result<Said> {
    if sequence::is_sequence(&args.input) {
        return sequence::decode(args, limits, progress);
    }
    if scene::is_scene(&args.input) {
        return scene::decode(args, limits, progress);
    }
    if args.wanted.is_some() {
        let what = "it is no scene of blocks, of which --box takes a part";
        return Err(Failure(format!("{}: {what}", args.input.display())));
    }
    let model = args.model.model.iter().map(PathBuf::as_path);
    let inputs: Vec<&Path> = model.chain([args.input.as_path()]).collect();
    manners::permit(&[&args.output], &inputs)?;
    cloud::refuse(&args.input)?;
    let log = progress.log();
    if args.points {
        return decoded_points(args, limits, &log);
    }
    let (input, to) = (&args.input, &args.output);
    let format = convert::output_format(to, args.format)?;
    let mut written = 0;
    let mut write = |gaussians: &Gaussians, known: &b2p::Axes, log: &Log| {
        written = gaussians.len();
        let axes = match cloud::up_of(args.up, known) {
            _ if args.keep_axes => Axes::of(format),
            Some(up) => Axes::Cloud(up),
            None => Axes::Ply,
        };
        convert::write(gaussians, axes, known, format, to, log)
    };
    let stream = budget::stream(&args.budget, input, &args.detail, limits)?;
    let chosen = match &stream {
        Some(stream) => budget::choose(&args.budget(limits, progress), input, stream, None, Task::Decode)?,
        None => None,
    };
    let detail = chosen.as_ref().map(Chosen::detail);
    let detail = detail.as_ref().unwrap_or(&args.detail);
    let mut took = Duration::ZERO;
    // What has gone to standard output cannot be replaced by something finer.
    let early = !manners::is_pipe(to);
    pipe::each(
        input,
        detail,
        &args.model,
        limits,
        early,
        &log,
        &mut |gaussians, known, log| {
            took = log.steps().iter().map(|step| step.time).sum();
            write(gaussians, known, log)
        },
    )?;
    let chosen = match chosen {
        Some(chosen) => chosen.describe(took, limits, progress)?,
        None => String::new(),
    };
    Ok(said(args, &chosen, written, "Gaussian", &log))
}

/// What was written.
fn said(args: &Decode, chosen: &str, written: usize, thing: &str, log: &Log) -> Said {
    let to = &args.output;
    let report = format!(
        "{chosen}{}\n{}: {}\n",
        steps(&log.steps()),
        to.display(),
        counted(written as u64, thing)
    );
    let json = || {
        json!({
            "output": to.display().to_string(),
            "count": written,
            "of": format!("{}s", thing.to_lowercase()),
            "budget": (!chosen.is_empty()).then(|| chosen.trim()),
            "steps": steps_json(&log.steps()),
        })
    };
    Said::report(report, json).beside(to)
}

/// Decodes a stream into a file of points.
fn decoded_points(args: &Decode, limits: &Limits, log: &Log) -> Result<Said> {
    let bytes = load::bytes(&args.input, limits)?;
    kinds::check_stream(&args.input, &bytes)?;
    let bytes = load::whole_levels(&args.input, bytes, &args.detail, limits)?;
    let fail = Failure::in_file(&args.input);
    if version(&bytes) == Some(2) {
        let what = "a stream of version 2 holds no colours of voxels, but Gaussians";
        return Err(Failure(format!("{}: {what}", args.input.display())));
    }
    let decoder = load::decoder(&bytes, &args.detail, &args.model, limits)?.with_log(log);
    load::reserve_for(&args.input, &bytes, &decoder, args.detail.level, limits)?;
    let decoding = decoder.whole(&bytes);
    let decoding = decoding.map_err(&fail)?;
    let voxels = decoding.points().map(|points| points.to_voxels());
    let voxels = voxels.ok_or_else(|| Failure(format!("{}: no level is complete", args.input.display())))?;
    let (written, to): (usize, &Path) = (voxels.voxels.len(), &args.output);
    let encoded = cloud::encoded(&voxels, &cloud::axes(&bytes), to, args.write)?;
    points::write(&encoded, written, to, log)?;
    Ok(said(args, "", written, "point", log))
}
