//! Arguments of `render`.

use std::path::PathBuf;

use b2p::Limits;
use b2p::renderer::{Background, Effect, EffectMode, Quality};
use clap::{Args, ValueEnum};

use super::{DetailArg, FrameArgs, ModelArg};
use crate::budget::{BudgetArgs, Request};
use crate::cloud::{UpArg, up};
use crate::many::Files;
use crate::progress::Progress;
use crate::values::{Orbit, background, effect, orbit, point, size};

#[derive(Debug, Args)]
#[command(override_usage = "b2p render [OPTIONS] <IN>... <OUT>")]
pub struct Render {
    #[command(flatten)]
    pub files: Files,
    /// Of the files: what is drawn at hand.
    #[arg(skip)]
    pub input: PathBuf,
    /// Its picture.
    #[arg(skip)]
    pub output: PathBuf,
    /// Draw a video of one turn around the object: .gif, .webp, animated .png, or with FFmpeg .mp4, .webm and .mkv; of
    /// several inputs into a folder
    #[arg(long, value_name = "FILE", conflicts_with = "output")]
    pub turntable: Option<PathBuf>,
    #[command(flatten)]
    pub sequence: FrameArgs,
    /// Draw blocks of a scene that are far away from coarser levels, whose voxels are at most so many pixels wide there.
    /// 0: everything from the finest level
    #[arg(long, help_heading = "Scenes", value_name = "PIXELS", default_value_t = 0.0)]
    pub lod: f64,
    /// Draw all views into one picture, a grid with their angles below them [default: 8 views]
    #[arg(long, conflicts_with_all = ["camera", "turntable"])]
    pub contact_sheet: bool,
    /// What is written [default: by the ending; to standard output png, and y4m of several pictures]
    #[arg(long, help_heading = "Advanced", value_enum, value_name = "FORMAT")]
    pub format: Option<Format>,
    /// Cameras of a file in place of --orbit: NeRF's transforms.json, COLMAP's images.txt beside its cameras.txt,
    /// Open3D's pinhole JSON, glTF's camera nodes
    #[arg(long, value_name = "FILE", conflicts_with_all = ["orbit", "views", "fov", "look_at"])]
    pub camera: Option<PathBuf>,
    /// Axis that points up in the pictures of --orbit: x, y, z, -x, -y, -z, or auto [default: what the input says, else
    /// y]
    #[arg(long, value_name = "AXIS", value_parser = up, allow_hyphen_values = true, conflicts_with = "camera")]
    pub up: Option<UpArg>,
    /// Parallel rays; the cube's centre stays as large as it is
    #[arg(long, conflicts_with = "camera")]
    pub orthographic: bool,
    /// What is drawn
    #[arg(long, value_enum, value_name = "WHAT", default_value_t = Show::Colour)]
    pub show: Show,
    #[arg(long, help_heading = "Advanced", value_name = "NAME=on|off|auto", value_parser = effect, help = effect_help())]
    pub effect: Vec<(Effect, EffectMode)>,
    /// How much of what is faint may be left out: fast, fine, exact
    #[arg(
        long,
        help_heading = "Advanced",
        value_name = "NAME",
        default_value = "fine",
        conflicts_with = "budget"
    )]
    pub quality: Quality,
    /// The same as --json
    #[arg(long, hide = true, value_enum, value_name = "FORMAT")]
    pub stats: Option<StatsFormat>,
    #[command(flatten)]
    pub detail: DetailArg,
    #[command(flatten)]
    pub view: View,
    #[command(flatten)]
    pub model: ModelArg,
    #[command(flatten)]
    pub budget: BudgetArgs,
}

/// The help of `--effect`.
fn effect_help() -> String {
    let names = Effect::ALL.map(Effect::name).join(", ");
    format!("Force an effect ({names}) on or off")
}

/// Kinds of pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// Eight bits a channel
    Png,
    /// Sixteen bits a channel
    Png16,
    /// Eight bits a channel, no transparency
    Ppm,
    /// A video of all pictures, 30 a second
    Y4m,
    /// OpenEXR: linear light, alpha, and of colours the depth
    Exr,
}

/// What a picture shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Show {
    /// Colours
    Colour,
    /// Distance along the viewing direction, the farthest white
    Depth,
    /// Normals in the camera's axes
    Normal,
    /// How much of a pixel is covered
    Alpha,
    /// The Gaussian that a pixel shows most of: its number plus one, the lowest eight bits red
    Id,
}

/// How numbers are printed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum StatsFormat {
    /// One object per picture, in an array
    Json,
}

/// Where the camera stands and what it sees.
#[derive(Debug, Args)]
pub struct View {
    /// Width and height in pixels
    #[arg(long, value_name = "WxH", default_value = "1024x1024", value_parser = size)]
    pub size: (u32, u32),
    /// Horizontal field of view in degrees
    #[arg(long, value_name = "DEG", default_value_t = 45.0, allow_negative_numbers = true)]
    pub fov: f32,
    /// Azimuth and elevation of the camera in degrees. It keeps the whole object in view, unless a distance is given: R
    /// from the cube's centre, the cube reaching from −1 to 1
    #[arg(long, value_name = "AZ,EL[,R]", default_value = "0,0", value_parser = orbit, allow_hyphen_values = true)]
    pub orbit: Orbit,
    /// Point to look at, in the units of the cloud [default: the middle of the object; with a distance the cube's
    /// centre]
    #[arg(long, value_name = "X,Y,Z", value_parser = point, allow_hyphen_values = true)]
    pub look_at: Option<[f64; 3]>,
    /// Draw N pictures, turning once around the object [default: 1; of a contact sheet 8, of a turntable 120]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub views: Option<u32>,
    /// white, black, grey, #rrggbb, or transparent
    #[arg(long, value_name = "COLOUR", default_value = "white", value_parser = background)]
    pub background: Background,
}

impl Render {
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
