//! What the sections of version 3 hold.

use super::chunk::{Chunk, ChunkKind, Chunks};
use super::header::Header;
use super::malformed;
use super::reader::Reader;
use super::stream::{Counts, Geometry, Slice, sliced};
use crate::error::Result;

/// The most voxels of the last level of a colour trunk.
pub const MAX_TRUNK_VOXELS: u32 = 65_536;

/// The colours of a level as transform coefficients.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Colours<'a> {
    /// In the base level: the colours of the root and of the first levels.
    pub trunk: Option<Trunk<'a>>,
    /// The levels that follow the trunk up to this level; of a level that is not the base level, this level.
    pub levels: Vec<ColourLevel<'a>>,
    /// XXH3-64 of the colours decoded at this level.
    pub hash: u64,
    /// The filter of the colours of this level, if it has one.
    pub filter: Option<Slice<'a>>,
}

/// The colours of the root and of the first levels, in one payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Trunk<'a> {
    /// K: it holds the levels 0 to K.
    pub level: u8,
    /// The payload; its count is the number of the voxels of level K.
    pub slice: Slice<'a>,
}

/// The colours of a level, given those of the level before.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ColourLevel<'a> {
    /// The level.
    pub level: u8,
    /// One entry for every slice of parents; counts are those of the parents.
    pub slices: Vec<Slice<'a>>,
}

/// The geometry section of `level`.
pub(super) fn take_geometry<'a>(chunks: &mut Chunks<'a>, header: &Header, level: u8) -> Result<Vec<Geometry<'a>>> {
    let mut counts = Counts::new(header, level)?;
    let mut geometry = match level == header.base && level > 0 {
        true => take_trunk(chunks, &mut counts, header.slice_voxels, level)?,
        false => Vec::new(),
    };
    let next = match level == header.base {
        true => 1 + geometry.len() as u8,
        false => level,
    };
    for level in next..=level {
        geometry.push(counts.take_level(chunks, level)?);
    }
    counts.finish()?;
    Ok(geometry)
}

/// The levels from 1 on that one chunk holds, each in one slice.
fn take_trunk<'a>(
    chunks: &mut Chunks<'a>,
    counts: &mut Counts,
    slice_voxels: u32,
    most: u8,
) -> Result<Vec<Geometry<'a>>> {
    let chunk = chunks.expect_up_to(ChunkKind::GeometryTrunk, 1..=most)?;
    let mut reader = Reader::new(chunk.payload, 0);
    let at = |reader: &Reader| chunk.payload_at + reader.at();
    let mut geometry = Vec::new();
    for level in 1..=chunk.level {
        let offset = at(&reader);
        if counts.parents > slice_voxels.into() {
            let field = format!("parents of level {level} in the geometry trunk");
            let expected = format!("at most {slice_voxels}, one slice");
            return Err(malformed(offset, field, counts.parents, expected));
        }
        let voxels = in_trunk(&chunk, reader.varint("voxel count"), offset)?;
        let allowed = counts.parents..=8 * counts.parents;
        if !allowed.contains(&voxels.into()) {
            let field = format!("voxel count of level {level}");
            let expected = format!("{} to {}", allowed.start(), allowed.end());
            return Err(malformed(offset, field, voxels, expected));
        }
        counts.check_total(level, offset, voxels.into())?;
        let offset = at(&reader);
        let length = in_trunk(&chunk, reader.varint("code length"), offset)?;
        let offset = at(&reader);
        let bytes = in_trunk(&chunk, reader.take(length as usize, "code"), offset)?;
        counts.parents = voxels.into();
        geometry.push(Geometry {
            level,
            slices: vec![Slice { voxels, bytes, offset }],
        });
    }
    let rest = chunk.payload.len() - reader.at();
    if rest > 0 || u64::from(chunk.count) != counts.parents {
        let field = "voxel count, and bytes after the last level, of the geometry trunk";
        let value = format!("{}, {rest}", chunk.count);
        let expected = format!("{}, 0", counts.parents);
        return Err(malformed(chunk.offset, field, value, expected));
    }
    Ok(geometry)
}

/// What was read of a payload whose checksum is right: if it is too short, that is no cut stream.
fn in_trunk<T>(chunk: &Chunk, read: Result<T>, offset: usize) -> Result<T> {
    read.map_err(|_| {
        let length = chunk.payload.len();
        let field = "payload of the geometry trunk";
        let value = format!("{length} bytes");
        malformed(offset, field, value, "counts and codes of all its levels")
    })
}

/// The colour section of `level`, whose geometry section held `geometry`, the children of `above` voxels first.
pub(super) fn take_colours<'a>(
    chunks: &mut Chunks<'a>,
    geometry: &[Geometry<'a>],
    above: u64,
    header: &Header,
    level: u8,
) -> Result<Colours<'a>> {
    let sum = |part: &Geometry| part.slices.iter().map(|s| u64::from(s.voxels)).sum();
    let counts: Vec<u64> = std::iter::once(above).chain(geometry.iter().map(sum)).collect();
    let voxels = |n: u8| counts[counts.len() - 1 - usize::from(level - n)];
    let mut hash = None;
    let trunk = match level == header.base {
        true => Some(take_colour_trunk(chunks, voxels, level, &mut hash)?),
        false => None,
    };
    let first = trunk.map_or(level, |trunk| trunk.level + 1);
    let levels = (first..=level).map(|n| {
        let mut slices = Vec::new();
        for (slice, parents) in sliced(voxels(n - 1), header.colour_slice()) {
            let chunk = chunks.expect(ChunkKind::Colours, n, slice, parents..=parents)?;
            let skip = take_hash(&chunk, &mut hash)?;
            slices.push(Slice::of(&chunk, skip));
        }
        Ok(ColourLevel { level: n, slices })
    });
    let levels = levels.collect::<Result<Vec<_>>>()?;
    let mut filter = None;
    if chunks.peek()?.is_some() {
        let count = voxels(level);
        let chunk = chunks.expect(ChunkKind::PostFilter, level, 0, count..=count)?;
        filter = Some(Slice::of(&chunk, 0));
    }
    Ok(Colours {
        trunk,
        levels,
        hash: hash.unwrap_or_default(),
        filter,
    })
}

/// The chunk of the first levels, of at most `most`, which have so many `voxels`.
fn take_colour_trunk<'a>(
    chunks: &mut Chunks<'a>,
    voxels: impl Fn(u8) -> u64,
    most: u8,
    hash: &mut Option<u64>,
) -> Result<Trunk<'a>> {
    let chunk = chunks.expect_up_to(ChunkKind::ColourTrunk, 0..=most)?;
    let expected = voxels(chunk.level);
    if u64::from(chunk.count) != expected {
        let field = "voxel count of the colour trunk";
        return Err(malformed(chunk.offset, field, chunk.count, expected));
    }
    if chunk.level > 0 && chunk.count > MAX_TRUNK_VOXELS {
        let field = "voxel count of the colour trunk";
        let expected = format!("at most {MAX_TRUNK_VOXELS}");
        return Err(malformed(chunk.offset, field, chunk.count, expected));
    }
    let skip = take_hash(&chunk, hash)?;
    Ok(Trunk {
        level: chunk.level,
        slice: Slice::of(&chunk, skip),
    })
}

/// Reads the hash that the first chunk of a section starts with; how many bytes it takes in this chunk.
fn take_hash(chunk: &Chunk, hash: &mut Option<u64>) -> Result<usize> {
    if hash.is_some() {
        return Ok(0);
    }
    let mut reader = Reader::new(chunk.payload, 0);
    let Ok(found) = reader.u64("colour hash") else {
        let field = "length of a level's first colour chunk";
        let length = chunk.payload.len();
        return Err(malformed(chunk.offset, field, length, "8 or more"));
    };
    *hash = Some(found);
    Ok(reader.at())
}
