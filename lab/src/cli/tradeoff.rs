//! `b2p-lab tradeoff`: what accuracy costs in time on this machine.

use std::path::{Path, PathBuf};

use b2p::cloud::{ColouredVoxels, PointCloud, voxelise_closed};
use b2p::latents::network::Model;
use b2p::log::Log;
use b2p::metrics::{Spread, Verdict};
use b2p::{Limits, embedded, encoder};

use crate::error::{LabError, Result};
use crate::sample::write_bytes;
use crate::tradeoff::{self, MeasuredInput, Options, Report, Row};

/// Measure what accuracy costs in time on this machine: a table, JSON, a plot, and a page with all of them
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Stream to measure with, or cloud to be coded first, whose own pictures are then compared with as well [default:
    /// the sample that comes with the program]
    input: Option<PathBuf>,
    /// Folder for tradeoff.html, tradeoff.json and tradeoff.svg
    #[arg(short, long, value_name = "DIR", default_value = "b2p-tradeoff")]
    output: PathBuf,
    /// Pictures, once around
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=100))]
    views: u32,
    /// Width and height of the pictures in pixels
    #[arg(long, value_name = "WxH", default_value = "512x512", value_parser = size)]
    size: [u32; 2],
    /// Times that everything is measured; medians are reported
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000))]
    repeat: u32,
    /// Model file [default: the one inside the program]
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
}

impl Args {
    /// Measures, prints a table, and writes it with all else into a folder.
    ///
    /// # Errors
    /// [`LabError::Io`], and those of [`tradeoff::run`].
    pub fn run(self) -> Result<()> {
        let limits = Limits::default();
        let stream = match &self.input {
            Some(path) => read(path)?,
            None => embedded::SAMPLE.to_vec(),
        };
        let file = match &self.model {
            Some(path) => read(path)?,
            None => embedded::MODEL.to_vec(),
        };
        let (stream, cloud) = match stream.starts_with(b"ply") {
            true => {
                let (stream, cloud) = coded(&stream, &file, &limits)?;
                (stream, Some(cloud))
            }
            false => (stream, None),
        };
        let subject = MeasuredInput {
            stream: &stream,
            model: &|| Model::from_bytes(&file),
            cloud: cloud.as_ref(),
            limits: &limits,
        };
        let options = Options {
            size: self.size,
            views: self.views,
            repeats: self.repeat,
        };
        let report = tradeoff::run(&subject, &options, &|step| eprintln!("{step}"))?;
        std::fs::create_dir_all(&self.output).map_err(LabError::io(&self.output))?;
        let json = serde_json::to_string_pretty(&report);
        let json = json.map_err(|e| LabError::Usage(format!("the report cannot be written: {e}")))?;
        let files = [
            ("tradeoff.json", json),
            ("tradeoff.svg", tradeoff::plot(&report)),
            ("tradeoff.html", tradeoff::page(&report)?),
        ];
        print!("{}\nWritten:\n", summary(&report));
        for (name, content) in files {
            let path = self.output.join(name);
            write_bytes(&path, content.as_bytes())?;
            println!("  {}", path.display());
        }
        Ok(())
    }
}

fn read(path: &Path) -> Result<Vec<u8>> {
    std::fs::read(path).map_err(LabError::io(path))
}

fn size(text: &str) -> Result<[u32; 2], String> {
    let sides = text.split_once('x').map(|(w, h)| (w.parse(), h.parse()));
    match sides {
        Some((Ok(w), Ok(h))) if w > 0 && h > 0 => Ok([w, h]),
        _ => Err("expected a size such as 1024x1024, both above 0".into()),
    }
}

/// A point cloud's stream, and its voxels.
fn coded(ply: &[u8], model: &[u8], limits: &Limits) -> b2p::Result<(Vec<u8>, ColouredVoxels)> {
    let (cloud, _) = voxelise_closed(&PointCloud::from_ply(ply, limits)?)?;
    let (model, log) = (Model::from_bytes(model)?, &Log::default());
    let coded = encoder::encode(&cloud, &model, &encoder::Options::default(), log)?;
    Ok((coded.bytes, cloud))
}

fn summary(report: &Report) -> String {
    let [width, height] = report.size;
    let mut text = format!(
        "{}, {} cores, {}; {} views of {width}×{height}, medians of {} repeats\n\
         Accuracy against pictures in double precision: PSNR in dB, MS-SSIM, the worst pixel of 255.\n\
         ~ cannot be told from the default's time.\n\n",
        report.machine.processor, report.machine.cores, report.machine.isa, report.views, report.repeats,
    );
    let head = [
        "one knob at a time",
        "decode ms",
        "picture ms",
        "PSNR",
        "MS-SSIM",
        "worst",
        "MB at most",
    ];
    let mut rows = vec![head.map(String::from).to_vec()];
    if report.ladder.iter().any(|row| row.cloud_psnr.is_some()) {
        rows[0].push("PSNR, cloud".into());
    }
    rows.extend(report.ladder.iter().map(line));
    text += &table(&rows);
    rows.truncate(1);
    rows[0][0] = "combinations that no other beats".into();
    let mut front: Vec<&Row> = report.combinations.iter().filter(|r| r.on_front).collect();
    front.sort_by(|a, b| a.total.median.total_cmp(&b.total.median));
    rows.extend(front.into_iter().map(line));
    text += "\n";
    text += &table(&rows);
    for (title, cases) in [
        ("renderer: worst of 255", &report.renderer_cases),
        ("network: worst of 255", &report.network_cases),
    ] {
        let settings = cases.first().map_or(&[][..], |case| &case.errors);
        let mut rows = vec![vec![title.to_owned()]];
        rows[0].extend(settings.iter().map(|error| error.setting.clone()));
        for case in cases {
            let mut row = vec![case.name.clone()];
            row.extend(case.errors.iter().map(|error| format!("{:.2}", error.worst)));
            rows.push(row);
        }
        text += "\n";
        text += &table(&rows);
    }
    let head = ["effect", "scene", "called for", "off ms", "on ms", "worst"];
    let mut rows = vec![head.map(String::from).to_vec()];
    for cost in &report.effects {
        let same = if cost.verdict == Verdict::Same { "~" } else { "" };
        rows.push(vec![
            cost.effect.clone(),
            cost.scene.clone(),
            if cost.called_for { "yes" } else { "no" }.into(),
            format!("{:.1}", cost.off.median),
            format!("{same}{:.1}", cost.on.median),
            format!("{:.2}", cost.worst),
        ]);
    }
    text += "\n";
    text += &table(&rows);
    text
}

fn line(row: &Row) -> Vec<String> {
    let time = |spread: Spread, verdict| {
        let same = if verdict == Verdict::Same { "~" } else { "" };
        format!("{same}{:.1}", spread.median)
    };
    let mut cells = vec![
        row.name(),
        time(row.decode, row.decode_verdict),
        time(row.picture, row.picture_verdict),
        row.psnr.map_or("equal".into(), |db| format!("{db:.1}")),
        row.ms_ssim.map_or("-".into(), |s| format!("{s:.5}")),
        format!("{:.2}", row.worst),
        (row.most_memory / 1_000_000).to_string(),
    ];
    cells.extend(row.cloud_psnr.map(|db| format!("{db:.2}")));
    cells
}

/// Lays rows out in columns, the first to the left, the others to the right.
fn table(rows: &[Vec<String>]) -> String {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |c: usize| {
        let cells = rows.iter().filter_map(|row| row.get(c));
        cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let mut text = String::new();
    for row in rows {
        let mut line = String::new();
        for (c, cell) in row.iter().enumerate() {
            let gap = " ".repeat(widths[c] - cell.chars().count());
            line += &match c {
                0 => format!("{cell}{gap}"),
                _ => format!("  {gap}{cell}"),
            };
        }
        text += line.trim_end();
        text.push('\n');
    }
    text
}
