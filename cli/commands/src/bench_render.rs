//! `b2p bench --render`: how long each stage of drawing takes.

use std::path::Path;
use std::time::Duration;

use b2p::log::Log;
use b2p::renderer::camera::Camera;
use b2p::renderer::{Image, Renderer, Stats, Times};
use b2p::{Limits, embedded};
use serde_json::json;

use super::Result;
use super::args::Bench;
use super::bench::{median, peak_memory};
use super::load::{self, Source};
use super::manners::{self, Said};
use super::progress::Progress;
use super::table::{count, milliseconds, table};
use super::views::Shot;

/// A stage's name, and where its time is.
type Stage = (&'static str, fn(&Times) -> Duration);

const STAGES: [Stage; 5] = [
    ("project", |times| times.project),
    ("bin", |times| times.bin),
    ("sort", |times| times.sort),
    ("blend", |times| times.blend),
    ("frame", Times::total),
];

/// Draws the same picture again and again; prints a table or JSON.
pub fn run(args: &Bench, limits: &Limits, progress: &Progress) -> Result<Said> {
    let (width, height) = args.size;
    let camera = Camera::orbit(0.0, 0.0, 3.0, 45.0, width, height)?;
    let log = Log::default();
    let gaussians = match &args.input {
        Some(path) => {
            let source = Source::open(path, &args.detail, &args.model, limits, &log)?;
            let shot = Shot {
                path: path.clone(),
                camera,
                label: String::new(),
            };
            source.gaussians(&args.detail, &[shot], &log)?.0
        }
        None => {
            let sample = embedded::SCENE;
            let decoder = load::decoder(sample, &args.detail, &args.model, limits)?;
            decoder.with_log(&log).decode(sample)?
        }
    };
    let isa = load::isa(args.model.isa.as_deref())?;
    let renderer = Renderer::new().with_isa(isa).with_limits(limits.clone());
    let mut renderer = renderer.with_quality(args.quality);
    let mut image = Image::default();
    // The first is not counted.
    let mut all: Vec<Stats> = Vec::new();
    for run in 0..=args.repeat {
        progress.say(&format!("run {run} of {}", args.repeat));
        let stats = renderer.render_into(&gaussians, &camera, &mut image)?;
        if run > 0 {
            all.push(stats);
        }
    }
    let medians = STAGES.map(|(name, time)| (name, median(all.iter().map(|s| time(&s.times)))));
    let threads = rayon::current_num_threads();
    let (stats, memory) = (all[0], peak_memory());
    let input = args.input.as_deref().unwrap_or(Path::new("sample"));
    if manners::json() {
        let stages: serde_json::Map<_, _> = medians
            .iter()
            .map(|(name, time)| ((*name).to_owned(), json!(time.as_secs_f64() * 1e3)))
            .collect();
        let report = json!({
            "input": input.display().to_string(),
            "gaussians": gaussians.len(),
            "width": width,
            "height": height,
            "isa": isa.to_string(),
            "threads": threads,
            "runs": args.repeat,
            "visible": stats.visible,
            "pairs": stats.pairs,
            "peak_memory_bytes": memory,
            "median_ms": stages,
        });
        return Ok(Said::result(format!("{report:#}\n")));
    }
    let rows: Vec<Vec<String>> = medians
        .iter()
        .map(|(name, time)| vec![(*name).to_owned(), milliseconds(*time)])
        .collect();
    Ok(Said::result(format!(
        "{}: {} Gaussians, {} of them drawn, {width}×{height}, {isa}, {threads} threads, medians of {} runs{}\n{}",
        input.display(),
        count(gaussians.len() as u64),
        count(stats.visible),
        args.repeat,
        memory.map_or(String::new(), |bytes| format!(", peak memory {} MB", bytes / 1_000_000)),
        table(&rows),
    )))
}
