//! `b2p render`: stream or Gaussians to pictures.

use std::io::Write;
use std::path::{Path, PathBuf};

use b2p::gaussians::Gaussians;
use b2p::log::Log;
use b2p::pixels::{Background, Channel, Effects, Image, Renderer, Stats};
use b2p::projection::{Camera, files};
use b2p::{Error, Limits, output};
use serde_json::json;

use super::args::{Format, Render, Show, View};
use super::pipe::{self, PIPE};
use super::progress::Progress;
use super::table::{count, milliseconds, steps};
use super::{Failure, Result, load};

/// Draws one picture, or several: on a circle, or with the cameras of a file.
pub fn run(args: &Render, limits: &Limits, progress: &Progress) -> Result<String> {
    let say = |step: &str| progress.say(step);
    let mut log = Log::with_listener(&say);
    let mut text = String::new();
    // What has gone to standard output cannot be replaced by something finer.
    let early = args.output != Path::new(PIPE);
    pipe::each(
        &args.input,
        &args.level,
        &args.model,
        limits,
        early,
        &mut log,
        &mut |gaussians, log| {
            text = pictures(args, limits, gaussians, log)?;
            Ok(())
        },
    )?;
    Ok(text)
}

/// Draws these Gaussians into the pictures asked for.
fn pictures(
    args: &Render,
    limits: &Limits,
    gaussians: &Gaussians,
    log: &mut Log,
) -> Result<String> {
    let mut effects = Effects::default();
    for (effect, choice) in &args.effect {
        effects.set(*effect, *choice);
    }
    let cameras = asked_for(args, gaussians)?;
    let mut text = String::new();
    if let (true, Some((_, camera))) = (args.verbose, cameras.first()) {
        for line in effects.explain(gaussians, camera) {
            text += &format!("{line}\n");
        }
    }
    let mut renderer = Renderer::new(load::isa(args.model.isa.as_deref())?);
    renderer.set_effects(effects);
    let mut image = Image::default();
    let mut all = Vec::new();
    let mut each = |path: &Path, camera: &Camera, image: &mut Image| -> b2p::Result<()> {
        let stats = log.step(
            format!("draw {}", path.display()),
            gaussians.len(),
            "Gaussians",
            || show(&mut renderer, gaussians, camera, args, limits, image),
        )?;
        all.push((path.to_owned(), camera.width, camera.height, stats));
        Ok(())
    };

    let format = format_of(args, cameras.len())?;
    let to_stdout = args.output == Path::new(PIPE);
    if format == Format::Y4m {
        let mut video = |to: &mut dyn Write| -> b2p::Result<()> {
            for (i, (path, camera)) in cameras.iter().enumerate() {
                let last = (image.width, image.height);
                each(path, camera, &mut image)?;
                if i == 0 {
                    write(to, &image.y4m_header(), &args.output)?;
                } else if last != (image.width, image.height) {
                    let what = "the pictures of a video are all of one size";
                    return Err(Error::Usage(format!("{what}: {} is not", path.display())));
                }
                write(to, &image.to_y4m_frame(), &args.output)?;
            }
            Ok(())
        };
        if to_stdout {
            video(&mut std::io::stdout().lock())?;
        } else {
            output::write_file(&args.output, video)?;
        }
    } else {
        for (path, camera) in &cameras {
            each(path, camera, &mut image)?;
            let file = match format {
                Format::Png => image.to_png()?,
                Format::Png16 => image.to_png16()?,
                Format::Ppm | Format::Y4m => image.to_ppm(),
            };
            if to_stdout {
                write(&mut std::io::stdout().lock(), &file, path)?;
            } else {
                output::write_file(path, |w| write(w, &file, path))?;
            }
        }
    }

    if args.stats.is_some() {
        let all: Vec<_> = all
            .iter()
            .map(|(path, width, height, stats)| numbers(path, [*width, *height], stats))
            .collect();
        // What a program reads is nothing but the numbers.
        let _ = std::io::stderr().write_all(text.as_bytes());
        text = format!("{:#}\n", json!(all));
    } else {
        for (path, _, _, stats) in &all {
            text += &describe(path, stats);
        }
        text = format!("{}\n{text}", steps(log.steps()));
    }
    if to_stdout {
        // Standard output is the picture's. Nobody to tell if even this fails.
        if args.stats.is_some() || args.verbose {
            let _ = std::io::stderr().write_all(text.as_bytes());
        }
        return Ok(String::new());
    }
    Ok(text)
}

/// The format asked for, or that the ending tells.
fn format_of(args: &Render, pictures: usize) -> Result<Format> {
    if let Some(format) = args.format {
        return Ok(format);
    }
    if args.output == Path::new(PIPE) {
        return Ok(if pictures == 1 {
            Format::Png
        } else {
            Format::Y4m
        });
    }
    let ending = args.output.extension().unwrap_or_default();
    match ending.to_string_lossy().to_lowercase().as_str() {
        "ppm" => Ok(Format::Ppm),
        "y4m" => Ok(Format::Y4m),
        "png" | "" => Ok(Format::Png),
        other => Err(Failure(format!(
            "{}: no pictures are written as .{other}, but as .png, .ppm and .y4m",
            args.output.display()
        ))),
    }
}

/// The cameras of the file, or of the circle.
fn asked_for(args: &Render, gaussians: &Gaussians) -> Result<Vec<(PathBuf, Camera)>> {
    let Some(path) = &args.camera else {
        let mut cameras = cameras(&args.view, &args.output)?;
        if args.orthographic {
            for (_, camera) in &mut cameras {
                *camera = camera.orthographic(args.view.orbit[2].into())?;
            }
        }
        return Ok(cameras);
    };
    let text = |path: &Path| -> Result<String> {
        String::from_utf8(load::bytes(path)?)
            .map_err(|_| Failure(format!("{}: not a text", path.display())))
    };
    let json = path.extension().is_some_and(|ending| ending == "json");
    let named = if json {
        files::nerf(&text(path)?, &gaussians.frame, args.view.size)
    } else {
        let lenses = text(&path.with_file_name("cameras.txt"))?;
        files::colmap(&lenses, &text(path)?, &gaussians.frame)
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

/// Draws what is asked for.
fn show(
    renderer: &mut Renderer,
    gaussians: &Gaussians,
    camera: &Camera,
    args: &Render,
    limits: &Limits,
    image: &mut Image,
) -> b2p::Result<Stats> {
    let (channel, background) = match args.show {
        Show::Colour => (Channel::Colour, args.view.background),
        Show::Depth => (Channel::Depth, Background::Transparent),
        Show::Normal => (Channel::Normal, Background::Transparent),
        Show::Alpha => (Channel::Colour, Background::Transparent),
    };
    let stats = renderer.draw_into(gaussians, camera, channel, background, limits, image)?;
    match args.show {
        Show::Colour | Show::Normal => {}
        Show::Alpha => {
            for pixel in &mut image.pixels {
                *pixel = [pixel[3], pixel[3], pixel[3], 1.0];
            }
        }
        Show::Depth => {
            let depth = |p: &[f32; 4]| if p[3] > 0.0 { p[0] / p[3] } else { 0.0 };
            let farthest = image.pixels.iter().map(depth).fold(0.0, f32::max);
            for pixel in &mut image.pixels {
                let share = depth(pixel) / farthest.max(f32::MIN_POSITIVE);
                *pixel = [share, share, share, 1.0];
            }
        }
    }
    Ok(stats)
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
        "pairs": stats.pairs,
        "overlap": stats.pairs as f64 / stats.visible.max(1) as f64,
        "coverage": stats.touched as f64 / (f64::from(width) * f64::from(height)),
        "effects": { "harmonics": effects.harmonics, "antialias": effects.antialias },
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
