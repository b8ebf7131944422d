//! `b2p view`: streams, Gaussians and point clouds in a window, or in the terminal.

mod blocks;
mod clip;
mod files;
mod folder;
mod keys;
mod orbit;
mod overlay;
mod pace;
mod painter;
mod player;
mod sixel;
mod source;
mod state;
mod tally;
mod terminal;
mod window;

use std::path::{Path, PathBuf};

use b2p::renderer::Background;
use b2p::sequence::play::clock::SPEEDS;
use clap::{Args, ValueEnum};

use super::args::{DetailArg, ModelArg, Orbit};
use super::cloud::{UpArg, up};
use super::manners::Said;
use super::values::{background, orbit as orbit_value, point, size};
use super::{Failure, Result, load};
use files::Loading;
use orbit::{OrbitCamera, Start};
use state::State;

/// The size of a window unless one is asked for.
const WINDOW: (u32, u32) = (1024, 1024);

/// What is viewed, and how.
#[derive(Debug, Args)]
pub struct View {
    /// Streams, Gaussians, point clouds, or folders of them. `-`: a stream on standard input, drawn as it arrives
    #[arg(value_name = "FILE|FOLDER", required_unless_present = "terminal")]
    inputs: Vec<PathBuf>,
    /// Draw in the terminal instead of a window: in half blocks of 24-bit colours, or as sixels [default: blocks]
    #[arg(long, value_name = "blocks|sixel", num_args = 0..=1, default_missing_value = "blocks", value_parser = terminal_arg)]
    terminal: Option<TerminalArg>,
    /// Width and height in pixels; with --terminal in columns and rows [default: 1024x1024; of a terminal all of it]
    #[arg(long, value_name = "WxH", value_parser = size)]
    size: Option<(u32, u32)>,
    /// Horizontal field of view in degrees
    #[arg(long, value_name = "DEG", default_value_t = 45.0)]
    fov: f32,
    /// Azimuth and elevation of the camera in degrees at the start; with R its distance from the cube's centre
    #[arg(long, value_name = "AZ,EL[,R]", default_value = "20,10", value_parser = orbit_value, allow_hyphen_values = true)]
    orbit: Orbit,
    /// Point to look at at the start, in the units of the cloud [default: the middle of the object]
    #[arg(long, value_name = "X,Y,Z", value_parser = point, allow_hyphen_values = true)]
    look_at: Option<[f64; 3]>,
    /// Axis that points up: x, y, z, -x, -y, -z, or auto [default: what the input says, else y]
    #[arg(long, value_name = "AXIS", value_parser = up, allow_hyphen_values = true)]
    up: Option<UpArg>,
    /// white, black, grey, #rrggbb, or transparent
    #[arg(long, value_name = "COLOUR", default_value = "white", value_parser = background)]
    background: Background,
    /// Folder for screenshots
    #[arg(short, long, value_name = "DIR", default_value = ".")]
    output: PathBuf,
    /// How many times as fast as it was recorded a sequence is played: 0.125, 0.25, 0.5, 1, 2, 4 or 8
    #[arg(long, help_heading = "Sequences", value_name = "X", default_value_t = 1.0, value_parser = speed)]
    speed: f64,
    /// Play a sequence once, not in a loop
    #[arg(long, help_heading = "Sequences")]
    once: bool,
    #[command(flatten)]
    detail: DetailArg,
    #[command(flatten)]
    model: ModelArg,
}

/// What may follow `--terminal`: how to draw there, or already the first file.
#[derive(Debug, Clone)]
enum TerminalArg {
    Kind(Kind),
    File(PathBuf),
}

/// How a terminal shows pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Kind {
    Blocks,
    Sixel,
}

fn terminal_arg(text: &str) -> std::result::Result<TerminalArg, String> {
    let kind = Kind::from_str(text, false).map(TerminalArg::Kind);
    Ok(kind.unwrap_or_else(|_| TerminalArg::File(text.into())))
}

fn speed(text: &str) -> std::result::Result<f64, String> {
    let speed = text.parse().ok().filter(|speed| SPEEDS.contains(speed));
    speed.ok_or_else(|| format!("expected one of {SPEEDS:?}"))
}

/// Shows files until the user closes the window.
pub fn run(args: &View, limits: &b2p::Limits) -> Result<Said> {
    let mut inputs = args.inputs.clone();
    let kind = match &args.terminal {
        None => None,
        Some(TerminalArg::Kind(kind)) => Some(*kind),
        Some(TerminalArg::File(path)) => {
            inputs.insert(0, path.clone());
            Some(Kind::Blocks)
        }
    };
    if inputs.is_empty() {
        return Err(Failure("--terminal: no file is named to be shown".into()));
    }
    let shown = folder::files_in(&inputs)?;
    let camera = OrbitCamera::new(Start {
        orbit: args.orbit,
        fov: args.fov.into(),
        look_at: args.look_at,
    });
    let (width, height) = args.size.unwrap_or(WINDOW);
    let state = State::new(shown, camera, args.background, [width, height]);
    let viewer = Viewer {
        // What is wrong with the camera is said before anything is opened.
        state: checked(
            state
                .with_detail(args.detail.level, args.detail.heads)
                .with_playing(args.speed, !args.once),
        )?,
        loading: Loading {
            model: args.model.clone(),
            per_voxel: args.detail.per_voxel,
            up: args.up,
            limits: limits.clone(),
        },
        isa: load::isa(args.model.isa.as_deref())?,
        screenshots: args.output.clone(),
        size: args.size,
    };
    match kind {
        None => window::run(viewer),
        Some(kind) => terminal::run(viewer, kind),
    }
}

fn checked(state: State) -> Result<State> {
    state.camera.camera(state.size)?;
    Ok(state)
}

/// What a window and a terminal begin with.
struct Viewer {
    state: State,
    loading: Loading,
    isa: b2p::Isa,
    /// The folder for them.
    screenshots: PathBuf,
    /// The size that was asked for.
    size: Option<(u32, u32)>,
}

/// The first name in a folder for a picture of `shown` that no file has yet.
fn screenshot_path(folder: &Path, shown: &Path) -> Result<PathBuf> {
    let stem = match crate::manners::is_pipe(shown) {
        true => "stdin".into(),
        false => shown.file_stem().unwrap_or_default().to_string_lossy(),
    };
    let names = (1..=9999).map(|i| folder.join(format!("{stem}-{i:03}.png")));
    let free = names.into_iter().find(|name| std::fs::symlink_metadata(name).is_err());
    free.ok_or_else(|| Failure(format!("{}: all names for screenshots are taken", folder.display())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn screenshots_never_replace_a_file() {
        let folder = tempfile::tempdir().unwrap();
        let first = screenshot_path(folder.path(), Path::new("a/person.b2p")).unwrap();
        assert_eq!(first, folder.path().join("person-001.png"));
        std::fs::write(&first, "").unwrap();
        let second = screenshot_path(folder.path(), Path::new("person.b2p")).unwrap();
        assert_eq!(second, folder.path().join("person-002.png"));
    }

    #[test]
    fn what_follows_the_option_may_be_the_file_already() {
        assert!(matches!(terminal_arg("sixel"), Ok(TerminalArg::Kind(Kind::Sixel))));
        assert!(matches!(terminal_arg("a.b2p"), Ok(TerminalArg::File(path)) if path == Path::new("a.b2p")));
    }

    #[test]
    fn a_speed_is_one_of_those_that_keys_choose() {
        assert_eq!(speed("0.5"), Ok(0.5));
        assert!(speed("3").unwrap_err().contains("4.0"));
    }
}
