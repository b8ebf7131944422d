//! `b2p decode`: stream to Gaussians in a file.

use std::time::Duration;

use b2p::log::Log;
use b2p::tradeoff::Task;
use b2p::{Limits, output};

use super::args::Decode;
use super::progress::Progress;
use super::table::{count, steps};
use super::{Result, budget, pipe};

/// Decodes a stream into a PLY.
pub fn run(args: &Decode, limits: &Limits, progress: &Progress) -> Result<String> {
    let say = |step: &str| progress.say(step);
    let mut log = Log::with_listener(&say);
    let mut written = 0;
    let mut took = Duration::ZERO;
    let (input, to) = (&args.input, &args.output);
    let chosen = budget::choose(
        &args.budget,
        &args.model,
        input,
        Task::Decode,
        limits,
        progress,
    )?;
    let chosen_args = chosen.as_ref().map(|c| (c.detail(), c.model(&args.model)));
    let (detail, model) = match &chosen_args {
        Some((detail, model)) => (detail, model),
        None => (&args.detail, &args.model),
    };
    pipe::each(
        input,
        detail,
        model,
        limits,
        true,
        &mut log,
        &mut |gaussians, log| {
            written = gaussians.len();
            took = log.steps().iter().map(|step| step.time).sum();
            log.step("write PLY", written, "Gaussians", || {
                output::write_file(to, |w| gaussians.write_ply(w, to))
            })?;
            Ok(())
        },
    )?;
    let chosen = chosen.map_or(String::new(), |c| c.describe(Task::Decode, took));
    Ok(format!(
        "{chosen}{}\n{}: {} Gaussians\n",
        steps(log.steps()),
        to.display(),
        count(written as u64),
    ))
}
