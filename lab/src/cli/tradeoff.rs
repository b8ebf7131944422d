//! `b2p-lab tradeoff`: what accuracy costs in time on this machine.

use std::path::{Path, PathBuf};

use b2p::cloud::{ColouredVoxels, PointCloud, voxelise_closed};
use b2p::container::{MAGIC, version};
use b2p::encoder::transform;
use b2p::geometry::Voxels;
use b2p::log::Log;
use b2p::metrics::{Spread, Verdict};
use b2p::{Limits, embedded};

use crate::error::{LabError, Result};
use crate::procedural;
use crate::sample::{Grid, Sampler, write_bytes};
use crate::surface::Surface;
use crate::tradeoff::{self, MeasuredInput, Options, Origin, Report, Row, TruthKind};

/// Points that are drawn of a mesh, and the share of the cube that its longest side spans.
const POINTS: u64 = 15_000_000;
const FILL: f64 = 0.95;
/// The scene that the built-in sample was coded from.
const SCENE: &str = "procedural:scene";

/// Measure what accuracy costs in time on this machine: a table, JSON, a plot, and a page with all of them
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Stream to measure with, or cloud (PLY) or mesh (.glb, procedural:NAME) to be coded first, whose own pictures are
    /// then the truth [default: the sample that comes with the program, and the mesh that it was coded from]
    input: Option<PathBuf>,
    /// Mesh behind the input, .glb or procedural:NAME: its pictures are the truth
    #[arg(long, value_name = "MESH", requires = "input")]
    mesh: Option<PathBuf>,
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
    /// Model file: of a learned stream (version 2) the model, of others heads [default: the one inside the program]
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
}

/// A stream, and what it was made of.
struct Input {
    stream: Vec<u8>,
    surface: Option<Surface>,
    cloud: Option<ColouredVoxels>,
}

impl Args {
    /// Measures, prints a table, and writes it with all else into a folder.
    ///
    /// # Errors
    /// [`LabError::Io`], and those of [`tradeoff::run`].
    pub fn run(self) -> Result<()> {
        let limits = Limits::default();
        let mut input = self.input(&limits)?;
        if let Some(mesh) = &self.mesh {
            input.surface = Some(Surface::new(&super::load_mesh(mesh)?));
        }
        let file = match &self.model {
            Some(path) => read(path)?,
            None if version(&input.stream) == Some(2) => embedded::model().to_vec(),
            None => embedded::HEADS.to_vec(),
        };
        let mesh = input.surface.as_ref().map(Origin::Mesh);
        let subject = MeasuredInput {
            stream: &input.stream,
            model: &file,
            origin: mesh.or(input.cloud.as_ref().map(Origin::Cloud)),
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

impl Args {
    fn input(&self, limits: &Limits) -> Result<Input> {
        let Some(path) = &self.input else {
            return Ok(Input {
                stream: embedded::SCENE.to_vec(),
                surface: Some(Surface::new(&super::load_mesh(Path::new(SCENE))?)),
                cloud: None,
            });
        };
        let is_mesh = path.extension().is_some_and(|ending| ending == "glb")
            || path.to_str().is_some_and(|name| name.starts_with(procedural::PREFIX));
        if is_mesh {
            let surface = Surface::new(&super::load_mesh(path)?);
            let cloud = sampled(&surface)?;
            return Ok(Input {
                stream: coded(&cloud)?,
                surface: Some(surface),
                cloud: None,
            });
        }
        let bytes = read(path)?;
        if bytes.starts_with(&MAGIC) {
            return Ok(Input {
                stream: bytes,
                surface: None,
                cloud: None,
            });
        }
        let (cloud, _) = voxelise_closed(&PointCloud::from_ply(&bytes, limits)?)?;
        Ok(Input {
            stream: coded(&cloud)?,
            surface: None,
            cloud: Some(cloud),
        })
    }
}

/// A mesh as a cloud of 10 bits.
fn sampled(surface: &Surface) -> Result<ColouredVoxels> {
    let grid = Grid::fit(surface.bounds(), 10, FILL)?;
    let sampled = Sampler::new(surface, grid, POINTS, 0)?.cloud(None);
    Ok(ColouredVoxels {
        voxels: Voxels::from_sorted(grid.bits, sampled.keys),
        colours: sampled.rgb,
        placement: grid.placement(),
    })
}

/// The stream of a cloud, as the program codes it.
fn coded(cloud: &ColouredVoxels) -> Result<Vec<u8>> {
    let options = transform::Options::default();
    Ok(transform::encode(cloud, &options, &Log::default())?.bytes)
}

fn summary(report: &Report) -> String {
    let [width, height] = report.size;
    let truth = match report.truth {
        Some(TruthKind::Mesh) => "pictures of the mesh",
        Some(TruthKind::Cloud) => "pictures of the cloud, as surfels",
        None => "not at hand",
    };
    let mut text = format!(
        "{}, {} cores, {}; {} views of {width}×{height}, medians of {} repeats\n\
         Computation: PSNR in dB, MS-SSIM and the worst pixel of 255, against the finest level in double precision.\n\
         Truth: {truth}. ~ cannot be told from the default's time.\n\n",
        report.machine.processor, report.machine.cores, report.machine.isa, report.views, report.repeats,
    );
    let head = [
        "one knob at a time",
        "decode ms",
        "picture ms",
        "both ms",
        "computation",
        "MS-SSIM",
        "worst",
        "MB at most",
    ];
    let mut rows = vec![head.map(String::from).to_vec()];
    if report.truth.is_some() {
        rows[0].extend(["truth dB", "SSIMULACRA2"].map(String::from));
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
        format!("{:.1}", row.total.median),
        row.psnr.map_or("equal".into(), |db| format!("{db:.1}")),
        row.ms_ssim.map_or("-".into(), |s| format!("{s:.5}")),
        format!("{:.2}", row.worst),
        (row.most_memory / 1_000_000).to_string(),
    ];
    if let Some(truth) = row.truth {
        cells.push(format!("{:.2}", truth.psnr));
        cells.push(truth.ssimulacra2.map_or("-".into(), |score| format!("{score:.1}")));
    }
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
