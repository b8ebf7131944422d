//! `b2p demo`: the sample inside the program, decoded and drawn.

use std::path::Path;
use std::sync::Arc;

use b2p::decoder::StreamDecoder;
use b2p::gaussians::learned::HeadsModel;
use b2p::log::Log;
use b2p::renderer::camera::Camera;
use b2p::renderer::{Background, Renderer};
use b2p::{Error, Limits, embedded, output};
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
    let say = |step: &str| progress.say(step);
    std::fs::create_dir_all(&args.output).map_err(|source| Error::Io {
        path: args.output.clone(),
        source,
    })?;
    let mut log = Log::with_listener(&say);
    let decoder = log.step("load", embedded::HEADS.len(), "bytes", || {
        let heads = HeadsModel::from_bytes(embedded::HEADS)?;
        Ok(StreamDecoder::new().with_heads_model(Arc::new(heads)))
    })?;
    let mut text = format!(
        "The sample: {} bytes of stream inside the program.\n\n{}",
        count(embedded::SCENE.len() as u64),
        steps(log.steps()),
    );
    let mut renderer = Renderer::default();
    let mut written = Vec::new();
    for level in decoder.levels(embedded::SCENE)? {
        let mut log = Log::with_listener(&say);
        let gaussians = decoder.decode(embedded::SCENE, Some(level), &mut log)?;
        let mut lines = String::new();
        for (name, [azimuth, elevation, distance]) in VIEWS {
            let path = args.output.join(format!("level-{level}-{name}.png"));
            let camera = Camera::orbit(azimuth, elevation, distance, 45.0, 1024, 768)?;
            let stats = log.step(format!("draw {name}"), gaussians.len(), "Gaussians", || {
                let limits = Limits::default();
                let (image, stats) = renderer.render(&gaussians, &camera, Background::WHITE, &limits)?;
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
        text += &format!("\nLevel {level}\n{}{lines}", steps(log.steps()));
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
