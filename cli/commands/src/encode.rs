//! `b2p encode`: point cloud to stream.

use std::path::{Path, PathBuf};

use b2p::axes::Axes;
use b2p::cloud::{ColouredVoxels, GridReport};
use b2p::container;
use b2p::encoder::transform::{self, GeometryTarget, QualityTarget};
use b2p::encoder::{self, Encoded, Options, Rate, Residual};
use b2p::latents::Steps;
use b2p::log::Log;
use b2p::{Error, Limits};
use serde_json::json;

use super::args::{Colours, Encode};
use super::manners::{self, Said};
use super::many::Kind;
use super::progress::Progress;
use super::table::{count, counted, steps, steps_json, table};
use super::{Failure, Result, cloud, decodable, load, scene, sequence};

/// What is taken from folders, and what becomes of it.
pub const KIND: Kind<'_> = Kind {
    command: "encode",
    takes: &[
        "ply", "las", "laz", "pcd", "e57", "xyz", "csv", "txt", "obj", "gltf", "glb",
    ],
    ending: "b2p",
    instead: None,
    gathers: true,
};

/// Codes a cloud and says what it cost.
pub fn run(args: &Encode, limits: &Limits, progress: &Progress) -> Result<Said> {
    if !args.clouds.is_empty() || sequence::names_many(&args.cloud) {
        return sequence::encode(args, limits, progress);
    }
    if let Some(name) = args.sequence.given() {
        let what = "is for sequences: a folder of clouds, or a name such as frame_%04d.ply";
        return Err(Failure(format!("{name} {what}")));
    }
    if let Some(pieces) = scene::pieces(args, limits)? {
        let options = |bits| transform_options(args, bits);
        return scene::encode_pieces(args, pieces, options, limits, progress);
    }
    let model = args.model.model.iter().map(PathBuf::as_path);
    let inputs: Vec<&Path> = model.chain([args.cloud.as_path()]).collect();
    manners::permit(&[&args.output], &inputs)?;
    let log = progress.log();
    let in_cloud = Failure::in_file(&args.cloud);
    let cloud = log
        .step("read cloud", 1, "file", || {
            Ok(cloud::read(&args.cloud, &args.read, limits))
        })
        .map_err(&in_cloud)??;
    let points = cloud.positions.len();
    let (grid, found) = log
        .step("voxelise", points, "points", || cloud::grid(&cloud, args.bits, limits))
        .map_err(&in_cloud)?;
    let axes = cloud.axes;
    drop((cloud.positions, cloud.colours));
    if scene::is_wanted(args, grid.voxels.len()) {
        let options = transform_options(args, grid.voxels.depth())?;
        return scene::encode(args, (&grid, &found), axes, options, limits, progress);
    }
    let coded = one_stream(args, &grid, axes, points, limits, &log)?;
    let (bytes, to) = (&coded.encoded.bytes, &args.output);
    manners::write(to, |w| {
        w.write_all(bytes).map_err(|source| Error::Io {
            path: to.to_path_buf(),
            source,
        })
    })?;
    decodable::warn(to, bytes, args.colours, &args.model, limits)?;
    Ok(report(args, &grid, &found, points, &coded, &log).beside(to))
}

/// Codes the voxels of a cloud of so many points as one stream.
fn one_stream(
    args: &Encode,
    cloud: &ColouredVoxels,
    axes: Axes,
    points: usize,
    limits: &Limits,
    log: &Log,
) -> Result<Coded> {
    let voxels = cloud.voxels.len();
    let axes = match args.bits_per_point {
        Some(most) => cloud::affordable(axes, most * voxels as f64 / 8.0),
        None => axes,
    };
    if args.colours == Colours::Transform {
        let options = transform_options(args, cloud.voxels.depth())?;
        let memory = transform::encode_memory(&cloud.voxels, &options, args.bits_per_point.is_some());
        let checked = limits.check_bytes("bytes that encoding the voxels takes", memory);
        checked.map_err(Failure::in_file(&args.cloud))?;
    }
    let merged = (points > voxels).then_some(points as u64);
    // The rate counts the whole file.
    let reserved = container::source_bytes(&axes, merged) as f64 * 8.0 / voxels as f64;
    let mut coded = match args.colours {
        Colours::Transform => transform(args, cloud, reserved, log)?,
        Colours::Learned => learned(args, cloud, reserved, log)?,
    };
    coded.encoded.bytes = container::with_source(&coded.encoded.bytes, &axes, merged)?;
    Ok(coded)
}

/// What a stream of the voxels of a cloud of so many points cost.
fn report(
    args: &Encode,
    cloud: &ColouredVoxels,
    found: &GridReport,
    points: usize,
    Coded { encoded, chosen }: &Coded,
    log: &Log,
) -> Said {
    let (voxels, depth) = (cloud.voxels.len(), cloud.voxels.depth());
    let json = || {
        let level = |rate: &Rate| {
            json!({
                "level": rate.level,
                "voxels": rate.voxels,
                "geometry_bytes": rate.geometry_bytes,
                "colour_bytes": rate.colour_bytes,
            })
        };
        json!({
            "output": args.output.display().to_string(),
            "bytes": encoded.bytes.len(),
            "points": points,
            "voxels": voxels,
            "bits": depth,
            "bits_per_point": encoded.bytes.len() as f64 * 8.0 / voxels as f64,
            "levels": encoded.rates.iter().map(level).collect::<Vec<_>>(),
            "steps": steps_json(&log.steps()),
        })
    };
    let bpp = |bytes: usize| format!("{:.4}", bytes as f64 * 8.0 / voxels as f64);
    let heading = ["level", "voxels", "geometry bpp", "colour bpp"];
    let mut rows = vec![heading.map(String::from).to_vec()];
    for rate in &encoded.rates {
        rows.push(vec![
            rate.level.to_string(),
            count(rate.voxels as u64),
            bpp(rate.geometry_bytes),
            bpp(rate.colour_bytes),
        ]);
    }
    let text = format!(
        "{}\n{}\n{}{}: {} for {} at {}, {} bits per point{}\n",
        steps(&log.steps()),
        table(&rows),
        cloud::describe(found),
        args.output.display(),
        counted(encoded.bytes.len() as u64, "byte"),
        counted(voxels as u64, "point"),
        counted(depth.into(), "bit"),
        bpp(encoded.bytes.len()),
        chosen,
    );
    Said::report(text, json)
}

/// A stream, and what was chosen about it in words.
struct Coded {
    encoded: Encoded,
    chosen: String,
}

/// How streams of version 3 are coded, of clouds of so many bits.
fn transform_options(args: &Encode, bits: u8) -> Result<transform::Options> {
    let model = &args.model;
    let learned = &args.learned;
    let asked = [
        ("--model", model.model.is_some()),
        ("--precision", model.precision.is_some()),
        ("--lambda-scale", learned.bit_price != 1.0),
        ("--residual", learned.residual != Residual::Coarse),
        ("--every-level", learned.every_level),
    ];
    if let Some((name, _)) = asked.iter().find(|(_, asked)| *asked) {
        return Err(Failure(format!("{name} is for --colours learned")));
    }
    let mut options = transform::Options {
        levels: args.levels.clone(),
        filter: !args.no_filter,
        isa: Some(load::isa(model.isa.as_deref())?),
        heads: Some(load::heads(None)?),
        head_maps: !args.no_head_maps,
        outline: args.outline.unwrap_or_default(),
        ..transform::Options::default()
    };
    if let Some(quality) = args.quality {
        options.set_quality(quality, bits);
    }
    if let Some(effort) = args.effort {
        options.set_effort(effort);
    }
    if let Some(tune) = args.tune {
        options.tune = tune;
    }
    options.geometry = args.geometry.unwrap_or(GeometryTarget::Visual);
    match args.step {
        Some(step) => options.fineness = step,
        None if args.lossless => options.fineness = QualityTarget::Lossless,
        None => {}
    }
    Ok(options)
}

/// Codes a stream of version 3, which keeps `reserved` bits per point free.
fn transform(args: &Encode, cloud: &ColouredVoxels, reserved: f64, log: &Log) -> Result<Coded> {
    let options = transform_options(args, cloud.voxels.depth())?;
    let in_cloud = Failure::in_file(&args.cloud);
    let (encoded, chosen) = match args.bits_per_point {
        Some(most) => {
            let (encoded, chosen) =
                transform::encode_to_rate(cloud, &options, most - reserved, log).map_err(in_cloud)?;
            let level = chosen.levels.map_or(0, |levels| *levels.end());
            let how = chosen.fineness;
            (encoded, format!(" of at most {most}: level {level}, {how}"))
        }
        None => {
            let encoded = transform::encode(cloud, &options, log).map_err(in_cloud)?;
            (encoded, String::new())
        }
    };
    Ok(Coded { encoded, chosen })
}

/// Codes a stream of version 2, which keeps `reserved` bits per point free.
fn learned(args: &Encode, cloud: &ColouredVoxels, reserved: f64, log: &Log) -> Result<Coded> {
    if args.step.is_some() || args.lossless {
        let what = "--step and --lossless are for --colours transform";
        return Err(Failure(what.into()));
    }
    if args.quality.is_some() || args.effort.is_some() || args.tune.is_some() || args.outline.is_some() {
        let what = "--quality, --effort, --tune and --outline are for --colours transform";
        return Err(Failure(what.into()));
    }
    let model = load::model(&args.model)?;
    let options = Options {
        levels: args.levels.clone(),
        bit_price: args.learned.bit_price,
        filter: !args.no_filter,
        residual: args.learned.residual,
        every_level: args.learned.every_level,
        ..Options::default()
    };
    let in_cloud = Failure::in_file(&args.cloud);
    let (encoded, chosen) = match args.bits_per_point {
        Some(most) => {
            let found = encoder::encode_to_rate(cloud, &model, &options, most - reserved, log);
            let (encoded, chosen) = found.map_err(in_cloud)?;
            (encoded, within(most, &chosen))
        }
        None => {
            let encoded = encoder::encode(cloud, &model, &options, log).map_err(in_cloud)?;
            (encoded, String::new())
        }
    };
    Ok(Coded { encoded, chosen })
}

/// What was chosen of a learned stream to keep to so many bits.
fn within(most: f64, chosen: &Options) -> String {
    let (price, residual) = (chosen.bit_price, chosen.residual);
    let more = match residual {
        Residual::Fine(Steps { luma: 1, .. }) => ", the finest there is",
        Residual::None if chosen.filter || price > 2.0 => "; a model for fewer bits (--model) may be better",
        _ => "",
    };
    format!(" of at most {most}: λ scale {price:.2}, {residual}{more}")
}
