//! `b2p-lab scene`

use std::path::PathBuf;

use crate::error::Result;
use crate::procedural;
use crate::sample::{Grid, Sampler, write_ply};
use crate::surface::Surface;

/// Make the demo's still life, as a voxelised coloured cloud (PLY)
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The cloud to write
    #[arg(short, long, value_name = "SCENE.ply")]
    output: PathBuf,
    /// Bit depth: the cube has 2^BITS voxels a side
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u8).range(1..=21))]
    bits: u8,
    /// The share of the cube's side that the scene's height spans
    #[arg(long, default_value_t = 0.75)]
    fill: f64,
    /// How many points to draw
    #[arg(long, default_value_t = 15_000_000)]
    points: u64,
}

impl Args {
    /// Makes, samples, writes.
    ///
    /// # Errors
    /// If the cloud cannot be written.
    pub fn run(self) -> Result<()> {
        let surface = Surface::new(&procedural::scene());
        let grid = Grid::fit(surface.bounds(), self.bits, self.fill)?;
        let cloud = Sampler::new(&surface, grid, self.points, 0)?.cloud(None);
        write_ply(&self.output, &cloud, &grid)?;
        eprintln!("{}: {} voxels", self.output.display(), cloud.keys.len());
        Ok(())
    }
}
