//! `b2p convert`: splats of one format to another, or to points at their centres; and what other commands read and
//! write of splats.

use std::path::{Path, PathBuf};

use b2p::cloud::PointCloud;
use b2p::container::MAGIC;
use b2p::gaussians::Gaussians;
use b2p::{Limits, Log, input, output};
use b2p_formats::detect::Kind;
use b2p_formats::splats::{self, Axes, Format, Splats};
use serde_json::{Value, json};

use super::args::Convert;
use super::manners::{self, Said};
use super::progress::Progress;
use super::table::{counted, steps, steps_json};
use super::{Failure, Result, cloud, load};

/// Converts a file.
pub fn run(args: &Convert, limits: &Limits, progress: &Progress) -> Result<Said> {
    manners::permit(&[&args.output], &[&args.input])?;
    let log = progress.log();
    let (input, to): (&Path, &Path) = (&args.input, &args.output);
    let bytes = load::bytes(input, limits)?;
    let Some(format) = format_of(input, &bytes, args.from) else {
        if bytes.starts_with(&MAGIC) {
            let what = "this is a stream of b2p: `b2p decode` writes its Gaussians in any of these formats";
            return Err(Failure(format!("{}: {what}", input.display())));
        }
        if cloud::is_cloud(&bytes) {
            let kind = Kind::of(&bytes);
            let what = "`b2p encode` codes points, and `b2p decode` makes Gaussians of them";
            return Err(Failure(format!(
                "{}: this is {kind}, not Gaussians: {what}",
                input.display()
            )));
        }
        let names: Vec<_> = Format::all().map(Format::name).collect();
        let what = format!(
            "no splats that are known by their contents; --from says which of {}",
            names.join(", ")
        );
        return Err(Failure(format!("{}: {what}", input.display())));
    };
    let splats = read(input, &bytes, format, limits, &log)?;
    drop(bytes);
    let count = splats.gaussians.len();
    let (written, thing) = match args.points {
        true => {
            let cloud = points(&splats.gaussians);
            let count = cloud.positions.len();
            write_points(&cloud, to, &log)?;
            (count, "point")
        }
        false => {
            let format = output_format(to, args.format)?;
            write(&splats.gaussians, splats.axes, format, to, &log)?;
            (count, "Gaussian")
        }
    };
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
    let options = splats::Options {
        offset: match format {
            Format::Spz | Format::Splat => offset_beside(path).unwrap_or_default(),
            _ => [0.0; 3],
        },
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

/// Writes Gaussians, with warnings about what the format does not keep. What was subtracted from coordinates far from
/// the origin stands in a file beside.
pub fn write(g: &Gaussians, axes: Axes, format: Format, to: &Path, log: &Log) -> Result<()> {
    let offset = splats::offset(g, axes, format);
    let beside = sidecar(to);
    let is_far = offset != [0.0; 3];
    if is_far && !manners::is_pipe(to) && offset_beside(to).is_none() {
        manners::permit(&[&beside], &[])?;
    }
    let name = format!("write {format}");
    let mut warnings = Vec::new();
    log.step(name, g.len(), "Gaussians", || {
        Ok(manners::write(to, |w| {
            warnings = splats::write(g, axes, format, w, to)?;
            Ok(())
        }))
    })??;
    for warning in warnings {
        manners::warn(&format!("{}: {warning}", to.display()));
    }
    if !is_far {
        return Ok(());
    }
    let [x, y, z] = offset;
    let what = format!("coordinates are less an offset of {x} {y} {z}");
    if manners::is_pipe(to) || !std::fs::metadata(to).is_ok_and(|file| file.is_file()) {
        manners::warn(&what);
        return Ok(());
    }
    let text = json!({ "file": to.file_name().map(|name| name.to_string_lossy()), "offset": offset });
    output::write_file(&beside, |w| {
        let io = |source| b2p::Error::Io {
            path: beside.clone(),
            source,
        };
        writeln!(w, "{text:#}").map_err(io)
    })?;
    manners::warn(&format!(
        "{}: {what}, which {} states, too",
        to.display(),
        beside.display()
    ));
    Ok(())
}

/// The file that states the offset of another.
fn sidecar(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".offset.json");
    name.into()
}

/// The offset that stands in a file beside.
fn offset_beside(path: &Path) -> Option<[f64; 3]> {
    let small = Limits::default().with_max_bytes(4096);
    let text = input::read_file(&sidecar(path), &small).ok()?;
    let value: Value = serde_json::from_slice(&text).ok()?;
    let [x, y, z] = value["offset"].as_array()?.as_slice() else {
        return None;
    };
    let offset = [x.as_f64()?, y.as_f64()?, z.as_f64()?];
    offset.iter().all(|x| x.is_finite()).then_some(offset)
}

/// A point at the centre of every Gaussian that has one, with its colour.
fn points(g: &Gaussians) -> PointCloud {
    let mut cloud = PointCloud::default();
    for (&position, colour) in g.position.iter().zip(&g.colour) {
        let place = g.frame.placement.from_cube(g.frame.bits, position);
        if place.iter().all(|x| x.is_finite()) {
            cloud.positions.push(place);
            cloud
                .colours
                .push(colour.map(|c| (c * 255.0).round().clamp(0.0, 255.0) as u8));
        }
    }
    cloud
}

fn write_points(cloud: &PointCloud, to: &Path, log: &Log) -> Result<()> {
    log.step("write PLY", cloud.positions.len(), "points", || {
        Ok(manners::write(to, |w| {
            let io = |source| b2p::Error::Io {
                path: to.to_path_buf(),
                source,
            };
            w.write_all(&cloud.to_ply()).map_err(io)
        }))
    })?
}
