//! Arguments of `convert`.

use std::path::PathBuf;

use b2p_formats::clouds::PointFormat;
use b2p_formats::splats::Format as SplatFormat;
use clap::Args;

use super::Output;
use crate::cloud::ReadArgs;

#[derive(Debug, Args)]
pub struct Convert {
    /// Gaussians: PLY, compressed PLY, SPZ, SOG, .splat, glTF, CSV or NumPy archive; or points: PLY, LAS, LAZ, PCD,
    /// E57, XYZ, OBJ or glTF. `-`: standard input
    #[arg(value_name = "IN")]
    pub input: PathBuf,
    #[command(flatten)]
    pub output: Output,
    /// Format of the output: of Gaussians ply, compressed-ply, spz, sog, splat, glb, gltf, csv, npz; of points ply,
    /// las, laz, pcd, e57, xyz [default: by the ending]
    #[arg(long, value_name = "NAME")]
    pub format: Option<OutFormat>,
    /// Format of the input, if it is Gaussians [default: by its contents, of .splat and .csv by the ending]
    #[arg(long, value_name = "NAME")]
    pub from: Option<SplatFormat>,
    /// Write the centres of Gaussians with their colours as points, also to .ply
    #[arg(long)]
    pub points: bool,
    /// Make flat Gaussians of points, without a stream between
    #[arg(long, conflicts_with_all = ["points", "double", "local"])]
    pub surfels: bool,
    /// Keep the axes of the coordinates: do not turn Gaussians so that they stand upright in viewers
    #[arg(long)]
    pub keep_axes: bool,
    /// Write points with coordinates as doubles [default: floats where they are exact]
    #[arg(long, help_heading = "Points")]
    pub double: bool,
    /// Write points with coordinates from a near origin, which goes into a comment and into OUT.json
    #[arg(long, help_heading = "Points")]
    pub local: bool,
    #[command(flatten)]
    pub read: ReadArgs,
}

/// A format of Gaussians or of points. PLY is one of both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OutFormat {
    Splats(SplatFormat),
    Points(PointFormat),
}

impl std::str::FromStr for OutFormat {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let points = || name.parse().map(OutFormat::Points);
        let found = name.parse().map(OutFormat::Splats).or_else(|_: b2p::Error| points());
        found.map_err(|_: b2p::Error| {
            let names: Vec<_> = SplatFormat::all().map(SplatFormat::name).collect();
            format!(
                "{name:?} is no format, expected {}, las, laz, pcd, e57 or xyz",
                names.join(", ")
            )
        })
    }
}
