//! Arguments of `serve`, `demo` and `bench`.

use std::net::IpAddr;
use std::path::PathBuf;

use b2p::renderer::Quality;
use clap::Args;

use super::{DetailArg, ModelArg};
use crate::values::size;

#[derive(Debug, Args)]
pub struct Serve {
    /// Stream or file of Gaussians, or a folder of them
    #[arg(value_name = "FILE|FOLDER")]
    pub source: PathBuf,
    /// Port; 0: any that is free
    #[arg(short, long, value_name = "N", default_value_t = 8000)]
    pub port: u16,
    /// Address to listen at. Others than this machine's own let everybody in who can reach it
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1")]
    pub host: IpAddr,
}

#[derive(Debug, Args)]
pub struct Demo {
    /// Folder for the pictures and the Gaussians
    #[arg(short, long, value_name = "DIR", default_value = "b2p-demo")]
    pub output: PathBuf,
}

#[derive(Debug, Args)]
pub struct Bench {
    /// Stream or sequence to decode, or, to render, PLY of Gaussians [default: the sample that comes with the program]
    pub input: Option<PathBuf>,
    /// Time drawing instead, stage by stage, seen from the front
    #[arg(long)]
    pub render: bool,
    /// Width and height in pixels of what is drawn
    #[arg(long, value_name = "WxH", default_value = "1024x1024", value_parser = size, requires = "render")]
    pub size: (u32, u32),
    /// What is drawn leaves out as much as this quality does: fast, fine, exact
    #[arg(long, value_name = "NAME", default_value = "fine", requires = "render")]
    pub quality: Quality,
    /// Times that it is decoded or drawn; medians are reported
    #[arg(long, value_name = "N", default_value_t = 7, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub repeat: u32,
    #[command(flatten)]
    pub detail: DetailArg,
    #[command(flatten)]
    pub model: ModelArg,
}
