//! `b2p-lab animate`

use std::path::{Path, PathBuf};

use b2p::cloud::ColouredVoxels;
use b2p::encoder::transform::GeometryTarget;
use b2p::geometry::Voxels;
use b2p::{SequenceEncoder, output};

use crate::error::{LabError, Result};
use crate::motion::{FrameInfo, Motion, Procedural, RECIPE, Sequence, Source};
use crate::sample::{Grid, write_ply};

/// Sample an animated mesh as coloured clouds on one voxel grid (PLY), each frame with points of its own
///
/// Writes frame_0000.ply, frame_0001.ply, … and sequence.json, from which `eval-sequence` makes the truth again; or codes
/// the clouds as one sequence.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The mesh: self-contained binary glTF with an animation
    #[arg(required_unless_present = "procedural", conflicts_with = "procedural")]
    mesh: Option<PathBuf>,
    /// A motion made by code in place of a file
    #[arg(long, value_enum, value_name = "NAME")]
    procedural: Option<Procedural>,
    /// The folder to write to, or the sequence to code, if the name ends in .b2p
    #[arg(short, long, value_name = "DIR|OUT.b2p")]
    output: PathBuf,
    /// How many frames [default: all of the file's, or 32]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    frames: Option<u32>,
    /// Frames a second
    #[arg(long, default_value_t = 30.0, value_parser = positive)]
    fps: f64,
    /// Seconds of the motion before the first frame
    #[arg(long, default_value_t = 0.0, value_parser = not_negative)]
    start: f64,
    /// Which of the file's animations, from 0
    #[arg(long, default_value_t = 0, conflicts_with = "procedural")]
    animation: usize,
    /// How many points to draw for each frame, before they are made voxels
    #[arg(long, default_value_t = 3_000_000, value_parser = clap::value_parser!(u64).range(1..=1_000_000_000))]
    points: u64,
    /// Bit depth: the cube has 2^BITS voxels a side
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u8).range(1..=21))]
    bits: u8,
    /// The share of the cube's side that the longest side of all frames together spans
    #[arg(long, default_value_t = 0.95)]
    fill: f64,
    /// Normal noise on the places of points: its standard deviation in voxels along each axis
    #[arg(long, value_name = "SIGMA", default_value_t = 0.0, value_parser = not_negative)]
    noise: f64,
    /// Everything random follows from it
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(number) if number > 0.0 && f64::is_finite(number) => Ok(number),
        _ => Err("expected a number above 0".into()),
    }
}

fn not_negative(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(number) if number >= 0.0 && f64::is_finite(number) => Ok(number),
        _ => Err("expected a number from 0 on".into()),
    }
}

/// Frames of a motion without end.
const ENDLESS: u32 = 32;

impl Args {
    /// Reads, poses, samples, writes.
    ///
    /// # Errors
    /// If the mesh cannot be read or has no extent, or a file cannot be written.
    pub fn run(self) -> Result<()> {
        let source = self.source()?;
        let motion = source.open()?;
        let count = self.count(&motion);
        let mut sequence = Sequence {
            source,
            start: self.start,
            fps: self.fps,
            points: self.points,
            noise: self.noise,
            seed: self.seed,
            grid: Grid::unit(self.bits).into(),
            frames: Vec::new(),
        };
        sequence.grid = self.grid(&sequence, &motion, count)?.into();
        if self.output.extension().is_some_and(|end| end == "b2p") {
            return code(&sequence, &motion, count, &self.output);
        }
        std::fs::create_dir_all(&self.output).map_err(LabError::io(&self.output))?;
        for index in 0..count as usize {
            let cloud = sequence.cloud(&motion, index)?;
            let file = format!("frame_{index:04}.ply");
            write_ply(&self.output.join(&file), &cloud, &sequence.grid())?;
            eprintln!("{file}: {} voxels", cloud.keys.len());
            let voxels = cloud.keys.len() as u64;
            sequence.frames.push(FrameInfo { file, voxels });
        }
        sequence.write(&self.output.join(RECIPE))
    }

    fn source(&self) -> Result<Source> {
        if let Some(motion) = self.procedural {
            return Ok(Source::Procedural(motion));
        }
        let missing = || LabError::Usage("name a mesh, or a motion with --procedural".into());
        let mesh = self.mesh.as_ref().ok_or_else(missing)?;
        // The recipe is read from other folders, too.
        let path = std::path::absolute(mesh).map_err(LabError::io(mesh))?;
        let animation = self.animation;
        Ok(Source::File { path, animation })
    }

    fn count(&self, motion: &Motion) -> u32 {
        let Some(duration) = motion.duration() else {
            return self.frames.unwrap_or(ENDLESS);
        };
        // A hair more, so that rounding does not lose the last key.
        let all = ((duration - self.start).max(0.0) * self.fps + 1e-3) as u32 + 1;
        let count = self.frames.unwrap_or(all);
        if count > all {
            eprintln!(
                "the animation has {all} frames: the last pose is held for {}",
                count - all
            );
        }
        count
    }

    /// The grid that holds every frame.
    fn grid(&self, sequence: &Sequence, motion: &Motion, count: u32) -> Result<Grid> {
        let mut bounds = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
        for index in 0..count as usize {
            let [low, high] = sequence.surface(motion, index).bounds();
            for axis in 0..3 {
                bounds[0][axis] = bounds[0][axis].min(low[axis]);
                bounds[1][axis] = bounds[1][axis].max(high[axis]);
            }
        }
        Grid::fit(bounds, self.bits, self.fill)
    }
}

/// Codes the clouds of a sequence, with the defaults of `b2p encode`.
fn code(sequence: &Sequence, motion: &Motion, count: u32, to: &Path) -> Result<()> {
    let placement = sequence.grid().placement();
    let cloud = |frame: u64| {
        let sampled = sequence.cloud(motion, frame as usize);
        let sampled = sampled.map_err(|error| b2p::Error::Usage(error.to_string()))?;
        Ok(ColouredVoxels {
            voxels: Voxels::new(sequence.grid().bits, sampled.keys),
            colours: sampled.rgb,
            placement,
        })
    };
    let (timescale, duration) = ticks(sequence.fps);
    let encoder = SequenceEncoder::new()
        .with_frame_rate(timescale, duration)
        .with_geometry(GeometryTarget::Visual);
    let bytes = encoder.encode(count.into(), cloud, |frame| eprintln!("frame {frame} is coded"))?;
    let written = output::write_file(to, |w| {
        w.write_all(&bytes).map_err(|source| b2p::Error::Io {
            path: to.to_path_buf(),
            source,
        })
    });
    eprintln!("{}: {count} frames, {} bytes", to.display(), bytes.len());
    Ok(written?)
}

/// Ticks a second and a frame, to a thousandth of a frame per second.
fn ticks(fps: f64) -> (u32, u32) {
    match fps.fract() == 0.0 {
        true => (fps as u32, 1),
        false => (((fps * 1000.0).round() as u32).max(1), 1000),
    }
}

#[cfg(test)]
mod tests {
    use b2p::{Decoder, Limits, SequenceDecoder, SequenceReader};
    use clap::Parser;

    use super::*;

    #[derive(clap::Parser)]
    struct Line {
        #[command(flatten)]
        args: Args,
    }

    #[test]
    fn a_name_of_a_stream_gives_a_sequence_of_the_clouds_that_a_folder_gets() {
        let folder = tempfile::tempdir().unwrap();
        let run = |output: &str| {
            let output = folder.path().join(output);
            let line = "x --procedural turning --frames 2 --bits 6 --points 30000 --fps 12.5 -o".split(' ');
            let line = line.map(Into::into).chain([output.into_os_string()]);
            Line::try_parse_from(line).unwrap().args.run().unwrap();
        };
        run("turning.b2p");
        run("frames");
        let bytes = std::fs::read(folder.path().join("turning.b2p")).unwrap();
        let sequence = SequenceReader::new(&bytes[..], &Limits::default()).unwrap();
        assert_eq!((sequence.frames(), sequence.frame_rate()), (2, 12.5));
        let decoded = SequenceDecoder::new(Decoder::new()).frame(&sequence, 0).unwrap();
        let first = std::fs::read(folder.path().join("frames/frame_0000.ply")).unwrap();
        let first = b2p::PointCloud::from_ply(&first, &Limits::default()).unwrap();
        let parents: std::collections::BTreeSet<_> = first.positions.iter().map(|p| p.map(|x| x as u32 / 2)).collect();
        let points = decoded.points().unwrap();
        assert_eq!((points.voxels.depth(), points.voxels.len()), (5, parents.len()));
    }
}
