//! Clouds on one grid to a sequence.

use std::borrow::Cow;
use std::fmt::Debug;
use std::ops::{Range, RangeInclusive};
use std::sync::Arc;

use rayon::prelude::*;

use super::SequenceReader;
use super::assembly::{Assembly, group_of};
use crate::axes::Axes;
use crate::cancel::Cancel;
use crate::cloud::ColouredVoxels;
use crate::container::sequence::{FrameEntry, FrameKind, FrameLevel, MAX_GROUP_FRAMES};
use crate::container::{Header, with_axes};
use crate::decoder::Decoder;
use crate::encoder::transform::{self, GeometryTarget, Motion, Options, Outline, PredictedFrame, QualityTarget, Tune};
use crate::error::{Error, Result};
use crate::limits::Limits;
use crate::log::Log;
use crate::motion::{Inter, Previous};

/// Groups that were coded, kept for a later run that is to go on where this one was stopped.
pub trait KeptGroups: Debug + Send + Sync {
    /// The sequence of these frames alone, if it was kept with these settings. Frames are the same if their clouds are.
    fn find(&self, frames: Range<u64>, settings: &str) -> Option<Vec<u8>>;
    /// Keeps the sequence of these frames, coded with these settings.
    fn keep(&self, frames: Range<u64>, settings: &str, sequence: &[u8]);
}

/// Codes clouds on one grid as a sequence.
#[derive(Debug, Clone)]
pub struct SequenceEncoder {
    pub(super) options: Options,
    timescale: u32,
    duration: u32,
    pub(super) group: u32,
    predicted: bool,
    /// Geometry of frames, but for those that a group is predicted from.
    geometry: GeometryTarget,
    axes: Axes,
    cancel: Cancel,
    kept: Option<Arc<dyn KeptGroups>>,
}

impl Default for SequenceEncoder {
    fn default() -> Self {
        SequenceEncoder {
            options: Options {
                tune: Tune::Psnr,
                ..Options::default()
            },
            timescale: 30,
            duration: 1,
            group: 32,
            predicted: true,
            geometry: GeometryTarget::Exact,
            axes: Axes::default(),
            cancel: Cancel::default(),
            kept: None,
        }
    }
}

/// The entry and the bytes of a frame.
type Coded = (FrameEntry, Vec<u8>);

/// Factor of the steps of a group's first frame: the frames after it show what they keep of it.
const FIRST_STEP: f32 = 0.7;
/// Share of the bytes of the group's first frame above which a predicted frame is compared with a whole one.
const LARGE: f64 = 0.35;
/// Bytes of a whole frame, over those of a predicted one, that its own voxels and colours are worth.
const WORTH: f64 = 1.2;

/// A coded group.
#[derive(Clone)]
struct Group {
    common: Header,
    frames: Vec<FrameEntry>,
    bytes: Vec<u8>,
}

/// A coded frame.
struct Frame {
    header: Header,
    coded: Coded,
    /// What the next frame is predicted from.
    next: Option<Arc<Previous>>,
}

impl SequenceEncoder {
    /// An encoder for 30 frames per second in groups of 32, with the levels and the quality of
    /// [`Encoder::new`](crate::Encoder::new).
    pub fn new() -> Self {
        Self::default()
    }

    /// The same encoder with these options of each frame.
    #[doc(hidden)]
    pub fn with_options(mut self, options: Options) -> Self {
        self.options = options;
        self
    }

    /// The same encoder for these levels: each frame may be cut after each of them.
    pub fn with_levels(mut self, levels: RangeInclusive<u8>) -> Self {
        self.options.levels = Some(levels);
        self
    }

    /// The same encoder with another quality of colours.
    pub fn with_quality(mut self, quality: QualityTarget) -> Self {
        self.options.fineness = quality;
        self
    }

    /// The same encoder for `timescale / duration` frames per second: frames last `duration` ticks, a second has
    /// `timescale`.
    pub fn with_frame_rate(mut self, timescale: u32, duration: u32) -> Self {
        (self.timescale, self.duration) = (timescale, duration);
        self
    }

    /// The same encoder with so many frames per group, 1 to 65,536. The first frame of a group is coded by itself.
    pub fn with_group(mut self, frames: u32) -> Self {
        self.group = frames;
        self
    }

    /// The same encoder, which predicts frames from the frame before or codes each by itself. Default: it predicts.
    pub fn with_prediction(mut self, predicted: bool) -> Self {
        self.predicted = predicted;
        self
    }

    /// The same encoder with another geometry of all frames, but for the first of a group that is predicted, if its last
    /// level is not the cloud's own. Default: exact.
    pub fn with_geometry(mut self, geometry: GeometryTarget) -> Self {
        self.geometry = geometry;
        self
    }

    /// The same encoder, which predicts each level from the same level of the frame before if `scalable`, else the coarser
    /// levels from the finest one. That takes far fewer bits, but a decoder that shows a coarser level then decodes the
    /// finest one, too. Default: not scalable.
    pub fn with_scalability(mut self, scalable: bool) -> Self {
        self.options.scalable = scalable;
        self
    }

    /// The same encoder, in which the previous frame moves in this way; [`Motion::Best`] by default. Frames that are
    /// lossless, or whose levels are predicted from themselves ([`SequenceEncoder::with_scalability`]), are not warped.
    #[must_use]
    pub fn with_motion(mut self, motion: Motion) -> Self {
        self.options.motion = motion;
        self
    }

    /// The same encoder, whose sequences state these axes.
    pub fn with_axes(mut self, axes: Axes) -> Self {
        self.axes = axes;
        self
    }

    /// The same encoder, stopped before its next frame when `cancel` is thrown.
    pub fn with_cancel(mut self, cancel: Cancel) -> Self {
        self.cancel = cancel;
        self
    }

    /// The same encoder, which keeps each group that it has coded, and codes none that was kept.
    pub fn with_kept_groups(mut self, kept: Arc<dyn KeptGroups>) -> Self {
        self.kept = Some(kept);
        self
    }

    /// Codes `count` frames. `cloud` gives each of them by its number, from several threads at a time; `done` gets
    /// each frame that was coded. The sequence does not depend on the number of threads.
    ///
    /// # Errors
    /// Those of `cloud` and of [`Encoder::encode`](crate::Encoder::encode), as [`Error::Frame`]; [`Error::Usage`] for
    /// no frames, a frame rate or a group out of range, and for frames on different grids; [`Error::Cancelled`].
    pub fn encode(
        &self,
        count: u64,
        cloud: impl Fn(u64) -> Result<ColouredVoxels> + Sync,
        done: impl Fn(u64) + Sync,
    ) -> Result<Vec<u8>> {
        if count == 0 || self.timescale == 0 || self.duration == 0 {
            let what = "a sequence needs at least one frame and a frame rate above 0";
            return Err(Error::Usage(what.into()));
        }
        if !(1..=MAX_GROUP_FRAMES).contains(&self.group) {
            let what = format!("a group has 1 to {MAX_GROUP_FRAMES} frames, not {}", self.group);
            return Err(Error::Usage(what));
        }
        let longest = u64::from(self.group).min(count) * u64::from(self.duration);
        if longest > u32::MAX.into() {
            let what = format!("a group lasts less than 2^32 ticks, not {longest}");
            return Err(Error::Usage(what));
        }
        self.outlined(&cloud)?.encode_groups(count, &cloud, &done)
    }

    /// The same encoder, whose frames have Gaussians as thick as is chosen for the first one, if they are to reach as far
    /// as the cloud.
    fn outlined(&self, cloud: &(impl Fn(u64) -> Result<ColouredVoxels> + Sync)) -> Result<Cow<'_, Self>> {
        if self.options.outline == Outline::Surface || !self.options.has_head_maps() {
            return Ok(Cow::Borrowed(self));
        }
        let options = Options {
            geometry: self.geometry,
            ..self.options.clone()
        };
        let first = cloud(0).and_then(|cloud| transform::encode(&cloud, &options, &self.log()));
        let first = first.map_err(|error| in_frame(0, error))?;
        let mut encoder = self.clone();
        encoder.options = Options {
            thickness: transform::thickness_of(&first.bytes)?,
            outline: Outline::Surface,
            heads: None,
            ..options
        };
        encoder.options.geometry = self.options.geometry;
        Ok(Cow::Owned(encoder))
    }

    fn encode_groups(
        &self,
        count: u64,
        cloud: &(impl Fn(u64) -> Result<ColouredVoxels> + Sync),
        done: &(impl Fn(u64) + Sync),
    ) -> Result<Vec<u8>> {
        let size = u64::from(self.group);
        let groups = (0..count.div_ceil(size)).into_par_iter().map(|group| {
            let frames = group * size..count.min((group + 1) * size);
            if let Some(kept) = self.kept_group(&frames) {
                frames.for_each(done);
                return Ok(kept);
            }
            let coded = self.code_group(frames.clone(), cloud, done)?;
            self.keep(frames, &coded)?;
            Ok(coded)
        });
        let groups = groups.collect::<Vec<Result<Group>>>();
        let groups = groups.into_iter().collect::<Result<Vec<_>>>()?;
        let common = groups[0].common.clone();
        let mut assembly = self.assembly(&common);
        for (i, group) in groups.into_iter().enumerate() {
            check_common(Some(&common), &group.common, i as u64 * size)?;
            self.add(&mut assembly, group)?;
        }
        assembly.finish()
    }

    /// Codes the frames of a group.
    fn code_group(
        &self,
        frames: Range<u64>,
        cloud: &(impl Fn(u64) -> Result<ColouredVoxels> + Sync),
        done: &(impl Fn(u64) + Sync),
    ) -> Result<Group> {
        let mut common: Option<Header> = None;
        let (mut all, mut previous): (Vec<Coded>, _) = (Vec::new(), None);
        for frame in frames.clone() {
            self.cancel.check()?;
            let cloud = cloud(frame).map_err(|error| in_frame(frame, error))?;
            let ticks = (frame - frames.start) as u32 * self.duration;
            let follows = self.predicted && frame + 1 < frames.end;
            let first_bytes = all.first().map_or(0, |(_, bytes)| bytes.len());
            let coded = match &previous {
                None => self.whole(&cloud, ticks, follows),
                Some(previous) => self.predicted(&cloud, previous, ticks, follows, first_bytes),
            };
            let coded = coded.map_err(|error| in_frame(frame, error))?;
            check_common(common.as_ref(), &coded.header, frame)?;
            common.get_or_insert(coded.header);
            all.push(coded.coded);
            previous = coded.next.filter(|_| follows);
            done(frame);
        }
        let common = common.ok_or_else(|| Error::Usage("a group needs at least one frame".into()))?;
        let (frames, bytes) = group_of(&all)?;
        Ok(Group { common, frames, bytes })
    }

    /// A group that was kept, if it is sound.
    fn kept_group(&self, frames: &Range<u64>) -> Option<Group> {
        let bytes = self.kept.as_ref()?.find(frames.clone(), &self.settings())?;
        let sequence = SequenceReader::new(&bytes[..], &Limits::unlimited()).ok()?;
        let group = sequence.group(0).ok()?;
        let right = sequence.groups() == 1 && sequence.frames() == frames.end - frames.start;
        right.then_some(Group {
            common: sequence.header().clone(),
            frames: group.frames.clone(),
            bytes: group.bytes.to_vec(),
        })
    }

    fn keep(&self, frames: Range<u64>, group: &Group) -> Result<()> {
        let Some(kept) = &self.kept else { return Ok(()) };
        let mut alone = self.assembly(&group.common);
        self.add(&mut alone, group.clone())?;
        kept.keep(frames, &self.settings(), &alone.finish()?);
        Ok(())
    }

    fn assembly(&self, common: &Header) -> Assembly {
        Assembly::new(common, self.timescale, self.duration)
    }

    fn add(&self, assembly: &mut Assembly, group: Group) -> Result<()> {
        let ticks = group.frames.len() as u32 * self.duration;
        assembly.push(&group.frames, group.bytes, 0, ticks)
    }

    /// What decides the bytes of a group beside its clouds.
    fn settings(&self) -> String {
        let options = Options {
            isa: None,
            ..self.options.clone()
        };
        let rate = (self.timescale, self.duration);
        format!("{:?}", (options, rate, self.predicted, self.geometry, &self.axes))
    }

    /// Codes the first frame of a group, or one that no other is predicted from.
    fn whole(&self, cloud: &ColouredVoxels, ticks: u32, follows: bool) -> Result<Frame> {
        let mut options = self.options.clone();
        let last = options.levels.as_ref().map(|levels| *levels.end());
        if follows {
            options.fineness = options.fineness.scaled(FIRST_STEP);
        }
        if !follows || last == Some(cloud.voxels.depth()) {
            options.geometry = self.geometry;
        }
        self.whole_with(cloud, &options, ticks, follows)
    }

    /// Codes a frame by itself.
    fn whole_with(&self, cloud: &ColouredVoxels, options: &Options, ticks: u32, follows: bool) -> Result<Frame> {
        let stream = transform::encode(cloud, options, &self.log())?.bytes;
        finished(with_axes(&stream, &self.axes)?, &[], None, ticks, follows)
    }

    /// Codes a frame from the frame before, or by itself if that is better. `first_bytes` are those of the group's
    /// first frame.
    fn predicted(
        &self,
        cloud: &ColouredVoxels,
        previous: &Arc<Previous>,
        ticks: u32,
        follows: bool,
        first_bytes: usize,
    ) -> Result<Frame> {
        let options = Options {
            geometry: self.geometry,
            ..self.options.clone()
        };
        let PredictedFrame { stream, motion } = transform::encode_predicted(cloud, previous, &options, &self.log())?;
        let frame = finished(stream, &motion, Some(previous), ticks, follows)?;
        let bytes = frame.coded.1.len() as f64;
        if bytes <= LARGE * first_bytes as f64 {
            return Ok(frame);
        }
        let worth = match self.options.fineness {
            QualityTarget::Lossless => 1.0,
            _ => WORTH,
        };
        let whole = self.whole_with(cloud, &options, ticks, follows)?;
        let better = whole.coded.1.len() as f64 <= worth * bytes;
        Ok(if better { whole } else { frame })
    }

    fn log(&self) -> Log {
        Log::off().with_cancel(self.cancel.clone())
    }
}

/// The error of a frame.
fn in_frame(frame: u64, error: Error) -> Error {
    match error {
        Error::Cancelled => Error::Cancelled,
        source => Error::Frame {
            frame,
            source: Box::new(source),
        },
    }
}

/// The frame of a stream and its motion, decoded if another frame follows, which is predicted from what the decoder will
/// have, or to check its motion.
fn finished(
    stream: Vec<u8>,
    motion: &[Vec<u8>],
    previous: Option<&Arc<Previous>>,
    ticks: u32,
    follows: bool,
) -> Result<Frame> {
    let header = Header::parse(&stream, &Limits::unlimited())?;
    let coded = frame_of(&header, &stream, motion, ticks)?;
    let mut next = None;
    if follows || !motion.is_empty() {
        let decoder = Decoder::new().with_limits(Limits::unlimited()).with_level(header.top);
        let inter = previous.map(|previous| {
            let motion: Vec<&[u8]> = motion.iter().map(Vec::as_slice).collect();
            Inter::new(decoder.isa(), Arc::clone(previous), &motion, [header.base, header.top])
        });
        let mut decoding = decoder.start_frame(stream, inter.transpose()?);
        decoding.finish()?;
        next = decoding.take_previous().map(Arc::new);
    }
    Ok(Frame { header, coded, next })
}

/// The entry and the bytes of a frame from its stream.
fn frame_of(header: &Header, stream: &[u8], motion: &[Vec<u8>], ticks: u32) -> Result<Coded> {
    let points = u32::try_from(header.points);
    let points = points.map_err(|_| Error::Usage("a frame has less than 2^32 points".into()))?;
    let kind = if motion.is_empty() {
        FrameKind::Whole
    } else {
        FrameKind::Predicted
    };
    let (mut levels, mut bytes) = (Vec::new(), Vec::new());
    let mut rest = &stream[header.bytes()..];
    for (i, (&voxels, &section)) in header.voxels.iter().zip(&header.sections).enumerate() {
        let moved = motion.get(i).map_or(&[][..], |moved| moved);
        let (sections, after) = rest.split_at(section.bytes() as usize);
        bytes.extend(moved);
        bytes.extend(sections);
        rest = after;
        levels.push(FrameLevel {
            voxels,
            motion: moved.len() as u32,
            section,
        });
    }
    let entry = FrameEntry {
        kind,
        ticks,
        points,
        levels,
        offset: 0,
    };
    Ok((entry, bytes))
}

/// Checks that a frame is on the grid of the first one.
fn check_common(first: Option<&Header>, header: &Header, frame: u64) -> Result<()> {
    let same = |first: &Header| {
        (first.bits, first.base, first.top) == (header.bits, header.base, header.top)
            && first.placement == header.placement
    };
    match first {
        Some(first) if !same(first) => Err(Error::Usage(format!(
            "frame {frame} is on another grid than the first: frames share bit depth, levels and placement"
        ))),
        _ => Ok(()),
    }
}
