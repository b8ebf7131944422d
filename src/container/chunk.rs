//! Chunks: typed, numbered, checked pieces of a section.

use super::malformed;
use super::reader::{Reader, put_varint};
use crate::error::{Error, Result};

/// How the bytes of a chunk before its payload are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Form {
    /// Of version 2: all numbers in their full width.
    Fixed,
    /// Of version 3: numbers as short as they are.
    Short,
}

/// Bytes of a chunk of version 2 before its checksum.
const FIXED: usize = 12;
/// Chunk types from here on may be skipped.
const ANCILLARY: u8 = 128;

/// What a chunk holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChunkKind {
    /// A slice of the octree.
    Geometry,
    /// A slice of the latents.
    Features,
    /// A correction of colours.
    Filter,
    /// A slice of what colours are still off.
    Residual,
    /// The first levels of the octree, in one.
    GeometryTrunk,
    /// The colours of the first levels, in one.
    ColourTrunk,
    /// A slice of the colours of a level.
    Colours,
    /// The filter of the colours of a level.
    PostFilter,
    /// Something that a reader may skip: its type, 128 to 255.
    Ancillary(u8),
}

/// One chunk whose checksum is right.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Chunk<'a> {
    /// What it holds.
    pub kind: ChunkKind,
    /// The level that it belongs to.
    pub level: u8,
    /// Its number within level and kind.
    pub slice: u16,
    /// How many voxels it describes; of a slice of colours, how many parents.
    pub count: u32,
    /// Its content.
    pub payload: &'a [u8],
    /// Byte offset of the chunk in the stream.
    pub offset: usize,
    /// Byte offset of the payload.
    pub payload_at: usize,
}

/// The chunks of a section.
#[derive(Debug, Clone)]
pub struct Chunks<'a> {
    form: Form,
    reader: Reader<'a>,
    end: usize,
}

/// The kinds of each form with their codes and names.
const KINDS: [(Form, u8, ChunkKind, &str); 9] = [
    (Form::Fixed, 1, ChunkKind::Geometry, "geometry"),
    (Form::Fixed, 2, ChunkKind::Features, "feature"),
    (Form::Fixed, 3, ChunkKind::Filter, "filter"),
    (Form::Fixed, 4, ChunkKind::Residual, "residual"),
    (Form::Short, 1, ChunkKind::Geometry, "geometry"),
    (Form::Short, 5, ChunkKind::GeometryTrunk, "geometry trunk"),
    (Form::Short, 6, ChunkKind::ColourTrunk, "colour trunk"),
    (Form::Short, 7, ChunkKind::Colours, "colour"),
    (Form::Short, 8, ChunkKind::PostFilter, "colour filter"),
];

impl ChunkKind {
    fn code(self) -> u8 {
        let code = |(_, code, kind, _): &(_, u8, ChunkKind, _)| (*kind == self).then_some(*code);
        match self {
            ChunkKind::Ancillary(code) => code,
            _ => KINDS.iter().find_map(code).unwrap_or_default(),
        }
    }

    fn of(form: Form, code: u8) -> Option<Self> {
        if code >= ANCILLARY {
            return Some(ChunkKind::Ancillary(code));
        }
        let own = KINDS.iter().find(|kind| kind.0 == form && kind.1 == code);
        own.map(|(_, _, kind, _)| *kind)
    }
}

impl std::fmt::Display for ChunkKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            ChunkKind::Ancillary(code) => write!(f, "ancillary {code}"),
            _ => {
                let name = KINDS.iter().find(|kind| kind.2 == *self);
                f.write_str(name.map_or("", |kind| kind.3))
            }
        }
    }
}

impl Chunk<'_> {
    /// Appends the chunk to `out`, `prefix` before its payload. The offsets play no part.
    ///
    /// # Errors
    /// [`Error::Usage`] if the payload is 4 GiB or more.
    pub(super) fn write(&self, form: Form, prefix: &[u8], out: &mut Vec<u8>) -> Result<()> {
        let length = prefix.len() + self.payload.len();
        let length = u32::try_from(length).map_err(|_| Error::Usage(format!("a chunk cannot hold {length} bytes")))?;
        let start = out.len();
        out.extend([self.kind.code(), self.level]);
        match form {
            Form::Fixed => {
                out.extend(self.slice.to_le_bytes());
                out.extend(self.count.to_le_bytes());
                out.extend(length.to_le_bytes());
            }
            Form::Short => {
                for number in [self.slice.into(), self.count, length] {
                    put_varint(out, number);
                }
            }
        }
        let sum = [prefix, self.payload]
            .iter()
            .fold(crc32c::crc32c(&out[start..]), |sum, part| {
                crc32c::crc32c_append(sum, part)
            });
        out.extend(sum.to_le_bytes());
        out.extend(prefix);
        out.extend(self.payload);
        Ok(())
    }
}

impl<'a> Chunks<'a> {
    /// The chunks of the section `range` of a stream, which lies within its bytes.
    pub(super) fn new(form: Form, stream: &'a [u8], range: std::ops::Range<usize>) -> Self {
        Chunks {
            form,
            reader: Reader::new(&stream[..range.end], range.start),
            end: range.end,
        }
    }

    fn read(&mut self) -> Result<Chunk<'a>> {
        let start = self.reader.at();
        let [code, level, slice, count, length] = match self.form {
            Form::Fixed => self.fixed_head()?,
            Form::Short => self.short_head()?,
        };
        let head = self.reader.since(start);
        let expected = self.reader.u32("chunk checksum")?;
        let payload_at = self.reader.at();
        let payload = self.reader.take(length as usize, "chunk payload")?;
        let found = crc32c::crc32c_append(crc32c::crc32c(head), payload);
        if found != expected {
            return Err(Error::ChecksumMismatch {
                what: format!("a chunk that calls itself type {code}, level {level}, slice {slice}"),
                offset: start as u64,
                expected,
                found,
            });
        }
        let Some(kind) = ChunkKind::of(self.form, code as u8) else {
            return Err(Error::Unsupported {
                what: "this chunk type",
                detail: format!("byte {start} has type {code}, which only a later version knows"),
            });
        };
        let Ok(slice) = slice.try_into() else {
            return Err(malformed(start, "slice of a chunk", slice, "at most 65535"));
        };
        Ok(Chunk {
            kind,
            level: level as u8,
            slice,
            count,
            payload,
            offset: start,
            payload_at,
        })
    }

    /// Type, level, slice, count and length of a chunk.
    fn fixed_head(&mut self) -> Result<[u32; 5]> {
        // Together, so that one error tells how much of it is missing.
        let head: [u8; FIXED] = self.reader.array("chunk header")?;
        let mut head = Reader::new(&head, 0);
        let field = "chunk header";
        Ok([
            head.u8(field)?.into(),
            head.u8(field)?.into(),
            head.u16(field)?.into(),
            head.u32(field)?,
            head.u32(field)?,
        ])
    }

    fn short_head(&mut self) -> Result<[u32; 5]> {
        let reader = &mut self.reader;
        Ok([
            reader.u8("chunk type")?.into(),
            reader.u8("chunk level")?.into(),
            reader.varint("chunk slice")?,
            reader.varint("chunk count")?,
            reader.varint("chunk length")?,
        ])
    }

    /// The next chunk that is not ancillary; it must be this one, with a count in `counts`.
    pub(super) fn expect(
        &mut self,
        kind: ChunkKind,
        level: u8,
        slice: u64,
        counts: std::ops::RangeInclusive<u64>,
    ) -> Result<Chunk<'a>> {
        let wanted = || format!("{kind} chunk of level {level}, slice {slice}");
        let fits = |chunk: &Chunk| chunk.level == level && u64::from(chunk.slice) == slice;
        let chunk = self.expect_kind(kind, fits, wanted)?;
        if !counts.contains(&chunk.count.into()) {
            let field = format!("voxel count of the {}", wanted());
            let expected = format!("{} to {}", counts.start(), counts.end());
            return Err(malformed(chunk.offset, field, chunk.count, expected));
        }
        Ok(chunk)
    }

    /// The next chunk that is not ancillary; it must be of this kind, slice 0, with a level in `levels`.
    pub(super) fn expect_up_to(&mut self, kind: ChunkKind, levels: std::ops::RangeInclusive<u8>) -> Result<Chunk<'a>> {
        let (first, last) = (levels.start(), levels.end());
        let wanted = || format!("{kind} chunk of a level from {first} to {last}, slice 0");
        let fits = |chunk: &Chunk| levels.contains(&chunk.level) && chunk.slice == 0;
        self.expect_kind(kind, fits, wanted)
    }

    fn expect_kind(
        &mut self,
        kind: ChunkKind,
        fits: impl Fn(&Chunk) -> bool,
        wanted: impl Fn() -> String,
    ) -> Result<Chunk<'a>> {
        let Some(chunk) = self.next_critical()? else {
            return Err(malformed(self.end, "end of the section", "here", wanted()));
        };
        if chunk.kind == kind && fits(&chunk) {
            return Ok(chunk);
        }
        let found = format!("{} of level {}, slice {}", chunk.kind, chunk.level, chunk.slice);
        Err(malformed(chunk.offset, "chunk", found, wanted()))
    }

    /// The next chunk that is not ancillary, without taking it.
    ///
    /// # Errors
    /// What is wrong with it.
    pub(super) fn peek(&self) -> Result<Option<Chunk<'a>>> {
        self.clone().next_critical()
    }

    /// Fails unless nothing but ancillary chunks is left.
    pub(super) fn finish(&mut self) -> Result<()> {
        match self.next_critical()? {
            None => Ok(()),
            Some(chunk) => {
                let found = format!("a {} chunk", chunk.kind);
                Err(malformed(chunk.offset, "chunk after the section's last", found, "none"))
            }
        }
    }

    fn next_critical(&mut self) -> Result<Option<Chunk<'a>>> {
        for chunk in self.by_ref() {
            let chunk = chunk?;
            if !matches!(chunk.kind, ChunkKind::Ancillary(_)) {
                return Ok(Some(chunk));
            }
        }
        Ok(None)
    }
}

impl<'a> Iterator for Chunks<'a> {
    type Item = Result<Chunk<'a>>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.reader.at() >= self.end {
            return None;
        }
        let chunk = self.read();
        if chunk.is_err() {
            // Where the next one starts is not known.
            self.end = self.reader.at();
        }
        Some(chunk)
    }
}
