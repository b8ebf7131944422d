//! `b2p-lab eval-sequence`

use std::path::PathBuf;

use b2p::gaussians::HeadSet;
use b2p::renderer::camera::Camera;

use crate::error::{LabError, Result};
use crate::eval::item::Item;
use crate::eval::protocol::SIDE;
use crate::eval::sequence::{self, Coded, SequenceReport};
use crate::motion::Sequence;
use crate::sample::write_bytes;

/// Judge sequences by pictures of the posed meshes that they came from, from a camera that stands still
///
/// PSNR over whole pictures, over the foreground and inside the silhouette; the same of frame-to-frame differences
/// inside; SSIMULACRA2, its mean and its worst frame.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// One file a frame: a folder, or a pattern such as out/frame_%04d.b2p; streams, Gaussians or clouds: [NAME=]PATH[@BPP]
    #[arg(required = true, value_name = "ITEM")]
    items: Vec<Item>,
    /// The truth: what `animate` wrote, the folder or its sequence.json
    #[arg(long, value_name = "DIR")]
    truth: PathBuf,
    /// How many frames to judge, from the first on [default: all]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    frames: Option<u32>,
    /// The heads that decode streams
    #[arg(long, value_name = "NAME", default_value_t = HeadSet::Best)]
    heads: HeadSet,
    /// The octree level to decode streams to [default: the finest]
    #[arg(long)]
    level: Option<u8>,
    /// Azimuth, elevation (degrees) and distance of the camera
    #[arg(long, num_args = 3, value_names = ["AZ", "EL", "RADIUS"], default_values_t = [0.0, 0.0, 3.0], allow_hyphen_values = true)]
    camera: Vec<f64>,
    /// A folder for the table and all scores as JSON
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
}

impl Args {
    /// Draws, compares, writes.
    ///
    /// # Errors
    /// If a file cannot be read or written, frames are missing, or the mesh is not seen.
    pub fn run(self) -> Result<()> {
        let truth = Sequence::read(&self.truth)?;
        let motion = truth.source.open()?;
        let have = truth.frames.len();
        let frames = self.frames.map_or(have, |n| n as usize);
        if frames > have || frames == 0 {
            return Err(LabError::Usage(format!("the sequence has {have} frames, not {frames}")));
        }
        let [azimuth, elevation, radius] = [self.camera[0], self.camera[1], self.camera[2]];
        let camera = Camera::orbit(azimuth, elevation, radius, 45.0, 2 * SIDE, 2 * SIDE)?;
        let open = |item: &Item| Coded::open(item, frames, self.heads, self.level);
        let items: Vec<Coded> = self.items.iter().map(open).collect::<Result<_>>()?;
        let rows = sequence::judge(&truth, &motion, frames, &camera, items)?;
        let report = SequenceReport {
            truth: self.truth.display().to_string(),
            camera: [azimuth, elevation, radius],
            frames,
            rows,
        };
        print!("{}", report.to_markdown());
        if let Some(folder) = &self.output {
            std::fs::create_dir_all(folder).map_err(LabError::io(folder))?;
            write_bytes(&folder.join("sequence.md"), report.to_markdown().as_bytes())?;
            write_bytes(&folder.join("sequence.json"), report.to_json()?.as_bytes())?;
        }
        Ok(())
    }
}
