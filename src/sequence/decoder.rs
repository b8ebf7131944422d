//! Decodes the frames of a sequence (`docs/format.md`, clause 17.4).

use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::Arc;

use super::{Group, SequenceReader};
use crate::container::Header;
use crate::decoder::{Decoder, Decoding, Points};
use crate::error::{Error, Result};
use crate::gaussians::Gaussians;
use crate::motion::{Inter, Previous, Warped};

/// Decodes frames of a sequence. It keeps what the frame that it decoded last leaves for the next one of its group: a
/// frame that follows is decoded alone, any other one with the frames of its group before it.
#[derive(Debug, Clone)]
pub struct SequenceDecoder {
    decoder: Decoder,
    last: Option<Last>,
}

/// The frame that was decoded last.
#[derive(Debug, Clone)]
struct Last {
    /// Hash of its group.
    group: u64,
    /// Its place in the group.
    at: usize,
    /// The finest level that was decoded.
    level: u8,
    previous: Arc<Previous>,
}

/// A decoded frame.
#[derive(Debug)]
pub struct DecodedFrame {
    /// Its number, from 0.
    pub number: u64,
    decoding: Decoding<'static>,
}

impl SequenceDecoder {
    /// A decoder of sequences, which decodes and draws as `decoder` does: its level, heads, limits and instructions
    /// count.
    pub fn new(decoder: Decoder) -> Self {
        SequenceDecoder { decoder, last: None }
    }

    /// Decodes and draws as `decoder` does from now on. What the last frame leaves for the next one is kept: with other
    /// heads or a coarser level the next frame is decoded alone. With a finer level it is decoded with the frames of its
    /// group before it, unless it is whole.
    pub fn set_decoder(&mut self, decoder: Decoder) {
        self.decoder = decoder;
    }

    /// Decodes a frame.
    ///
    /// # Errors
    /// [`Error::Frame`] if the frame, or one that it is predicted from, is damaged; those of
    /// [`SequenceReader::group`]. Frames of other groups can be decoded after that.
    pub fn frame(&mut self, sequence: &SequenceReader, frame: u64) -> Result<DecodedFrame> {
        let group = sequence.group(sequence.group_of(frame)?)?;
        self.in_group(&group, frame)
    }

    /// Decodes the frames `frames` one after the other.
    pub fn frames<'a>(&'a mut self, sequence: &'a SequenceReader<'a>, frames: Range<u64>) -> Frames<'a> {
        Frames {
            decoder: self,
            sequence,
            frames,
        }
    }

    /// Decodes all frames, and returns what is wrong with the sequence, each fault once: with groups, with frames, and
    /// behind the last group. Of a group whose hash is wrong it finds the chunks that are damaged.
    /// [`SequenceReader::part_at`] tells what lies at [`Error::offset`].
    pub fn faults(&mut self, sequence: &SequenceReader) -> Vec<Error> {
        let mut faults = Vec::new();
        for number in 0..sequence.groups() {
            let group = match sequence.group(number) {
                Ok(group) => group,
                Err(error) => {
                    let is_cut = matches!(error, Error::Truncated { .. });
                    faults.push(error);
                    match sequence.damaged_group(number) {
                        Ok(group) => faults.extend(group.damaged_chunks()),
                        Err(error) if !is_cut => faults.push(error),
                        Err(_) => {}
                    }
                    continue;
                }
            };
            let frames = (group.first()..).take(group.len());
            faults.extend(frames.filter_map(|frame| self.in_group(&group, frame).err()));
        }
        faults.extend(sequence.check_end().err());
        let mut said = BTreeSet::new();
        faults.retain(|fault| said.insert(fault.to_string()));
        faults
    }

    /// The Gaussians of the frames `frames`, one after the other: while those of a frame are made, the next frame is
    /// decoded.
    pub fn gaussians<'a>(&'a mut self, sequence: &'a SequenceReader<'a>, frames: Range<u64>) -> GaussianFrames<'a> {
        let mut frames = self.frames(sequence, frames);
        let next = frames.next();
        GaussianFrames { frames, next }
    }

    fn in_group(&mut self, group: &Group, frame: u64) -> Result<DecodedFrame> {
        let at = (frame - group.first()) as usize;
        let whole = (0..=at).rev().find(|at| group.is_whole(*at)).unwrap_or(0);
        let shown = self.decoder.last_level(&group.frame_header(at));
        let needed = needed(group, whole..at, shown)?;
        let last = self.last.take().filter(|last| last.group == group.hash());
        let fits = |last: &Last| (whole..at).contains(&last.at) && last.level >= needed[last.at - whole];
        let mut last = last.filter(fits);
        let start = last.as_ref().map_or(whole, |last| last.at + 1);
        for before in start..at {
            let level = needed[before - whole];
            let mut decoding = self.decoded(group, before, last.as_ref(), level)?;
            last = kept(&mut decoding, group, before, level);
        }
        let follows = at + 1 < group.len() && !group.is_whole(at + 1);
        let next = if follows {
            group.reference_level(at + 1).ok()
        } else {
            None
        };
        // What the next frame is predicted from may be finer than what is shown.
        if let Some(level) = next.filter(|next| *next > shown)
            && let Some((decoding, last)) = self.on_the_way(group, at, last.as_ref(), shown..level)
        {
            self.last = last;
            return Ok(DecodedFrame {
                number: frame,
                decoding,
            });
        }
        let mut decoding = self.decoded(group, at, last.as_ref(), shown)?;
        if next.is_some_and(|next| next <= shown) {
            self.last = kept(&mut decoding, group, at, shown);
        }
        Ok(DecodedFrame {
            number: frame,
            decoding,
        })
    }

    /// Decodes the frame at a place of the group, given the frame before it, down to level `levels.end`, which the next one
    /// is predicted from: what it leaves for that, and the level `levels.start`, which is shown. Faults of finer levels
    /// are none of it. `None` if it must be decoded by itself.
    fn on_the_way(
        &self,
        group: &Group,
        at: usize,
        last: Option<&Last>,
        levels: Range<u8>,
    ) -> Option<(Decoding<'static>, Option<Last>)> {
        let mut decoding = self.started(group, at, last, levels.end).ok()?;
        while decoding.level() != Some(levels.start) {
            decoding.advance().ok()??;
        }
        let shown = decoding.so_far()?;
        let finished = decoding.finish().ok();
        let last = finished.and_then(|()| kept(&mut decoding, group, at, levels.end));
        Some((shown, last))
    }

    /// Decodes the frame at a place of the group down to `level`, given the frame before it.
    fn decoded(&self, group: &Group, at: usize, last: Option<&Last>, level: u8) -> Result<Decoding<'static>> {
        let mut decoding = self.started(group, at, last, level)?;
        decoding.finish().map_err(|error| group.in_frame(at, error))?;
        Ok(decoding)
    }

    /// Begins to decode the frame at a place of the group down to `level`, given the frame before it.
    fn started(&self, group: &Group, at: usize, last: Option<&Last>, level: u8) -> Result<Decoding<'static>> {
        let started = || {
            let (stream, motion) = group.stream(at);
            let header = group.frame_header(at);
            let inter = match (group.is_whole(at), last) {
                (true, _) => None,
                (false, None) => return Err(Error::Usage("the frame before was not decoded".into())),
                (false, Some(last)) => {
                    self.check_memory(&header, group, level)?;
                    // What is wrong with the motion of finer levels is theirs.
                    let motion = &motion[..=usize::from(level - header.base)];
                    let previous = Arc::clone(&last.previous);
                    let (isa, levels) = (self.decoder.isa(), [header.base, header.top]);
                    let voxels = previous.voxels();
                    let inter = || Inter::new(isa, previous, motion, levels);
                    Some(self.decoder.log().step("motion", voxels, "voxels", inter)?)
                }
            };
            let decoder = self.decoder.clone().with_level(level);
            Ok(decoder.start_frame(stream, inter))
        };
        started().map_err(|error| group.in_frame(at, error))
    }

    /// Checks that a frame and the one before it fit the limits. Both have at most the voxels that the sequence states.
    /// The frame moved by parts has at most twice as many, the level moved by blocks as many as a frame; a warped frame
    /// takes more.
    fn check_memory(&self, header: &Header, group: &Group, top: u8) -> Result<()> {
        let most = group.common.voxels(top)?;
        // Levels above the last one have a third of its voxels, more or less; never more than each as many.
        let levels = u64::from(top) + 1;
        let voxels = u64::from(most).saturating_mul(levels.min(4));
        let moved = voxels.saturating_mul(3 * Previous::bytes_per_voxel() as u64);
        let warped = u64::from(most).saturating_mul(Warped::bytes_per_voxel() as u64);
        let kept = voxels.saturating_mul(Previous::bytes_per_voxel() as u64) + moved.max(warped);
        let bytes = self.decoder.memory(header, top)?.saturating_add(kept);
        self.decoder
            .limits()
            .check_bytes("memory to decode this sequence", bytes)
    }
}

/// The levels that the frames at `places` must be decoded to so that the frame behind them can be shown at level `shown`.
fn needed(group: &Group, places: Range<usize>, shown: u8) -> Result<Vec<u8>> {
    let mut level = shown;
    let mut levels = Vec::with_capacity(places.len());
    for next in (places.start + 1..=places.end).rev() {
        level = level.max(group.reference_level(next)?);
        levels.push(level);
    }
    levels.reverse();
    Ok(levels)
}

/// What a frame that was decoded down to `level` leaves for the next one.
fn kept(decoding: &mut Decoding, group: &Group, at: usize, level: u8) -> Option<Last> {
    Some(Last {
        group: group.hash(),
        at,
        level,
        previous: Arc::new(decoding.take_previous()?),
    })
}

impl DecodedFrame {
    /// The voxels with their colours.
    pub fn points(&self) -> Option<Points<'_>> {
        self.decoding.points()
    }

    /// The frame's Gaussians.
    ///
    /// # Errors
    /// Those of [`Decoding::gaussians`].
    pub fn gaussians(&self) -> Result<Gaussians> {
        self.decoding.gaussians()
    }

    /// The level that was decoded.
    pub fn level(&self) -> Option<u8> {
        self.decoding.level()
    }
}

/// Frames of a sequence, one after the other. An error does not end it: frames of later groups follow.
#[derive(Debug)]
pub struct Frames<'a> {
    decoder: &'a mut SequenceDecoder,
    sequence: &'a SequenceReader<'a>,
    frames: Range<u64>,
}

impl Iterator for Frames<'_> {
    type Item = Result<DecodedFrame>;

    fn next(&mut self) -> Option<Self::Item> {
        let frame = self.frames.next()?;
        Some(self.decoder.frame(self.sequence, frame))
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        self.frames.size_hint()
    }
}

/// Gaussians of the frames of a sequence. An error does not end it.
#[derive(Debug)]
pub struct GaussianFrames<'a> {
    frames: Frames<'a>,
    /// The frame whose Gaussians come next.
    next: Option<Result<DecodedFrame>>,
}

impl Iterator for GaussianFrames<'_> {
    type Item = Result<Gaussians>;

    fn next(&mut self) -> Option<Self::Item> {
        let frame = self.next.take()?;
        let frames = &mut self.frames;
        let (gaussians, next) = rayon::join(|| frame?.gaussians(), || frames.next());
        self.next = next;
        Some(gaussians)
    }
}

#[cfg(all(test, feature = "encoder"))]
mod tests;
