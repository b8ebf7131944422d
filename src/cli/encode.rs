//! `b2p encode`: point cloud to stream.

use b2p::cloud::{PointCloud, voxelise, voxelise_closed};
use b2p::encoder::{self, Options, Residual};
use b2p::gaussians::Steps;
use b2p::log::Log;
use b2p::{Error, Limits, output};

use super::args::Encode;
use super::progress::Progress;
use super::table::{count, steps, table};
use super::{Failure, Result, load};

/// Codes a cloud and says what it cost.
pub fn run(args: &Encode, limits: &Limits, progress: &Progress) -> Result<String> {
    let say = |step: &str| progress.say(step);
    let mut log = Log::with_listener(&say);
    let in_cloud = Failure::in_file(&args.cloud);
    let cloud = log
        .step("read cloud", 1, "file", || {
            PointCloud::open(&args.cloud, limits)
        })
        .map_err(&in_cloud)?;
    let points = cloud.positions.len();
    let (cloud, finest) = log
        .step("voxelise", points, "points", || match args.bits {
            Some(bits) => Ok((voxelise(&cloud, Some(bits))?, bits)),
            None => voxelise_closed(&cloud),
        })
        .map_err(&in_cloud)?;
    let model = load::model(&args.model)?;
    let options = Options {
        levels: args.levels.clone(),
        bit_price: args.bit_price,
        filter: !args.no_filter,
        residual: args.residual,
        every_level: args.every_level,
        ..Options::default()
    };
    let coded = match args.bits_per_point {
        Some(bits) => encoder::encode_within(&cloud, &model, &options, bits, &mut log),
        None => {
            encoder::encode(&cloud, &model, &options, &mut log).map(|encoded| (encoded, options))
        }
    };
    let (encoded, chosen) = coded.map_err(&in_cloud)?;
    output::write_file(&args.output, |w| {
        w.write_all(&encoded.bytes).map_err(|source| Error::Io {
            path: args.output.clone(),
            source,
        })
    })?;

    let bpp = |bytes: usize| format!("{:.4}", bytes as f64 * 8.0 / cloud.voxels.len() as f64);
    let mut rows = vec![
        ["level", "voxels", "geometry bpp", "feature bpp"]
            .map(String::from)
            .to_vec(),
    ];
    for rate in &encoded.rates {
        rows.push(vec![
            rate.level.to_string(),
            count(rate.voxels as u64),
            bpp(rate.geometry_bytes),
            bpp(rate.feature_bytes),
        ]);
    }
    let depth = cloud.voxels.depth();
    let coarser = match depth < finest {
        true => format!(
            "The points lie too far apart for {finest} bits: surfaces would have holes. --bits {finest} codes them all the same.\n"
        ),
        false => String::new(),
    };
    Ok(format!(
        "{}\n{}\n{}: {} bytes for {} points at {depth} bits, {} bits per point{}\n{coarser}",
        steps(log.steps()),
        table(&rows),
        args.output.display(),
        count(encoded.bytes.len() as u64),
        count(cloud.voxels.len() as u64),
        bpp(encoded.bytes.len()),
        args.bits_per_point
            .map_or(String::new(), |most| within(most, &chosen)),
    ))
}

/// What was chosen to keep to so many bits.
fn within(most: f64, chosen: &Options) -> String {
    let (price, residual) = (chosen.bit_price, chosen.residual);
    let more = match residual {
        Residual::Fine(Steps { luma: 1, .. }) => ", the finest there is",
        Residual::None if chosen.filter || price > 2.0 => {
            "; a model for fewer bits (--model) may be better"
        }
        _ => "",
    };
    format!(" of at most {most}: bit price {price:.2}, {residual}{more}")
}
