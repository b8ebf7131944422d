//! Finds the groups and frames of a sequence (`docs/format.md`, clauses 17.1 to 17.3).

use std::borrow::Cow;

use crate::axes::Axes;
use crate::container::sequence::{FrameEntry, FrameKind, GroupEntry, Index, parse_table};
use crate::container::{Header, Scan, ScannedChunk, axes};
use crate::error::{Error, Result, Stage};
use crate::limits::Limits;
use crate::motion::{Head, level_of};

/// Header and index of a sequence. Its groups are read when they are asked for, so that one that is damaged or missing
/// leaves the others usable.
#[derive(Debug, Clone)]
pub struct SequenceReader<'a> {
    bytes: Cow<'a, [u8]>,
    header: Header,
    index: Index,
    limits: Limits,
}

/// What lies at a byte of a sequence.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct FramePart {
    /// The number of the frame.
    pub frame: u64,
    /// The level whose sections or motion it is.
    pub level: u8,
    /// Whether it is of the motion that the level is predicted with.
    pub is_motion: bool,
    /// The chunk, if it is of one whose checksum holds. Places in it count from the start of a stream of the frame.
    pub chunk: Option<ScannedChunk>,
}

/// Where a level of a frame lies in the sequence.
struct Part {
    level: u8,
    /// Where its motion starts.
    start: u64,
    /// Where its sections start.
    sections: u64,
    end: u64,
}

/// A group whose hash and frame table hold.
#[derive(Debug, Clone)]
pub struct Group<'a> {
    pub(super) bytes: &'a [u8],
    pub(super) frames: Vec<FrameEntry>,
    pub(super) common: &'a Header,
    entry: GroupEntry,
}

impl<'a> SequenceReader<'a> {
    /// Whether these bytes start like a sequence of frames, and not like a stream of one frame.
    pub fn is_sequence(bytes: &[u8]) -> bool {
        Header::is_of_sequence(bytes)
    }

    /// Reads header and index. The groups may be missing, in part or all.
    ///
    /// # Errors
    /// [`Error::Truncated`], [`Error::ChecksumMismatch`], [`Error::Malformed`]; [`Error::Unsupported`] for a stream of
    /// one frame or a later version; [`Error::LimitExceeded`] for too many frames, voxels or levels.
    pub fn new(bytes: impl Into<Cow<'a, [u8]>>, limits: &Limits) -> Result<Self> {
        let bytes = bytes.into();
        let header = Header::parse_sequence(&bytes, limits)?;
        let index = Index::parse(&bytes, &header, limits)?;
        Ok(SequenceReader {
            bytes,
            header,
            index,
            limits: limits.clone(),
        })
    }

    /// What all frames have in common. Voxels and points are the most of any frame; section lengths are 0.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The index.
    #[doc(hidden)]
    pub fn index(&self) -> &Index {
        &self.index
    }

    /// What the sequence says of its coordinates: what its first frame does.
    ///
    /// # Errors
    /// Those of [`SequenceReader::group`].
    pub fn axes(&self) -> Result<Axes> {
        axes(&self.group(0)?.stream(0).0)
    }

    /// Number of frames, at least 1.
    pub fn frames(&self) -> u64 {
        self.index.frames()
    }

    /// Number of groups, at least 1.
    pub fn groups(&self) -> usize {
        self.index.groups.len()
    }

    /// Frames per second, of frames with the usual duration.
    pub fn frame_rate(&self) -> f64 {
        f64::from(self.index.timescale) / f64::from(self.index.duration)
    }

    /// Seconds from time 0 to the end of the last frame.
    pub fn seconds(&self) -> f64 {
        let end = |group: &GroupEntry| group.start + u64::from(group.ticks);
        self.to_seconds(self.index.groups.last().map_or(0, end))
    }

    /// Numbers of the frames of a group. `None` if there is no such group.
    pub fn frames_of(&self, group: usize) -> Option<std::ops::Range<u64>> {
        let entry = self.index.groups.get(group)?;
        Some(entry.first..entry.first + u64::from(entry.frames))
    }

    /// The group that has a frame.
    ///
    /// # Errors
    /// [`Error::Usage`] if the sequence has no such frame.
    pub fn group_of(&self, frame: u64) -> Result<usize> {
        if frame >= self.frames() {
            return Err(Error::Usage(format!(
                "the sequence has the frames 0 to {}, not {frame}",
                self.frames() - 1
            )));
        }
        Ok(self.index.groups.partition_point(|group| group.first <= frame) - 1)
    }

    /// The frame that is shown at a time in seconds: the last one that starts no later. The first one before that.
    ///
    /// # Errors
    /// Those of [`SequenceReader::group`]; [`Error::Usage`] if the time is not a number.
    pub fn frame_at(&self, seconds: f64) -> Result<u64> {
        if seconds.is_nan() {
            return Err(Error::Usage("the time of a frame must be a number of seconds".into()));
        }
        // Times that frames were given round up to their ticks.
        let tick = (seconds * f64::from(self.index.timescale) + 1e-6).max(0.0) as u64;
        let at = self.index.groups.partition_point(|group| group.start <= tick);
        let at = at.saturating_sub(1);
        let group = self.group(at)?;
        let since = tick.saturating_sub(group.entry.start);
        let after = group.frames.partition_point(|frame| u64::from(frame.ticks) <= since);
        Ok(group.entry.first + after.saturating_sub(1) as u64)
    }

    /// The time of a frame in seconds.
    ///
    /// # Errors
    /// Those of [`SequenceReader::group`], and [`Error::Usage`] if there is no such frame.
    pub fn time_of(&self, frame: u64) -> Result<f64> {
        let group = self.group(self.group_of(frame)?)?;
        let ticks = group.frames[(frame - group.entry.first) as usize].ticks;
        Ok(self.to_seconds(group.entry.start + u64::from(ticks)))
    }

    /// Reads a group and its frame table.
    ///
    /// # Errors
    /// [`Error::Truncated`] if it is not all there, [`Error::Malformed`], [`Error::ChecksumMismatch`],
    /// [`Error::LimitExceeded`]; [`Error::Usage`] if there is no such group.
    pub fn group(&self, group: usize) -> Result<Group<'_>> {
        let entry = self.entry(group)?;
        let bytes = entry.take(&self.bytes)?;
        self.with_table(entry, bytes)
    }

    /// The group, whatever its hash is: what is known of it if it is damaged.
    pub(super) fn damaged_group(&self, group: usize) -> Result<Group<'_>> {
        let entry = self.entry(group)?;
        self.with_table(entry, entry.unchecked(&self.bytes)?)
    }

    fn with_table<'b>(&'b self, entry: &GroupEntry, bytes: &'b [u8]) -> Result<Group<'b>> {
        let frames = parse_table(bytes, entry, &self.header, &self.limits);
        Ok(Group {
            bytes,
            frames: frames.map_err(|error| error.moved(|byte| entry.offset + byte))?,
            common: &self.header,
            entry: *entry,
        })
    }

    /// What lies at a byte of the sequence, as far as the tables tell. `None` outside of frames.
    pub fn part_at(&self, byte: u64) -> Option<FramePart> {
        let is_in = |entry: &GroupEntry| (entry.offset..entry.offset + u64::from(entry.bytes)).contains(&byte);
        let group = self.index.groups.iter().position(is_in)?;
        let group = self.damaged_group(group).ok()?;
        (0..group.len()).find_map(|at| group.part_at(at, byte))
    }

    /// The bytes of a group.
    pub(super) fn group_bytes(&self, group: usize) -> Result<&[u8]> {
        self.entry(group)?.take(&self.bytes)
    }

    fn entry(&self, group: usize) -> Result<&GroupEntry> {
        self.index.groups.get(group).ok_or_else(|| {
            let last = self.groups() - 1;
            Error::Usage(format!("the sequence has the groups 0 to {last}, not {group}"))
        })
    }

    /// Checks that the file ends with the last group.
    ///
    /// # Errors
    /// [`Error::Truncated`] or [`Error::Malformed`] if not.
    pub fn check_end(&self) -> Result<()> {
        let end = self
            .index
            .groups
            .last()
            .map_or(0, |group| group.offset + u64::from(group.bytes));
        let length = self.bytes.len() as u64;
        match length.checked_sub(end) {
            Some(0) => Ok(()),
            None => Err(Error::Truncated {
                stage: Stage::Bitstream,
                offset: length,
                field: "group of frames",
                needed: end - length,
            }),
            Some(rest) => {
                let field = "number of bytes after the last group";
                Err(Error::malformed(Stage::Bitstream, format!("byte {end}"), field, rest, 0).breaks("17.1.1"))
            }
        }
    }

    fn to_seconds(&self, ticks: u64) -> f64 {
        ticks as f64 / f64::from(self.index.timescale)
    }
}

impl Group<'_> {
    /// Number of frames.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether there are no frames. There is always one.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// The number of its first frame in the sequence.
    pub fn first(&self) -> u64 {
        self.entry.first
    }

    /// Whether the frame at this place in the group is coded by itself.
    ///
    /// # Panics
    /// If the group has no such frame.
    pub fn is_whole(&self, at: usize) -> bool {
        self.frames[at].kind == FrameKind::Whole
    }

    /// Whether the frame at this place in the group is predicted from the previous one as a smooth field warps it
    /// (`docs/format.md`, clause 17.10). Not if its motion is damaged.
    ///
    /// # Panics
    /// If the group has no such frame.
    pub fn is_warped(&self, at: usize) -> bool {
        !self.is_whole(at) && self.head(at).is_ok_and(|head| head.warped)
    }

    /// The header of the frame at this place in the group, as if it was a stream of its own.
    ///
    /// # Panics
    /// If the group has no such frame.
    pub fn frame_header(&self, at: usize) -> Header {
        self.frames[at].header(self.common)
    }

    /// Ticks from the start of the group to the frame at this place in it.
    ///
    /// # Panics
    /// If the group has no such frame.
    #[doc(hidden)]
    pub fn ticks(&self, at: usize) -> u32 {
        self.frames[at].ticks
    }

    /// Bytes of the frame at this place in the group, without its entry in the table.
    ///
    /// # Panics
    /// If the group has no such frame.
    pub fn frame_bytes(&self, at: usize) -> u64 {
        self.frames[at].bytes()
    }

    /// What tells the group from others.
    pub(super) fn hash(&self) -> u64 {
        self.entry.hash
    }

    /// The level that the frame before must be decoded to at least, so that the predicted frame at this place in the
    /// group can be decoded.
    ///
    /// # Errors
    /// [`Error::Malformed`] if the frame's motion is damaged.
    pub(super) fn reference_level(&self, at: usize) -> Result<u8> {
        Ok(self.head(at)?.reference_level)
    }

    /// The head of the motion of the predicted frame at this place in the group.
    fn head(&self, at: usize) -> Result<Head> {
        let frame = &self.frames[at];
        let motion = frame.levels.first().map_or(0, |level| level.motion as usize);
        let bytes = &self.bytes[frame.offset as usize..][..motion];
        let head = Head::parse(bytes, self.common.base, self.common.top);
        head.map(|(head, _)| head).map_err(|error| self.in_frame(at, error))
    }

    /// An error in the stream or in the motion of a frame, as one of the sequence.
    pub(super) fn in_frame(&self, at: usize, error: Error) -> Error {
        let source = match level_of(&error).and_then(|level| self.parts(at).find(|part| part.level == level)) {
            Some(part) => in_motion(error, &part),
            None => error.moved(|byte| self.place(at, byte)),
        };
        Error::Frame {
            frame: self.entry.first + at as u64,
            source: Box::new(source),
        }
    }

    /// Where the bytes of each level of a frame lie in the sequence.
    fn parts(&self, at: usize) -> impl Iterator<Item = Part> {
        let frame = &self.frames[at];
        let mut start = self.entry.offset + frame.offset;
        (self.common.base..).zip(&frame.levels).map(move |(level, own)| {
            let sections = start + u64::from(own.motion);
            let part = Part {
                level,
                start,
                sections,
                end: sections + own.section.bytes(),
            };
            start = part.end;
            part
        })
    }

    /// Where a byte of the stream of a frame lies in the sequence. Its header stands for the frame's entry in the table,
    /// and lies where the frame starts.
    fn place(&self, at: usize, byte: u64) -> u64 {
        let Some(mut left) = byte.checked_sub(self.frame_header(at).bytes() as u64) else {
            return self.entry.offset + self.frames[at].offset;
        };
        let mut last = self.entry.offset;
        for part in self.parts(at) {
            let own = part.end - part.sections;
            if left < own {
                return part.sections + left;
            }
            left -= own;
            last = part.end;
        }
        last + left
    }

    /// What lies at a byte of the sequence, if it is of this frame.
    fn part_at(&self, at: usize, byte: u64) -> Option<FramePart> {
        let part = self.parts(at).find(|part| (part.start..part.end).contains(&byte))?;
        let (stream, _) = self.stream(at);
        let scan = Scan::new(&stream, &self.frame_header(at));
        let is_here = |chunk: &&ScannedChunk| {
            let ends = [chunk.start, chunk.end - 1].map(|end| self.place(at, end as u64));
            (ends[0]..=ends[1]).contains(&byte) && byte >= part.sections
        };
        Some(FramePart {
            frame: self.entry.first + at as u64,
            level: part.level,
            is_motion: byte < part.sections,
            chunk: scan.chunks.iter().find(is_here).copied(),
        })
    }

    /// The chunks of all frames that are damaged.
    pub(super) fn damaged_chunks(&self) -> Vec<Error> {
        let damaged = |at: usize| {
            let (stream, _) = self.stream(at);
            let faults = Scan::new(&stream, &self.frame_header(at)).faults;
            faults.into_iter().map(move |(_, error)| self.in_frame(at, error))
        };
        (0..self.len()).flat_map(damaged).collect()
    }

    /// The sections of a frame behind a header of its own: a stream of one frame, if the frame is whole. With the
    /// motion of each level.
    pub(super) fn stream(&self, at: usize) -> (Vec<u8>, Vec<&[u8]>) {
        let frame = &self.frames[at];
        let mut stream = frame.header(self.common).write();
        let mut motion = Vec::new();
        // The table was held against the bytes of the group.
        let mut rest = &self.bytes[frame.offset as usize..];
        for level in &frame.levels {
            let (moved, after) = rest.split_at(level.motion as usize);
            let (sections, after) = after.split_at(level.section.bytes() as usize);
            stream.extend(sections);
            motion.push(moved);
            rest = after;
        }
        (stream, motion)
    }
}

/// An error in the motion of a level, with its place.
fn in_motion(mut error: Error, part: &Part) -> Error {
    if let Error::Malformed { at, .. } = &mut error {
        *at = format!("byte {}, {at}", part.start);
    }
    error
}
