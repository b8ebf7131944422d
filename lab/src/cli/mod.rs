//! The program's subcommands.

pub mod dataset;
pub mod voxelize;

use clap::{Parser, Subcommand};

use crate::error::Result;

/// The laboratory of b2p: mesh to cloud, training sets, evaluation.
#[derive(Debug, Parser)]
#[command(name = "b2p-lab", version, arg_required_else_help = true)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Voxelize(voxelize::Args),
    Dataset(dataset::Args),
}

impl Cli {
    /// Does what the arguments say.
    ///
    /// # Errors
    /// Whatever the subcommand fails with.
    pub fn run(self) -> Result<()> {
        match self.command {
            Command::Voxelize(args) => args.run(),
            Command::Dataset(args) => args.run(),
        }
    }
}
