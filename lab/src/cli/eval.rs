//! `b2p-lab eval`

use std::path::{Path, PathBuf};

use b2p::Limits;
use b2p::cloud::{PointCloud, voxelise};
use b2p::gaussians::Frame;
use b2p::placement::Placement;

use super::load_mesh;
use crate::error::{LabError, Result};
use crate::eval::item::{self, Content, Item};
use crate::eval::points::Points;
use crate::eval::protocol::{Truth, VIEWS};
use crate::eval::report::{Rate, Report, Row};
use crate::eval::sheet::{SheetRow, contact_sheet};
use crate::eval::{Drawn, judge_cloud, judge_gaussians};
use crate::sample::Grid;
use crate::surface::Surface;

/// Judge streams and point clouds by pictures of the mesh they came from
///
/// Every item is drawn from twelve cameras and compared with the mesh: PSNR over whole pictures and over the foreground, MS-SSIM,
/// SSIMULACRA2. Point clouds are drawn as squares (the best of three sizes) and as one round Gaussian a point.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Point clouds on the voxel grid or Gaussians, both as PLY, or PLY in zstd: [NAME=]PATH[@BPP]
    #[arg(value_name = "ITEM", required = true)]
    items: Vec<Item>,
    /// The truth: a self-contained binary glTF, or procedural:NAME
    #[arg(long, value_name = "MESH.glb")]
    mesh: PathBuf,
    /// The finest cloud: tells where the mesh lies on the grid, and over how many points bits are counted
    #[arg(long, value_name = "CLOUD.ply")]
    cloud: Option<PathBuf>,
    /// Bit depth of the grid, where the cloud does not tell
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u8).range(1..=21))]
    bits: u8,
    /// The share of the cube's side that the mesh's longest side spans, where the cloud does not tell
    #[arg(long, default_value_t = 0.95)]
    fill: f64,
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
        let points = match &cloud {
            Some(cloud) => Some(voxelise(cloud, Some(frame.bits))?.voxels.len() as u64),
            None => None,
        };
        let in_cube = |p: [f32; 3]| frame.placement.to_cube(frame.bits, p.map(f64::from));
        let truth = Truth::new(&surface.map(in_cube))?;
        let mut report = Report {
            mesh: self.mesh.display().to_string(),
            bits: frame.bits,
            points,
            rows: Vec::new(),
        };
        let mut drawn = Vec::new();
        for item in &self.items {
            eprintln!("{}", item.name);
            let found = match item::open(&item.path, &limits)? {
                Content::Cloud(coded) => {
                    let points = Points::on_grid(&coded, frame.bits, cloud.as_ref());
                    judge_cloud(&truth, &points, frame)?.into()
                }
                Content::Gaussians(gaussians) => {
                    vec![judge_gaussians(&truth, gaussians, "Gaussians", frame)?]
                }
            };
            report.rows.extend(found.iter().map(|one| row(item, one)));
            drawn.extend(found);
        }
        print!("{}", report.to_markdown());
        match &self.output {
            Some(folder) => self.write(folder, &report, &truth, &drawn),
            None => Ok(()),
        }
    }

    /// Where the cube lies around the mesh: as the cloud's comments say, else as the sampler would put it.
    fn frame(&self, surface: &Surface, cloud: Option<&PointCloud>) -> Result<Frame> {
        let hints = cloud.map(|c| c.hints).unwrap_or_default();
        let bits = hints.bits.unwrap_or(self.bits);
        if let Some(placement) = hints.placement {
            return Ok(Frame { bits, placement });
        }
        let grid = Grid::fit(surface.bounds(), bits, self.fill)?;
        let placement = Placement {
            origin: std::array::from_fn(|i| grid.origin[i] - grid.shift[i] * grid.unit),
            voxel_size: grid.unit,
        };
        Ok(Frame { bits, placement })
    }

    fn write(&self, folder: &Path, report: &Report, truth: &Truth, drawn: &[Drawn]) -> Result<()> {
        std::fs::create_dir_all(folder).map_err(LabError::io(folder))?;
        let write =
            |name: &str, bytes: &[u8]| crate::sample::write_bytes(&folder.join(name), bytes);
        write("scores.md", report.to_markdown().as_bytes())?;
        let json = report.to_json();
        let failed = |e| LabError::Usage(format!("the report cannot be written as JSON: {e}"));
        write("scores.json", json.map_err(failed)?.as_bytes())?;
        let step = 360 / VIEWS as u32;
        let chosen = |pictures: Vec<_>| -> Vec<_> {
            self.columns
                .iter()
                .map(|c| pictures[(c / step) as usize])
                .collect()
        };
        let mut rows = vec![SheetRow {
            label: "truth".into(),
            pictures: chosen(truth.pictures().collect()),
        }];
        for (row, one) in report.rows.iter().zip(drawn) {
            rows.push(SheetRow {
                label: label(row),
                pictures: chosen(one.judged.pictures.iter().collect()),
            });
        }
        write("sheet.png", &contact_sheet(&rows, truth.extent()).to_png()?)
    }
}

fn row(item: &Item, drawn: &Drawn) -> Row {
    Row {
        name: item.name.clone(),
        drawn: drawn.how.clone(),
        level: None,
        rate: item.bpp.map(|total| Rate {
            total,
            levels: Vec::new(),
        }),
        primitives: drawn.primitives,
        scores: drawn.judged.mean,
        views: drawn.judged.views.clone(),
    }
}

fn label(row: &Row) -> String {
    let rate = match &row.rate {
        Some(rate) => format!(", {:.3} bpp", rate.total),
        None => String::new(),
    };
    let Row {
        name,
        drawn,
        scores,
        ..
    } = row;
    format!(
        "{name}, {drawn}{rate}: {:.2} dB, foreground {:.2} dB",
        scores.psnr, scores.foreground_psnr
    )
}
