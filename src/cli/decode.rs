//! `b2p decode`: stream to Gaussians in a file.

use b2p::log::Log;
use b2p::{Limits, output};

use super::args::Decode;
use super::progress::Progress;
use super::table::{count, steps};
use super::{Result, pipe};

/// Decodes a stream into a PLY.
pub fn run(args: &Decode, limits: &Limits, progress: &Progress) -> Result<String> {
    let say = |step: &str| progress.say(step);
    let mut log = Log::with_listener(&say);
    let mut written = 0;
    let Decode {
        input,
        output: to,
        level,
        model,
    } = args;
    pipe::each(
        input,
        level,
        model,
        limits,
        true,
        &mut log,
        &mut |gaussians, log| {
            written = gaussians.len();
            log.step("write PLY", written, "Gaussians", || {
                output::write_file(to, |w| gaussians.write_ply(w, to))
            })?;
            Ok(())
        },
    )?;
    Ok(format!(
        "{}\n{}: {} Gaussians\n",
        steps(log.steps()),
        to.display(),
        count(written as u64),
    ))
}
