//! `b2p-lab eval`

use std::path::{Path, PathBuf};

use b2p::Limits;
use b2p::cloud::PointCloud;
use b2p::gaussians::Frame;
use b2p::gaussians::Heads;
use b2p::latents::network::Model;

use super::load_mesh;
use crate::error::{LabError, Result};
use crate::eval::item::{self, Content, Item};
use crate::eval::picture::Picture;
use crate::eval::protocol::{Truth, VIEWS};
use crate::eval::report::{Report, Row};
use crate::eval::sheet::{SheetRow, contact_sheet};
use crate::eval::{Bench, Entry};
use crate::sample::{Grid, write_bytes};
use crate::surface::Surface;

/// Judge streams and point clouds by pictures of the mesh they came from
///
/// Every item is drawn from twelve cameras and compared with the mesh: PSNR over whole pictures and over the
/// foreground, MS-SSIM, SSIMULACRA2. Point clouds are drawn as squares (the best of three sizes), as one round Gaussian
/// a point (of four), and as wide and slim surfels (of eight). With a cloud and a model but no stream among the items, the cloud is
/// coded first.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Streams (.b2p), or point clouds on the voxel grid or Gaussians (.ply, .ply.zst): [NAME=]PATH[@BPP]
    #[arg(value_name = "ITEM")]
    items: Vec<Item>,
    /// The truth: a self-contained binary glTF, or procedural:NAME
    #[arg(long, value_name = "MESH.glb")]
    mesh: PathBuf,
    /// The finest cloud: tells where the mesh lies on the grid, and over how many points bits are counted
    #[arg(long, value_name = "CLOUD.ply")]
    cloud: Option<PathBuf>,
    /// The model to code and decode streams with [default: the one inside the program]
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// The model's heads that decode streams: best, or quick if it has them
    #[arg(long, value_name = "NAME", default_value_t = Heads::Best)]
    heads: Heads,
    /// Octree levels to decode streams to [default: all that the model can draw]
    #[arg(long, value_name = "M,…", value_delimiter = ',')]
    levels: Option<Vec<u8>>,
    /// Bit depth of the grid, where the cloud does not tell
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u8).range(1..=21))]
    bits: u8,
    /// The share of the cube's side that the mesh's longest side spans, where the cloud does not tell
    #[arg(long, default_value_t = 0.95)]
    fill: f64,
    /// Judge nothing but the items: do not code the cloud
    #[arg(long, requires = "items")]
    items_only: bool,
    /// A folder for the table, all scores as JSON, and a sheet of pictures
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// The views on the sheet, by azimuth: multiples of 30 degrees
    #[arg(long, value_name = "DEG,…", value_delimiter = ',', default_values_t = [0, 90, 180, 270], value_parser = azimuth)]
    columns: Vec<u32>,
}

fn azimuth(text: &str) -> Result<u32, String> {
    let step = 360 / VIEWS as u32;
    match text.parse() {
        Ok(degrees) if degrees < 360 && degrees % step == 0 => Ok(degrees),
        _ => Err(format!("expected a multiple of {step} below 360")),
    }
}

impl Args {
    /// Draws, compares, writes.
    ///
    /// # Errors
    /// If a file cannot be read or written, or the mesh is not seen.
    pub fn run(self) -> Result<()> {
        let limits = Limits::default();
        let surface = Surface::new(&load_mesh(&self.mesh)?);
        let cloud = match &self.cloud {
            Some(path) => Some(item::read_cloud(path, &limits)?),
            None => None,
        };
        let frame = self.frame(&surface, cloud.as_ref())?;
        let mut items = Vec::new();
        for Item { name, path, bpp } in &self.items {
            items.push((name.clone(), item::open(path, &limits)?, *bpp));
        }
        let streams = items.iter().any(|(_, c, _)| matches!(c, Content::Stream(_)));
        let code = cloud.is_some() && !streams && !self.items_only;
        let mut bench = Bench::new(&surface, frame)?;
        if let Some(cloud) = cloud {
            bench = bench.with_cloud(cloud)?;
        }
        let model = match &self.model {
            Some(path) => Model::open(path)?,
            None => Model::from_bytes(b2p::embedded::model())?,
        };
        bench = bench.with_model(model, self.levels.clone()).with_heads(self.heads);
        if code {
            let stream = bench.encode()?;
            if let Some(folder) = &self.output {
                self.write(folder, "cloud.b2p", &stream)?;
            }
            items.insert(0, ("b2p".to_owned(), Content::Stream(stream), None));
        }
        if items.is_empty() {
            let what = "nothing to judge: name items, or a cloud and a model";
            return Err(LabError::Usage(what.into()));
        }
        let mut entries = Vec::new();
        for (name, content, bpp) in items {
            eprintln!("{name}");
            entries.extend(bench.judge(&name, content, bpp)?);
        }
        let report = Report {
            mesh: self.mesh.display().to_string(),
            bits: frame.bits,
            points: bench.points(),
            rows: entries.iter().map(|e| e.row.clone()).collect(),
        };
        print!("{}", report.to_markdown());
        if let Some(folder) = &self.output {
            let failed = |e| LabError::Usage(format!("the report cannot be JSON: {e}"));
            let json = report.to_json().map_err(failed)?;
            self.write(folder, "scores.md", report.to_markdown().as_bytes())?;
            self.write(folder, "scores.json", json.as_bytes())?;
            self.write(folder, "sheet.png", &self.sheet(bench.truth(), &entries).to_png()?)?;
        }
        Ok(())
    }

    /// Where the cube lies around the mesh: as the cloud's comments say, else as the sampler would put it.
    fn frame(&self, surface: &Surface, cloud: Option<&PointCloud>) -> Result<Frame> {
        let hints = cloud.map(|c| c.hints).unwrap_or_default();
        let bits = hints.bits.unwrap_or(self.bits);
        if let Some(placement) = hints.placement {
            return Ok(Frame { bits, placement });
        }
        let placement = Grid::fit(surface.bounds(), bits, self.fill)?.placement();
        Ok(Frame { bits, placement })
    }

    fn write(&self, folder: &Path, name: &str, bytes: &[u8]) -> Result<()> {
        std::fs::create_dir_all(folder).map_err(LabError::io(folder))?;
        write_bytes(&folder.join(name), bytes)
    }

    fn sheet(&self, truth: &Truth, entries: &[Entry]) -> Picture {
        let step = 360 / VIEWS as u32;
        let row = |label: String, pictures: Vec<_>| SheetRow {
            label,
            pictures: self.columns.iter().map(|c| pictures[(c / step) as usize]).collect(),
        };
        let mut rows = vec![row("truth".into(), truth.pictures().collect())];
        for entry in entries {
            rows.push(row(label(&entry.row), entry.pictures.iter().collect()));
        }
        contact_sheet(&rows, truth.extent())
    }
}

fn label(row: &Row) -> String {
    let rate = match &row.rate {
        Some(rate) => format!(", {:.3} bpp", rate.total),
        None => String::new(),
    };
    let Row {
        name, drawn, scores, ..
    } = row;
    format!(
        "{name}, {drawn}{rate}: {:.2} dB, foreground {:.2} dB",
        scores.psnr, scores.foreground_psnr
    )
}
