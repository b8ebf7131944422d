//! How much an input may ask for.

use b2p::Limits;
use clap::{Args, ValueEnum};

use crate::values::bytes;

/// What an input may ask for.
#[derive(Debug, Args)]
#[command(next_help_heading = "Limits")]
pub struct LimitArgs {
    /// Where limits start from: what suits a board with 512 MB, anything, or input that is trusted
    #[arg(long, global = true, value_enum, value_name = "PRESET", default_value_t = Preset::Default)]
    pub limits: Preset,
    /// Memory that one input may make the program reserve, such as 500M or 4G
    #[arg(long, global = true, value_name = "BYTES", value_parser = bytes)]
    pub max_memory: Option<u64>,
    /// Voxels of a level, and points of a cloud
    #[arg(long, global = true, value_name = "N")]
    pub max_points: Option<u64>,
    /// Pixels of a picture
    #[arg(long, global = true, value_name = "N")]
    pub max_pixels: Option<u64>,
    /// Pairs of a Gaussian and a tile of 32×32 pixels that it touches: the work of a picture
    #[arg(long, global = true, value_name = "N")]
    pub max_pairs: Option<u64>,
}

/// Limits by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Preset {
    /// 2²⁰ points, 2²² pixels, 2²⁴ pairs, 192 MiB
    Embedded,
    /// 2²⁶ points, 2²⁶ pixels, 2²⁸ pairs, 2 GiB
    Default,
    /// Those of the format
    Unlimited,
}

impl LimitArgs {
    /// The limits that they name.
    pub fn limits(&self) -> Limits {
        let limits = match self.limits {
            Preset::Embedded => Limits::embedded(),
            Preset::Default => Limits::default(),
            Preset::Unlimited => Limits::unlimited(),
        };
        let [points, pixels] = [
            self.max_points.unwrap_or(limits.max_points),
            self.max_pixels.unwrap_or(limits.max_pixels),
        ];
        let [pairs, bytes] = [
            self.max_pairs.unwrap_or(limits.max_pairs),
            self.max_memory.unwrap_or(limits.max_bytes),
        ];
        limits
            .with_max_points(points)
            .with_max_pixels(pixels)
            .with_max_pairs(pairs)
            .with_max_bytes(bytes)
    }
}
