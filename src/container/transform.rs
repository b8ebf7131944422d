//! Reads the sections of version 3 (`docs/format.md`, clauses 3.2 and 3.3).

use super::chunk::{Chunk, ChunkKind, Chunks};
use super::header::Header;
use super::malformed;
use super::reader::Reader;
use super::stream::{Counts, Geometry, Slice, sliced};
use crate::error::{Error, Result};

/// Maximum number of voxels of the last level of a colour trunk.
pub const MAX_TRUNK_VOXELS: u32 = 65_536;

/// The colours of a level as transform coefficients.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Colours<'a> {
    /// The colours of the root and of the first levels, in the base level only.
    pub trunk: Option<Trunk<'a>>,
    /// In the base level, the levels after the trunk up to this level; else this level alone.
    pub levels: Vec<ColourLevel<'a>>,
    /// XXH3-64 of this level's decoded Y, Co and Cg before the post filter, each as i16, little-endian.
    pub hash: u64,
    /// The colour filter of this level.
    pub filter: Option<Slice<'a>>,
    /// Where surfels take the place of learned Gaussians; in place of voxels, how much thicker Gaussians are.
    pub head_map: Option<Slice<'a>>,
}

/// The colours of the root and of the first levels in one payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Trunk<'a> {
    /// K: the trunk holds the levels 0 to K.
    pub level: u8,
    /// The payload, with the number of voxels of level K.
    pub slice: Slice<'a>,
}

/// The colours of a level, given those of the level above.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ColourLevel<'a> {
    /// The level.
    pub level: u8,
    /// One entry per slice of parents, with their number.
    pub slices: Vec<Slice<'a>>,
}

/// Reads the geometry section of `level`.
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

/// Reads the geometry trunk: the levels from 1 on, at most to `deepest`, each of one slice.
fn take_trunk<'a>(
    chunks: &mut Chunks<'a>,
    counts: &mut Counts,
    slice_voxels: u32,
    deepest: u8,
) -> Result<Vec<Geometry<'a>>> {
    let chunk = chunks.expect_up_to(ChunkKind::GeometryTrunk, 1..=deepest)?;
    let mut reader = Reader::new(chunk.payload, 0);
    let at = |reader: &Reader| chunk.payload_at + reader.at();
    let mut geometry = Vec::new();
    for level in 1..=chunk.level {
        let offset = at(&reader);
        if counts.parents > slice_voxels.into() {
            let field = format!("parents of level {level} in the geometry trunk");
            let expected = format!("at most {slice_voxels}, one slice");
            return Err(malformed("3.2.2", offset, field, counts.parents, expected));
        }
        let voxels = in_trunk(&chunk, reader.varint("voxel count"), offset)?;
        let allowed = counts.parents..=8 * counts.parents;
        if !allowed.contains(&voxels.into()) {
            let field = format!("voxel count of level {level}");
            let expected = format!("{} to {}", allowed.start(), allowed.end());
            return Err(malformed("3.2.2", offset, field, voxels, expected));
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
        return Err(malformed("3.2.2", chunk.offset, field, value, expected));
    }
    Ok(geometry)
}

/// Converts the error of a payload that ends early: its checksum is valid, so the stream is malformed, not truncated.
/// Offsets become those of the stream.
fn in_trunk<T>(chunk: &Chunk, read: Result<T>, offset: usize) -> Result<T> {
    read.map_err(|error| {
        if let Error::Malformed {
            field, value, expected, ..
        } = error
        {
            return malformed("1.4.2", offset, field, value, expected);
        }
        let length = chunk.payload.len();
        let field = "payload of the geometry trunk";
        let value = format!("{length} bytes");
        malformed("3.2.2", offset, field, value, "counts and codes of all its levels")
    })
}

/// Reads the colour section of `level`. `geometry` is its geometry section, `above` the number of voxels of the level
/// above the first level of that section.
pub(super) fn take_colours<'a>(
    chunks: &mut Chunks<'a>,
    geometry: &[Geometry<'a>],
    above: u64,
    header: &Header,
    level: u8,
) -> Result<Colours<'a>> {
    let sum = |part: &Geometry| part.slices.iter().map(|s| u64::from(s.voxels)).sum();
    let head_map = chunks.head_map(level).map(|chunk| Slice::of(&chunk, 0));
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
        head_map,
    })
}

/// Reads the colour trunk, at most to level `deepest`. `voxels` returns the number of voxels of a level.
fn take_colour_trunk<'a>(
    chunks: &mut Chunks<'a>,
    voxels: impl Fn(u8) -> u64,
    deepest: u8,
    hash: &mut Option<u64>,
) -> Result<Trunk<'a>> {
    let chunk = chunks.expect_up_to(ChunkKind::ColourTrunk, 0..=deepest)?;
    let expected = voxels(chunk.level);
    if u64::from(chunk.count) != expected {
        let field = "voxel count of the colour trunk";
        return Err(malformed("3.3.1", chunk.offset, field, chunk.count, expected));
    }
    if chunk.level > 0 && chunk.count > MAX_TRUNK_VOXELS {
        let field = "voxel count of the colour trunk";
        let expected = format!("at most {MAX_TRUNK_VOXELS}");
        return Err(malformed("3.3.1", chunk.offset, field, chunk.count, expected));
    }
    let skip = take_hash(&chunk, hash)?;
    Ok(Trunk {
        level: chunk.level,
        slice: Slice::of(&chunk, skip),
    })
}

/// Reads the hash at the start of the first chunk of a section. Returns its length in this chunk.
fn take_hash(chunk: &Chunk, hash: &mut Option<u64>) -> Result<usize> {
    if hash.is_some() {
        return Ok(0);
    }
    let mut reader = Reader::new(chunk.payload, 0);
    let Ok(found) = reader.u64("colour hash") else {
        let field = "length of a level's first colour chunk";
        let length = chunk.payload.len();
        return Err(malformed("3.3.3", chunk.offset, field, length, "8 or more"));
    };
    *hash = Some(found);
    Ok(reader.at())
}
