//! `b2p render`: stream or Gaussians to pictures.

use std::path::{Path, PathBuf};

use b2p::gaussians::Gaussians;
use b2p::log::Log;
use b2p::pixels::{Renderer, Stats};
use b2p::projection::Camera;
use b2p::{Error, Limits, output};

use super::args::{Render, View};
use super::progress::Progress;
use super::table::{count, milliseconds, steps};
use super::{Result, load};

/// Draws one picture, or several on a circle.
pub fn run(args: &Render, progress: &Progress) -> Result<String> {
    let say = |step: &str| progress.say(step);
    let mut log = Log::with_listener(&say);
    let gaussians = load::gaussians(&args.input, &args.level, &args.model, &mut log)?;
    let mut text = String::new();
    let mut renderer = Renderer::default();
    for (path, camera) in cameras(&args.view, &args.output)? {
        let stats = log.step(
            format!("draw {}", path.display()),
            gaussians.len(),
            "Gaussians",
            || draw(&mut renderer, &gaussians, &camera, &args.view, &path),
        )?;
        text += &describe(&path, &stats);
    }
    Ok(format!("{}\n{text}", steps(log.steps())))
}

/// The pictures to draw: where each goes and where its camera stands.
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
    output::write_file(path, |w| {
        w.write_all(&png).map_err(|source| Error::Io {
            path: path.to_owned(),
            source,
        })
    })?;
    Ok(stats)
}

/// What a picture took.
pub fn describe(path: &Path, stats: &Stats) -> String {
    let times = stats.times;
    format!(
        "{}: {} Gaussians drawn, {} dropped; project {}, sort {}, bin {}, blend {}\n",
        path.display(),
        count(stats.visible),
        count(stats.dropped.total()),
        milliseconds(times.project),
        milliseconds(times.sort),
        milliseconds(times.bin),
        milliseconds(times.blend),
    )
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
