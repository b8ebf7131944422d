//! `b2p upgrade`: a stream of version 2 as one of version 3.

use b2p::cloud::ColouredVoxels;
use b2p::container::{Format, Header, with_axes};
use b2p::encoder::transform::{self, Options, QualityTarget, Tune};
use b2p::gaussians::HeadSet;
use b2p::metrics::psnr;
use b2p::{Decoder, Decoding, Error, Gaussians, Limits, Placement};
use serde_json::json;

use super::args::Upgrade;
use super::manners::{self, Said};
use super::progress::Progress;
use super::table::{count, counted};
use super::{Failure, Result, cloud, kinds, load};

/// Carries geometry over as it is, codes the colours that voxels are drawn in, and says what changes.
pub fn run(args: &Upgrade, limits: &Limits, progress: &Progress) -> Result<Said> {
    manners::permit(&[&args.output], &[&args.input])?;
    let bytes = load::bytes(&args.input, limits)?;
    kinds::check_stream(&args.input, &bytes)?;
    let fail = Failure::in_file(&args.input);
    let header = Header::parse(&bytes, limits).map_err(&fail)?;
    if let Format::Transform { .. } = header.format {
        return Err(Failure(format!("{}: it has version 3 already", args.input.display())));
    }
    let log = progress.log();
    let model = load::model(&args.model)?;
    let decoder = Decoder::new()
        .with_model(model)
        .with_limits(limits.clone())
        .with_log(&log);
    let decoding = decoder.whole(&bytes).map_err(&fail)?;
    let gaussians = decoding.gaussians().map_err(&fail)?;
    let old = level_of(&decoding, &gaussians, &header)?;
    let options = Options {
        levels: Some(header.base..=old.voxels.depth()),
        fineness: match args.lossless {
            true => QualityTarget::Lossless,
            false => args.step.unwrap_or(QualityTarget::Step(20.0)),
        },
        tune: Tune::Psnr,
        ..Options::default()
    };
    let coded = transform::encode(&old, &options, &log)?.bytes;
    let coded = of_finer_cloud(&coded, &header)?;
    let new = with_axes(&coded, &cloud::axes(&bytes))?;
    let error = difference(&old, &new, limits)?;
    let to = &args.output;
    manners::write(to, |w| {
        w.write_all(&new).map_err(|source| Error::Io {
            path: to.to_path_buf(),
            source,
        })
    })?;
    Ok(said(args, &header, &old, [bytes.len(), new.len()], error).beside(to))
}

/// The voxels of the level reached, each with the mean colour of its Gaussians, weighted by opacity.
fn level_of(decoding: &Decoding, gaussians: &Gaussians, header: &Header) -> Result<ColouredVoxels> {
    let voxels = decoding
        .voxels()
        .ok_or_else(|| Failure("no level is complete".into()))?;
    let each = gaussians.len() / voxels.len().max(1);
    let colours = gaussians
        .colour
        .chunks(each.max(1))
        .zip(gaussians.opacity.chunks(each.max(1)));
    let colours = colours.map(|(colours, opacities)| {
        let weight: f32 = opacities.iter().sum();
        [0, 1, 2].map(|c| {
            let sum: f32 = colours
                .iter()
                .zip(opacities)
                .map(|(colour, weight)| colour[c] * weight)
                .sum();
            (sum / weight.max(f32::MIN_POSITIVE) * 255.0).round() as u8
        })
    });
    let placement = header.placement;
    let coarser = f64::from(1u32 << (header.bits - voxels.depth()));
    Ok(ColouredVoxels {
        voxels: voxels.clone(),
        colours: colours.collect(),
        placement: Placement {
            voxel_size: placement.voxel_size * coarser,
            ..placement
        },
    })
}

/// The stream with the bit depth, points and placement of the cloud that the other stream was made from.
fn of_finer_cloud(stream: &[u8], of: &Header) -> Result<Vec<u8>> {
    let mut header = Header::parse(stream, &Limits::unlimited())?;
    let start = header.bytes();
    header.bits = of.bits;
    header.points = of.points;
    header.placement = of.placement;
    Ok([&header.write(), &stream[start..]].concat())
}

/// Mean square error of the new stream's colours against those that it was made from, in 255ths. Geometry must be the
/// same.
fn difference(old: &ColouredVoxels, new: &[u8], limits: &Limits) -> Result<f64> {
    let decoder = Decoder::new().with_heads(HeadSet::Surfels).with_limits(limits.clone());
    let decoding = decoder.whole(new)?;
    let points = decoding.points();
    let points = points.filter(|points| *points.voxels == old.voxels);
    let points = points.ok_or_else(|| Failure("the new stream has another geometry: this is a fault of b2p".into()))?;
    let pairs = old.colours.as_flattened().iter().zip(points.colours.as_flattened());
    let squares: f64 = pairs.map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    Ok(squares / (3 * old.colours.len()).max(1) as f64)
}

/// What was written, and what differs from the input.
fn said(args: &Upgrade, header: &Header, old: &ColouredVoxels, bytes: [usize; 2], error: f64) -> Said {
    let level = old.voxels.depth();
    let same = error == 0.0;
    let psnr = psnr(error / (255.0 * 255.0));
    let colours = match same {
        true => "the colours that voxels are drawn in are exact to 8 bits".into(),
        false => format!("the colours that voxels are drawn in are coded again, PSNR {psnr:.1} dB"),
    };
    let missing = match level < header.top {
        true => format!("level {} is left out: the model does not draw it\n", header.top),
        false => String::new(),
    };
    let report = format!(
        "{}: version 3, {} instead of {}\n\
         geometry of the levels {} to {level} is exact\n{colours}\n{missing}\
         shapes of Gaussians are not kept: surfels or heads of version 3 draw the stream\n",
        args.output.display(),
        count(bytes[1] as u64),
        counted(bytes[0] as u64, "byte"),
        header.base,
    );
    Said::report(report, || {
        json!({
            "output": args.output.display().to_string(),
            "bytes": bytes[1],
            "bytes_before": bytes[0],
            "levels": [header.base, level],
            "level_left_out": (level < header.top).then_some(header.top),
            "geometry_exact": true,
            "colours_exact": same,
            "colour_psnr": (!same).then_some(psnr),
        })
    })
}
