//! `b2p decode`: stream to Gaussians in a file.

use std::path::Path;
use std::time::{Duration, Instant};

use super::budget::Task;
use b2p::container::version;
use b2p::log::Log;
use b2p::{Error, Limits, output};

use super::args::Decode;
use super::progress::Progress;
use super::table::{count, steps};
use super::{Failure, Result, budget, cloud, keep, load, pipe};

/// Decodes a stream into a PLY.
pub fn run(args: &Decode, limits: &Limits, progress: &Progress) -> Result<String> {
    cloud::refuse(&args.input)?;
    if args.points {
        return points(args, limits, progress);
    }
    let say = |step: &str| progress.say(step);
    let mut log = Log::with_listener(&say);
    let mut written = 0;
    let mut took = Duration::ZERO;
    let (input, to) = (&args.input, &args.output);
    if let Some(bytes) = keep::stream(&args.budget, input)? {
        let (budget, start) = (&args.budget, Instant::now());
        let kept = keep::decode(budget, input, &bytes, &args.model, limits, &mut log)?;
        let told = kept.describe(start.elapsed());
        let gaussians = kept.gaussians;
        log.step("write PLY", gaussians.len(), "Gaussians", || {
            output::write_file(to, |w| gaussians.write_ply(w, to))
        })?;
        let count = count(gaussians.len() as u64);
        let steps = steps(log.steps());
        return Ok(format!("{told}{steps}\n{}: {count} Gaussians\n", to.display()));
    }
    let chosen = budget::choose(&args.budget, &args.model, input, Task::Decode, limits, progress)?;
    let chosen_args = chosen.as_ref().map(|c| (c.detail(), c.model(&args.model)));
    let (detail, model) = match &chosen_args {
        Some((detail, model)) => (detail, model),
        None => (&args.detail, &args.model),
    };
    pipe::each(input, detail, model, limits, true, &mut log, &mut |gaussians, log| {
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
        steps(log.steps()),
        to.display(),
        count(written as u64),
    ))
}

/// Decodes a stream into a file of points.
fn points(args: &Decode, limits: &Limits, progress: &Progress) -> Result<String> {
    let say = |step: &str| progress.say(step);
    let mut log = Log::with_listener(&say);
    let bytes = load::bytes(&args.input)?;
    let fail = Failure::in_file(&args.input);
    if version(&bytes) == Some(2) {
        let what = "a stream of version 2 holds no colours of voxels, but Gaussians";
        return Err(Failure(format!("{}: {what}", args.input.display())));
    }
    let decoder = load::decoder(&bytes, &args.detail, &args.model, limits)?;
    let decoding = decoder.whole(&bytes, args.detail.level, &mut log);
    let decoding = decoding.map_err(&fail)?;
    let voxels = decoding.points().map(|points| points.to_voxels());
    let voxels = voxels.ok_or_else(|| Failure(format!("{}: no level is whole", args.input.display())))?;
    let (written, to) = (voxels.voxels.len(), &args.output);
    let encoded = cloud::encoded(&voxels, &cloud::axes(&bytes), to, args.write)?;
    let write = |path: &Path, bytes: &[u8]| {
        output::write_file(path, |w| {
            w.write_all(bytes).map_err(|source| Error::Io {
                path: path.to_owned(),
                source,
            })
        })
    };
    log.step("write points", written, "points", || write(to, &encoded.bytes))?;
    if let Some(text) = &encoded.sidecar {
        let mut path = to.clone().into_os_string();
        path.push(".json");
        write(path.as_ref(), text.as_bytes())?;
    }
    Ok(format!(
        "{}\n{}: {} points\n",
        steps(log.steps()),
        to.display(),
        count(written as u64),
    ))
}
