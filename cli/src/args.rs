//! What can be asked of the program.

use std::net::IpAddr;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use b2p::Limits;
use b2p::encoder::Residual;
use b2p::encoder::transform::{GeometryTarget, QualityTarget};
use b2p::gaussians::HeadSet;
use clap::{Args, Parser, Subcommand, ValueEnum};

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
    /// .y4m for a video. Of several pictures a number is put before the ending
    Render(Render),
    /// Show streams, sequences, Gaussians and point clouds in a window, or in the terminal
    #[cfg(feature = "view")]
    View(super::view::View),
    /// Play sequences in a window, or in the terminal: `view` under another name
    #[cfg(feature = "view")]
    Play(super::view::View),
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
    /// Show streams in a web page, drawn by the browser without a GPU
    Serve(Serve),
    /// Decode and draw the sample that comes with the program
    Demo(Demo),
    /// Time the stages of decoding
    Bench(Bench),
    /// Print completions of command lines for a shell
    Completions(super::paperwork::Completions),
    /// Write the manual, a page for each command
    Man(super::paperwork::Manual),
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
    /// Quality, from 0 to 100: chooses quantisation step and finest level. 100 is lossless, 38 the default
    #[arg(short = 'Q', long, value_name = "0..100", value_parser = clap::value_parser!(u8).range(0..=100), conflicts_with_all = ["step", "lossless", "bits_per_point"])]
    pub quality: Option<u8>,
    /// Make the best stream of at most X bits for each point of the cloud, the whole file counted: chooses the
    /// quantisation step, and leaves out the finest levels if they do not fit
    #[arg(short, long, value_name = "X", value_parser = bits_per_point, conflicts_with_all = ["step", "lossless", "bit_price", "residual"])]
    pub bits_per_point: Option<f64>,
    /// Effort, from 0 (quick) to 9: rate–distortion optimised quantisation from 1 on, colour filters from 2 on; with
    /// --bits-per-point 2 + EFFORT tries for a level, of 9 as many as it takes [default: 9]
    #[arg(short, long, value_name = "0..9", value_parser = clap::value_parser!(u8).range(0..=9))]
    pub effort: Option<u8>,
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
    /// bits and looks alike; a number from 0 to 100 is the Lagrangian λ of that, in squared voxels per bit
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
        ];
        all.iter().find(|(_, given)| *given).map(|(name, _)| *name)
    }
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

#[derive(Debug, Args)]
pub struct Check {
    /// Streams to check to the last bit. `-`: standard input
    #[arg(value_name = "STREAM", required = true)]
    pub inputs: Vec<PathBuf>,
    /// Model of learned streams [default: the one inside the program]
    #[arg(long, value_name = "FILE")]
    pub model: Option<PathBuf>,
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

#[derive(Debug, Args)]
pub struct Info {
    /// Stream to describe. `-`: standard input
    #[arg(value_name = "IN")]
    pub input: PathBuf,
    /// Model file to look for the stream's model in [default: the one inside the program]
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
pub struct Demo {
    /// Folder for the pictures and the Gaussians
    #[arg(short, long, value_name = "DIR", default_value = "b2p-demo")]
    pub output: PathBuf,
}

#[derive(Debug, Args)]
pub struct Bench {
    /// Stream to decode, or, to render, PLY of Gaussians [default: the sample that comes with the program]
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
    /// Model file: of learned streams the model that they were coded with [default: the one inside the program], of
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

use super::budget::{BudgetArgs, Request};
use super::cloud::{ReadArgs, UpArg, WriteArgs, up};
use super::many::Files;
use super::plan::Plan;
use super::progress::Progress;
pub use super::values::Orbit;
use super::values::{
    background, bits, bits_per_point, bytes, effect, frame_rate, frames, geometry, levels, orbit, per_voxel, point,
    price, residual, size, step,
};
pub use b2p::renderer::{Background, Effect, EffectMode, Quality};
use b2p_formats::clouds::PointFormat;
pub use b2p_formats::splats::Format as SplatFormat;

/// The help of `--effect`.
fn effect_help() -> String {
    let names = Effect::ALL.map(Effect::name).join(", ");
    format!("Force an effect ({names}) on or off")
}

macro_rules! budget_request {
    ($($command:ident)*) => {$(
        impl $command {
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
    )*};
}

budget_request!(Decode Render);

#[derive(Debug, Args)]
pub struct Serve {
    /// Stream, or folder of streams
    #[arg(value_name = "FILE|FOLDER")]
    pub source: PathBuf,
    /// Port; 0: any that is free
    #[arg(short, long, value_name = "N", default_value_t = 8000)]
    pub port: u16,
    /// Address to listen at. Others than this machine's own let everybody in who can reach it
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1")]
    pub host: IpAddr,
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
