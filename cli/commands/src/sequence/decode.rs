//! `b2p decode` of a sequence: one frame, or all.

use std::path::Path;

use b2p::gaussians::Gaussians;
use b2p::{Limits, Log, SequenceDecoder, SequenceReader};
use b2p_formats::splats::Axes;
use serde_json::json;

use super::super::args::Decode;
use super::super::manners::{self, Said};
use super::super::progress::Progress;
use super::super::table::counted;
use super::super::{Failure, Result, cloud, convert, load, points};
use super::Pattern;

/// Writes the frame that is asked for, or all frames to files of a pattern.
pub fn run(args: &Decode, limits: &Limits, progress: &Progress) -> Result<Said> {
    let sequence = super::read(&args.input, limits)?;
    let fail = Failure::in_file(&args.input);
    let decoder = load::decoder(&[], &args.detail, &args.model, limits)?;
    let mut decoder = SequenceDecoder::new(decoder);
    let log = progress.log();
    if let Some(frame) = args.sequence.frame(&sequence).transpose().map_err(&fail)? {
        manners::permit(&[&args.output], &[&args.input])?;
        write(args, &sequence, &mut decoder, frame, &args.output, &log)?;
        return Ok(said(args, 1, &format!("frame {frame}")));
    }
    let Some(pattern) = Pattern::of(&args.output) else {
        let what = "it is a sequence: --frame or --time chooses a frame, OUT with %04d takes all frames";
        return Err(Failure(format!("{}: {what}", args.input.display())));
    };
    let paths: Vec<_> = (0..sequence.frames()).map(|frame| pattern.path(frame)).collect();
    let outputs: Vec<&Path> = paths.iter().map(|path| path.as_path()).collect();
    manners::permit(&outputs, &[&args.input])?;
    let (mut written, mut lost) = (0, Vec::new());
    for (frame, path) in paths.iter().enumerate() {
        progress.say(&format!("frame {frame} of {}", paths.len()));
        match write(args, &sequence, &mut decoder, frame as u64, path, &Log::default()) {
            Ok(()) => written += 1,
            Err(failure) => {
                manners::warn(&failure.0);
                lost.push(frame);
            }
        }
    }
    match lost.len() {
        0 => Ok(said(args, written, &args.output.display().to_string())),
        n => Err(Failure(format!(
            "{}: {} cannot be decoded",
            args.input.display(),
            counted(n as u64, "frame")
        ))),
    }
}

fn said(args: &Decode, written: u64, what: &str) -> Said {
    let report = format!("{what}: {}\n", counted(written, "frame"));
    let json = || json!({ "output": args.output.display().to_string(), "frames": written });
    Said::report(report, json).beside(&args.output)
}

/// Writes a frame to a file.
fn write(
    args: &Decode,
    sequence: &SequenceReader,
    decoder: &mut SequenceDecoder,
    frame: u64,
    to: &Path,
    log: &Log,
) -> Result<()> {
    let decoded = decoder.frame(sequence, frame).map_err(Failure::in_file(&args.input))?;
    if args.points {
        let voxels = decoded.points().map(|points| points.to_voxels());
        let voxels = voxels.ok_or_else(|| Failure(format!("frame {frame} has no points")))?;
        let encoded = cloud::encoded(&voxels, &b2p::Axes::default(), to, args.write)?;
        return points::write(&encoded, voxels.voxels.len(), to, log);
    }
    let gaussians: Gaussians = decoded.gaussians()?;
    let format = convert::output_format(to, args.format)?;
    let known = sequence.axes()?;
    let axes = match cloud::up_of(args.up, &known) {
        _ if args.keep_axes => Axes::of(format),
        Some(up) => Axes::Cloud(up),
        None => Axes::Ply,
    };
    convert::write(&gaussians, axes, &known, format, to, log)
}
