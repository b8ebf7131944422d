//! `b2p decode`: stream to Gaussians in a file.

use std::path::{Path, PathBuf};

use super::budget::{Chosen, Task};
use b2p::Limits;
use b2p::container::version;
use b2p::log::Log;
use b2p_formats::splats::{Axes, Format, PartWriter};
use serde_json::json;

use super::args::Decode;
use super::manners::{self, Said};
use super::many::Kind;
use super::pipe::Shown;
use super::progress::Progress;
use super::table::{counted, steps, steps_json};
use super::{Failure, Result, budget, cloud, convert, kinds, load, parts, pipe, points, scene, sequence};

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
    let mut write = |shown: Shown<'_>, known: &b2p::Axes, log: &Log| {
        let axes = match cloud::up_of(args.up, known) {
            _ if args.keep_axes => Axes::of(format),
            Some(up) => Axes::Cloud(up),
            None => Axes::Ply,
        };
        written = write_shown(shown, (axes, known), (input, to), format, log)?;
        Ok(())
    };
    let stream = budget::stream(&args.budget, input, &args.detail, limits)?;
    let chosen = match &stream {
        Some(stream) => budget::choose(&args.budget(limits, progress), input, stream, None, Task::Decode)?,
        None => None,
    };
    let detail = chosen.as_ref().map(Chosen::detail);
    let detail = detail.as_ref().unwrap_or(&args.detail);
    // What has gone to standard output cannot be replaced by something finer.
    let early = !manners::is_pipe(to);
    let in_parts = PartWriter::new(Axes::of(format), format).is_some();
    pipe::each(input, detail, &args.model, limits, (early, in_parts), &log, &mut write)?;
    // Writing is the last step.
    let took = log.steps().iter().rev().skip(1).map(|step| step.time).sum();
    let chosen = match chosen {
        Some(chosen) => chosen.describe(took, limits, progress)?,
        None => String::new(),
    };
    Ok(said(args, &chosen, written, "Gaussian", &log))
}

/// Writes Gaussians of `input`, part by part if there is a level to make them of and the format allows it; says how many
/// they are.
fn write_shown(
    shown: Shown<'_>,
    (axes, known): (Axes, &b2p::Axes),
    (input, to): (&Path, &Path),
    format: Format,
    log: &Log,
) -> Result<usize> {
    let mut written = 0;
    if let Shown::Level(level) = shown
        && let (true, Some(frame)) = (level.has_parts(), level.frame())
        && let Some(writer) = PartWriter::new(axes, format)
    {
        convert::write_with(frame, axes, known, format, to, || {
            let (count, warnings) = parts::write(level, input, writer, to, (format!("write {format}"), log))?;
            written = count;
            Ok(warnings)
        })?;
        return Ok(written);
    }
    shown.all_at_once(input, |gaussians| {
        written = gaussians.len();
        convert::write(gaussians, axes, known, format, to, log)
    })?;
    Ok(written)
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
