//! The index of a sequence of frames, and the frame tables of its groups (`docs/format.md`, clause 17).
//!
//! A sequence is a header, an index, and groups of frames. The index says of each unit of the file what it covers, how
//! much it holds, and where it lies. The units here are groups of frames in time.

use xxhash_rust::xxh3::xxh3_64;

use super::chunk::{Chunk, ChunkKind, Chunks, Form};
use super::header::{Header, Section};
use super::malformed;
use super::reader::{Reader, put_varint};
use crate::error::{Error, Result, Stage, feature};
use crate::limits::Limits;

/// Maximum number of frames of a group.
pub const MAX_GROUP_FRAMES: u32 = 65_536;
/// What the units of the index are: groups of frames in time.
const UNITS_IN_TIME: u8 = 0;

/// Where the groups of a sequence lie, in time and in the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Index {
    /// Ticks per second.
    pub timescale: u32,
    /// Ticks that a frame is shown for, where no other frame follows.
    pub duration: u32,
    /// The groups in the order of time.
    pub groups: Vec<GroupEntry>,
}

/// A group of frames that is decoded without any other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GroupEntry {
    /// The number of its first frame, from 0.
    pub first: u64,
    /// Number of frames, 1 to [`MAX_GROUP_FRAMES`].
    pub frames: u32,
    /// The time of its first frame, in ticks.
    pub start: u64,
    /// Ticks from its first frame to the end of its last.
    pub ticks: u32,
    /// Byte offset in the sequence.
    pub offset: u64,
    /// Length in bytes.
    pub bytes: u32,
    /// XXH3-64 of its bytes.
    pub hash: u64,
}

/// How a frame is coded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameKind {
    /// By itself.
    Whole,
    /// From the frame before it.
    Predicted,
}

/// A frame in the table of its group.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameEntry {
    /// How it is coded.
    pub kind: FrameKind,
    /// Ticks after the group's first frame.
    pub ticks: u32,
    /// Voxels of level N.
    pub points: u32,
    /// The levels L to M.
    pub levels: Vec<FrameLevel>,
    /// Byte offset in the group.
    pub offset: u64,
}

/// A level of a frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct FrameLevel {
    /// Its voxels.
    pub voxels: u32,
    /// Bytes of its motion, before its sections.
    pub motion: u32,
    /// Bytes of its sections.
    pub section: Section,
}

impl FrameLevel {
    fn bytes(&self) -> u64 {
        u64::from(self.motion) + self.section.bytes()
    }
}

impl FrameEntry {
    /// Bytes of the frame up to and including the level of this index, from L on.
    pub fn prefix_bytes(&self, level: usize) -> u64 {
        self.levels.iter().take(level + 1).map(FrameLevel::bytes).sum()
    }

    /// Bytes of the frame.
    pub fn bytes(&self) -> u64 {
        self.levels.iter().map(FrameLevel::bytes).sum()
    }

    /// The header of the frame as a stream of its own. `common` is that of the sequence.
    pub fn header(&self, common: &Header) -> Header {
        Header {
            points: self.points.into(),
            voxels: self.levels.iter().map(|level| level.voxels).collect(),
            sections: self.levels.iter().map(|level| level.section).collect(),
            ..common.clone()
        }
    }
}

impl Index {
    /// Reads the index behind the header of a sequence. Returns it with the byte offset of the first group. The groups
    /// need not be there.
    ///
    /// # Errors
    /// [`Error::Truncated`], [`Error::ChecksumMismatch`], [`Error::Malformed`], and [`Error::LimitExceeded`] for
    /// too many frames.
    pub fn parse(bytes: &[u8], header: &Header, limits: &Limits) -> Result<Self> {
        if let Some(section) = header.sections.iter().find(|section| section.bytes() > 0) {
            let value = format!("{section:?}");
            return Err(malformed("17.1.2", 72, "section lengths of a sequence", value, 0));
        }
        let chunk = only_chunk(bytes, header.bytes(), ChunkKind::Index, "index of the sequence")?;
        if chunk.count == 0 {
            return Err(malformed("17.2.1", chunk.offset, "number of groups", 0, "at least 1"));
        }
        let mut reader = InPayload::new(&chunk, "17.2.2");
        let units = reader.read(|r| r.u8("units of the index"))?;
        if units != UNITS_IN_TIME {
            return Err(Error::Unsupported {
                what: feature::UNITS_OF_SEQUENCE,
                detail: format!("its units are of kind {units}; this version knows groups of frames, kind 0"),
            });
        }
        let timescale = reader.read(|r| r.u32("timescale"))?;
        let duration = reader.read(|r| r.u32("duration of a frame"))?;
        for (field, value) in [("timescale", timescale), ("duration of a frame", duration)] {
            if value == 0 {
                return Err(malformed("17.2.2", chunk.payload_at, field, value, "at least 1"));
            }
        }
        let mut index = Index {
            timescale,
            duration,
            groups: Vec::new(),
        };
        let (mut first, mut end) = (0u64, 0u64);
        let mut offset = (chunk.payload_at + chunk.payload.len()) as u64;
        for _ in 0..chunk.count {
            let entry = reader.group(first, end, offset)?;
            first += u64::from(entry.frames);
            end = entry.start + u64::from(entry.ticks);
            offset += u64::from(entry.bytes);
            limits.check_frames("number of frames of the sequence", first)?;
            index.groups.push(entry);
        }
        reader.finish()?;
        Ok(index)
    }

    /// Appends the index. The groups' offsets and first frames follow from the rest.
    ///
    /// # Errors
    /// [`Error::Usage`] if there are too many groups, or gaps between them are too long.
    pub fn write(&self, out: &mut Vec<u8>) -> Result<()> {
        let mut payload = vec![UNITS_IN_TIME];
        payload.extend(self.timescale.to_le_bytes());
        payload.extend(self.duration.to_le_bytes());
        let mut end = 0;
        for group in &self.groups {
            let gap = group.start.checked_sub(end).and_then(|gap| u32::try_from(gap).ok());
            let Some(gap) = gap else {
                let what = "groups must follow one another in time, less than 2^32 ticks apart";
                return Err(Error::Usage(what.into()));
            };
            end = group.start + u64::from(group.ticks);
            for number in [group.frames, gap, group.ticks, group.bytes] {
                put_varint(&mut payload, number);
            }
            payload.extend(group.hash.to_le_bytes());
        }
        put_chunk(ChunkKind::Index, self.groups.len(), &payload, out)
    }

    /// Number of frames.
    pub fn frames(&self) -> u64 {
        self.groups
            .last()
            .map_or(0, |group| group.first + u64::from(group.frames))
    }
}

impl GroupEntry {
    /// The entry of a group of these bytes, with a length of `ticks`, which starts at `start`.
    ///
    /// # Errors
    /// [`Error::Usage`] if it is 4 GiB or more.
    pub fn of(bytes: &[u8], frames: u32, start: u64, ticks: u32) -> Result<Self> {
        let length =
            u32::try_from(bytes.len()).map_err(|_| Error::Usage("a group must be shorter than 4 GiB".into()))?;
        Ok(GroupEntry {
            first: 0,
            frames,
            start,
            ticks,
            offset: 0,
            bytes: length,
            hash: xxh3_64(bytes),
        })
    }

    /// The bytes of the group in a sequence, once their hash is checked.
    ///
    /// # Errors
    /// [`Error::Truncated`], [`Error::Malformed`] if the hash differs.
    pub fn take<'a>(&self, sequence: &'a [u8]) -> Result<&'a [u8]> {
        let bytes = self.unchecked(sequence)?;
        let found = xxh3_64(bytes);
        if found != self.hash {
            let (found, expected) = (format!("{found:#018x}"), format!("{:#018x}", self.hash));
            return Err(malformed("17.2.3", self.offset, "hash of the group", found, expected));
        }
        Ok(bytes)
    }

    /// The same, whatever their hash is.
    pub(crate) fn unchecked<'a>(&self, sequence: &'a [u8]) -> Result<&'a [u8]> {
        let start = usize::try_from(self.offset).unwrap_or(usize::MAX);
        Reader::new(sequence, start).take(self.bytes as usize, "group of frames")
    }
}

/// Reads the frame table of a group of `frames` frames and `ticks` ticks. `common` is the header of the sequence.
///
/// # Errors
/// [`Error::Truncated`], [`Error::ChecksumMismatch`], [`Error::Malformed`], [`Error::LimitExceeded`].
pub fn parse_table(group: &[u8], entry: &GroupEntry, common: &Header, limits: &Limits) -> Result<Vec<FrameEntry>> {
    let chunk = only_chunk(group, 0, ChunkKind::FrameTable, "frame table")?;
    if chunk.count != entry.frames {
        let field = "number of frames in the table";
        return Err(malformed("17.3.1", chunk.offset, field, chunk.count, entry.frames));
    }
    let mut reader = InPayload::new(&chunk, "17.3.2");
    let mut frames: Vec<FrameEntry> = Vec::new();
    let mut offset = (chunk.payload_at + chunk.payload.len()) as u64;
    for _ in 0..chunk.count {
        let at = reader.at();
        let frame = reader.frame(frames.last(), common.voxels.len(), offset)?;
        check_frame(&frame, at, common, limits)?;
        offset += frame.bytes();
        frames.push(frame);
    }
    reader.finish()?;
    if frames.first().is_none_or(|first| first.kind != FrameKind::Whole) {
        let (field, expected) = ("first frame of the group", "a whole frame");
        return Err(malformed(
            "17.3.3",
            chunk.payload_at,
            field,
            "a predicted one",
            expected,
        ));
    }
    let last = frames.last().map_or(0, |frame| frame.ticks);
    if last >= entry.ticks {
        let expected = format!("less than {}", entry.ticks);
        return Err(malformed(
            "17.3.3",
            chunk.payload_at,
            "time of the last frame",
            last,
            expected,
        ));
    }
    if offset != group.len() as u64 {
        let field = "bytes of the group";
        return Err(malformed("17.3.4", chunk.payload_at, field, group.len(), offset));
    }
    Ok(frames)
}

/// The frame table of a group as bytes.
///
/// # Errors
/// [`Error::Usage`] if there are too many frames.
pub fn table_bytes(frames: &[FrameEntry]) -> Result<Vec<u8>> {
    let (mut payload, mut before) = (Vec::new(), 0);
    for frame in frames {
        let predicted = frame.kind == FrameKind::Predicted;
        payload.push(u8::from(predicted));
        put_varint(&mut payload, frame.ticks.saturating_sub(before));
        before = frame.ticks;
        put_varint(&mut payload, frame.points);
        for level in &frame.levels {
            put_varint(&mut payload, level.voxels);
            if predicted {
                put_varint(&mut payload, level.motion);
            }
            put_varint(&mut payload, level.section.geometry);
            put_varint(&mut payload, level.section.colours);
        }
    }
    let mut bytes = Vec::new();
    put_chunk(ChunkKind::FrameTable, frames.len(), &payload, &mut bytes)?;
    Ok(bytes)
}

/// Checks a frame's counts against each other and against those of the sequence, which are the most of any frame.
fn check_frame(frame: &FrameEntry, at: usize, common: &Header, limits: &Limits) -> Result<()> {
    let header = frame.header(common);
    header.check(limits).map_err(|error| match error {
        Error::Malformed {
            field, value, expected, ..
        } => malformed("17.3.2", at, field, value, expected),
        error => error,
    })?;
    for (level, (found, most)) in (common.base..).zip(header.voxels.iter().zip(&common.voxels)) {
        if found > most {
            let field = format!("voxel count of level {level}");
            let expected = format!("at most {most}, as the sequence states");
            return Err(malformed("17.1.2", at, field, found, expected));
        }
    }
    match header.points > common.points {
        true => Err(malformed(
            "17.1.2",
            at,
            "points",
            header.points,
            format!("at most {}", common.points),
        )),
        false => Ok(()),
    }
}

/// The first critical chunk from byte `at` on, which must be of this kind. One that is not all there is the `field` that
/// is cut.
pub(super) fn only_chunk<'a>(bytes: &'a [u8], at: usize, kind: ChunkKind, field: &'static str) -> Result<Chunk<'a>> {
    let cut = |offset, needed| Error::Truncated {
        stage: Stage::Bitstream,
        offset,
        field,
        needed,
    };
    if at >= bytes.len() {
        return Err(cut(bytes.len() as u64, (at - bytes.len() + 1) as u64));
    }
    let chunk = Chunks::new(Form::Sequence, bytes, at..bytes.len()).expect(kind, 0, 0, 0..=u32::MAX.into());
    chunk.map_err(|error| match error {
        Error::Truncated { offset, needed, .. } => cut(offset, needed),
        error => error,
    })
}

pub(super) fn put_chunk(kind: ChunkKind, count: usize, payload: &[u8], out: &mut Vec<u8>) -> Result<()> {
    let count = u32::try_from(count).map_err(|_| Error::Usage(format!("{count} are too many units")))?;
    let chunk = Chunk {
        kind,
        level: 0,
        slice: 0,
        count,
        payload,
        offset: 0,
        payload_at: 0,
    };
    chunk.write(Form::Sequence, &[], out)
}

/// Reads the payload of a chunk, whose checksum holds: what is missing in it is malformed, not cut.
pub(super) struct InPayload<'a> {
    reader: Reader<'a>,
    payload_at: usize,
    length: usize,
    clause: &'static str,
}

impl<'a> InPayload<'a> {
    pub(super) fn new(chunk: &Chunk<'a>, clause: &'static str) -> Self {
        InPayload {
            reader: Reader::new(chunk.payload, 0),
            payload_at: chunk.payload_at,
            length: chunk.payload.len(),
            clause,
        }
    }

    pub(super) fn at(&self) -> usize {
        self.payload_at + self.reader.at()
    }

    pub(super) fn read<T>(&mut self, read: impl FnOnce(&mut Reader<'a>) -> Result<T>) -> Result<T> {
        let (at, clause, length) = (self.at(), self.clause, self.length);
        read(&mut self.reader).map_err(|error| match error {
            Error::Truncated { field, .. } => malformed(clause, at, field, format!("end after {length} bytes"), "more"),
            Error::Malformed {
                field, value, expected, ..
            } => malformed("1.4.2", at, field, value, expected),
            error => error,
        })
    }

    pub(super) fn varint(&mut self, field: &'static str) -> Result<u32> {
        self.read(|reader| reader.varint(field))
    }

    /// Reads the entry of a group: the number of its first frame, the end of the group before, and the byte offset are
    /// known.
    fn group(&mut self, first: u64, end: u64, offset: u64) -> Result<GroupEntry> {
        let at = self.at();
        let frames = self.varint("frames of a group")?;
        if !(1..=MAX_GROUP_FRAMES).contains(&frames) {
            let expected = format!("1 to {MAX_GROUP_FRAMES}");
            return Err(malformed("17.2.2", at, "frames of a group", frames, expected));
        }
        let gap = self.varint("ticks before a group")?;
        Ok(GroupEntry {
            first,
            frames,
            start: end + u64::from(gap),
            ticks: self.varint("ticks of a group")?,
            offset,
            bytes: self.varint("bytes of a group")?,
            hash: self.read(|reader| reader.u64("hash of a group"))?,
        })
    }

    /// Reads the entry of a frame with so many levels, which starts at this byte of its group.
    fn frame(&mut self, before: Option<&FrameEntry>, levels: usize, offset: u64) -> Result<FrameEntry> {
        let at = self.at();
        let kind = match self.read(|reader| reader.u8("kind of a frame"))? {
            0 => FrameKind::Whole,
            1 => FrameKind::Predicted,
            other => return Err(malformed("17.3.2", at, "kind of a frame", other, "0 or 1")),
        };
        let step = self.varint("ticks after the frame before")?;
        let (ticks, expected) = match before {
            None => (Some(0).filter(|_| step == 0), "0 for the first frame"),
            Some(before) => (
                before.ticks.checked_add(step).filter(|_| step > 0),
                "more than 0, and less than 2^32 in all",
            ),
        };
        let Some(ticks) = ticks else {
            return Err(malformed("17.3.2", at, "ticks after the frame before", step, expected));
        };
        let points = self.varint("points of a frame")?;
        let mut all = Vec::with_capacity(levels);
        for _ in 0..levels {
            all.push(FrameLevel {
                voxels: self.varint("voxel count")?,
                motion: match kind {
                    FrameKind::Whole => 0,
                    FrameKind::Predicted => self.varint("bytes of the motion")?,
                },
                section: Section {
                    geometry: self.varint("bytes of the geometry")?,
                    colours: self.varint("bytes of the colours")?,
                },
            });
        }
        Ok(FrameEntry {
            kind,
            ticks,
            points,
            levels: all,
            offset,
        })
    }

    pub(super) fn finish(&self) -> Result<()> {
        match self.length - self.reader.at() {
            0 => Ok(()),
            rest => Err(malformed(self.clause, self.at(), "bytes after the last entry", rest, 0)),
        }
    }
}
