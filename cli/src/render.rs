//! `b2p render`: stream or Gaussians to pictures.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::budget::Task;
use b2p::gaussians::{Frame, Gaussians};
use b2p::log::Log;
use b2p::renderer::camera::{Camera, files};
use b2p::renderer::{Choice, Effects, Explanation, Quality, Renderer, Stats};
use b2p::{Error, Limits, output};
use serde_json::json;

use super::args::{Format, Render, View};
use super::budget::{self, Chosen};
use super::keep::{self, Kept};
use super::load::Source;
use super::picture::{Artist, format_of};
use super::pipe::{self, PIPE};
use super::progress::Progress;
use super::table::{count, milliseconds, steps};
use super::{Failure, Result, cloud, load};

/// Frames that the cost of an effect is measured with; the fastest counts.
const TRIALS: usize = 3;

/// Draws one picture, or several: on a circle, or with the cameras of a file.
pub fn run(args: &Render, limits: &Limits, progress: &Progress) -> Result<String> {
    let say = |step: &str| progress.say(step);
    let mut log = Log::with_listener(&say);
    if args.input == Path::new(PIPE) && !args.budget.is_given() {
        let mut text = String::new();
        // What has gone to standard output cannot be replaced by something finer.
        let early = args.output != Path::new(PIPE);
        let mut show = |gaussians: &Gaussians, log: &mut Log| {
            let cameras = asked_for(args, &gaussians.frame)?;
            let drawing = Drawing {
                args,
                quality: args.quality,
                limits,
                detail: None,
                chosen: None,
            };
            text = pictures(&drawing, gaussians, &cameras, log)?;
            Ok(())
        };
        pipe::each(
            &args.input,
            &args.detail,
            &args.model,
            limits,
            early,
            &mut log,
            &mut show,
        )?;
        return Ok(text);
    }
    if let Some(bytes) = keep::stream(&args.budget, &args.input)? {
        let frame = load::decoder(&bytes, &args.detail, &args.model, limits)?.frame(&bytes);
        let cameras = asked_for(args, &frame.map_err(Failure::in_file(&args.input))?)?;
        let Some((_, camera)) = cameras.first() else {
            return Ok(String::new());
        };
        let (budget, model) = (&args.budget, &args.model);
        let kept = keep::draw(budget, &args.input, &bytes, model, camera, limits, &mut log)?;
        let drawing = Drawing {
            args,
            quality: args.quality,
            limits,
            detail: None,
            chosen: Some(For::Kept(&kept)),
        };
        return pictures(&drawing, &kept.gaussians, &cameras, &mut log);
    }
    let pixels = u64::from(args.view.size.0) * u64::from(args.view.size.1);
    let task = Task::Picture { pixels };
    let (budget, input) = (&args.budget, &args.input);
    let chosen = budget::choose(budget, &args.model, input, task, limits, progress)?;
    let chosen_args = chosen.as_ref().map(|c| (c.detail(), c.model(&args.model)));
    let (detail, model) = match &chosen_args {
        Some((detail, model)) => (detail, model),
        None => (&args.detail, &args.model),
    };
    let source = Source::open(input, detail, model, limits, &mut log)?;
    let cameras = asked_for(args, &source.frame()?)?;
    let views: Vec<Camera> = cameras.iter().map(|(_, camera)| *camera).collect();
    let (gaussians, detail) = source.gaussians(detail, &views, &mut log)?;
    let drawing = Drawing {
        args,
        quality: chosen.as_ref().map_or(args.quality, |c| c.choice.quality),
        limits,
        detail: Some(detail),
        chosen: chosen.as_ref().map(|chosen| For::Chosen(chosen, task)),
    };
    pictures(&drawing, &gaussians, &cameras, &mut log)
}

/// How pictures are drawn.
struct Drawing<'a> {
    args: &'a Render,
    quality: Quality,
    limits: &'a Limits,
    detail: Option<Explanation>,
    chosen: Option<For<'a>>,
}

/// What pictures were chosen for.
enum For<'a> {
    Chosen(&'a Chosen, Task),
    Kept(&'a Kept),
}

/// A picture's file, its size, and how it was drawn.
type Drawn = (PathBuf, [u32; 2], Stats);

/// Draws these Gaussians into the pictures asked for.
fn pictures(drawing: &Drawing, gaussians: &Gaussians, cameras: &[(PathBuf, Camera)], log: &mut Log) -> Result<String> {
    let &Drawing { args, limits, .. } = drawing;
    let mut effects = Effects::default();
    for (effect, choice) in &args.effect {
        effects.set(*effect, *choice);
    }
    let mut renderer = Renderer::new(load::isa(args.model.isa.as_deref())?);
    renderer.set_effects(effects);
    renderer.set_quality(drawing.quality);
    let format = format_of(args, cameras.len())?;
    let mut artist = Artist::new(renderer, gaussians, limits, args, format);
    let all = match format {
        Format::Y4m => video(args, cameras, &mut artist, log)?,
        _ => stills(args, cameras, &mut artist, log)?,
    };

    let mut text = chosen(drawing, &all);
    if let (true, Some((_, camera)), Some((_, _, stats))) = (args.verbose, cameras.first(), all.first()) {
        if let Some(detail) = &drawing.detail {
            text += &format!("{detail}\n");
        }
        for line in effects.explain(gaussians, camera, stats) {
            let cost = cost_of(&line, &mut artist, effects, camera)?;
            text += &format!("{line}{cost}\n");
        }
    }
    if args.stats.is_some() {
        let all: Vec<_> = all
            .iter()
            .map(|(path, size, stats)| numbers(path, *size, stats))
            .collect();
        // What a program reads is nothing but the numbers.
        let _ = std::io::stderr().write_all(text.as_bytes());
        text = format!("{:#}\n", json!(all));
    } else {
        for (path, _, stats) in &all {
            text += &describe(path, stats);
        }
        text = format!("{}\n{text}", steps(log.steps()));
    }
    if args.output == Path::new(PIPE) {
        // Standard output is the picture's. Nobody to tell if even this fails.
        if args.stats.is_some() || args.verbose || drawing.chosen.is_some() {
            let _ = std::io::stderr().write_all(text.as_bytes());
        }
        return Ok(String::new());
    }
    Ok(text)
}

/// Draws one picture into the artist's image.
fn draw_logged(path: &Path, camera: &Camera, artist: &mut Artist, log: &mut Log) -> b2p::Result<Drawn> {
    let count = artist.gaussians.len();
    let drawn = log.step(format!("draw {}", path.display()), count, "Gaussians", || {
        artist.draw(camera)
    });
    Ok((path.to_owned(), camera.size(), drawn?))
}

/// Draws all pictures into one file.
fn video(args: &Render, cameras: &[(PathBuf, Camera)], artist: &mut Artist, log: &mut Log) -> Result<Vec<Drawn>> {
    let mut all = Vec::new();
    let mut frames = |to: &mut dyn Write| -> b2p::Result<()> {
        for (i, (path, camera)) in cameras.iter().enumerate() {
            let last = (artist.image.width, artist.image.height);
            all.push(draw_logged(path, camera, artist, log)?);
            if i == 0 {
                write(to, &artist.image.y4m_header(), &args.output)?;
            } else if last != (artist.image.width, artist.image.height) {
                let what = "the pictures of a video are all of one size";
                return Err(Error::Usage(format!("{what}: {} is not", path.display())));
            }
            write(to, &artist.file()?, &args.output)?;
        }
        Ok(())
    };
    if args.output == Path::new(PIPE) {
        frames(&mut std::io::stdout().lock())?;
    } else {
        output::write_file(&args.output, frames)?;
    }
    Ok(all)
}

/// Draws each picture into a file of its own.
fn stills(args: &Render, cameras: &[(PathBuf, Camera)], artist: &mut Artist, log: &mut Log) -> Result<Vec<Drawn>> {
    let mut all = Vec::new();
    for (path, camera) in cameras {
        all.push(draw_logged(path, camera, artist, log)?);
        let file = artist.file()?;
        if args.output == Path::new(PIPE) {
            write(&mut std::io::stdout().lock(), &file, path)?;
        } else {
            output::write_file(path, |w| write(w, &file, path))?;
        }
    }
    Ok(all)
}

/// What was chosen for a budget, and how long the slowest picture took.
fn chosen(drawing: &Drawing, all: &[Drawn]) -> String {
    let slowest = all.iter().map(|(.., stats)| stats.times.total()).max();
    let slowest = slowest.unwrap_or_default();
    match &drawing.chosen {
        None => String::new(),
        Some(For::Chosen(chosen, task)) => chosen.describe(*task, slowest),
        Some(For::Kept(kept)) => kept.describe(slowest),
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
    without.set(effect, Choice::Off);
    let [without, with] = [least(without)?, least(effects)?];
    let cost = with.as_secs_f64() - without.as_secs_f64();
    Ok(format!("; {:+.2} ms of {}", cost * 1e3, milliseconds(with)))
}

/// The cameras of the file, or of the circle.
fn asked_for(args: &Render, frame: &Frame) -> Result<Vec<(PathBuf, Camera)>> {
    let Some(path) = &args.camera else {
        let mut cameras = cameras(&args.view, &args.output)?;
        if let Some(up) = cloud::up_of(&args.input, args.up) {
            for (_, camera) in &mut cameras {
                *camera = camera.with_up(up);
            }
        }
        if args.orthographic {
            for (_, camera) in &mut cameras {
                *camera = camera.orthographic(args.view.orbit[2].into())?;
            }
        }
        return Ok(cameras);
    };
    let text = |path: &Path| -> Result<String> {
        String::from_utf8(load::bytes(path)?).map_err(|_| Failure(format!("{}: not a text", path.display())))
    };
    let named = if path.extension().is_some_and(|ending| ending == "txt") {
        let lenses = text(&path.with_file_name("cameras.txt"))?;
        files::colmap(&lenses, &text(path)?, frame)
    } else {
        files::read(&load::bytes(path)?, frame, args.view.size)
    };
    let named = named.map_err(Failure::in_file(path))?;
    if named.is_empty() {
        return Err(Failure(format!("{}: no cameras", path.display())));
    }
    let several = named.len() > 1;
    let path = |i: usize| {
        if several {
            numbered(&args.output, i as u32)
        } else {
            args.output.clone()
        }
    };
    let cameras = named.into_iter().enumerate();
    Ok(cameras.map(|(i, (_, camera))| (path(i), camera)).collect())
}

fn write(to: &mut dyn Write, bytes: &[u8], path: &Path) -> b2p::Result<()> {
    to.write_all(bytes)
        .and_then(|()| to.flush())
        .map_err(|source| Error::Io {
            path: path.to_owned(),
            source,
        })
}

/// The pictures on a circle: where each goes and where its camera stands.
pub fn cameras(view: &View, output: &Path) -> Result<Vec<(PathBuf, Camera)>> {
    let [azimuth, elevation, radius] = view.orbit.map(f64::from);
    let (width, height) = view.size;
    (0..view.views)
        .map(|i| {
            let turned = azimuth + 360.0 * f64::from(i) / f64::from(view.views);
            let camera = Camera::orbit(turned, elevation, radius, view.fov.into(), width, height)?;
            let path = if view.views == 1 {
                output.to_owned()
            } else {
                numbered(output, i)
            };
            Ok((path, camera))
        })
        .collect()
}

/// Draws into a file.
pub fn draw(
    renderer: &mut Renderer,
    gaussians: &Gaussians,
    camera: &Camera,
    view: &View,
    path: &Path,
) -> b2p::Result<Stats> {
    let (image, stats) = renderer.render(gaussians, camera, view.background, &Limits::default())?;
    let png = image.to_png()?;
    output::write_file(path, |w| write(w, &png, path))?;
    Ok(stats)
}

/// What a picture took.
pub fn describe(path: &Path, stats: &Stats) -> String {
    let times = stats.times;
    format!(
        "{}: {} Gaussians drawn, {} dropped; project {}, bin {}, sort {}, blend {}\n",
        path.display(),
        count(stats.visible),
        count(stats.dropped.total()),
        milliseconds(times.project),
        milliseconds(times.bin),
        milliseconds(times.sort),
        milliseconds(times.blend),
    )
}

/// What a picture took, for programs. `overlap`: tiles that a Gaussian touches, in the mean. `coverage`: the share of the pixels
/// that something was drawn on.
fn numbers(path: &Path, [width, height]: [u32; 2], stats: &Stats) -> serde_json::Value {
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
        "effects": {
            "harmonics": effects.harmonics,
            "antialias": effects.antialias,
            "supersample": effects.supersample,
            "near": effects.near,
            "order": effects.order,
        },
        "ms": {
            "project": ms(times.project),
            "bin": ms(times.bin),
            "sort": ms(times.sort),
            "blend": ms(times.blend),
            "total": ms(times.total()),
        },
    })
}

fn numbered(path: &Path, i: u32) -> PathBuf {
    let mut name = path.file_stem().unwrap_or_default().to_owned();
    name.push(format!("-{i:03}"));
    if let Some(ending) = path.extension() {
        name.push(".");
        name.push(ending);
    }
    path.with_file_name(name)
}
