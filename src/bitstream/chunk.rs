//! Chunks: typed, numbered, checked pieces of a section.

use super::malformed;
use super::reader::Reader;
use crate::error::{Error, Result};

/// Bytes of a chunk before its payload.
pub(super) const CHUNK_HEADER: usize = 16;
/// Those of them that the checksum covers.
const CHECKED: usize = 12;
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
    /// How many voxels it describes.
    pub count: u32,
    /// Its content.
    pub payload: &'a [u8],
    /// Byte offset of the chunk in the stream.
    pub offset: usize,
}

/// The chunks of a section.
#[derive(Debug, Clone)]
pub struct Chunks<'a> {
    reader: Reader<'a>,
    end: usize,
}

impl ChunkKind {
    fn code(self) -> u8 {
        match self {
            ChunkKind::Geometry => 1,
            ChunkKind::Features => 2,
            ChunkKind::Filter => 3,
            ChunkKind::Residual => 4,
            ChunkKind::Ancillary(code) => code,
        }
    }
}

impl std::fmt::Display for ChunkKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            ChunkKind::Geometry => f.write_str("geometry"),
            ChunkKind::Features => f.write_str("feature"),
            ChunkKind::Filter => f.write_str("filter"),
            ChunkKind::Residual => f.write_str("residual"),
            ChunkKind::Ancillary(code) => write!(f, "ancillary {code}"),
        }
    }
}

impl Chunk<'_> {
    /// Appends the chunk to `out`, `prefix` before its payload. `offset` plays no part.
    ///
    /// # Errors
    /// [`Error::Usage`] if the payload is 4 GiB or more.
    pub(super) fn write(&self, prefix: &[u8], out: &mut Vec<u8>) -> Result<()> {
        let length = prefix.len() + self.payload.len();
        let length = u32::try_from(length)
            .map_err(|_| Error::Usage(format!("a chunk cannot hold {length} bytes")))?;
        let mut head = [0; CHECKED];
        head[0] = self.kind.code();
        head[1] = self.level;
        head[2..4].copy_from_slice(&self.slice.to_le_bytes());
        head[4..8].copy_from_slice(&self.count.to_le_bytes());
        head[8..12].copy_from_slice(&length.to_le_bytes());
        let sum = [prefix, self.payload]
            .iter()
            .fold(crc32c::crc32c(&head), |sum, part| {
                crc32c::crc32c_append(sum, part)
            });
        out.extend(head);
        out.extend(sum.to_le_bytes());
        out.extend(prefix);
        out.extend(self.payload);
        Ok(())
    }
}

impl<'a> Chunks<'a> {
    /// The chunks of the section `range` of a stream, which lies within its bytes.
    pub(super) fn new(stream: &'a [u8], range: std::ops::Range<usize>) -> Self {
        Chunks {
            reader: Reader::new(&stream[..range.end], range.start),
            end: range.end,
        }
    }

    fn read(&mut self) -> Result<Chunk<'a>> {
        let offset = self.reader.at();
        let head: [u8; CHECKED] = self.reader.array("chunk header")?;
        let expected = self.reader.u32("chunk checksum")?;
        let [code, level, slice @ .., _, _, _, _, _, _, _, _] = head;
        let mut numbers = Reader::new(&head, 4);
        let count = numbers.u32("chunk count")?;
        let length = numbers.u32("chunk length")?;
        let slice = u16::from_le_bytes(slice);
        let payload = self.reader.take(length as usize, "chunk payload")?;
        let found = crc32c::crc32c_append(crc32c::crc32c(&head), payload);
        if found != expected {
            return Err(Error::ChecksumMismatch {
                what: format!(
                    "a chunk that calls itself type {code}, level {level}, slice {slice}"
                ),
                offset: offset as u64,
                expected,
                found,
            });
        }
        let kind = match code {
            1 => ChunkKind::Geometry,
            2 => ChunkKind::Features,
            3 => ChunkKind::Filter,
            4 => ChunkKind::Residual,
            ANCILLARY.. => ChunkKind::Ancillary(code),
            _ => {
                return Err(Error::Unsupported {
                    what: "this chunk type",
                    detail: format!(
                        "byte {offset} has type {code}, which only a later version knows"
                    ),
                });
            }
        };
        Ok(Chunk {
            kind,
            level,
            slice,
            count,
            payload,
            offset,
        })
    }

    /// The next chunk that is not ancillary; it must be this one, with a count in `counts`.
    pub(super) fn expect(
        &mut self,
        kind: ChunkKind,
        level: u8,
        slice: u64,
        counts: std::ops::RangeInclusive<u64>,
    ) -> Result<Chunk<'a>> {
        let wanted = format!("{kind} chunk of level {level}, slice {slice}");
        let Some(chunk) = self.next_critical()? else {
            return Err(malformed(self.end, "end of the section", "here", wanted));
        };
        let at = chunk.offset;
        if chunk.kind != kind || chunk.level != level || u64::from(chunk.slice) != slice {
            let found = format!(
                "{} of level {}, slice {}",
                chunk.kind, chunk.level, chunk.slice
            );
            return Err(malformed(at, "chunk", found, wanted));
        }
        if !counts.contains(&chunk.count.into()) {
            let field = format!("voxel count of the {wanted}");
            let expected = format!("{} to {}", counts.start(), counts.end());
            return Err(malformed(at, field, chunk.count, expected));
        }
        Ok(chunk)
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
                Err(malformed(
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
