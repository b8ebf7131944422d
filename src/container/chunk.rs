//! Chunks: the typed, numbered and checksummed parts of a section (`docs/format.md`, clauses 3.1 and 8.1).

use super::malformed;
use super::reader::{Reader, put_varint};
use crate::error::{Error, Result, feature};

/// Encoding of a chunk's header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Form {
    /// Version 2: numbers of fixed width.
    Fixed,
    /// Version 3: numbers as varints.
    Short,
    /// The same around the frames of a sequence, whose kinds occur there alone.
    Sequence,
}

impl Form {
    /// The clause that says what a chunk is.
    fn clause_of_chunks(self) -> &'static str {
        match self {
            Form::Fixed => "8.1.1",
            Form::Short | Form::Sequence => "3.1.1",
        }
    }

    /// The clause that says where chunks of this kind stand, and what they count.
    fn clause_of(self, kind: ChunkKind) -> &'static str {
        match (self, kind) {
            (Form::Fixed, ChunkKind::Geometry) => "8.2.1",
            (Form::Fixed, _) => "8.2.2",
            (Form::Short, ChunkKind::GeometryTrunk) => "3.2.1",
            (Form::Short, ChunkKind::Geometry) => "3.2.3",
            (Form::Short, ChunkKind::ColourTrunk) => "3.3.1",
            (Form::Short, ChunkKind::Colours) => "3.3.2",
            (Form::Short, _) => "3.3.4",
            (Form::Sequence, ChunkKind::Index) => "17.2.1",
            (Form::Sequence, _) => "17.3.1",
        }
    }
}

/// Bytes of a chunk header of version 2, without the checksum.
const FIXED_HEADER: usize = 12;
/// Chunk types from here on are ancillary: a reader skips them.
const ANCILLARY: u8 = 128;
/// The type of head maps; axes have 128.
pub(super) const HEAD_MAP: u8 = 129;

/// The kind of a chunk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChunkKind {
    /// A slice of the octree.
    Geometry,
    /// A slice of the latents (version 2).
    Features,
    /// A colour filter (version 2).
    Filter,
    /// A slice of the colour residual (version 2).
    Residual,
    /// The first levels of the octree (version 3).
    GeometryTrunk,
    /// The colours of the first levels (version 3).
    ColourTrunk,
    /// A slice of the colours of a level (version 3).
    Colours,
    /// The colour filter of a level (version 3).
    PostFilter,
    /// Where surfels take the place of learned Gaussians (version 3). Ancillary.
    HeadMap,
    /// Where the groups of a sequence lie.
    Index,
    /// Where the frames of a group lie (sequences).
    FrameTable,
    /// A chunk that a reader skips, of type 128 to 255.
    Ancillary(u8),
}

/// A chunk with a valid checksum.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Chunk<'a> {
    /// The kind.
    pub kind: ChunkKind,
    /// The level.
    pub level: u8,
    /// Slice number within the level and kind.
    pub slice: u16,
    /// Number of voxels of the slice; for [`ChunkKind::Colours`], of parents.
    pub count: u32,
    /// The payload.
    pub payload: &'a [u8],
    /// Byte offset of the chunk in the stream.
    pub offset: usize,
    /// Byte offset of the payload.
    pub payload_at: usize,
}

/// Iterator over the chunks of a section.
#[derive(Debug, Clone)]
pub struct Chunks<'a> {
    form: Form,
    reader: Reader<'a>,
    end: usize,
    /// Byte offset of the payload of the chunk read last.
    payload_at: usize,
}

/// Form, type number and name of each kind.
const KINDS: [(Form, u8, ChunkKind, &str); 12] = [
    (Form::Fixed, 1, ChunkKind::Geometry, "geometry"),
    (Form::Fixed, 2, ChunkKind::Features, "feature"),
    (Form::Fixed, 3, ChunkKind::Filter, "filter"),
    (Form::Fixed, 4, ChunkKind::Residual, "residual"),
    (Form::Short, 1, ChunkKind::Geometry, "geometry"),
    (Form::Short, 5, ChunkKind::GeometryTrunk, "geometry trunk"),
    (Form::Short, 6, ChunkKind::ColourTrunk, "colour trunk"),
    (Form::Short, 7, ChunkKind::Colours, "colour"),
    (Form::Short, 8, ChunkKind::PostFilter, "colour filter"),
    (Form::Short, HEAD_MAP, ChunkKind::HeadMap, "head map"),
    (Form::Sequence, 10, ChunkKind::Index, "index"),
    (Form::Sequence, 11, ChunkKind::FrameTable, "frame table"),
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
        let own = KINDS.iter().find(|kind| kind.0 == form && kind.1 == code);
        match own {
            Some((_, _, kind, _)) => Some(*kind),
            None if code >= ANCILLARY => Some(ChunkKind::Ancillary(code)),
            None => None,
        }
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
    /// Appends the chunk to `out`. Its payload is `prefix`, then `self.payload`. The offsets are ignored.
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
            Form::Short | Form::Sequence => {
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
    /// The chunks of the section `range`, which must lie within the stream.
    pub(super) fn new(form: Form, stream: &'a [u8], range: std::ops::Range<usize>) -> Self {
        Chunks {
            form,
            reader: Reader::new(&stream[..range.end], range.start),
            end: range.end,
            payload_at: range.start,
        }
    }

    /// The next chunk, damaged or not, with its byte offset. Unlike the iterator it goes on behind a chunk that is
    /// refused, as long as its length can be read.
    pub(super) fn next_of_damaged(&mut self) -> Option<(usize, Result<Chunk<'a>>)> {
        if self.reader.at() >= self.end {
            return None;
        }
        let start = self.reader.at();
        let chunk = self.read();
        if matches!(
            chunk,
            Err(Error::Truncated { .. }
                | Error::Malformed {
                    clause: Some("1.4.2"),
                    ..
                })
        ) {
            self.end = start;
        }
        Some((start, chunk))
    }

    /// Byte offset of the checksum of the chunk read last.
    pub(super) fn checksum_at(&self) -> usize {
        self.payload_at - 4
    }

    /// Whether a chunk starts here, or the section ends.
    pub(super) fn is_at_chunk(&self) -> bool {
        self.clone().next().is_none_or(|chunk| chunk.is_ok())
    }

    fn read(&mut self) -> Result<Chunk<'a>> {
        let start = self.reader.at();
        let [code, level, slice, count, length] = match self.form {
            Form::Fixed => self.fixed_header()?,
            Form::Short | Form::Sequence => self.short_header()?,
        };
        let head = self.reader.since(start);
        let expected = self.reader.u32("chunk checksum")?;
        let payload_at = self.reader.at();
        self.payload_at = payload_at;
        let payload = self.reader.take(length as usize, "chunk payload")?;
        let found = crc32c::crc32c_append(crc32c::crc32c(head), payload);
        if found != expected {
            return Err(Error::ChecksumMismatch {
                what: format!("a chunk of stated type {code}, level {level}, slice {slice}"),
                offset: start as u64,
                expected,
                found,
                clause: self.form.clause_of_chunks(),
            });
        }
        let Some(kind) = ChunkKind::of(self.form, code as u8) else {
            return Err(Error::Unsupported {
                what: match self.form {
                    Form::Fixed => feature::CHUNK_OF_VERSION_2,
                    Form::Short | Form::Sequence => feature::CHUNK,
                },
                detail: format!("byte {start} has the critical type {code}, which this decoder does not know"),
            });
        };
        let Ok(slice) = slice.try_into() else {
            return Err(malformed("3.1.1", start, "slice of a chunk", slice, "at most 65535"));
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

    /// Reads type, level, slice, count and length in the form of version 2.
    fn fixed_header(&mut self) -> Result<[u32; 5]> {
        // Read at once, so that the error states all missing bytes.
        let head: [u8; FIXED_HEADER] = self.reader.array("chunk header")?;
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

    /// Reads type, level, slice, count and length in the form of version 3.
    fn short_header(&mut self) -> Result<[u32; 5]> {
        let reader = &mut self.reader;
        Ok([
            reader.u8("chunk type")?.into(),
            reader.u8("chunk level")?.into(),
            reader.varint("chunk slice")?,
            reader.varint("chunk count")?,
            reader.varint("chunk length")?,
        ])
    }

    /// Reads the next critical chunk, which must have this kind, level and slice, and a count in `counts`.
    pub(super) fn expect(
        &mut self,
        kind: ChunkKind,
        level: u8,
        slice: u64,
        counts: std::ops::RangeInclusive<u64>,
    ) -> Result<Chunk<'a>> {
        let expected_chunk = || format!("{kind} chunk of level {level}, slice {slice}");
        let fits = |chunk: &Chunk| chunk.level == level && u64::from(chunk.slice) == slice;
        let chunk = self.expect_kind(kind, fits, expected_chunk)?;
        if !counts.contains(&chunk.count.into()) {
            let field = format!("voxel count of the {}", expected_chunk());
            let expected = format!("{} to {}", counts.start(), counts.end());
            return Err(malformed(
                self.form.clause_of(kind),
                chunk.offset,
                field,
                chunk.count,
                expected,
            ));
        }
        Ok(chunk)
    }

    /// Reads the next critical chunk, which must have this kind, slice 0, and a level in `levels`.
    pub(super) fn expect_up_to(&mut self, kind: ChunkKind, levels: std::ops::RangeInclusive<u8>) -> Result<Chunk<'a>> {
        let (first, last) = (levels.start(), levels.end());
        let expected_chunk = || format!("{kind} chunk of a level from {first} to {last}, slice 0");
        let fits = |chunk: &Chunk| levels.contains(&chunk.level) && chunk.slice == 0;
        self.expect_kind(kind, fits, expected_chunk)
    }

    fn expect_kind(
        &mut self,
        kind: ChunkKind,
        fits: impl Fn(&Chunk) -> bool,
        expected_chunk: impl Fn() -> String,
    ) -> Result<Chunk<'a>> {
        let Some(chunk) = self.next_critical()? else {
            let clause = self.form.clause_of(kind);
            return Err(malformed(
                clause,
                self.end,
                "end of the section",
                "here",
                expected_chunk(),
            ));
        };
        if chunk.kind == kind && fits(&chunk) {
            return Ok(chunk);
        }
        let found = format!("{} of level {}, slice {}", chunk.kind, chunk.level, chunk.slice);
        Err(malformed(
            self.form.clause_of(kind),
            chunk.offset,
            "chunk",
            found,
            expected_chunk(),
        ))
    }

    /// The next critical chunk, without consuming it.
    ///
    /// # Errors
    /// Those of reading that chunk.
    pub(super) fn peek(&self) -> Result<Option<Chunk<'a>>> {
        self.clone().next_critical()
    }

    /// The first head map among the chunks from here on that are whole.
    pub(super) fn head_map(&self, level: u8) -> Option<Chunk<'a>> {
        let mut chunks = self.clone().map_while(Result::ok);
        chunks.find(|chunk| chunk.kind == ChunkKind::HeadMap && chunk.level == level)
    }

    /// Checks that only ancillary chunks remain, as `clause` says.
    pub(super) fn finish(&mut self, clause: &'static str) -> Result<()> {
        match self.next_critical()? {
            None => Ok(()),
            Some(chunk) => {
                let found = format!("a {} chunk", chunk.kind);
                Err(malformed(
                    clause,
                    chunk.offset,
                    "chunk after the section's last",
                    found,
                    "none",
                ))
            }
        }
    }

    fn next_critical(&mut self) -> Result<Option<Chunk<'a>>> {
        for chunk in self.by_ref() {
            let chunk = chunk?;
            if !matches!(chunk.kind, ChunkKind::Ancillary(_) | ChunkKind::HeadMap) {
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
            // The start of the next chunk is unknown.
            self.end = self.reader.at();
        }
        Some(chunk)
    }
}
