//! `b2p-lab dataset`

use std::path::PathBuf;

use indicatif::{ProgressBar, ProgressStyle};

use crate::dataset::{self, Object, Options};
use crate::error::Result;
use crate::triplanar;

/// Cut a training set from textured meshes
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Meshes, or folders of them
    #[arg(value_name = "MESH.glb|DIR")]
    inputs: Vec<PathBuf>,
    /// The folder to write samples to
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Add meshes of the project's own making; another seed makes others
    #[arg(long)]
    procedural: bool,
    /// A folder of photographs to project onto some of the objects
    #[arg(long, value_name = "DIR")]
    textures: Option<PathBuf>,
    /// How many samples
    #[arg(long, default_value_t = 360)]
    count: usize,
    /// Everything random follows from it
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Bit depth of the clouds that crops are cut from
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u8).range(4..=21))]
    bits: u8,
    /// Side of a crop in finest voxels: a power of two
    #[arg(long, default_value_t = 128)]
    crop: u32,
    /// Pictures per sample
    #[arg(long, default_value_t = 6)]
    views: usize,
    /// Pixels per side of a picture
    #[arg(long, default_value_t = 160)]
    size: u32,
    /// Samples per pixel and axis
    #[arg(long, default_value_t = 4)]
    supersampling: u32,
    /// The share of clouds with noise on their points and fewer of them, as captures have, 0 to 1
    #[arg(long, default_value_t = 0.0, value_parser = share)]
    noisy: f64,
}

fn share(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(share) if (0.0..=1.0).contains(&share) => Ok(share),
        _ => Err("expected a number from 0 to 1".into()),
    }
}

impl Args {
    /// Reads, cuts, writes.
    ///
    /// # Errors
    /// If a mesh or photograph cannot be read, or a sample cannot be written.
    pub fn run(self) -> Result<()> {
        let mut objects = Object::load_all(&self.inputs)?;
        if self.procedural {
            objects.extend(Object::procedural(self.seed));
        }
        let photos = match &self.textures {
            Some(folder) => triplanar::load_folder(folder)?,
            None => Vec::new(),
        };
        let options = Options {
            count: self.count,
            seed: self.seed,
            bits: self.bits,
            crop: self.crop,
            views: self.views,
            size: self.size,
            supersampling: self.supersampling,
            noisy: self.noisy,
        };
        // Hidden where the output is not a terminal.
        let bar = ProgressBar::new(self.count as u64).with_style(
            ProgressStyle::with_template("{bar:40} {pos}/{len} samples, {eta} left")
                .unwrap_or_else(|_| ProgressStyle::default_bar()),
        );
        let written = dataset::write(&self.output, &objects, &photos, &options, || bar.inc(1))?;
        bar.finish_and_clear();
        eprintln!("{}: {written} samples", self.output.display());
        Ok(())
    }
}
