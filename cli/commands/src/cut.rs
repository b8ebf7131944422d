//! `b2p cut`: a stream cut after a level.

use b2p::container::Stream;
use b2p::{Error, Limits};
use serde_json::json;

use super::args::Cut;
use super::manners::{self, Said};
use super::table::{count, counted};
use super::{Failure, Result, kinds, load, scene, sequence};

/// Writes the stream up to the end of a level, once it is known to be complete.
pub fn run(args: &Cut, limits: &Limits) -> Result<Said> {
    if sequence::is_sequence(&args.input) {
        return sequence::cut(args, limits);
    }
    if scene::is_scene(&args.input) {
        return scene::cut(args, limits);
    }
    let Some(level) = args.level else {
        let what = "it is no sequence: --level M cuts it";
        return Err(Failure(format!("{}: {what}", args.input.display())));
    };
    manners::permit(&[&args.output], &[&args.input])?;
    let bytes = load::bytes(&args.input, limits)?;
    kinds::check_stream(&args.input, &bytes)?;
    let fail = Failure::in_file(&args.input);
    let stream = Stream::parse(&bytes, limits).map_err(&fail)?;
    let stream = stream.require(level).map_err(&fail)?;
    let header = stream.header();
    let end = header.prefix_bytes(level).map_err(&fail)?;
    let kept = usize::try_from(end).ok().and_then(|end| bytes.get(..end));
    let kept = kept.ok_or_else(|| Failure(format!("{}: it ends before level {level}", args.input.display())))?;
    let to = &args.output;
    manners::write(to, |w| {
        w.write_all(kept).map_err(|source| Error::Io {
            path: to.to_path_buf(),
            source,
        })
    })?;
    let top = header.top;
    let bits = kept.len() as f64 * 8.0 / header.points.max(1) as f64;
    let report = format!(
        "{}: {} of {}, level {level} of {top}, {bits:.4} bits per point\n",
        to.display(),
        count(kept.len() as u64),
        counted(bytes.len() as u64, "byte"),
    );
    let said = Said::report(report, || {
        json!({
            "output": to.display().to_string(),
            "bytes": kept.len(),
            "bytes_before": bytes.len(),
            "level": level,
            "top": top,
            "bits_per_point": bits,
        })
    });
    Ok(said.beside(to))
}
