//! `b2p-lab scene`

use std::path::PathBuf;

use crate::error::Result;
use crate::procedural;
use crate::sample::{Grid, Sampler, write_ply};
use crate::scatter;
use crate::surface::Surface;

/// Make the demo's still life, as a voxelised coloured cloud (PLY); or with --objects a large one: meshes placed many times
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Meshes that are placed by turns with --objects: self-contained binary glTF, or procedural:NAME
    meshes: Vec<PathBuf>,
    /// Place so many objects at random poses, in cells of 2^BITS voxels a side
    #[arg(long, value_name = "N", requires = "meshes")]
    objects: Option<u32>,
    /// With --objects, the share of the evaluation's number of samples
    #[arg(long, default_value_t = 1.0)]
    density: f64,
    /// With --objects, which poses
    #[arg(long, default_value_t = 0)]
    seed: u64,
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
        if let Some(count) = self.objects {
            return self.scatter(count);
        }
        let surface = Surface::new(&procedural::scene());
        let grid = Grid::fit(surface.bounds(), self.bits, self.fill)?;
        let cloud = Sampler::new(&surface, grid, self.points, 0)?.cloud(None);
        write_ply(&self.output, &cloud, &grid)?;
        eprintln!("{}: {} voxels", self.output.display(), cloud.keys.len());
        Ok(())
    }

    /// Places meshes many times.
    fn scatter(self, count: u32) -> Result<()> {
        let surface = |path: &PathBuf| Ok(Surface::new(&super::load_mesh(path)?));
        let surfaces = self.meshes.iter().map(surface).collect::<Result<Vec<_>>>()?;
        let options = scatter::Options {
            count,
            bits: self.bits,
            density: self.density,
            seed: self.seed,
        };
        let (points, bits) = scatter::write(&self.output, &surfaces, &options)?;
        eprintln!("{}: {points} points at {bits} bits", self.output.display());
        Ok(())
    }
}
