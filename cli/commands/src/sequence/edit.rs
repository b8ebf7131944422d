//! `b2p cut --frames` and `b2p join`.

use std::path::{Path, PathBuf};

use b2p::{Error, Limits, SequenceReader};
use serde_json::json;

use super::super::args::{Cut, Join};
use super::super::manners::{self, Said};
use super::super::table::counted;
use super::super::{Failure, Result};

/// Writes the groups of some frames.
pub fn cut(args: &Cut, limits: &Limits) -> Result<Said> {
    manners::permit(&[&args.output], &[&args.input])?;
    let sequence = super::read(&args.input, limits)?;
    let Some(frames) = &args.frames else {
        let what = "it is a sequence, which --frames A..B cuts";
        return Err(Failure(format!("{}: {what}", args.input.display())));
    };
    let bytes = sequence.cut(frames.clone()).map_err(Failure::in_file(&args.input))?;
    write(&args.output, &bytes, limits)
}

/// Writes the frames of several sequences, one after the other.
pub fn join(args: &Join, limits: &Limits) -> Result<Said> {
    let inputs: Vec<&Path> = args.inputs.iter().map(PathBuf::as_path).collect();
    manners::permit(&[&args.output], &inputs)?;
    let sequences = args.inputs.iter().map(|path| super::read(path, limits));
    let sequences = sequences.collect::<Result<Vec<_>>>()?;
    write(&args.output, &b2p::sequence::join(&sequences)?, limits)
}

fn write(to: &Path, bytes: &[u8], limits: &Limits) -> Result<Said> {
    let sequence = SequenceReader::new(bytes, limits)?;
    let (frames, groups) = (sequence.frames(), sequence.groups());
    manners::write(to, |w| {
        w.write_all(bytes).map_err(|source| Error::Io {
            path: to.to_path_buf(),
            source,
        })
    })?;
    let report = format!(
        "{}: {} in {}, {}\n",
        to.display(),
        counted(frames, "frame"),
        counted(groups as u64, "group"),
        counted(bytes.len() as u64, "byte")
    );
    let json =
        || json!({ "output": to.display().to_string(), "frames": frames, "groups": groups, "bytes": bytes.len() });
    Ok(Said::report(report, json).beside(to))
}
