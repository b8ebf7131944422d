//! `b2p info`: what a stream holds.

use b2p::container::Stream;
use b2p::latents::{Precision, Steps};
use b2p::{Limits, colour};
use serde_json::json;

use super::args::Info;
use super::table::{count, table};
use super::{Failure, Result, load};

/// Describes a stream as text or JSON. A cut or damaged stream is described with what is wrong; its model is described if it is the one at hand.
pub fn run(args: &Info, limits: &Limits) -> Result<String> {
    let bytes = load::bytes(&args.input)?;
    let stream = Stream::parse(&bytes, limits).map_err(Failure::in_file(&args.input))?;
    let header = stream.header();
    let whole = stream.levels().len();
    let model = header.model();
    let at_hand = match model {
        Some(_) => Some(load::from_file(args.model.as_deref())?),
        None => None,
    };
    let at_hand = at_hand.filter(|at_hand| header.check_model(&at_hand.id()).is_ok());
    let known = at_hand.map(|at_hand| {
        let shape = at_hand.shape();
        let heads: Vec<_> = shape.heads().iter().map(ToString::to_string).collect();
        (shape.name.clone(), heads)
    });
    let levels = || {
        (header.base..)
            .zip(header.voxels.iter().zip(&header.sections))
            .enumerate()
    };

    // Of a level that is not whole it is not known.
    let residual = |i: usize| {
        let level = stream.levels().get(i)?;
        let bytes = level.residual.iter().map(|slice| slice.bytes.len() + 16);
        Some(bytes.sum::<usize>())
    };

    let precision = |i: usize| {
        let level = stream.levels().get(i)?;
        Precision::read(level.residual.first()?.bytes)
    };

    // Luma's step of a level of version 3, in 255ths.
    let step = |i: usize| {
        let colours = stream.levels().get(i)?.colours.as_ref()?;
        let trunk = colours.trunk.map(|trunk| trunk.slice);
        let last = colours.levels.last().and_then(|level| level.slices.first());
        let &[luma, chroma, ..] = last.or(trunk.as_ref())?.bytes else {
            return None;
        };
        let steps = colour::Steps { luma, chroma };
        steps.is_valid().then_some(steps)
    };

    if args.json {
        let levels: Vec<_> = levels()
            .map(|(i, (level, (voxels, section)))| {
                json!({
                    "level": level,
                    "voxels": voxels,
                    "geometry_bytes": section.geometry,
                    "colour_bytes": section.colours,
                    "luma_step": step(i).map(|steps| steps.luma_step()),
                    "lossless": step(i).map(|steps| steps.is_lossless()),
                    "residual_bytes": residual(i),
                    "residual_steps": precision(i).map(|told| json!({
                        "fine": [told.fine.luma, told.fine.chroma],
                        "coarse": [told.coarse.luma, told.coarse.chroma],
                        "boundary": told.boundary,
                    })),
                    "whole": i < whole,
                })
            })
            .collect();
        let description = json!({
            "version": header.format.version(),
            "bits": header.bits,
            "points": header.points,
            "levels": levels,
            "total_bytes": bytes.len(),
            "model": model,
            "model_name": known.as_ref().map(|(name, _)| name),
            "heads": known.as_ref().map(|(_, heads)| heads),
            "origin": header.placement.origin,
            "voxel_size": header.placement.voxel_size,
            "damage": stream.damage().map(ToString::to_string),
        });
        return Ok(format!("{description:#}\n"));
    }

    let bpp = |bytes: u64| format!("{:.4}", bytes as f64 * 8.0 / header.points.max(1) as f64);
    let mut rows = vec![
        [
            "level",
            "voxels",
            "geometry bytes",
            "colour bytes",
            "step",
            "residual bytes",
            "its steps",
            "bits/point up to here",
        ]
        .map(String::from)
        .to_vec(),
    ];
    for (i, (level, (&voxels, section))) in levels() {
        let prefix = header.prefix_bytes(level)?;
        let missing = if i < whole { "" } else { " (not whole)" };
        rows.push(vec![
            format!("{level}{missing}"),
            count(voxels.into()),
            count(section.geometry.into()),
            count(section.colours.into()),
            step(i).map_or("-".into(), step_told),
            residual(i).map_or("?".into(), |bytes| count(bytes as u64)),
            precision(i).map_or("-".into(), told),
            bpp(prefix),
        ]);
    }
    let coded = match (&model, &known, &args.model) {
        (None, ..) => "transform coefficients, no model needed".into(),
        (Some(id), Some((name, heads)), _) => {
            format!("model {id}: {name}, heads: {}", heads.join(", "))
        }
        (Some(id), None, None) => format!("model {id}, which is not the one inside the program"),
        (Some(id), None, Some(path)) => format!("model {id}, which is not {}", path.display()),
    };
    let mut text = format!(
        "version {}, {} points at {} bits, {} bytes\n{coded}\n{}\n",
        header.format.version(),
        count(header.points),
        header.bits,
        count(bytes.len() as u64),
        table(&rows),
    );
    if let Some(damage) = stream.damage() {
        text += &format!("damage: {damage}\n");
    }
    Ok(text)
}

/// A step of luma in 255ths.
fn step_told(steps: colour::Steps) -> String {
    match steps.is_lossless() {
        true => "exact".into(),
        false => format!("{:.2}", steps.luma_step()),
    }
}

/// The bands of a residual with their steps of luma and chroma.
fn told(precision: Precision) -> String {
    let bands = [("fine", precision.fine), ("coarse", precision.coarse)];
    let bands = bands.iter().filter(|(_, steps)| *steps != Steps::NONE);
    let told = bands.map(|(band, steps)| format!("{band} {},{}", steps.luma, steps.chroma));
    told.collect::<Vec<_>>().join(" ")
}
