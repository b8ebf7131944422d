//! A stream taken apart: its header, and its whole levels.

use super::chunk::{Chunk, ChunkKind, Chunks, Form};
use super::header::{Format, Header};
use super::malformed;
use super::reader::Reader;
use super::transform::{self, Colours};
use crate::error::{Error, Result};
use crate::limits::Limits;

/// A stream whose header is sound, with the levels that are whole.
///
/// A level is whole if all chunks of it and of the levels before are there, in order, with the right checksums and possible voxel
/// counts. Whether their payloads decode is for the stages that read them.
#[derive(Debug)]
pub struct Stream<'a> {
    header: Header,
    levels: Vec<Level<'a>>,
    damage: Option<Error>,
    length: u64,
}

/// The most colour filters of a level.
pub(super) const FILTERS: usize = 2;

/// A whole level.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Level<'a> {
    /// Its number.
    pub level: u8,
    /// How many voxels it has.
    pub voxels: u32,
    /// The octree from the level before to this one; in the base level from level 0, one entry per level.
    pub geometry: Vec<Geometry<'a>>,
    /// The latents, one entry per slice; none if the level has no latents.
    pub features: Vec<Slice<'a>>,
    /// XXH3-64 of the latents, 0 if there are none.
    pub latent_hash: u64,
    /// Corrections of the colours that the best and the quick heads generate.
    pub filters: [Option<Slice<'a>>; FILTERS],
    /// What the colours are still off, one entry per slice; none if the stream does not say.
    pub residual: Vec<Slice<'a>>,
    /// The colours of version 3, in which the four fields above are empty.
    pub colours: Option<Colours<'a>>,
}

/// The octree of one level, given the level before.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Geometry<'a> {
    /// The level.
    pub level: u8,
    /// One entry for every slice of parents; counts are those of their children.
    pub slices: Vec<Slice<'a>>,
}

/// An independently coded part of a level.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Slice<'a> {
    /// How many voxels it describes; of a slice of colours, how many parents.
    pub voxels: u32,
    /// Its code.
    pub bytes: &'a [u8],
    /// Byte offset of `bytes` in the stream.
    pub offset: usize,
}

impl<'a> Stream<'a> {
    /// Takes a stream, or a prefix of one, apart. Reserves no more than a small multiple of the bytes given.
    ///
    /// # Errors
    /// Those of [`Header::parse`]. Anything wrong later is [`Stream::damage`], and leaves the whole levels before it usable.
    pub fn parse(bytes: &'a [u8], limits: &Limits) -> Result<Self> {
        let header = Header::parse(bytes, limits)?;
        let mut levels = Vec::new();
        let damage = take_levels(bytes, &header, &mut levels).err();
        Ok(Stream {
            header,
            levels,
            damage,
            length: bytes.len() as u64,
        })
    }

    /// The header.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The whole levels, from the base level on.
    pub fn levels(&self) -> &[Level<'a>] {
        &self.levels
    }

    /// The deepest whole level.
    pub fn deepest(&self) -> Option<u8> {
        self.levels.last().map(|level| level.level)
    }

    /// What is wrong with the first level that is not whole, or with what follows the last one.
    pub fn damage(&self) -> Option<&Error> {
        self.damage.as_ref()
    }

    /// The stream, if it is whole or ends just where one of its levels ends.
    ///
    /// # Errors
    /// The [`Stream::damage`].
    pub fn intact(self) -> Result<Self> {
        let end = self.deepest().map(|level| self.header.prefix_bytes(level));
        match self.damage {
            Some(damage) if !end.is_some_and(|end| end.is_ok_and(|end| end == self.length)) => Err(damage),
            _ => Ok(self),
        }
    }

    /// The stream, if `level` is whole.
    ///
    /// # Errors
    /// [`Error::Usage`] if the header tells of no such level, else the damage.
    pub fn require(self, level: u8) -> Result<Self> {
        let index = self.header.index(level)?;
        match self.damage {
            Some(damage) if self.levels.len() <= index => Err(damage),
            _ => Ok(self),
        }
    }
}

impl<'a> Level<'a> {
    /// Takes level `level` out of a stream with this header, or out of a prefix of one; the levels before it have been taken.
    ///
    /// # Errors
    /// [`Error::Usage`] if the header tells of no such level; else what is wrong with it: [`Error::Truncated`],
    /// [`Error::ChecksumMismatch`], [`Error::Malformed`], [`Error::Unsupported`] for chunks that are not known and not to be skipped.
    pub fn read(bytes: &'a [u8], header: &Header, level: u8) -> Result<Self> {
        if let Format::Learned { .. } = header.format {
            return Self::read_learned(bytes, header, level);
        }
        let index = header.index(level)?;
        let (voxels, section) = (header.voxels[index], header.sections[index]);
        let mut at = header.start(level)?;
        let (length, field) = (section.geometry, "geometry section");
        let mut chunks = take_section(Form::Short, bytes, &mut at, length, field)?;
        let geometry = transform::take_geometry(&mut chunks, header, level)?;
        chunks.finish()?;
        let (length, field) = (section.colours, "colour section");
        let mut chunks = take_section(Form::Short, bytes, &mut at, length, field)?;
        let above = header.parents(level)?;
        let colours = transform::take_colours(&mut chunks, &geometry, above, header, level)?;
        chunks.finish()?;
        Ok(Level {
            level,
            voxels,
            geometry,
            features: Vec::new(),
            latent_hash: 0,
            filters: [None; FILTERS],
            residual: Vec::new(),
            colours: Some(colours),
        })
    }

    fn read_learned(bytes: &'a [u8], header: &Header, level: u8) -> Result<Self> {
        let index = header.index(level)?;
        let (voxels, section) = (header.voxels[index], header.sections[index]);
        let mut at = header.start(level)?;
        let (length, field) = (section.geometry, "geometry section");
        let mut chunks = take_section(Form::Fixed, bytes, &mut at, length, field)?;
        let geometry = take_geometry(&mut chunks, header, level)?;
        chunks.finish()?;

        let (length, field) = (section.colours, "feature section");
        let mut chunks = take_section(Form::Fixed, bytes, &mut at, length, field)?;
        let (features, latent_hash) = match chunks.peek()?.map(|chunk| chunk.kind) {
            None | Some(ChunkKind::Filter | ChunkKind::Residual) => Default::default(),
            Some(_) => take_features(&mut chunks, header.slice_voxels, level, voxels)?,
        };
        let filters = take_filters(&mut chunks, level, voxels)?;
        let residual = take_residual(&mut chunks, header.slice_voxels, level, voxels)?;
        chunks.finish()?;
        Ok(Level {
            level,
            voxels,
            geometry,
            features,
            latent_hash,
            filters,
            residual,
            colours: None,
        })
    }

    /// Sees that decoded latents with the hash `found` are those that were coded.
    ///
    /// # Errors
    /// [`Error::DeterminismMismatch`] if they are not.
    pub fn check_latents(&self, found: u64) -> Result<()> {
        self.check_hash("latents", self.latent_hash, found)
    }

    /// Sees that decoded colours with the hash `found` are those that were coded.
    ///
    /// # Errors
    /// [`Error::DeterminismMismatch`] if they are not.
    pub fn check_colours(&self, found: u64) -> Result<()> {
        let expected = self.colours.as_ref().map_or(0, |colours| colours.hash);
        self.check_hash("colours", expected, found)
    }

    fn check_hash(&self, what: &'static str, expected: u64, found: u64) -> Result<()> {
        if found == expected {
            return Ok(());
        }
        Err(Error::DeterminismMismatch {
            what,
            level: self.level,
            expected,
            found,
        })
    }
}

/// Fills `levels` until the first fault.
fn take_levels<'a>(bytes: &'a [u8], header: &Header, levels: &mut Vec<Level<'a>>) -> Result<()> {
    for level in header.base..=header.top {
        levels.push(Level::read(bytes, header, level)?);
    }
    header.check_end(bytes.len() as u64)
}

/// The section that starts at `at`, which then is where it ends.
fn take_section<'a>(form: Form, bytes: &'a [u8], at: &mut u64, length: u32, field: &'static str) -> Result<Chunks<'a>> {
    // Whatever starts beyond what a machine can address starts beyond the bytes.
    let start = usize::try_from(*at).unwrap_or(usize::MAX);
    *at += u64::from(length);
    let mut reader = Reader::new(bytes, start);
    reader.take(length as usize, field)?;
    Ok(Chunks::new(form, bytes, start..reader.at()))
}

/// The geometry section of a level of version 2.
fn take_geometry<'a>(chunks: &mut Chunks<'a>, header: &Header, level: u8) -> Result<Vec<Geometry<'a>>> {
    let first = if level == header.base { 1 } else { level };
    let mut counts = Counts::new(header, level)?;
    let geometry = (first..=level)
        .map(|level| counts.take_level(chunks, level))
        .collect::<Result<Vec<_>>>()?;
    counts.finish()?;
    Ok(geometry)
}

/// What is known of the voxels while a geometry section is read.
pub(super) struct Counts {
    slice_voxels: u32,
    /// Of the level that was read last.
    pub parents: u64,
    /// The level that the section ends with, and its voxels as the header tells.
    level: u8,
    most: u32,
    /// Where the section starts.
    start: u64,
}

impl Counts {
    pub(super) fn new(header: &Header, level: u8) -> Result<Self> {
        Ok(Counts {
            slice_voxels: header.slice_voxels,
            parents: header.parents(level)?,
            level,
            most: header.voxels(level)?,
            start: header.start(level)?,
        })
    }

    /// The slices of the next level.
    pub(super) fn take_level<'a>(&mut self, chunks: &mut Chunks<'a>, level: u8) -> Result<Geometry<'a>> {
        let mut slices = Vec::new();
        let mut total = 0;
        // Ends with the section's chunks, however many parents are claimed.
        for (slice, parents) in sliced(self.parents, self.slice_voxels) {
            let counts = parents..=8 * parents;
            let chunk = chunks.expect(ChunkKind::Geometry, level, slice, counts)?;
            total += u64::from(chunk.count);
            self.check_total(level, chunk.offset, total)?;
            slices.push(Slice::of(&chunk, 0));
        }
        self.parents = total;
        Ok(Geometry { level, slices })
    }

    /// No level has more voxels than the one that ends the section.
    pub(super) fn check_total(&self, level: u8, offset: usize, total: u64) -> Result<()> {
        if total <= u64::from(self.most) {
            return Ok(());
        }
        let field = format!("voxel count of level {level}");
        let expected = format!("at most {}, as the header tells", self.most);
        Err(malformed(offset, field, total, expected))
    }

    /// Sees that the section ended with as many voxels as the header tells.
    pub(super) fn finish(&self) -> Result<()> {
        if self.parents == u64::from(self.most) {
            return Ok(());
        }
        let field = format!("voxel count of level {}", self.level);
        let expected = format!("{}, as the header tells", self.most);
        Err(malformed(self.start, field, self.parents, expected))
    }
}

fn take_features<'a>(
    chunks: &mut Chunks<'a>,
    slice_voxels: u32,
    level: u8,
    voxels: u32,
) -> Result<(Vec<Slice<'a>>, u64)> {
    let mut slices = Vec::new();
    let mut latent_hash = 0;
    for (slice, count) in sliced(voxels.into(), slice_voxels) {
        let chunk = chunks.expect(ChunkKind::Features, level, slice, count..=count)?;
        let mut hash_bytes = 0;
        if slice == 0 {
            let mut reader = Reader::new(chunk.payload, 0);
            let Ok(hash) = reader.u64("latent hash") else {
                let field = "length of a level's first feature chunk";
                return Err(malformed(chunk.offset, field, chunk.payload.len(), "8 or more"));
            };
            latent_hash = hash;
            hash_bytes = reader.at();
        }
        slices.push(Slice::of(&chunk, hash_bytes));
    }
    Ok((slices, latent_hash))
}

fn take_filters<'a>(chunks: &mut Chunks<'a>, level: u8, voxels: u32) -> Result<[Option<Slice<'a>>; FILTERS]> {
    let mut filters = [None; FILTERS];
    for (number, filter) in filters.iter_mut().enumerate() {
        let counts = u64::from(voxels)..=voxels.into();
        let next = chunks.peek()?;
        let comes = |next: Chunk| next.kind != ChunkKind::Residual && usize::from(next.slice) == number;
        if next.is_some_and(comes) {
            let chunk = chunks.expect(ChunkKind::Filter, level, number as u64, counts)?;
            *filter = Some(Slice::of(&chunk, 0));
        }
    }
    Ok(filters)
}

fn take_residual<'a>(chunks: &mut Chunks<'a>, slice_voxels: u32, level: u8, voxels: u32) -> Result<Vec<Slice<'a>>> {
    let mut slices = Vec::new();
    let next = chunks.peek()?;
    if next.is_none_or(|next| next.kind != ChunkKind::Residual) {
        return Ok(slices);
    }
    for (slice, count) in sliced(voxels.into(), slice_voxels) {
        let chunk = chunks.expect(ChunkKind::Residual, level, slice, count..=count)?;
        slices.push(Slice::of(&chunk, 0));
    }
    Ok(slices)
}

impl<'a> Slice<'a> {
    /// A chunk's payload without its first bytes.
    pub(super) fn of(chunk: &Chunk<'a>, skip: usize) -> Self {
        Slice {
            voxels: chunk.count,
            bytes: &chunk.payload[skip..],
            offset: chunk.payload_at + skip,
        }
    }
}

/// Numbers of the slices that `voxels` fill, and how many voxels each has.
pub(super) fn sliced(voxels: u64, slice_voxels: u32) -> impl Iterator<Item = (u64, u64)> {
    let size = u64::from(slice_voxels);
    (0..voxels.div_ceil(size)).map(move |i| (i, size.min(voxels - i * size)))
}
