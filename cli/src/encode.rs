//! `b2p encode`: point cloud to stream.

use b2p::cloud::ColouredVoxels;
use b2p::container;
use b2p::encoder::transform::{self, Fineness};
use b2p::encoder::{self, Encoded, Options, Residual};
use b2p::latents::Steps;
use b2p::log::Log;
use b2p::{Error, Limits, output};

use super::args::{Colours, Encode};
use super::cloud;
use super::progress::Progress;
use super::table::{count, steps, table};
use super::{Failure, Result, load};

/// Codes a cloud and says what it cost.
pub fn run(args: &Encode, limits: &Limits, progress: &Progress) -> Result<String> {
    let say = |step: &str| progress.say(step);
    let mut log = Log::with_listener(&say);
    let in_cloud = Failure::in_file(&args.cloud);
    let points = log
        .step("read cloud", 1, "file", || cloud::read(&args.cloud, &args.read, limits))
        .map_err(&in_cloud)?;
    let count_of_points = points.positions.len();
    let (cloud, report) = log
        .step("voxelise", count_of_points, "points", || {
            cloud::grid(&points, args.bits)
        })
        .map_err(&in_cloud)?;
    let axes = points.axes;
    drop((points.positions, points.colours));
    let voxels = cloud.voxels.len() as f64;
    let axes = match args.bits_per_point {
        Some(most) => cloud::affordable(axes, most * voxels / 8.0),
        None => axes,
    };
    // The rate counts the whole file.
    let reserved = container::axes_bytes(&axes) as f64 * 8.0 / voxels;
    let coded = match args.colours {
        Colours::Transform => transform(args, &cloud, reserved, &mut log)?,
        Colours::Learned => learned(args, &cloud, reserved, &mut log)?,
    };
    let Coded { mut encoded, chosen } = coded;
    encoded.bytes = container::with_axes(&encoded.bytes, &axes)?;
    output::write_file(&args.output, |w| {
        w.write_all(&encoded.bytes).map_err(|source| Error::Io {
            path: args.output.clone(),
            source,
        })
    })?;

    let bpp = |bytes: usize| format!("{:.4}", bytes as f64 * 8.0 / cloud.voxels.len() as f64);
    let mut rows = vec![
        ["level", "voxels", "geometry bpp", "colour bpp"]
            .map(String::from)
            .to_vec(),
    ];
    for rate in &encoded.rates {
        rows.push(vec![
            rate.level.to_string(),
            count(rate.voxels as u64),
            bpp(rate.geometry_bytes),
            bpp(rate.colour_bytes),
        ]);
    }
    let depth = cloud.voxels.depth();
    let grid = cloud::describe(&report);
    Ok(format!(
        "{}\n{}\n{grid}{}: {} bytes for {} points at {depth} bits, {} bits per point{}\n",
        steps(log.steps()),
        table(&rows),
        args.output.display(),
        count(encoded.bytes.len() as u64),
        count(cloud.voxels.len() as u64),
        bpp(encoded.bytes.len()),
        chosen,
    ))
}

/// A stream, and what was chosen about it in words.
struct Coded {
    encoded: Encoded,
    chosen: String,
}

/// Codes a stream of version 3, which keeps `reserved` bits per point free.
fn transform(args: &Encode, cloud: &ColouredVoxels, reserved: f64, log: &mut Log) -> Result<Coded> {
    let model = &args.model;
    let learned = &args.learned;
    let asked = [
        ("--model", model.model.is_some()),
        ("--precision", model.precision.is_some()),
        ("--bit-price", learned.bit_price != 1.0),
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
        ..transform::Options::default()
    };
    match args.step {
        Some(step) => options.fineness = step,
        None if args.lossless => options.fineness = Fineness::Lossless,
        None => {}
    }
    let in_cloud = Failure::in_file(&args.cloud);
    let (encoded, chosen) = match args.bits_per_point {
        Some(most) => {
            let (encoded, chosen) =
                transform::encode_within(cloud, &options, most - reserved, log).map_err(in_cloud)?;
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
fn learned(args: &Encode, cloud: &ColouredVoxels, reserved: f64, log: &mut Log) -> Result<Coded> {
    if args.step.is_some() || args.lossless {
        let what = "--step and --lossless are for --colours transform";
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
            let found = encoder::encode_within(cloud, &model, &options, most - reserved, log);
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
    format!(" of at most {most}: bit price {price:.2}, {residual}{more}")
}
