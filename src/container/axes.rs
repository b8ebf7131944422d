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
    Ok(ours(bytes)?
        .iter()
        .find_map(|chunk| Axes::from_bytes(chunk.payload))
        .unwrap_or_default())
}

/// The number of points that the stream's voxels were made of, if it states it.
///
/// # Errors
/// Those of [`axes`].
pub fn source_points(bytes: &[u8]) -> Result<Option<u32>> {
    Ok(ours(bytes)?.iter().map(|chunk| chunk.count).find(|count| *count > 0))
}

/// The chunks of the type in a stream that may be cut after them.
fn ours(bytes: &[u8]) -> Result<Vec<Chunk<'_>>> {
    let header = Header::parse(bytes, &Limits::unlimited())?;
    let start = header.bytes();
    let length = header.sections.first().map_or(0, |section| section.geometry as usize);
    let end = start.saturating_add(length).min(bytes.len());
    let chunks = Chunks::new(form(&header), bytes, start.min(end)..end);
    let ours = |chunk: &Chunk| chunk.kind == ChunkKind::Ancillary(AXES);
    Ok(chunks.map_while(Result::ok).filter(ours).collect())
}

/// The same stream with a chunk for `axes`. It is unchanged if they are empty. A chunk that it has already is not
/// replaced, but the new one comes first and counts.
///
/// # Errors
/// Those of [`Header::parse`]; [`Error::Usage`] if the coordinate system is too long.
pub fn with_axes(stream: &[u8], axes: &Axes) -> Result<Vec<u8>> {
    with_source(stream, axes, None)
}

/// [`with_axes`], and the number of points that the voxels were made of. A number that 32 bits cannot hold is left out.
///
/// # Errors
/// Those of [`with_axes`].
pub fn with_source(stream: &[u8], axes: &Axes, points: Option<u64>) -> Result<Vec<u8>> {
    let mut header = Header::parse(stream, &Limits::unlimited())?;
    let count = points.and_then(|points| u32::try_from(points).ok()).unwrap_or(0);
    if axes.is_empty() && count == 0 {
        return Ok(stream.to_vec());
    }
    if axes.crs.len() > Axes::MAX_CRS {
        let (length, most) = (axes.crs.len(), Axes::MAX_CRS);
        return Err(Error::Usage(format!(
            "the coordinate system has {length} bytes, at most {most} are allowed"
        )));
    }
    let payload = match axes.is_empty() {
        true => Vec::new(),
        false => axes.to_bytes(),
    };
    let chunk = Chunk {
        kind: ChunkKind::Ancillary(AXES),
        level: 0,
        slice: 0,
        count,
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
    source_bytes(axes, None)
}

/// Bytes that [`with_source`] adds at most.
pub fn source_bytes(axes: &Axes, points: Option<u64>) -> usize {
    /// A chunk's header: type, level, slice, count, length and checksum.
    const HEAD: usize = 2 + 1 + 1 + 5 + 4 + 7;
    match (axes.is_empty(), points) {
        (true, None) => 0,
        (true, Some(_)) => HEAD,
        (false, _) => HEAD + axes.to_bytes().len(),
    }
}

pub(super) fn form(header: &Header) -> Form {
    match header.format {
        Format::Learned { .. } => Form::Fixed,
        Format::Transform { .. } => Form::Short,
    }
}
