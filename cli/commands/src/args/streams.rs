//! Arguments of the commands that look into streams, cut, join and upgrade them.

use std::path::PathBuf;

use b2p::encoder::transform::QualityTarget;
use clap::Args;

use super::{ModelArg, Output};
use crate::values::{frames, step};

#[derive(Debug, Args)]
pub struct Info {
    /// Stream to describe. `-`: standard input
    #[arg(value_name = "IN")]
    pub input: PathBuf,
    /// Model file to look for the stream's model in [default: the program's own]
    #[arg(long, value_name = "FILE")]
    pub model: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub struct Check {
    /// Streams to check to the last bit. `-`: standard input
    #[arg(value_name = "STREAM", required = true)]
    pub inputs: Vec<PathBuf>,
    /// Model of learned streams [default: the program's own]
    #[arg(long, value_name = "FILE")]
    pub model: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub struct Cut {
    /// Stream to cut. `-`: standard input
    #[arg(value_name = "IN")]
    pub input: PathBuf,
    #[command(flatten)]
    pub output: Output,
    /// Last level to keep of a stream
    #[arg(
        long,
        value_name = "M",
        required_unless_present = "frames",
        conflicts_with = "frames"
    )]
    pub level: Option<u8>,
    /// Frames to keep of a sequence, from A to before B: whole groups
    #[arg(long, value_name = "A..B", value_parser = frames)]
    pub frames: Option<std::ops::Range<u64>>,
}

#[derive(Debug, Args)]
pub struct Join {
    /// Sequences on one grid, in order
    #[arg(value_name = "IN", required = true, num_args = 1..)]
    pub inputs: Vec<PathBuf>,
    /// File to write; `-`: standard output
    #[arg(short, long, value_name = "OUT")]
    pub output: PathBuf,
}

#[derive(Debug, Args)]
pub struct Upgrade {
    /// Stream of version 2. `-`: standard input
    #[arg(value_name = "IN")]
    pub input: PathBuf,
    #[command(flatten)]
    pub output: Output,
    /// Quantisation steps of the finest level's luma and chroma in 255ths, 0.5 to 1000 [default: 20]
    #[arg(long, value_name = "LUMA[,CHROMA]", value_parser = step, conflicts_with = "lossless")]
    pub step: Option<QualityTarget>,
    /// Code the colours that the voxels are drawn in exactly, in 8 bits
    #[arg(long)]
    pub lossless: bool,
    #[command(flatten)]
    pub model: ModelArg,
}
