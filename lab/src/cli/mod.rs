//! The program's subcommands.

pub mod animate;
pub mod capture;
pub mod closeup;
pub mod dataset;
pub mod eval;
pub mod eval_sequence;
pub mod occupancy;
pub mod scene;
pub mod tradeoff;
pub mod voxelize;

use std::path::Path;

use clap::{Parser, Subcommand};

use crate::error::{LabError, Result};
use crate::mesh::{Mesh, glb};
use crate::procedural;

/// The laboratory of b2p: mesh to cloud, training sets, evaluation.
#[derive(Debug, Parser)]
#[command(name = "b2p-lab", version, arg_required_else_help = true)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Animate(animate::Args),
    Voxelize(voxelize::Args),
    Capture(capture::Args),
    Closeup(closeup::Args),
    Dataset(dataset::Args),
    Scene(scene::Args),
    Eval(eval::Args),
    EvalSequence(eval_sequence::Args),
    Occupancy(occupancy::Args),
    Tradeoff(tradeoff::Args),
}

impl Cli {
    /// Does what the arguments say.
    ///
    /// # Errors
    /// Whatever the subcommand fails with.
    pub fn run(self) -> Result<()> {
        match self.command {
            Command::Animate(args) => args.run(),
            Command::Voxelize(args) => args.run(),
            Command::Capture(args) => args.run(),
            Command::Closeup(args) => args.run(),
            Command::Dataset(args) => args.run(),
            Command::Scene(args) => args.run(),
            Command::Eval(args) => args.run(),
            Command::EvalSequence(args) => args.run(),
            Command::Occupancy(args) => args.run(),
            Command::Tradeoff(args) => args.run(),
        }
    }
}

/// The mesh of a `.glb` file, or the one that `procedural:NAME` names.
fn load_mesh(path: &Path) -> Result<Mesh> {
    match path.to_str() {
        Some(name) if name.starts_with(procedural::PREFIX) => {
            procedural::named(name).ok_or_else(|| LabError::Usage(format!("there is no mesh called {name}")))
        }
        _ => glb::load(path),
    }
}
