//! `b2p render` of a sequence: a video, or a picture of each frame.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::Instant;

use b2p::gaussians::Gaussians;
use b2p::renderer::camera::{Camera, Extent};
use b2p::renderer::{Effects, Renderer};
use b2p::{Axes, Error, Limits, SequenceDecoder, SequenceReader};
use serde_json::json;

use super::super::args::{Format, Render};
use super::super::manners::{self, Said};
use super::super::picture::{Artist, format_of};
use super::super::progress::Progress;
use super::super::table::counted;
use super::super::video::{self, FrameTime};
use super::super::views::shots;
use super::super::{Failure, Result, load};
use super::Pattern;

/// Bytes of a Gaussian of one colour: 14 numbers.
const GAUSSIAN_BYTES: usize = 14 * size_of::<f32>();

/// Draws every frame with one camera: into a video, or into pictures of a pattern. While a frame is drawn, the next one
/// is decoded.
pub fn run(args: &Render, limits: &Limits, progress: &Progress) -> Result<Said> {
    let sequence = super::read(&args.input, limits)?;
    let one = args
        .sequence
        .frame(&sequence)
        .transpose()
        .map_err(Failure::in_file(&args.input))?;
    let frames = one.map_or(0..sequence.frames(), |frame| frame..frame + 1);
    let pattern = Pattern::of(&args.output);
    let format = match (&pattern, one) {
        (None, None) => Format::Y4m,
        _ => format_of(args, 1)?,
    };
    if args.contact_sheet || args.turntable.is_some() || args.view.views.is_some_and(|views| views > 1) {
        let what = "a sequence is drawn with one camera; --frame draws other views of a frame";
        return Err(Failure(what.into()));
    }
    if pattern.is_none() && one.is_none() && !is_video(&args.output) {
        let what = "a sequence is drawn into a video (.gif, .webp, .apng, .y4m, or with FFmpeg .mp4, .webm, .mkv) or, with %04d in the name, into a picture of each frame";
        return Err(Failure(format!("{}: {what}", args.output.display())));
    }
    let paths: Vec<PathBuf> = match &pattern {
        Some(pattern) => frames.clone().map(|frame| pattern.path(frame)).collect(),
        None => vec![args.output.to_path_buf()],
    };
    let outputs: Vec<&Path> = paths.iter().map(PathBuf::as_path).collect();
    manners::permit(&outputs, &[&args.input])?;
    let mut film = Film {
        args,
        limits,
        format,
        camera: None,
        renderer: None,
        decoder: SequenceDecoder::new(load::decoder(&[], &args.detail, &args.model, limits)?),
        axes: sequence.axes().map_err(Failure::in_file(&args.input))?,
        other_bytes: 0,
    };
    let started = Instant::now();
    let count = frames.end - frames.start;
    match pattern.is_some() || one.is_some() {
        true => film.stills(&sequence, frames, &paths, progress)?,
        false => {
            let (width, height) = args.view.size;
            film.other_bytes = u64::from(width) * u64::from(height) * video::BYTES_PER_PIXEL;
            film.video(&sequence, frames, &paths[0], progress)?;
        }
    }
    let took = started.elapsed().as_secs_f64();
    let rate = count as f64 / took;
    let to = args.output.display();
    let report = format!("{to}: {}, {rate:.1} a second\n", counted(count, "frame"));
    let json = || json!({ "output": to.to_string(), "frames": count, "seconds": took, "frames_per_second": rate });
    Ok(Said::report(report, json).beside(&args.output))
}

/// Whether all frames go into a file with this ending. A `.png` file is one picture.
fn is_video(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ending != "png") && video::kind_of(path).is_ok()
}

/// Calls `draw` with the Gaussians of the frames, one after the other, which a thread decodes ahead of it.
fn ahead<T>(
    decoder: &mut SequenceDecoder,
    sequence: &SequenceReader,
    frames: Range<u64>,
    draw: impl FnOnce(Receiver<b2p::Result<Gaussians>>) -> Result<T>,
) -> Result<T> {
    std::thread::scope(|scope| {
        // No frame waits: the next one is made, and the one behind it decoded, while a frame is drawn.
        let (sender, receiver) = sync_channel(0);
        let decode = move || {
            for frame in decoder.gaussians(sequence, frames) {
                // Nobody draws any more.
                if sender.send(frame).is_err() {
                    break;
                }
            }
        };
        let builder = std::thread::Builder::new().name("decode".into());
        builder
            .spawn_scoped(scope, decode)
            .map_err(|e| Failure(format!("no thread can be had to decode with: {e}")))?;
        draw(receiver)
    })
}

/// The Gaussians of the next frame.
fn next(decoded: &Receiver<b2p::Result<Gaussians>>) -> b2p::Result<Gaussians> {
    decoded.recv().map_err(|_| Error::Usage("a frame is missing".into()))?
}

/// Draws frames one after the other.
struct Film<'a> {
    args: &'a Render,
    limits: &'a Limits,
    format: Format,
    /// That of the first frame, and of all that follow.
    camera: Option<Camera>,
    renderer: Option<Renderer>,
    decoder: SequenceDecoder,
    axes: Axes,
    /// Bytes that a video holds beside a picture.
    other_bytes: u64,
}

impl Film<'_> {
    /// Writes each frame to a file of its own.
    fn stills(
        &mut self,
        sequence: &SequenceReader,
        frames: Range<u64>,
        paths: &[PathBuf],
        progress: &Progress,
    ) -> Result<()> {
        let mut decoder = self.decoder.clone();
        ahead(&mut decoder, sequence, frames, |decoded| {
            for path in paths {
                progress.say(&format!("draw {}", path.display()));
                let gaussians = next(&decoded).map_err(Failure::in_file(&self.args.input))?;
                self.draw(&gaussians, |artist| manners::write(path, |w| artist.write(w, path)))?;
            }
            Ok(())
        })
    }

    /// Writes all frames into one video.
    fn video(&mut self, sequence: &SequenceReader, frames: Range<u64>, path: &Path, progress: &Progress) -> Result<()> {
        let mut decoder = self.decoder.clone();
        let index = sequence.index();
        let time = FrameTime {
            timescale: index.timescale,
            duration: index.duration,
        };
        let count = u32::try_from(frames.end - frames.start)
            .map_err(|_| Failure("a video has less than 2^32 frames".into()))?;
        ahead(&mut decoder, sequence, frames, |decoded| {
            video::write(path, count, time, |i, image| {
                progress.say(&format!("draw frame {i}"));
                let gaussians = next(&decoded)?;
                let drawn = self.draw(&gaussians, |artist| {
                    std::mem::swap(image, &mut artist.image);
                    Ok(())
                });
                drawn.map_err(|failure| Error::Usage(failure.0))
            })
        })
    }

    /// Draws a frame, and hands it to `use_picture`.
    fn draw(&mut self, gaussians: &Gaussians, use_picture: impl FnOnce(&mut Artist) -> Result<()>) -> Result<()> {
        let camera = match &self.camera {
            Some(camera) => *camera,
            None => {
                let extent = Extent::of_gaussians(gaussians);
                let shots = shots(self.args, &gaussians.frame, &extent, &self.axes, self.limits)?;
                let first = shots
                    .into_iter()
                    .next()
                    .ok_or_else(|| Failure("there is no camera".into()))?;
                *self.camera.insert(first.camera)
            }
        };
        let renderer = match self.renderer.take() {
            Some(renderer) => renderer,
            None => self.new_renderer()?,
        };
        let mut artist = Artist::new(renderer, gaussians, self.limits, self.args, self.format);
        // Beside the frame that is drawn, one more was made that could not be handed over.
        let others = gaussians.len() * GAUSSIAN_BYTES;
        artist.other_bytes = self.other_bytes.saturating_add(others as u64);
        artist.draw(&camera)?;
        use_picture(&mut artist)?;
        self.renderer = Some(artist.renderer);
        Ok(())
    }

    fn new_renderer(&self) -> Result<Renderer> {
        let mut effects = Effects::default();
        for (effect, choice) in &self.args.effect {
            effects.set(*effect, *choice);
        }
        let mut renderer = Renderer::new().with_isa(load::isa(self.args.model.isa.as_deref())?);
        renderer.set_effects(effects);
        renderer.set_quality(self.args.quality);
        Ok(renderer)
    }
}
