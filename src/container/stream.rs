//! Splits a stream into its header and its complete levels (`docs/format.md`, clauses 2.1, 3.2 and 8.2).

use super::chunk::{Chunk, ChunkKind, Chunks, Form};
use super::header::{Format, Header};
use super::malformed;
use super::reader::Reader;
use super::transform::{self, Colours};
use crate::error::{Error, Result};
use crate::limits::Limits;

/// A stream with a valid header, and its complete levels.
///
/// A level is complete if all its chunks, and those of the levels before, are present, in order, with valid checksums
/// and possible voxel counts. The payloads are checked by the stages that decode them.
#[derive(Debug)]
pub struct Stream<'a> {
    header: Header,
    levels: Vec<Level<'a>>,
    damage: Option<Error>,
    length: u64,
}

/// Maximum number of colour filters of a level (version 2).
pub(super) const FILTERS: usize = 2;

/// A complete level.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Level<'a> {
    /// The level.
    pub level: u8,
    /// Number of voxels.
    pub voxels: u32,
    /// Occupancies of the level above; in the base level, of all levels from level 0 on, one entry per level.
    pub geometry: Vec<Geometry<'a>>,
    /// The latents, one entry per slice; empty if the level has none.
    pub features: Vec<Slice<'a>>,
    /// XXH3-64 of the latents, 0 if there are none.
    pub latent_hash: u64,
    /// Colour filters for the best and for the quick heads.
    pub filters: [Option<Slice<'a>>; FILTERS],
    /// The colour residual, one entry per slice; empty if the stream has none.
    pub residual: Vec<Slice<'a>>,
    /// The colours of version 3. Its streams leave the four fields above empty.
    pub colours: Option<Colours<'a>>,
}

/// The geometry of one level, given the level above.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Geometry<'a> {
    /// The level.
    pub level: u8,
    /// One entry per slice of parents, with the number of their children.
    pub slices: Vec<Slice<'a>>,
}

/// An independently decodable part of a level.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Slice<'a> {
    /// Number of voxels; for a slice of colours of version 3, of parents.
    pub voxels: u32,
    /// The payload.
    pub bytes: &'a [u8],
    /// Byte offset of `bytes` in the stream.
    pub offset: usize,
}

impl<'a> Stream<'a> {
    /// Parses a stream or a prefix of one. Allocates at most a small multiple of the length of `bytes`.
    ///
    /// # Errors
    /// Those of [`Header::parse`]. Later errors are reported by [`Stream::damage`]; the complete levels before stay
    /// usable.
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

    /// The complete levels, from the base level on.
    pub fn levels(&self) -> &[Level<'a>] {
        &self.levels
    }

    /// The deepest complete level.
    pub fn deepest(&self) -> Option<u8> {
        self.levels.last().map(|level| level.level)
    }

    /// The error in the first incomplete level, or in bytes after the last level.
    pub fn damage(&self) -> Option<&Error> {
        self.damage.as_ref()
    }

    /// The stream, if it is complete or ends exactly where one of its levels ends.
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

    /// The stream, if `level` is complete.
    ///
    /// # Errors
    /// [`Error::Usage`] if the header has no such level, else the damage.
    pub fn require(self, level: u8) -> Result<Self> {
        let index = self.header.index(level)?;
        match self.damage {
            Some(damage) if self.levels.len() <= index => Err(damage),
            _ => Ok(self),
        }
    }
}

impl<'a> Level<'a> {
    /// Reads level `level` of a stream or of a prefix of one. The levels before must have been read.
    ///
    /// # Errors
    /// [`Error::Usage`] if the header has no such level. For an incomplete level [`Error::Truncated`],
    /// [`Error::ChecksumMismatch`], [`Error::Malformed`], or [`Error::Unsupported`] for unknown critical chunks.
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
        chunks.finish("3.2.1")?;
        let (length, field) = (section.colours, "colour section");
        let mut chunks = take_section(Form::Short, bytes, &mut at, length, field)?;
        let above = header.parents(level)?;
        let colours = transform::take_colours(&mut chunks, &geometry, above, header, level)?;
        chunks.finish("3.3.4")?;
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

    /// [`Level::read`] for version 2.
    fn read_learned(bytes: &'a [u8], header: &Header, level: u8) -> Result<Self> {
        let index = header.index(level)?;
        let (voxels, section) = (header.voxels[index], header.sections[index]);
        let mut at = header.start(level)?;
        let (length, field) = (section.geometry, "geometry section");
        let mut chunks = take_section(Form::Fixed, bytes, &mut at, length, field)?;
        let geometry = take_geometry(&mut chunks, header, level)?;
        chunks.finish("8.2.1")?;

        let (length, field) = (section.colours, "feature section");
        let mut chunks = take_section(Form::Fixed, bytes, &mut at, length, field)?;
        let (features, latent_hash) = match chunks.peek()?.map(|chunk| chunk.kind) {
            None | Some(ChunkKind::Filter | ChunkKind::Residual) => Default::default(),
            Some(_) => take_features(&mut chunks, header.slice_voxels, level, voxels)?,
        };
        let filters = take_filters(&mut chunks, level, voxels)?;
        let residual = take_residual(&mut chunks, header.slice_voxels, level, voxels)?;
        chunks.finish("8.2.2")?;
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

    /// Checks the hash `found` of the decoded latents.
    ///
    /// # Errors
    /// [`Error::DeterminismMismatch`] if they are not.
    pub fn check_latents(&self, found: u64) -> Result<()> {
        self.check_hash("latents", self.latent_hash, found)
    }

    /// Checks the hash `found` of the decoded colours.
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

/// Appends levels to `levels` until the first error.
fn take_levels<'a>(bytes: &'a [u8], header: &Header, levels: &mut Vec<Level<'a>>) -> Result<()> {
    for level in header.base..=header.top {
        levels.push(Level::read(bytes, header, level)?);
    }
    header.check_end(bytes.len() as u64)
}

/// The chunks of the section of `length` bytes that starts at `at`. Advances `at` to its end.
fn take_section<'a>(form: Form, bytes: &'a [u8], at: &mut u64, length: u32, field: &'static str) -> Result<Chunks<'a>> {
    // An offset that does not fit in `usize` is beyond the end of the bytes.
    let start = usize::try_from(*at).unwrap_or(usize::MAX);
    *at += u64::from(length);
    let mut reader = Reader::new(bytes, start);
    reader.take(length as usize, field)?;
    Ok(Chunks::new(form, bytes, start..reader.at()))
}

/// Reads the geometry section of a level of version 2.
fn take_geometry<'a>(chunks: &mut Chunks<'a>, header: &Header, level: u8) -> Result<Vec<Geometry<'a>>> {
    let first = if level == header.base { 1 } else { level };
    let mut counts = Counts::new(header, level)?;
    let geometry = (first..=level)
        .map(|level| counts.take_level(chunks, level))
        .collect::<Result<Vec<_>>>()?;
    counts.finish()?;
    Ok(geometry)
}

/// Voxel counts while a geometry section is read.
pub(super) struct Counts {
    slice_voxels: u32,
    /// Number of voxels of the level read last.
    pub parents: u64,
    /// The last level of the section.
    level: u8,
    /// Number of voxels of that level according to the header.
    max: u32,
    /// Byte offset of the section.
    start: u64,
    /// The clause that these counts obey.
    clause: &'static str,
}

impl Counts {
    pub(super) fn new(header: &Header, level: u8) -> Result<Self> {
        Ok(Counts {
            slice_voxels: header.slice_voxels,
            parents: header.parents(level)?,
            level,
            max: header.voxels(level)?,
            start: header.start(level)?,
            clause: match header.format {
                Format::Learned { .. } => "8.2.1",
                Format::Transform { .. } => "3.2.4",
            },
        })
    }

    /// Reads the slices of the next level.
    pub(super) fn take_level<'a>(&mut self, chunks: &mut Chunks<'a>, level: u8) -> Result<Geometry<'a>> {
        let mut slices = Vec::new();
        let mut total = 0;
        // An excessive number of parents ends this loop with an error when the chunks run out.
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

    /// Checks that a level has at most as many voxels as the section's last level.
    pub(super) fn check_total(&self, level: u8, offset: usize, total: u64) -> Result<()> {
        if total <= u64::from(self.max) {
            return Ok(());
        }
        let field = format!("voxel count of level {level}");
        let expected = format!("at most {}, as in the header", self.max);
        Err(malformed(self.clause, offset, field, total, expected))
    }

    /// Checks that the section's last level has as many voxels as the header states.
    pub(super) fn finish(&self) -> Result<()> {
        if self.parents == u64::from(self.max) {
            return Ok(());
        }
        let field = format!("voxel count of level {}", self.level);
        let expected = format!("{}, as in the header", self.max);
        Err(malformed(self.clause, self.start, field, self.parents, expected))
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
                return Err(malformed(
                    "8.2.2",
                    chunk.offset,
                    field,
                    chunk.payload.len(),
                    "8 or more",
                ));
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
        let is_filter = |next: Chunk| next.kind != ChunkKind::Residual && usize::from(next.slice) == number;
        if next.is_some_and(is_filter) {
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
    /// A chunk's payload without its first `skip` bytes.
    pub(super) fn of(chunk: &Chunk<'a>, skip: usize) -> Self {
        Slice {
            voxels: chunk.count,
            bytes: &chunk.payload[skip..],
            offset: chunk.payload_at + skip,
        }
    }
}

/// Number and voxel count of each slice of a level of `voxels` voxels.
pub(super) fn sliced(voxels: u64, slice_voxels: u32) -> impl Iterator<Item = (u64, u64)> {
    let size = u64::from(slice_voxels);
    (0..voxels.div_ceil(size)).map(move |i| (i, size.min(voxels - i * size)))
}
