//! What can be asked of the program: global options, commands, and what several commands share.

use std::path::{Path, PathBuf};

use b2p::gaussians::HeadSet;
use clap::{Args, Parser, Subcommand, ValueEnum};

use super::many::Files;
use super::plan::Plan;
pub use super::values::Orbit;
use super::values::per_voxel;

mod convert;
mod decode;
mod encode;
mod limits;
mod render;
mod streams;
mod tools;

pub use convert::{Convert, OutFormat};
pub use decode::Decode;
pub use encode::{Colours, Encode};
pub use limits::LimitArgs;
pub use render::{Format, Render, Show};
pub use streams::{Check, Cut, Info, Join, Upgrade};
pub use tools::{Bench, Demo, Serve};

/// Coloured point clouds as small streams, decoded to 3D Gaussians and pictures on a plain CPU.
#[derive(Debug, Parser)]
#[command(name = "b2p", version, about, max_term_width = 110)]
pub struct Cli {
    /// Threads to use, at most 1024 [default: one per core]
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub threads: Option<u16>,

    /// Print results, warnings and errors, but no reports
    #[arg(short, long, global = true)]
    pub quiet: bool,

    /// Say more: the time of each step, effects and their reasons
    #[arg(short, long, global = true)]
    pub verbose: bool,

    /// Overwrite existing files. Without it the program asks on a terminal, and refuses elsewhere
    #[arg(short, long, global = true)]
    pub force: bool,

    /// Print JSON to standard output instead of a report
    #[arg(long, global = true)]
    pub json: bool,

    /// Colours of messages
    #[arg(long, global = true, value_enum, value_name = "WHEN", default_value_t = Colour::Auto)]
    pub color: Colour,

    #[command(flatten)]
    pub limits: LimitArgs,

    #[command(subcommand)]
    pub command: Command,
}

/// When messages have colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Colour {
    /// On a terminal, unless NO_COLOR is set
    Auto,
    /// Always
    Always,
    /// Never
    Never,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Code coloured point clouds into streams: PLY, LAS, LAZ, PCD, E57, XYZ, CSV, OBJ, glTF or GLB, recognised by
    /// content. Several clouds into one file, or a name such as `frame_%04d.ply`: the frames of a sequence
    Encode(Encode),
    /// Decode streams to 3D Gaussians
    Decode(Decode),
    /// Convert Gaussians or points from one file format to another
    Convert(Convert),
    /// Draw streams, Gaussians in any format that `convert` reads, or point clouds into pictures: .png, .ppm, .exr, or
    /// .y4m for a video; sequences also into .gif, .webp and .apng. Of several pictures a number is put before the ending
    Render(Render),
    /// Show streams, sequences, Gaussians and point clouds in a window, or in the terminal
    #[cfg(feature = "view")]
    View(crate::view::View),
    /// Play sequences in a window, or in the terminal: `view` under another name
    #[cfg(feature = "view")]
    Play(crate::view::View),
    /// Say what a stream holds
    Info(Info),
    /// Say whether streams are valid, and where not, which clause of the format they break
    Check(Check),
    /// Turn a stream of version 2 into one of version 3, which needs no model
    Upgrade(Upgrade),
    /// Cut a stream after a level, or a sequence between groups of frames
    Cut(Cut),
    /// Plan a job of many files for a render farm or a cluster: Open Job Description, Slurm or Ray
    Plan(Plan),
    /// Join sequences, one after the other, without coding anything again
    Join(Join),
    /// Show streams and Gaussians in a web page, drawn by the browser without a GPU
    Serve(Serve),
    /// Decode and draw the sample that comes with the program
    Demo(Demo),
    /// Time the stages of decoding
    Bench(Bench),
    /// Print completions of command lines for a shell
    Completions(crate::paperwork::Completions),
    /// Write the manual, a page for each command
    Man(crate::paperwork::Manual),
}

impl Command {
    /// The files of commands that take many.
    pub fn files(&self) -> Option<&Files> {
        match self {
            Command::Encode(args) => Some(&args.files),
            Command::Decode(args) => Some(&args.files),
            Command::Render(args) => Some(&args.files),
            _ => None,
        }
    }
}

/// Where the output goes.
#[derive(Debug, Args)]
#[group(required = true, multiple = false)]
pub struct Output {
    /// File to write; `-`: standard output
    #[arg(value_name = "OUT")]
    to: Option<PathBuf>,
    /// The same as an option
    #[arg(short, long = "output", value_name = "OUT")]
    output: Option<PathBuf>,
}

impl std::ops::Deref for Output {
    type Target = Path;

    fn deref(&self) -> &Path {
        let given = self.to.as_deref().or(self.output.as_deref());
        // The parser requires one.
        given.unwrap_or(Path::new(""))
    }
}

/// Which of the Gaussians that a stream can be decoded to.
#[derive(Debug, Args)]
pub struct DetailArg {
    /// Octree level to decode to [default: the finest with Gaussians; to draw, the finest that can be seen]
    #[arg(long, value_name = "M")]
    pub level: Option<u8>,
    /// Heads that make Gaussians: best; quick, less accurate in a fraction of the time; or surfels, which need no model
    /// file (learned streams have none) [default: the best there are]
    #[arg(long, value_name = "NAME")]
    pub heads: Option<HeadSet>,
    /// Gaussians that heads make of a voxel of streams of version 3: 1 or 8, of surfels 1 or 4 [default: 1 from level
    /// N−1 on, else more]
    #[arg(long, help_heading = "Advanced", value_name = "N", value_parser = per_voxel)]
    pub per_voxel: Option<usize>,
}

#[derive(Debug, Clone, Args)]
pub struct ModelArg {
    /// Model file: of learned streams the model that they were coded with [default: the program's own], of
    /// others heads
    #[arg(long, help_heading = "Advanced", value_name = "FILE")]
    pub model: Option<PathBuf>,
    /// Use at most this instruction set: scalar, avx2, avxvnni, avx512, amx, neon, dotprod [default: B2P_ISA, or the
    /// best of this machine]
    #[arg(long, help_heading = "Advanced", value_name = "NAME")]
    pub isa: Option<String>,
    /// Generate Gaussians in int16 (the same bits everywhere), f16, or half (f16 with sums in f16 too, on processors
    /// that have them) [default: int16 if the model has it]
    #[arg(long, help_heading = "Advanced", value_name = "NAME")]
    pub precision: Option<String>,
}

/// A frame of a sequence.
#[derive(Debug, Args)]
#[command(next_help_heading = "Sequences")]
pub struct FrameArgs {
    /// Frame of a sequence, from 0
    #[arg(long, value_name = "N", conflicts_with = "time")]
    frame: Option<u64>,
    /// The frame that is shown at this time, in seconds
    #[arg(long, value_name = "SECONDS")]
    time: Option<f64>,
}

impl FrameArgs {
    /// The frame that was asked for.
    pub fn frame(&self, sequence: &b2p::SequenceReader) -> Option<b2p::Result<u64>> {
        let by_time = || self.time.map(|time| sequence.frame_at(time));
        self.frame.map(Ok).or_else(by_time)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }
}
