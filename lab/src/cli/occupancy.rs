//! `b2p-lab occupancy`

use std::path::PathBuf;

use rayon::prelude::*;

use crate::error::Result;
use crate::occupancy::{Network, Samples, shapes, views};
use crate::random::Random;
use crate::sample::write_bytes;
use crate::surface::Surface;

/// Train the network that predicts octree occupancy (src/geometry/codec/weights.bin)
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Meshes to learn from: self-contained binary glTF, or procedural:NAME
    #[arg(required = true)]
    meshes: Vec<PathBuf>,
    /// The weights to write
    #[arg(short, long, value_name = "WEIGHTS.bin")]
    output: PathBuf,
    /// Steps of 2048 voxels
    #[arg(long, default_value_t = 60_000)]
    steps: u32,
    /// The first step's learning rate; the last one's is near zero
    #[arg(long, default_value_t = 0.004)]
    rate: f32,
    /// Which views, weights and draws
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

impl Args {
    /// Samples, trains, writes.
    ///
    /// # Errors
    /// If a mesh cannot be read or has no area, or the weights cannot be written.
    pub fn run(self) -> Result<()> {
        let random = Random::new(self.seed);
        let mut clouds = Vec::new();
        for (i, mesh) in self.meshes.iter().enumerate() {
            let surface = Surface::new(&super::load_mesh(mesh)?);
            clouds.extend(views(&surface, &mut random.fork(i as u64))?);
        }
        clouds.extend(shapes(2, &mut random.fork(u64::MAX)));
        let clouds: Vec<Samples> = clouds.into_par_iter().map(Samples::new).collect::<Result<_>>()?;
        let samples: usize = clouds.iter().map(Samples::len).sum();
        eprintln!("{} clouds, {samples} voxels", clouds.len());

        let mut network = Network::new(self.seed);
        let mut bits = 0.0;
        for step in 0..self.steps {
            let left = 1.0 - step as f32 / self.steps as f32;
            bits += network.step(&clouds, self.rate * left);
            if (step + 1) % 1000 == 0 {
                eprintln!("step {}: {:.4} bits per voxel", step + 1, bits / 1000.0);
                bits = 0.0;
                write_bytes(&self.output, &network.weights())?;
            }
        }
        write_bytes(&self.output, &network.weights())
    }
}
