//! `b2p-lab capture`

use std::path::PathBuf;

use b2p::geometry::morton;

use crate::capture::{Capture, Kind, Options, capture};
use crate::error::Result;
use crate::sample::{Grid, Sampled, write_ply};
use crate::surface::Surface;

/// Simulate the capture of a textured mesh by an instrument: a cloud with holes, noise and uneven density (PLY)
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The mesh: self-contained binary glTF, or procedural:NAME
    mesh: PathBuf,
    /// The cloud to write, in the mesh's space
    #[arg(short, long, value_name = "CLOUD.ply")]
    output: PathBuf,
    /// The instrument
    #[arg(long, value_enum)]
    kind: Kind,
    /// About how many points
    #[arg(long, default_value_t = 300_000, value_parser = clap::value_parser!(u64).range(1..=100_000_000))]
    points: u64,
    /// Everything random follows from it
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Noise over that of the instrument: 0 leaves geometry exact
    #[arg(long, default_value_t = 1.0, value_parser = noise)]
    noise: f64,
    /// Also write the points' voxels on the grid that `voxelize` gives the mesh, for codecs that need integers
    #[arg(long, value_name = "VOXELS.ply")]
    voxels: Option<PathBuf>,
    /// Bit depth of those voxels
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u8).range(1..=21), requires = "voxels")]
    bits: u8,
}

fn noise(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(noise) if (0.0..=100.0).contains(&noise) => Ok(noise),
        _ => Err("expected a number from 0 to 100".into()),
    }
}

impl Args {
    /// Reads, captures, writes.
    ///
    /// # Errors
    /// If the mesh cannot be read or has no extent, or a cloud cannot be written.
    pub fn run(self) -> Result<()> {
        let surface = Surface::new(&super::load_mesh(&self.mesh)?);
        let options = Options {
            kind: self.kind,
            points: self.points,
            seed: self.seed,
            noise: self.noise,
        };
        let captured = capture(&surface, &options)?;
        if let Some(path) = &self.voxels {
            let grid = Grid::fit(surface.bounds(), self.bits, 0.95)?;
            write_ply(path, &voxels(&captured, &grid), &grid)?;
        }
        captured.write_ply(&self.output)?;
        eprintln!("{}: {} points", self.output.display(), captured.positions.len());
        Ok(())
    }
}

/// The voxels that hold points, with their points' mean colours. Points outside of the grid are left out.
fn voxels(captured: &Capture, grid: &Grid) -> Sampled {
    let end = f64::from(1u32 << grid.bits);
    let mut points: Vec<(u64, [u8; 3])> = captured
        .positions
        .iter()
        .zip(&captured.rgb)
        .filter_map(|(&position, &rgb)| {
            let place = grid.coordinate(position);
            let inside = place.iter().all(|x| (0.0..end).contains(x));
            inside.then(|| (morton::encode(place.map(|x| x as u32)), rgb))
        })
        .collect();
    points.sort_unstable();
    let mut sampled = Sampled::default();
    for same in points.chunk_by(|a, b| a.0 == b.0) {
        let mean = |c: usize| {
            let sum: usize = same.iter().map(|(_, rgb)| usize::from(rgb[c])).sum();
            ((sum + same.len() / 2) / same.len()) as u8
        };
        sampled.keys.push(same[0].0);
        sampled.rgb.push([mean(0), mean(1), mean(2)]);
    }
    sampled
}
