//! `b2p info`: what a stream holds.

use b2p::Limits;
use b2p::bitstream::Stream;
use b2p::gaussians::{Precision, Steps};
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
    let model = header.model().unwrap_or_default();
    let at_hand = load::from_file(args.model.as_deref())?;
    let known = header.check_model(&at_hand.id()).is_ok().then(|| {
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

    if args.json {
        let levels: Vec<_> = levels()
            .map(|(i, (level, (voxels, section)))| {
                json!({
                    "level": level,
                    "voxels": voxels,
                    "geometry_bytes": section.geometry,
                    "feature_bytes": section.colours,
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
            "feature bytes",
            "of them residual",
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
            residual(i).map_or("?".into(), |bytes| count(bytes as u64)),
            precision(i).map_or("-".into(), told),
            bpp(prefix),
        ]);
    }
    let mut text = format!(
        "{} points at {} bits, {} bytes, model {model}\n{}{}\n",
        count(header.points),
        header.bits,
        count(bytes.len() as u64),
        table(&rows),
        match (&known, &args.model) {
            (Some((name, heads)), _) => format!("model {name}, heads: {}", heads.join(", ")),
            (None, None) => "the model is not the one inside the program".into(),
            (None, Some(path)) => format!("the model is not {}", path.display()),
        },
    );
    if let Some(damage) = stream.damage() {
        text += &format!("damage: {damage}\n");
    }
    Ok(text)
}

/// The bands of a residual with their steps of luma and chroma.
fn told(precision: Precision) -> String {
    let bands = [("fine", precision.fine), ("coarse", precision.coarse)];
    let bands = bands.iter().filter(|(_, steps)| *steps != Steps::NONE);
    let told = bands.map(|(band, steps)| format!("{band} {},{}", steps.luma, steps.chroma));
    told.collect::<Vec<_>>().join(" ")
}
