//! `b2p decode`: stream to Gaussians in a file.

use std::time::{Duration, Instant};

use super::budget::Task;
use b2p::container::version;
use b2p::{Limits, output};

use super::args::Decode;
use super::progress::Progress;
use super::table::{count, steps};
use super::{Failure, Result, budget, keep, load, pipe};

/// Decodes a stream into a PLY.
pub fn run(args: &Decode, limits: &Limits, progress: &Progress) -> Result<String> {
    if args.points {
        return points(args, limits, progress);
    }
    let log = progress.log();
    let mut written = 0;
    let mut took = Duration::ZERO;
    let (input, to) = (&args.input, &args.output);
    if let Some(bytes) = keep::stream(&args.budget, input)? {
        let (budget, start) = (&args.budget, Instant::now());
        let kept = keep::decode(budget, input, &bytes, &args.model, limits, &log)?;
        let told = kept.describe(start.elapsed());
        let gaussians = kept.gaussians;
        log.step("write PLY", gaussians.len(), "Gaussians", || {
            output::write_file(to, |w| gaussians.write_ply(w, to))
        })?;
        let count = count(gaussians.len() as u64);
        let steps = steps(&log.steps());
        return Ok(format!("{told}{steps}\n{}: {count} Gaussians\n", to.display()));
    }
    let chosen = budget::choose(&args.budget, &args.model, input, Task::Decode, limits, progress)?;
    let chosen_args = chosen.as_ref().map(|c| (c.detail(), c.model(&args.model)));
    let (detail, model) = match &chosen_args {
        Some((detail, model)) => (detail, model),
        None => (&args.detail, &args.model),
    };
    pipe::each(input, detail, model, limits, true, &log, &mut |gaussians, log| {
        written = gaussians.len();
        took = log.steps().iter().map(|step| step.time).sum();
        log.step("write PLY", written, "Gaussians", || {
            output::write_file(to, |w| gaussians.write_ply(w, to))
        })?;
        Ok(())
    })?;
    let chosen = chosen.map_or(String::new(), |c| c.describe(Task::Decode, took));
    Ok(format!(
        "{chosen}{}\n{}: {} Gaussians\n",
        steps(&log.steps()),
        to.display(),
        count(written as u64),
    ))
}

/// Decodes a stream into a PLY of points.
fn points(args: &Decode, limits: &Limits, progress: &Progress) -> Result<String> {
    let log = progress.log();
    let bytes = load::bytes(&args.input)?;
    let fail = Failure::in_file(&args.input);
    if version(&bytes) == Some(2) {
        let what = "a stream of version 2 holds no colours of voxels, but Gaussians";
        return Err(Failure(format!("{}: {what}", args.input.display())));
    }
    let decoder = load::decoder(&bytes, &args.detail, &args.model, limits)?.with_log(&log);
    let decoding = decoder.whole(&bytes);
    let decoding = decoding.map_err(&fail)?;
    let cloud = decoding.points().map(|points| points.to_cloud()).unwrap_or_default();
    let (written, to) = (cloud.positions.len(), &args.output);
    log.step("write PLY", written, "points", || cloud.write(to))?;
    Ok(format!(
        "{}\n{}: {} points\n",
        steps(&log.steps()),
        to.display(),
        count(written as u64),
    ))
}
