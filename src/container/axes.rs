//! The ancillary chunk that says how coordinates are to be understood (`docs/format.md`, clause 3.4).

use super::chunk::{Chunk, ChunkKind, Chunks, Form};
use super::header::{Format, Header};
use crate::axes::Axes;
use crate::error::{Error, Result};
use crate::limits::Limits;

/// The type of the chunk.
pub(super) const AXES: u8 = 128;

/// What a stream says of its coordinates, which is nothing unless it has the chunk. The stream may be cut after the
/// chunk.
///
/// # Errors
/// Those of [`Header::parse`]. Damage behind the header is left to decoding.
pub fn axes(bytes: &[u8]) -> Result<Axes> {
    let header = Header::parse(bytes, &Limits::unlimited())?;
    let start = header.bytes();
    let length = header.sections.first().map_or(0, |section| section.geometry as usize);
    let end = start.saturating_add(length).min(bytes.len());
    let chunks = Chunks::new(form(&header), bytes, start.min(end)..end);
    let ours = |chunk: &Chunk| chunk.kind == ChunkKind::Ancillary(AXES);
    let found = chunks.map_while(Result::ok).filter(ours);
    Ok(found
        .filter_map(|chunk| Axes::from_bytes(chunk.payload))
        .next()
        .unwrap_or_default())
}

/// The same stream with a chunk for `axes`. It is unchanged if they are empty. A chunk that it has already is not
/// replaced, but the new one comes first and counts.
///
/// # Errors
/// Those of [`Header::parse`]; [`Error::Usage`] if the coordinate system is too long.
pub fn with_axes(stream: &[u8], axes: &Axes) -> Result<Vec<u8>> {
    let mut header = Header::parse(stream, &Limits::unlimited())?;
    if axes.is_empty() {
        return Ok(stream.to_vec());
    }
    if axes.crs.len() > Axes::MAX_CRS {
        let (length, most) = (axes.crs.len(), Axes::MAX_CRS);
        return Err(Error::Usage(format!(
            "the coordinate system has {length} bytes, at most {most} are allowed"
        )));
    }
    let payload = axes.to_bytes();
    let chunk = Chunk {
        kind: ChunkKind::Ancillary(AXES),
        level: 0,
        slice: 0,
        count: 0,
        payload: &payload,
        offset: 0,
        payload_at: 0,
    };
    let mut bytes = Vec::new();
    chunk.write(form(&header), &[], &mut bytes)?;
    let old = header.bytes();
    let section = &mut header.sections[0].geometry;
    let longer = u32::try_from(bytes.len())
        .ok()
        .and_then(|more| section.checked_add(more));
    *section =
        longer.ok_or_else(|| Error::Usage("the geometry section of the first level would be too long".into()))?;
    Ok([&header.write(), &bytes[..], &stream[old..]].concat())
}

/// Bytes that [`with_axes`] adds at most.
pub fn axes_bytes(axes: &Axes) -> usize {
    /// A chunk's header: type, level, slice, count, length and checksum.
    const HEAD: usize = 2 + 1 + 1 + 5 + 4 + 7;
    if axes.is_empty() {
        0
    } else {
        HEAD + axes.to_bytes().len()
    }
}

pub(super) fn form(header: &Header) -> Form {
    match header.format {
        Format::Learned { .. } => Form::Fixed,
        Format::Transform { .. } => Form::Short,
    }
}
