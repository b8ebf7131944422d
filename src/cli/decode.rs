//! `b2p decode`: stream to Gaussians in a file.

use b2p::decoder::Decoder;
use b2p::log::Log;
use b2p::output;

use super::args::Decode;
use super::progress::Progress;
use super::table::{count, steps};
use super::{Failure, Result, load};

/// Decodes a stream into a PLY.
pub fn run(args: &Decode, progress: &Progress) -> Result<String> {
    let say = |step: &str| progress.say(step);
    let mut log = Log::with_listener(&say);
    let bytes = load::bytes(&args.input)?;
    let model = load::model(&args.model)?;
    let gaussians = Decoder::new(&model)
        .decode(&bytes, args.level.level, &mut log)
        .map_err(Failure::in_file(&args.input))?;
    log.step("write PLY", gaussians.len(), "Gaussians", || {
        output::write_file(&args.output, |w| gaussians.write_ply(w, &args.output))
    })?;
    Ok(format!(
        "{}\n{}: {} Gaussians\n",
        steps(log.steps()),
        args.output.display(),
        count(gaussians.len() as u64),
    ))
}
