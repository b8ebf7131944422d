//! All chunks of a stream, damaged ones too: what a check reports, and goes on with (`docs/format.md`, clause 15.3).

use std::borrow::Cow;

use super::axes::{AXES, form};
use super::chunk::{Chunk, ChunkKind, Chunks};
use super::header::Header;
use crate::axes::Axes;
use crate::error::Error;

/// The most faults that are reported of a stream.
const MAX_FAULTS: usize = 1000;

/// A chunk with a valid checksum.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ScannedChunk {
    /// The kind.
    pub kind: ChunkKind,
    /// The level whose section holds it.
    pub section: u8,
    /// The level that it states.
    pub level: u8,
    /// The slice that it states.
    pub slice: u16,
    /// Where it starts.
    pub start: usize,
    /// Where it ends.
    pub end: usize,
}

/// Something unusual that a decoder accepts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Note {
    /// The clause of `docs/format.md` that allows it.
    pub clause: &'static str,
    /// Byte offset.
    pub offset: usize,
    /// What it is.
    pub text: String,
}

/// The chunks of a stream.
#[derive(Debug)]
pub struct Scan<'a> {
    /// The stream, in which damaged chunks that decoders skip have valid checksums: they hide nothing then.
    pub bytes: Cow<'a, [u8]>,
    /// The chunks whose checksums were valid.
    pub chunks: Vec<ScannedChunk>,
    /// Damaged chunks, with the level of their section.
    pub faults: Vec<(u8, Error)>,
    /// What is unusual.
    pub notes: Vec<Note>,
}

impl<'a> Scan<'a> {
    /// Looks at all chunks of a stream with this header, each section by itself.
    pub fn new(bytes: &'a [u8], header: &Header) -> Self {
        let mut scan = Scan {
            bytes: Cow::Borrowed(bytes),
            chunks: Vec::new(),
            faults: Vec::new(),
            notes: Vec::new(),
        };
        let mut at = header.bytes() as u64;
        for (level, section) in (header.base..).zip(&header.sections) {
            for (length, of_geometry) in [(section.geometry, true), (section.colours, false)] {
                let end = at + u64::from(length);
                scan.section(bytes, header, level, of_geometry, at..end);
                at = end;
            }
        }
        scan
    }

    fn section(&mut self, bytes: &[u8], header: &Header, level: u8, of_geometry: bool, range: std::ops::Range<u64>) {
        let clip = |at: u64| usize::try_from(at).unwrap_or(usize::MAX).min(bytes.len());
        let (start, end) = (clip(range.start), clip(range.end));
        let whole = end as u64 == range.end;
        let mut chunks = Chunks::new(form(header), bytes, start..end);
        // Whether the next chunk of axes, the next head map would count.
        let mut axes = of_geometry && level == header.base;
        let mut map = !of_geometry;
        while let Some((at, chunk)) = chunks.next_of_damaged() {
            match chunk {
                Ok(chunk) => {
                    let end = chunk.payload_at + chunk.payload.len();
                    self.chunks.push(scanned(&chunk, level, end));
                    self.ancillary(&chunk, axes, map && chunk.level == level);
                    axes &= chunk.kind != ChunkKind::Ancillary(AXES) || Axes::from_bytes(chunk.payload).is_none();
                    map &= chunk.kind != ChunkKind::HeadMap || chunk.level != level;
                }
                // The section is cut, which is reported once.
                Err(Error::Truncated { .. }) if !whole => break,
                Err(error) => {
                    let skipped = bytes[at] >= 128;
                    let mismatch = match error {
                        Error::ChecksumMismatch { found, .. } => Some(found),
                        _ => None,
                    };
                    let believed = chunks.is_at_chunk();
                    self.fault(level, error);
                    if !believed {
                        break;
                    }
                    if let (true, Some(sum)) = (skipped, mismatch) {
                        let sum_at = chunks.checksum_at();
                        self.bytes.to_mut()[sum_at..sum_at + 4].copy_from_slice(&sum.to_le_bytes());
                    }
                }
            }
        }
    }

    fn fault(&mut self, level: u8, error: Error) {
        if self.faults.len() < MAX_FAULTS {
            self.faults.push((level, error));
        }
    }

    /// Notes what is unusual about a chunk that decoders skip. `axes`, `map`: whether axes or a head map count here.
    fn ancillary(&mut self, chunk: &Chunk, axes: bool, map: bool) {
        let (clause, text) = match chunk.kind {
            ChunkKind::Ancillary(AXES) if !axes => ("3.4.2", "axes that do not count here".into()),
            // A chunk that has the number of points alone has no payload (3.4.3).
            ChunkKind::Ancillary(AXES) if chunk.payload.is_empty() && chunk.count > 0 => return,
            ChunkKind::Ancillary(AXES) if Axes::from_bytes(chunk.payload).is_none() => {
                ("3.4.2", "axes of another form: they say nothing".into())
            }
            ChunkKind::HeadMap if !map => ("7.5.1", "a head map that has no effect here".into()),
            ChunkKind::Ancillary(AXES) => return,
            ChunkKind::Ancillary(code) => (
                "1.6.2",
                format!("skippable chunk of type {code}, which this version does not know"),
            ),
            _ => return,
        };
        let offset = chunk.offset;
        self.notes.push(Note { clause, offset, text });
    }
}

fn scanned(chunk: &Chunk, section: u8, end: usize) -> ScannedChunk {
    ScannedChunk {
        kind: chunk.kind,
        section,
        level: chunk.level,
        slice: chunk.slice,
        start: chunk.offset,
        end,
    }
}
