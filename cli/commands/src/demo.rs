//! `b2p demo`: the sample inside the program, decoded and drawn.

use std::path::Path;

use b2p::{Camera, Decoder, Error, HeadsModel, Image, Renderer, embedded, output};
use serde_json::json;

use super::args::Demo;
use super::manners::Said;
use super::progress::Progress;
use super::table::{count, steps};
use super::{Result, render};

/// Views of the sample: a name, and azimuth, elevation, distance.
const VIEWS: [(&str, [f64; 3]); 2] = [("front", [20.0, 20.0, 2.6]), ("close", [-15.0, 25.0, 1.4])];

/// Decodes the sample to each of its levels that has Gaussians, and draws each from two sides.
pub fn run(args: &Demo, progress: &Progress) -> Result<Said> {
    std::fs::create_dir_all(&args.output).map_err(|source| Error::Io {
        path: args.output.clone(),
        source,
    })?;
    let log = progress.log();
    let decoder = log.step("load", embedded::HEADS.len(), "bytes", || {
        let heads = HeadsModel::from_bytes(embedded::HEADS)?;
        Ok(Decoder::new().with_heads_model(heads))
    })?;
    let mut text = format!(
        "The sample: {} bytes of stream inside the program.\n\n{}",
        count(embedded::SCENE.len() as u64),
        steps(&log.steps()),
    );
    let mut renderer = Renderer::default();
    let mut written = Vec::new();
    for level in decoder.levels(embedded::SCENE)? {
        let log = progress.log();
        let decoder = decoder.clone().with_level(level).with_log(&log);
        let gaussians = decoder.decode(embedded::SCENE)?;
        let mut lines = String::new();
        for (name, [azimuth, elevation, distance]) in VIEWS {
            let path = args.output.join(format!("level-{level}-{name}.png"));
            let camera = Camera::orbit(azimuth, elevation, distance, 45.0, 1024, 768)?;
            let stats = log.step(format!("draw {name}"), gaussians.len(), "Gaussians", || {
                let mut image = Image::default();
                let stats = renderer.render_into(&gaussians, &camera, &mut image)?;
                output::write_file(&path, |w| image.write_png(w, &path))?;
                Ok(stats)
            })?;
            lines += &render::describe(&path, &stats);
            written.push(path);
        }
        let path = args.output.join(format!("level-{level}.ply"));
        log.step("write PLY", gaussians.len(), "Gaussians", || {
            write_ply(&gaussians, &path)
        })?;
        written.push(path);
        text += &format!("\nLevel {level}\n{}{lines}", steps(&log.steps()));
    }
    text += "\nWritten:\n";
    for path in &written {
        text += &format!("  {}\n", path.display());
    }
    let written: Vec<String> = written.iter().map(|path| path.display().to_string()).collect();
    Ok(Said::report(text, || json!({ "written": written })))
}

fn write_ply(gaussians: &b2p::gaussians::Gaussians, path: &Path) -> b2p::Result<()> {
    output::write_file(path, |w| gaussians.write_ply(w, path))
}
