//! Arguments of `decode`.

use std::path::PathBuf;

use b2p::Limits;
use b2p_formats::splats::Format as SplatFormat;
use clap::Args;

use super::{DetailArg, FrameArgs, ModelArg};
use crate::budget::{BudgetArgs, Request};
use crate::cloud::{UpArg, WriteArgs, corners, up};
use crate::many::Files;
use crate::progress::Progress;

#[derive(Debug, Args)]
#[command(override_usage = "b2p decode [OPTIONS] <IN>... <OUT>")]
pub struct Decode {
    #[command(flatten)]
    pub files: Files,
    /// Of the files: the stream at hand.
    #[arg(skip)]
    pub input: PathBuf,
    /// Its Gaussians.
    #[arg(skip)]
    pub output: PathBuf,
    /// Write the level's voxels with their colours instead, as points: PLY, or LAS, LAZ, PCD, E57 or XYZ by the ending
    /// (of learned streams there are none)
    #[arg(long, conflicts_with_all = ["heads", "budget", "calibrate"])]
    pub points: bool,
    /// Format of the Gaussians: ply, compressed-ply, spz, sog, splat, glb, gltf, csv, npz [default: by the ending]
    #[arg(long, value_name = "NAME", conflicts_with = "points")]
    pub format: Option<SplatFormat>,
    /// Axis of the cloud that points up: x, y, z, -x, -y, -z, or auto. Gaussians are turned so that they stand upright
    /// in viewers [default: what the stream says; if it says nothing, they are not turned]
    #[arg(long, value_name = "AXIS", value_parser = up, allow_hyphen_values = true, conflicts_with = "points")]
    pub up: Option<UpArg>,
    /// Keep the axes of the cloud: do not turn Gaussians
    #[arg(long, conflicts_with_all = ["points", "up"])]
    pub keep_axes: bool,
    /// Decode a box of a scene: its lowest and its highest corner, in the units of the cloud. Only blocks that it meets
    /// are read
    #[arg(long = "box", help_heading = "Scenes", value_name = "X0,Y0,Z0,X1,Y1,Z1", value_parser = corners, allow_hyphen_values = true)]
    pub wanted: Option<[[f64; 3]; 2]>,
    #[command(flatten)]
    pub sequence: FrameArgs,
    #[command(flatten)]
    pub write: WriteArgs,
    #[command(flatten)]
    pub detail: DetailArg,
    #[command(flatten)]
    pub model: ModelArg,
    #[command(flatten)]
    pub budget: BudgetArgs,
}

impl Decode {
    /// What a choice of level and heads is made for.
    pub fn budget<'a>(&'a self, limits: &'a Limits, progress: &'a Progress) -> Request<'a> {
        Request {
            args: &self.budget,
            detail: &self.detail,
            model: &self.model,
            limits,
            progress,
        }
    }
}
