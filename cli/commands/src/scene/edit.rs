//! `b2p cut --level` of a scene.

use b2p::{Error, Limits};
use serde_json::json;

use super::super::args::Cut;
use super::super::manners::{self, Said};
use super::super::table::{count, counted};
use super::super::{Failure, Result};

/// Writes a scene whose blocks are cut after a level.
pub fn cut(args: &Cut, limits: &Limits) -> Result<Said> {
    let Some(level) = args.level else {
        let what = "it is a scene: --level M cuts it";
        return Err(Failure(format!("{}: {what}", args.input.display())));
    };
    manners::permit(&[&args.output], &[&args.input])?;
    let scene = super::open(&args.input, limits)?;
    let bytes = scene.cut(level).map_err(Failure::in_file(&args.input))?;
    let to = &args.output;
    manners::write(to, |w| {
        w.write_all(&bytes).map_err(|source| Error::Io {
            path: to.to_path_buf(),
            source,
        })
    })?;
    let top = scene.header().top;
    let report = format!(
        "{}: {} of {}, level {level} of {top}\n",
        to.display(),
        count(bytes.len() as u64),
        counted(scene.bytes(), "byte"),
    );
    let json = || {
        json!({
            "output": to.display().to_string(),
            "bytes": bytes.len(),
            "bytes_before": scene.bytes(),
            "level": level,
            "top": top,
        })
    };
    Ok(Said::report(report, json).beside(to))
}
