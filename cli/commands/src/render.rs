//! `b2p render`: stream or Gaussians to pictures.

use std::path::{Path, PathBuf};
use std::time::Duration;

use b2p::gaussians::{Frame, Gaussians};
use b2p::log::Log;
use b2p::renderer::camera::{Camera, Extent};
use b2p::renderer::{Background, EffectMode, Effects, Explanation, Renderer, Stats};
use b2p::{Axes, Error, Limits};
use serde_json::json;

use super::args::{Format, Render};
use super::budget::{self, Chosen, Task};
use super::load::Source;
use super::manners::{self, Said};
use super::many::Kind;
use super::picture::{Artist, ending, format_of};
use super::pipe::{self, Shown};
use super::progress::Progress;
use super::sheet::Sheet;
use super::table::{count, counted, milliseconds, steps};
use super::views::{Shot, lenses_beside, shots};
use super::{Failure, Result, cloud, load, scene, sequence, video};

/// Frames that the cost of an effect is measured with; the fastest counts.
const TRIALS: usize = 3;

/// Endings of what is taken from folders.
pub const TAKES: &[&str] = &[
    "b2p", "ply", "spz", "sog", "splat", "glb", "gltf", "npz", "las", "laz", "pcd", "e57", "xyz", "obj",
];

/// What is taken from folders, and what becomes of it.
pub fn kind(args: &Render) -> Kind<'_> {
    Kind {
        command: "render",
        takes: TAKES,
        ending: match (args.format, &args.turntable) {
            (None, Some(_)) => "mp4",
            (Some(format), _) => ending(format),
            (None, None) => "png",
        },
        instead: args.turntable.as_deref(),
        gathers: false,
    }
}

/// Draws one picture, or several: on a circle, or with the cameras of a file.
pub fn run(args: &Render, limits: &Limits, progress: &Progress) -> Result<Said> {
    if sequence::is_sequence(&args.input) {
        return sequence::render(args, limits, progress);
    }
    if scene::is_scene(&args.input) {
        return scene::render(args, limits, progress);
    }
    let log = progress.log();
    if let Some(path) = &args.turntable {
        video::kind_of(path)?;
    }
    if args.camera.is_none() {
        // Where pictures go is known at once; a file of cameras needs to know the cube.
        let unseen = Axes::default();
        permit(args, &shots(args, &Frame::default(), &Extent::cube(), &unseen, limits)?)?;
    }
    if manners::is_pipe(&args.input) && !args.budget.is_given() {
        return from_pipe(args, limits, &log);
    }
    let chosen = choose(args, limits, progress)?;
    let detail = chosen.as_ref().map(Chosen::detail);
    let detail = detail.as_ref().unwrap_or(&args.detail);
    let source = Source::open(&args.input, detail, &args.model, limits, &log)?;
    let (frame, axes) = (source.frame()?, source.axes());
    let mut cameras = shots(args, &frame, &Extent::cube(), &axes, limits)?;
    if args.camera.is_some() {
        permit(args, &cameras)?;
    }
    // What keeps the object in view is nearer than what keeps the cube in view.
    if detail.level.is_none() && source.level_for(&cameras)?.is_some() {
        cameras = shots(args, &frame, &source.extent(limits), &axes, limits)?;
    }
    let (gaussians, detail) = source.gaussians(detail, &cameras, &log)?;
    let decoded = log.steps().iter().map(|step| step.time).sum();
    let drawing = Drawing {
        args,
        limits,
        detail: Some(detail),
        chosen: chosen.as_ref().map(|chosen| (chosen, decoded, progress)),
    };
    pictures(&drawing, &gaussians, &axes, &log)
}

/// Draws what comes on standard input, each level as it is complete.
fn from_pipe(args: &Render, limits: &Limits, log: &Log) -> Result<Said> {
    let mut said = Said::default();
    // What has gone to standard output cannot be replaced by something finer.
    let early = !manners::is_pipe(&args.output);
    let mut permitted = args.camera.is_none();
    let mut draw = |gaussians: &Gaussians, axes: &Axes, log: &Log| {
        // Pictures of coarser levels are this program's own.
        if !permitted {
            permit(args, &shots(args, &gaussians.frame, &Extent::cube(), axes, limits)?)?;
            permitted = true;
        }
        let drawing = Drawing {
            args,
            limits,
            detail: None,
            chosen: None,
        };
        said = pictures(&drawing, gaussians, axes, log)?;
        Ok(())
    };
    let input = &args.input;
    let mut show = |shown: Shown<'_>, axes: &Axes, log: &Log| shown.all_at_once(input, |all| draw(all, axes, log));
    pipe::each(input, &args.detail, &args.model, limits, (early, false), log, &mut show)?;
    Ok(said)
}

/// Level and heads for a budget, if one is given: for a picture as the cameras see the object, and no finer than they
/// see.
fn choose(args: &Render, limits: &Limits, progress: &Progress) -> Result<Option<Chosen>> {
    let Some(stream) = budget::stream(&args.budget, &args.input, &args.detail, limits)? else {
        return Ok(None);
    };
    let fail = Failure::in_file(&args.input);
    let decoder = load::decoder(&stream, &args.detail, &args.model, limits)?;
    let frame = decoder.frame(&stream).map_err(&fail)?;
    let extent = load::extent(&stream, &decoder, limits);
    let cameras = shots(args, &frame, &extent, &cloud::axes(&stream), limits)?;
    let per_unit = cameras.iter().map(|shot| shot.camera.pixels_per_unit());
    let per_unit = per_unit.fold(0.0, f64::max);
    let pixels = cameras.iter().map(|shot| shot.camera.size().map(f64::from));
    let pixels = pixels.map(|[width, height]| width * height).fold(0.0, f64::max);
    let finest = decoder.level_for(&stream, per_unit).map_err(&fail)?;
    let task = Task::Picture { pixels, per_unit };
    budget::choose(&args.budget(limits, progress), &args.input, &stream, finest, task)
}

/// Whether the pictures may be written.
pub fn permit(args: &Render, cameras: &[Shot]) -> Result<()> {
    let mut outputs: Vec<&Path> = cameras.iter().map(|shot| shot.path.as_path()).collect();
    outputs.dedup();
    let is_video = args.turntable.is_some() || args.contact_sheet;
    if !is_video
        && !manners::is_pipe(&args.output)
        && cameras.len() > 1
        && format_of(args, cameras.len())? == Format::Y4m
    {
        outputs = vec![&args.output];
    }
    let lenses = args.camera.as_deref().and_then(lenses_beside);
    let inputs = [
        Some(&args.input),
        args.camera.as_ref(),
        lenses.as_ref(),
        args.model.model.as_ref(),
    ];
    let inputs: Vec<&Path> = inputs.into_iter().flatten().map(PathBuf::as_path).collect();
    manners::permit(&outputs, &inputs)
}

/// How pictures are drawn.
pub struct Drawing<'a> {
    pub args: &'a Render,
    pub limits: &'a Limits,
    pub detail: Option<Explanation>,
    /// What was chosen for a budget, how long it took to decode, and what shows a calibration.
    pub chosen: Option<(&'a Chosen, Duration, &'a Progress)>,
}

/// A picture's file, its size, and how it was drawn.
type Drawn = (PathBuf, [u32; 2], Stats);

/// Draws these Gaussians into the pictures asked for.
pub fn pictures(drawing: &Drawing, gaussians: &Gaussians, axes: &Axes, log: &Log) -> Result<Said> {
    let &Drawing { args, limits, .. } = drawing;
    let extent = Extent::of_gaussians(gaussians);
    let cameras = &shots(args, &gaussians.frame, &extent, axes, limits)?[..];
    let mut effects = Effects::default();
    for (effect, choice) in &args.effect {
        effects.set(*effect, *choice);
    }
    let mut renderer = Renderer::new().with_isa(load::isa(args.model.isa.as_deref())?);
    renderer.set_effects(effects);
    renderer.set_quality(args.quality);
    let many = if args.contact_sheet { 1 } else { cameras.len() };
    let format = match &args.turntable {
        Some(_) => Format::Y4m,
        None => format_of(args, many)?,
    };
    let mut artist = Artist::new(renderer, gaussians, limits, args, format);
    let all = match format {
        _ if args.contact_sheet => sheet(cameras, &mut artist, limits, log)?,
        _ if args.turntable.is_some() => turn(cameras, &mut artist, log)?,
        Format::Y4m => video(args, cameras, &mut artist, log)?,
        _ => stills(args, cameras, &mut artist, log)?,
    };

    let mut report = chosen(drawing, &all)?;
    if let (true, Some(Shot { camera, .. }), Some((_, _, stats))) = (manners::verbose(), cameras.first(), all.first()) {
        if let Some(detail) = &drawing.detail {
            report += &format!("{detail}\n");
        }
        for line in effects.explain(gaussians, camera, stats) {
            let cost = cost_of(&line, &mut artist, effects, camera)?;
            report += &format!("{line}{cost}\n");
        }
    }
    let to = &args.output;
    if manners::json() || args.stats.is_some() {
        let all: Vec<_> = all
            .iter()
            .map(|(path, size, stats)| numbers(path, *size, stats))
            .collect();
        let result = format!("{:#}\n", json!(all));
        return Ok(Said { result, report }.beside(to));
    }
    // Of many frames in one file, one line.
    let distinct = all
        .first()
        .map(|(path, ..)| all.iter().all(|(other, ..)| other == path));
    match distinct {
        Some(true) if all.len() > 1 => report += &format!("{}: {}\n", to.display(), counted(all.len() as u64, "view")),
        _ => {
            for (path, _, stats) in &all {
                report += &describe(path, stats);
            }
        }
    }
    let many = all.len() > 8;
    if manners::verbose() || !many {
        report = format!("{}\n{report}", steps(&log.steps()));
    }
    Ok(Said {
        report,
        result: String::new(),
    })
}

/// Draws one picture into the artist's image.
fn draw_logged(shot: &Shot, artist: &mut Artist, log: &Log) -> b2p::Result<Drawn> {
    let count = artist.gaussians.len();
    let name = format!("draw {}", shot.path.display());
    let drawn = log.step(name, count, "Gaussians", || artist.draw(&shot.camera));
    Ok((shot.path.clone(), shot.camera.size(), drawn?))
}

/// Draws all pictures into one file.
fn video(args: &Render, cameras: &[Shot], artist: &mut Artist, log: &Log) -> Result<Vec<Drawn>> {
    let mut all = Vec::new();
    let to = &args.output;
    manners::write(to, |w| {
        for (i, shot) in cameras.iter().enumerate() {
            let last = (artist.image.width, artist.image.height);
            all.push(draw_logged(shot, artist, log)?);
            if i == 0 {
                w.write_all(&artist.image.y4m_header()).map_err(|source| Error::Io {
                    path: to.to_path_buf(),
                    source,
                })?;
            } else if last != (artist.image.width, artist.image.height) {
                let what = "the pictures of a video are all of one size";
                return Err(Error::Usage(format!("{what}: {} is not", shot.label)));
            }
            artist.write(w, to)?;
        }
        Ok(())
    })?;
    Ok(all)
}

/// Draws one turn into a video.
fn turn(cameras: &[Shot], artist: &mut Artist, log: &Log) -> Result<Vec<Drawn>> {
    let mut all = Vec::new();
    let Some(first) = cameras.first() else { return Ok(all) };
    let [width, height] = first.camera.size();
    artist.other_bytes = u64::from(width) * u64::from(height) * video::BYTES_PER_PIXEL;
    video::write(
        &first.path,
        cameras.len() as u32,
        video::FrameTime::THIRTIETH,
        |i, image| {
            let drawn = draw_logged(&cameras[i as usize], artist, log)?;
            all.push(drawn);
            std::mem::swap(image, &mut artist.image);
            Ok(())
        },
    )?;
    Ok(all)
}

/// Draws all views into one picture.
fn sheet(cameras: &[Shot], artist: &mut Artist, limits: &Limits, log: &Log) -> Result<Vec<Drawn>> {
    let mut all = Vec::new();
    let Some(first) = cameras.first() else { return Ok(all) };
    let paper = match artist.args.view.background {
        Background::Colour([r, g, b]) => [r, g, b, 1.0],
        _ => [0.0; 4],
    };
    let mut sheet = Sheet::new(cameras.len() as u32, first.camera.size(), paper, limits)?;
    artist.other_bytes = (sheet.image.pixels.len() * size_of::<[f32; 4]>()) as u64;
    for shot in cameras {
        all.push(draw_logged(shot, artist, log)?);
        sheet.add(&artist.image, &shot.label);
    }
    artist.image = sheet.image;
    if artist.format == Format::Exr {
        let what = "a contact sheet is written as .png or .ppm";
        return Err(Failure(what.into()));
    }
    manners::write(&first.path, |w| artist.write(w, &first.path))?;
    Ok(all)
}

/// Draws each picture into a file of its own.
fn stills(args: &Render, cameras: &[Shot], artist: &mut Artist, log: &Log) -> Result<Vec<Drawn>> {
    let mut all = Vec::new();
    for shot in cameras {
        all.push(draw_logged(shot, artist, log)?);
        let to = match manners::is_pipe(&args.output) {
            true => &args.output,
            false => shot.path.as_path(),
        };
        manners::write(to, |w| artist.write(w, to))?;
    }
    Ok(all)
}

/// What was chosen for a budget, and how long decoding and the slowest picture took.
fn chosen(drawing: &Drawing, all: &[Drawn]) -> Result<String> {
    let slowest = all.iter().map(|(.., stats)| stats.times.total()).max();
    match drawing.chosen {
        None => Ok(String::new()),
        Some((chosen, decoded, progress)) => {
            let took = decoded + slowest.unwrap_or_default();
            chosen.describe(took, drawing.limits, progress)
        }
    }
}

/// What an effect that is on costs, in words: how much sooner the picture is there without it.
fn cost_of(line: &Explanation, artist: &mut Artist, effects: Effects, camera: &Camera) -> Result<String> {
    let Ok(effect) = line.name.parse() else {
        return Ok(String::new());
    };
    if !line.on {
        return Ok(String::new());
    }
    let mut least = |effects| -> Result<Duration> {
        artist.renderer.set_effects(effects);
        let mut least = Duration::MAX;
        for _ in 0..TRIALS {
            least = least.min(artist.draw(camera)?.times.total());
        }
        Ok(least)
    };
    let mut without = effects;
    without.set(effect, EffectMode::Off);
    let [without, with] = [least(without)?, least(effects)?];
    let cost = with.as_secs_f64() - without.as_secs_f64();
    Ok(format!("; {:+.2} ms of {}", cost * 1e3, milliseconds(with)))
}

/// What a picture took.
pub fn describe(path: &Path, stats: &Stats) -> String {
    let times = stats.times;
    format!(
        "{}: {} drawn, {} dropped; project {}, bin {}, sort {}, blend {}\n",
        path.display(),
        counted(stats.visible, "Gaussian"),
        count(stats.dropped.total()),
        milliseconds(times.project),
        milliseconds(times.bin),
        milliseconds(times.sort),
        milliseconds(times.blend),
    )
}

/// What a picture took, for programs. `overlap`: tiles that a Gaussian touches, in the mean. `coverage`: the share of
/// the pixels that something was drawn on.
pub fn numbers(path: &Path, [width, height]: [u32; 2], stats: &Stats) -> serde_json::Value {
    let ms = |time: std::time::Duration| time.as_secs_f64() * 1e3;
    let (times, dropped, effects) = (stats.times, stats.dropped, stats.effects);
    json!({
        "picture": path.display().to_string(),
        "width": width,
        "height": height,
        "visible": stats.visible,
        "dropped": {
            "not_finite": dropped.not_finite,
            "no_rotation": dropped.no_rotation,
            "too_faint": dropped.too_faint,
            "behind": dropped.behind,
            "outside": dropped.outside,
        },
        "crossing": stats.crossing,
        "pairs": stats.pairs,
        "overlap": stats.pairs as f64 / stats.visible.max(1) as f64,
        "coverage": stats.touched as f64 / (f64::from(width) * f64::from(height)),
        "effects": effects,
        "ms": {
            "project": ms(times.project),
            "bin": ms(times.bin),
            "sort": ms(times.sort),
            "blend": ms(times.blend),
            "total": ms(times.total()),
        },
    })
}
