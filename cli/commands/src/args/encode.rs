//! Arguments of `encode`.

use std::ops::RangeInclusive;
use std::path::PathBuf;

use b2p::encoder::Residual;
use b2p::encoder::transform::{GeometryTarget, Outline, QualityTarget, Tune};
use clap::{Args, ValueEnum};

use super::ModelArg;
use crate::cloud::ReadArgs;
use crate::many::Files;
use crate::values::{bits, bits_per_point, frame_rate, geometry, levels, outline, price, residual, step, tune};

#[derive(Debug, Args)]
#[command(override_usage = "b2p encode [OPTIONS] <IN>... <OUT>")]
pub struct Encode {
    #[command(flatten)]
    pub files: Files,
    /// Of the files: the cloud at hand.
    #[arg(skip)]
    pub cloud: PathBuf,
    /// The frames of a sequence, if the files are such.
    #[arg(skip)]
    pub clouds: Vec<PathBuf>,
    /// Its stream.
    #[arg(skip)]
    pub output: PathBuf,
    #[command(flatten)]
    pub sequence: SequenceArgs,
    /// Make a scene of a cloud with more than N voxels: blocks of at most N, which are coded, read and drawn one by one
    /// [default: blocks of 2²¹ voxels, of clouds with more than 2²²]
    #[arg(long, help_heading = "Scenes", value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub block_size: Option<u32>,
    /// Code any cloud in one piece
    #[arg(long, help_heading = "Scenes", conflicts_with = "block_size")]
    pub no_blocks: bool,
    /// Quality, from 0 to 100: chooses quantisation step and finest level. 100 is lossless, 38 the default
    #[arg(short = 'Q', long, value_name = "0..100", value_parser = clap::value_parser!(u8).range(0..=100), conflicts_with_all = ["step", "lossless", "bits_per_point"])]
    pub quality: Option<u8>,
    /// Make the best stream of at most X bits for each point of the cloud, the whole file counted: chooses the
    /// quantisation step, and leaves out the finest levels if they do not fit
    #[arg(short, long, value_name = "X", value_parser = bits_per_point, conflicts_with_all = ["step", "lossless", "bit_price", "residual"])]
    pub bits_per_point: Option<f64>,
    /// Effort, from 0 (quick) to 9: rate–distortion optimised quantisation from 1 on, colour filters from 2 on, --tune
    /// visual from 3 on; with --bits-per-point 2 + EFFORT tries for a level, and as many of tuned colours, from 7 on as
    /// many as it takes; 8 and 9 compare pictures from all sides, which takes 3 and 5 times as long [default: 7]
    #[arg(short, long, value_name = "0..9", value_parser = clap::value_parser!(u8).range(0..=9))]
    pub effort: Option<u8>,
    /// What coded colours approach. `visual`: those with which the cloud is drawn as it is; the stream is coded, decoded,
    /// compared with the cloud, and coded again. `psnr`: the mean colours of voxels [default: visual; psnr for sequences]
    #[arg(long, value_name = "visual|psnr", value_parser = tune, conflicts_with = "lossless")]
    pub tune: Option<Tune>,
    /// How far Gaussians reach. `surface`: to the surface that the points sample; `cloud`: as far as the cloud itself does
    /// when it is drawn as surfels, for captures, of which nothing else is known [default: surface]
    #[arg(long, value_name = "surface|cloud", value_parser = outline, conflicts_with = "no_head_maps")]
    pub outline: Option<Outline>,
    /// Bit depth N of the voxel grid, 1 to 21 [default: by the spacing of the points; at most what a cloud of integers
    /// needs]
    #[arg(long, help_heading = "Advanced", value_name = "N", value_parser = clap::value_parser!(u8).range(1..=21))]
    pub bits: Option<u8>,
    /// Octree levels that the stream may be cut after, the last at most N; of learned streams up to three, the last
    /// below N [default: N−3..N−1; with --bits-per-point up to N]
    #[arg(long, help_heading = "Advanced", value_name = "L..M", value_parser = levels)]
    pub levels: Option<RangeInclusive<u8>>,
    /// Quantisation steps of the finest level's luma and chroma in 255ths, 0.5 to 1000, of chroma by default twice that
    /// of luma; coarser levels have finer steps [default: 20]
    #[arg(long, help_heading = "Advanced", value_name = "LUMA[,CHROMA]", value_parser = step, conflicts_with = "lossless")]
    pub step: Option<QualityTarget>,
    /// Code the mean colours of the finest level's voxels exactly
    #[arg(long, help_heading = "Advanced")]
    pub lossless: bool,
    /// Geometry of the finest level. `exact`: its voxels as they are; `visual`: voxels may move by one where that saves
    /// bits and looks alike; a number from 0 to 100 is the Lagrangian λ of that, in squared voxels per bit [default:
    /// visual; exact for first frames that others are predicted from, above level N]
    #[arg(long, help_heading = "Advanced", value_name = "exact|visual|X", value_parser = geometry, conflicts_with = "lossless")]
    pub geometry: Option<GeometryTarget>,
    /// How colours are coded
    #[arg(long, help_heading = "Advanced", value_enum, value_name = "HOW", default_value_t = Colours::Transform)]
    pub colours: Colours,
    /// Leave out colour filters: encoding and decoding take less time, pictures are less accurate
    #[arg(long, help_heading = "Advanced")]
    pub no_filter: bool,
    /// Do not look where surfels draw better than learned heads: encoding takes less time
    #[arg(long)]
    pub no_head_maps: bool,
    #[command(flatten)]
    pub read: ReadArgs,
    #[command(flatten)]
    pub learned: LearnedArgs,
    #[command(flatten)]
    pub model: ModelArg,
}

/// What may be chosen about a sequence.
#[derive(Debug, Args)]
#[command(next_help_heading = "Sequences")]
pub struct SequenceArgs {
    /// Frames per second, such as 30 or 30000/1001 [default: 30]
    #[arg(long, value_name = "F", value_parser = frame_rate)]
    fps: Option<(u32, u32)>,
    /// Frames of a group, which decodes alone: the first of a group is coded by itself
    #[arg(long, value_name = "N", default_value_t = 32, value_parser = clap::value_parser!(u32).range(1..=65_536))]
    pub gop: u32,
    /// Make the best sequence of at most so many bits per second, such as 5M
    #[arg(long, value_name = "BITS", value_parser = bits, conflicts_with_all = ["bits_per_point", "step", "lossless", "quality"])]
    pub bitrate: Option<f64>,
    /// Code every frame by itself
    #[arg(long)]
    pub intra: bool,
    /// Predict each level from the same level: a coarser level of all frames decodes without the finer ones, for more
    /// bits
    #[arg(long)]
    pub scalable: bool,
}

impl SequenceArgs {
    /// Ticks per second and per frame.
    pub fn rate(&self) -> (u32, u32) {
        self.fps.unwrap_or((30, 1))
    }

    /// The first option that was given and concerns sequences alone.
    pub fn given(&self) -> Option<&'static str> {
        let all = [
            ("--fps", self.fps.is_some()),
            ("--bitrate", self.bitrate.is_some()),
            ("--intra", self.intra),
            ("--scalable", self.scalable),
        ];
        all.iter().find(|(_, given)| *given).map(|(name, _)| *name)
    }
}

/// How colours are coded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Colours {
    /// As transform coefficients (version 3): no model file is needed to decode them
    Transform,
    /// As latents of a learned model (version 2), which decoding needs, too
    Learned,
}

/// What may be chosen about learned streams.
#[derive(Debug, Args)]
#[command(next_help_heading = "With --colours learned")]
pub struct LearnedArgs {
    /// Rate-distortion trade-off, a factor on the model's Lagrangian λ: 0 rounds latents to the nearest, higher gives
    /// smaller files and costs quality
    #[arg(long = "lambda-scale", alias = "bit-price", value_name = "X", value_parser = price, default_value_t = 1.0)]
    pub bit_price: f32,
    /// Residual of the finest level's colours. `coarse`: low frequencies, where they are worth it and filters are made;
    /// `none`: nothing; else all of it, in steps of STEP/255, 1 to 255, of chroma by default 3/8 of it: 24 doubles some
    /// streams
    #[arg(long, value_name = "coarse|none|STEP[,CHROMA]", value_parser = residual, default_value = "coarse")]
    pub residual: Residual,
    /// Give each level that is drawn a residual of its own, not the finest alone: better pictures of coarser levels,
    /// for bytes that the finest does not need
    #[arg(long)]
    pub every_level: bool,
}
