//! `b2p decode` of a scene, whole or a box of it.

use b2p::{Limits, SceneDecoder, Wanted};
use b2p_formats::splats::Axes;
use serde_json::json;

use super::super::args::Decode;
use super::super::manners::{self, Said};
use super::super::progress::Progress;
use super::super::table::{counted, steps, steps_json};
use super::super::{Failure, Result, cloud, convert, load, points};
use super::{Reader, complain};

/// Decodes a scene into a file of Gaussians or points. What could be decoded is written even if some blocks are
/// damaged.
pub fn run(args: &Decode, limits: &Limits, progress: &Progress) -> Result<Said> {
    if args.budget.is_given() {
        let what = "it is a scene, which is decoded without a budget: --level and --heads choose how";
        return Err(Failure(format!("{}: {what}", args.input.display())));
    }
    manners::permit(&[&args.output], &[&args.input])?;
    let scene = super::open(&args.input, limits)?;
    let decoder = load::decoder(&[], &args.detail, &args.model, limits)?;
    let decoder = SceneDecoder::new(decoder);
    let wanted = match args.wanted {
        Some([low, high]) => Wanted::Box(low, high),
        None => Wanted::All,
    };
    super::reserve(&args.input, &scene, &decoder, &wanted, limits)?;
    match args.points {
        true => voxels(args, &scene, &decoder, &wanted, progress),
        false => gaussians(args, &scene, &decoder, &wanted, progress),
    }
}

fn gaussians(
    args: &Decode,
    scene: &Reader,
    decoder: &SceneDecoder,
    wanted: &Wanted,
    progress: &Progress,
) -> Result<Said> {
    let (to, log) = (&args.output, progress.log());
    let format = convert::output_format(to, args.format)?;
    let decoded = log.step("decode scene", scene.blocks().len(), "blocks", || {
        decoder.gaussians(scene, wanted)
    });
    let decoded = decoded.map_err(Failure::in_file(&args.input))?;
    let known = scene.axes().unwrap_or_default();
    let axes = match cloud::up_of(args.up, &known) {
        _ if args.keep_axes => Axes::of(format),
        Some(up) => Axes::Cloud(up),
        None => Axes::Ply,
    };
    convert::write(&decoded.content, axes, &known, format, to, &log)?;
    complain(&args.input, &decoded.lost, decoded.blocks)?;
    Ok(said(args, decoded.blocks, decoded.content.len(), "Gaussian", &log))
}

fn voxels(args: &Decode, scene: &Reader, decoder: &SceneDecoder, wanted: &Wanted, progress: &Progress) -> Result<Said> {
    let (to, log) = (&args.output, progress.log());
    let decoded = log.step("decode scene", scene.blocks().len(), "blocks", || {
        decoder.points(scene, wanted)
    });
    let decoded = decoded.map_err(Failure::in_file(&args.input))?;
    let count = decoded.content.voxels.len();
    let encoded = cloud::encoded(&decoded.content, &scene.axes().unwrap_or_default(), to, args.write)?;
    points::write(&encoded, count, to, &log)?;
    complain(&args.input, &decoded.lost, decoded.blocks)?;
    Ok(said(args, decoded.blocks, count, "point", &log))
}

/// What was written.
fn said(args: &Decode, blocks: usize, written: usize, thing: &str, log: &b2p::Log) -> Said {
    let to = args.output.display();
    let report = format!(
        "{}\n{to}: {} of {}\n",
        steps(&log.steps()),
        counted(written as u64, thing),
        counted(blocks as u64, "block")
    );
    let json = || {
        json!({
            "output": to.to_string(),
            "count": written,
            "of": format!("{}s", thing.to_lowercase()),
            "blocks": blocks,
            "steps": steps_json(&log.steps()),
        })
    };
    Said::report(report, json).beside(&args.output)
}
