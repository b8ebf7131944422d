//! `b2p convert`: a file of Gaussians or of points to another format; and what other commands read and write of splats.

use std::path::Path;

use b2p::axes::{Axes as CloudAxes, Up};
use b2p::cloud::PointCloud;
use b2p::container::MAGIC;
use b2p::gaussians::{Frame, Gaussians};
use b2p::{Limits, Log};
use b2p_formats::clouds::{PointFormat, WriteOptions, encode_cloud};
use b2p_formats::detect::Kind;
use b2p_formats::sidecar::Sidecar;
use b2p_formats::splats::{self, Axes, Format, Splats};
use serde_json::json;

use super::args::{Convert, OutFormat};
use super::manners::{self, Said};
use super::progress::Progress;
use super::table::{counted, steps, steps_json};
use super::{Failure, Result, cloud, load, points, sidecar};

/// Converts a file.
pub fn run(args: &Convert, limits: &Limits, progress: &Progress) -> Result<Said> {
    manners::permit(&[&args.output], &[&args.input])?;
    let log = progress.log();
    let input: &Path = &args.input;
    let bytes = load::bytes(input, limits)?;
    let (written, thing) = match format_of(input, &bytes, args.from) {
        Some(format) => of_gaussians(args, &bytes, format, limits, &log)?,
        None if cloud::is_cloud(&bytes) => of_points(args, bytes, limits, &log)?,
        None => return Err(unknown(input, &bytes)),
    };
    let to: &Path = &args.output;
    let report = format!(
        "{}\n{}: {}\n",
        steps(&log.steps()),
        to.display(),
        counted(written as u64, thing)
    );
    let json = || {
        json!({
            "output": to.display().to_string(),
            "count": written,
            "of": format!("{}s", thing.to_lowercase()),
            "steps": steps_json(&log.steps()),
        })
    };
    Ok(Said::report(report, json).beside(to))
}

/// What to say of a file that cannot be converted.
fn unknown(input: &Path, bytes: &[u8]) -> Failure {
    let what = match bytes.starts_with(&MAGIC) {
        true => {
            "this is a stream of b2p: `b2p decode` writes its Gaussians, or its points, in any of these formats".into()
        }
        false => {
            let names: Vec<_> = Format::all().map(Format::name).collect();
            let names = names.join(", ");
            let kind = Kind::of(bytes);
            format!(
                "this is {kind}, neither points nor splats that are known by their contents; --from says which of {names}"
            )
        }
    };
    Failure(format!("{}: {what}", input.display()))
}

/// The format of points that is asked for, or named by the output's ending. Those of `--points` are PLY by default.
fn point_format(args: &Convert) -> Result<Option<PointFormat>> {
    let to: &Path = &args.output;
    let found = match args.format {
        Some(OutFormat::Points(format)) => Some(format),
        Some(OutFormat::Splats(Format::Ply)) => Some(PointFormat::Ply),
        Some(OutFormat::Splats(format)) if args.points => {
            return Err(Failure(format!(
                "--format {format} is for Gaussians, --points writes points"
            )));
        }
        Some(OutFormat::Splats(_)) => None,
        None => PointFormat::of(to).filter(|_| Format::of_path(to) != Some(Format::CompressedPly)),
    };
    Ok(match (found, args.format) {
        (None, None) if args.points => Some(PointFormat::Ply),
        (found, _) => found,
    })
}

/// Converts splats: to splats, or to points at their centres if only they can be meant.
fn of_gaussians(
    args: &Convert,
    bytes: &[u8],
    format: Format,
    limits: &Limits,
    log: &Log,
) -> Result<(usize, &'static str)> {
    let (input, to): (&Path, &Path) = (&args.input, &args.output);
    if let Some(name) = args.read.given() {
        let what = format!("{name} is for points, these are Gaussians");
        return Err(Failure(format!("{}: {what}", input.display())));
    }
    let splats = read(input, bytes, format, limits, log)?;
    let known = Sidecar::beside(input).unwrap_or_default().axes;
    let count = splats.gaussians.len();
    let asked = args.read.up.and_then(|up| up.up());
    // PLY is a format of both.
    let points = point_format(args)?.filter(|format| args.points || *format != PointFormat::Ply);
    let Some(points) = points else {
        let axes = match (args.keep_axes, asked) {
            (true, _) => return keep_axes(args, splats, log).map(|()| (count, "Gaussian")),
            (false, Some(up)) => Axes::Cloud(up),
            (false, None) => splats.axes,
        };
        let known = CloudAxes { up: None, ..known };
        write(&splats.gaussians, axes, &known, splat_format(args)?, to, log)?;
        return Ok((count, "Gaussian"));
    };
    let up = match splats.axes {
        Axes::Cloud(up) => Some(up),
        Axes::Gltf => Some(Up::MinusY),
        Axes::Ply => None,
    };
    let mut cloud = points::centres(&splats.into_cloud());
    cloud.axes = CloudAxes {
        up: asked.or(up).or(known.up),
        ..known
    };
    let what =
        "only the centres and colours of Gaussians are written as points; scales, rotations and opacities are not";
    manners::warn(&format!("{}: {what}", input.display()));
    write_cloud(args, cloud, points, log)
}

/// Writes splats with the coordinates of the cloud that they were made of.
fn keep_axes(args: &Convert, splats: Splats, log: &Log) -> Result<()> {
    let format = splat_format(args)?;
    let gaussians = splats.into_cloud();
    write(
        &gaussians,
        Axes::of(format),
        &CloudAxes::default(),
        format,
        &args.output,
        log,
    )
}

fn splat_format(args: &Convert) -> Result<Format> {
    let asked = match args.format {
        Some(OutFormat::Splats(format)) => Some(format),
        Some(OutFormat::Points(_)) | None => None,
    };
    output_format(&args.output, asked)
}

/// Converts points: to points, or with `--surfels` to Gaussians.
fn of_points(args: &Convert, bytes: Vec<u8>, limits: &Limits, log: &Log) -> Result<(usize, &'static str)> {
    let input: &Path = &args.input;
    if args.surfels {
        let format = splat_format(args)?;
        let (gaussians, axes) = cloud::surfels_of(input, bytes, &args.read, load::isa(None)?, limits, log)?;
        let own = match axes.up.filter(|_| !args.keep_axes) {
            Some(up) => Axes::Cloud(up),
            None if args.keep_axes => Axes::of(format),
            None => Axes::Ply,
        };
        write(&gaussians, own, &axes, format, &args.output, log)?;
        return Ok((gaussians.len(), "Gaussian"));
    }
    let to: &Path = &args.output;
    let format = match point_format(args)? {
        Some(format) => format,
        None if manners::is_pipe(to) && args.format.is_none() => PointFormat::Ply,
        None => {
            let kind = Kind::of(&bytes);
            let what = "`b2p encode` codes points, and `b2p decode` makes Gaussians of them; --surfels makes flat Gaussians of \
                        them at once; points are written to .ply, .las, .laz, .pcd, .e57, .xyz and .txt";
            return Err(Failure(format!(
                "{}: this is {kind}, not Gaussians: {what}",
                input.display()
            )));
        }
    };
    let cloud = log.step("read cloud", 1, "file", || {
        Ok(cloud::of_bytes(input, bytes, &args.read, limits))
    })??;
    write_cloud(args, cloud, format, log)
}

fn write_cloud(args: &Convert, cloud: PointCloud, format: PointFormat, log: &Log) -> Result<(usize, &'static str)> {
    let count = cloud.positions.len();
    let options = WriteOptions {
        double: args.double,
        local: args.local,
    };
    let encoded = encode_cloud(cloud, format, options)?;
    points::write(&encoded, count, &args.output, log)?;
    Ok((count, "point"))
}

/// Whether a file that starts like this may be one of splats.
pub fn may_be(start: &[u8]) -> bool {
    let starts: [&[u8]; 6] = [b"ply", b"NGSP", b"\x1f\x8b", b"PK\x03\x04", b"glTF", b"{"];
    starts.iter().any(|known| start.starts_with(known))
}

/// The format of a file of splats: the one asked for, or that of its contents; `.splat` and CSV files are known by
/// their names.
pub fn format_of(path: &Path, bytes: &[u8], asked: Option<Format>) -> Option<Format> {
    if asked.is_some() || bytes.starts_with(&MAGIC) {
        return asked;
    }
    let named = || Format::of_path(path).filter(|format| matches!(format, Format::Splat | Format::Csv));
    let found = Format::of_bytes(bytes).filter(|&format| format != Format::Ply || Kind::of(bytes) == Kind::GaussianPly);
    let is_cloud = || cloud::is_cloud(bytes);
    found.or_else(|| named().filter(|_| !is_cloud()))
}

/// Splats as they stand in a file, with warnings about what was ignored.
pub fn read(path: &Path, bytes: &[u8], format: Format, limits: &Limits, log: &Log) -> Result<Splats> {
    // Other formats say themselves what is beside them, too.
    let beside = match format {
        Format::Spz | Format::Splat | Format::Csv => Sidecar::beside(path).unwrap_or_default(),
        _ => Sidecar::default(),
    };
    let options = splats::Options {
        offset: beside.offset,
        turned_from: beside.turned_from,
    };
    let read = log.step("read Gaussians", 1, "file", || {
        splats::read(bytes, format, &options, limits)
    });
    let splats = read.map_err(Failure::in_file(path))?;
    for warning in &splats.warnings {
        manners::warn(&format!("{}: {warning}", path.display()));
    }
    Ok(splats)
}

/// What a file of splats, and the file beside it, say of the coordinates of the cloud that they show.
pub fn cloud_axes(path: &Path, splats: &Splats) -> CloudAxes {
    let beside = Sidecar::beside(path).unwrap_or_default().axes;
    match splats.axes {
        Axes::Cloud(up) => CloudAxes { up: Some(up), ..beside },
        Axes::Ply | Axes::Gltf => beside,
    }
}

/// The format to write: the one asked for, or that of the name; PLY to standard output and under other names.
pub fn output_format(to: &Path, asked: Option<Format>) -> Result<Format> {
    let known = asked.or_else(|| Format::of_path(to));
    if let (None, Some(ending)) = (known, to.extension().filter(|_| !manners::is_pipe(to))) {
        let names: Vec<_> = Format::all().map(Format::extension).collect();
        let ending = ending.to_string_lossy();
        let what = format!(
            "no splats end in .{ending}, but in {}; --format says what to write",
            names.join(", ")
        );
        return Err(Failure(format!("{}: {what}", to.display())));
    }
    Ok(known.unwrap_or(Format::Ply))
}

/// Writes Gaussians with these axes, with warnings about what the format does not keep. What a file cannot say of a
/// scene that is far from the origin, or was turned, stands in a file beside, with what else is known of its
/// coordinates.
pub fn write(g: &Gaussians, axes: Axes, known: &CloudAxes, format: Format, to: &Path, log: &Log) -> Result<()> {
    let name = format!("write {format}");
    write_with(g.frame, axes, known, format, to, || {
        let mut warnings = Vec::new();
        log.step(name, g.len(), "Gaussians", || {
            Ok(manners::write(to, |w| {
                warnings = splats::write(g, axes, format, w, to)?;
                Ok(())
            }))
        })??;
        Ok(warnings)
    })
}

/// What [`write`] does around the writing itself, which gives its warnings.
pub fn write_with(
    frame: Frame,
    axes: Axes,
    known: &CloudAxes,
    format: Format,
    to: &Path,
    write: impl FnOnce() -> Result<Vec<String>>,
) -> Result<()> {
    let offset = splats::offset(frame, axes, format);
    let turned_from = match axes {
        Axes::Cloud(up) => Some(up),
        Axes::Ply | Axes::Gltf => None,
    };
    let unsaid = turned_from.filter(|_| matches!(format, Format::Spz | Format::Splat | Format::Csv));
    let beside = (offset != [0.0; 3] || unsaid.is_some()).then(|| Sidecar {
        offset,
        turned_from,
        axes: CloudAxes {
            up: None,
            ..known.clone()
        },
        ..Sidecar::default()
    });
    sidecar::check(to, beside.as_ref())?;
    for warning in write()? {
        manners::warn(&format!("{}: {warning}", to.display()));
    }
    if let (Some(up), true) = (turned_from, axes != Axes::of(format)) {
        say_turned(up, format, to);
    }
    sidecar::settle(to, beside.as_ref())
}

/// Says that a scene was turned, unless it lay as the format has it.
fn say_turned(up: Up, format: Format, to: &Path) {
    let there = match Axes::of(format) {
        Axes::Gltf => Up::Y,
        _ => Up::MinusY,
    };
    if up != there {
        let what =
            format!("turned from {up} up to {there} up, as viewers of {format} expect; --keep-axes does not turn");
        manners::note_report(&format!("{}: {what}", to.display()));
    }
}
