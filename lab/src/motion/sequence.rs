//! A recipe of a sequence: what moves, which frames, how they are sampled.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{Motion, Procedural};
use crate::error::{LabError, Result};
use crate::mesh::animated;
use crate::random::Random;
use crate::sample::{Grid, Sampled, Sampler, write_bytes};
use crate::surface::Surface;

/// The name of a recipe in the folder of its clouds.
pub const RECIPE: &str = "sequence.json";

/// Where a motion comes from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    /// An animated glTF file, and which of its animations, from 0.
    File {
        /// The file.
        path: PathBuf,
        /// The animation.
        animation: usize,
    },
    /// A motion made by code.
    Procedural(Procedural),
}

impl Source {
    /// Reads or makes it.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn open(&self) -> Result<Motion> {
        match self {
            Source::File { path, animation } => Ok(Motion::of_file(animated::load(path, *animation)?)),
            Source::Procedural(motion) => Ok(Motion::of_code(*motion)),
        }
    }
}

/// A [`Grid`] in a recipe.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GridRecipe {
    bits: u8,
    unit: f64,
    origin: [f64; 3],
    shift: [f64; 3],
}

/// A frame that was sampled.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameInfo {
    /// The file's name in the recipe's folder.
    pub file: String,
    /// Voxels of the cloud.
    pub voxels: u64,
}

/// Which frames of a motion are sampled, and how.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Sequence {
    /// What moves.
    pub source: Source,
    /// Seconds of the motion before frame 0.
    pub start: f64,
    /// Frames a second.
    pub fps: f64,
    /// Points drawn for each frame, before they are made voxels.
    pub points: u64,
    /// Standard deviation of the points' places, in voxels along each axis.
    pub noise: f64,
    /// Everything random follows from it.
    pub seed: u64,
    /// The grid of all frames.
    pub grid: GridRecipe,
    /// The frames.
    pub frames: Vec<FrameInfo>,
}

impl From<Grid> for GridRecipe {
    fn from(grid: Grid) -> Self {
        let Grid {
            bits,
            unit,
            origin,
            shift,
        } = grid;
        GridRecipe {
            bits,
            unit,
            origin,
            shift,
        }
    }
}

impl From<GridRecipe> for Grid {
    fn from(grid: GridRecipe) -> Self {
        let GridRecipe {
            bits,
            unit,
            origin,
            shift,
        } = grid;
        Grid {
            bits,
            unit,
            origin,
            shift,
        }
    }
}

impl Sequence {
    /// The grid of all frames.
    pub fn grid(&self) -> Grid {
        self.grid.into()
    }

    /// Seconds of the motion before frame `index`.
    pub fn time(&self, index: usize) -> f64 {
        self.start + index as f64 / self.fps
    }

    /// The surface of a frame: its truth.
    pub fn surface(&self, motion: &Motion, index: usize) -> Surface {
        motion.at(self.time(index))
    }

    /// The cloud of a frame, with points of its own.
    ///
    /// # Errors
    /// If the surface has no area.
    pub fn cloud(&self, motion: &Motion, index: usize) -> Result<Sampled> {
        let seed = Random::new(self.seed).fork(index as u64).bits();
        let surface = self.surface(motion, index);
        let sampler = Sampler::new(&surface, self.grid(), self.points, seed)?;
        Ok(sampler.with_noise(self.noise).cloud(None))
    }

    /// Reads a recipe, from its file or the folder that it is in.
    ///
    /// # Errors
    /// If it cannot be read, or does not say what a recipe must.
    pub fn read(path: &Path) -> Result<Self> {
        let path = match path.is_dir() {
            true => path.join(RECIPE),
            false => path.to_owned(),
        };
        let wrong = |what: String| LabError::Usage(format!("{}: {what}", path.display()));
        let bytes = std::fs::read(&path).map_err(LabError::io(&path))?;
        let sequence: Sequence = serde_json::from_slice(&bytes).map_err(|e| wrong(format!("no recipe: {e}")))?;
        sequence.check().map_err(wrong)?;
        Ok(sequence)
    }

    /// Writes the recipe.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<()> {
        let json = serde_json::to_string_pretty(self);
        let json = json.map_err(|e| LabError::Usage(format!("the recipe cannot be JSON: {e}")))?;
        write_bytes(path, (json + "\n").as_bytes())
    }

    fn check(&self) -> Result<(), String> {
        let grid = self.grid;
        if !(1..=b2p::geometry::morton::MAX_DEPTH).contains(&grid.bits) {
            return Err(format!("grid.bits is {}, expected 1 to 21", grid.bits));
        }
        let places = grid.origin.iter().chain(&grid.shift).all(|x| x.is_finite());
        if !(places && grid.unit > 0.0 && grid.unit.is_finite()) {
            return Err("the grid has no extent".into());
        }
        if !(self.fps > 0.0 && self.fps.is_finite() && self.start.is_finite()) {
            return Err(format!("fps is {}, expected above 0", self.fps));
        }
        if !(self.noise >= 0.0 && self.noise.is_finite()) {
            return Err(format!("noise is {}, expected 0 or more", self.noise));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recipe_is_read_as_it_was_written_and_a_wrong_one_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(RECIPE);
        let mut sequence = Sequence {
            source: Source::Procedural(Procedural::Cloth),
            start: 0.5,
            fps: 30.0,
            points: 1000,
            noise: 0.25,
            seed: 7,
            grid: Grid::unit(6).into(),
            frames: vec![FrameInfo {
                file: "frame_0000.ply".into(),
                voxels: 12,
            }],
        };
        sequence.write(&path).unwrap();
        assert_eq!(Sequence::read(folder.path()).unwrap(), sequence);
        assert_eq!(sequence.time(15), 1.0);
        sequence.fps = 0.0;
        sequence.write(&path).unwrap();
        assert!(Sequence::read(&path).unwrap_err().to_string().contains("fps"));
        std::fs::write(&path, "{}").unwrap();
        assert!(Sequence::read(&path).unwrap_err().to_string().contains("source"));
    }
}
