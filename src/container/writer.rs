//! Writes streams (`docs/format.md`, clauses 2, 3 and 8).

use super::chunk::{Chunk, ChunkKind, Form};
use super::header::{Format, Header, Section};
use super::reader::put_varint;
use super::stream::{Stream, sliced};
use crate::error::{Error, Result};
use crate::limits::Limits;

/// Builds a stream, level by level.
#[derive(Debug)]
pub struct Writer {
    header: Header,
    body: Vec<u8>,
}

/// No limits: the writer checks only what the format forbids.
const UNLIMITED: Limits = Limits {
    max_points: u64::MAX,
    max_depth: u8::MAX,
    max_pixels: u64::MAX,
    max_pairs: u64::MAX,
    max_frames: u64::MAX,
    max_bytes: u64::MAX,
};

impl Writer {
    /// Starts a stream. The header's `sections` are ignored: the writer sets them.
    ///
    /// # Errors
    /// [`Error::Malformed`] if the format forbids the header.
    pub fn new(mut header: Header) -> Result<Self> {
        header.sections = vec![Section::default(); header.voxels.len()];
        header.check(&UNLIMITED)?;
        Ok(Writer {
            header,
            body: Vec::new(),
        })
    }

    /// Adds the geometry of `level`: for each slice of parents the number of their children, and the payload.
    ///
    /// # Errors
    /// [`Error::Usage`] if the stream has no such level or a payload is too long.
    pub fn geometry(&mut self, level: u8, slices: &[(u32, impl AsRef<[u8]>)]) -> Result<()> {
        let section = self.header.index(level.max(self.header.base))?;
        let start = self.body.len();
        for (slice, (count, bytes)) in slices.iter().enumerate() {
            self.chunk(ChunkKind::Geometry, level, slice, *count, &[], bytes.as_ref())?;
        }
        let length = &mut self.header.sections[section].geometry;
        *length = extended(*length, self.body.len() - start)?;
        Ok(())
    }

    /// Version 2: adds the latents of `level`: their hash, and the payload of each slice of voxels.
    ///
    /// # Errors
    /// [`Error::Usage`] if the stream has no such level, the number of slices is wrong, or a payload is too long.
    pub fn features(&mut self, level: u8, latent_hash: u64, slices: &[impl AsRef<[u8]>]) -> Result<()> {
        let section = self.header.index(level)?;
        let counts = self.slices(section, slices.len())?;
        let start = self.body.len();
        for (slice, (&count, bytes)) in counts.iter().zip(slices).enumerate() {
            let hash = latent_hash.to_le_bytes();
            let prefix = if slice == 0 { &hash[..] } else { &[] };
            self.chunk(ChunkKind::Features, level, slice, count, prefix, bytes.as_ref())?;
        }
        self.extend_colours(section, start)
    }

    /// Version 2: adds a colour filter for the best heads of `level` (`slice` 0) or the quick ones (1), after its
    /// latents.
    ///
    /// # Errors
    /// [`Error::Usage`] if the stream has no such level.
    pub fn filter(&mut self, level: u8, slice: usize, payload: &[u8]) -> Result<()> {
        let section = self.header.index(level)?;
        let (voxels, start) = (self.header.voxels[section], self.body.len());
        self.chunk(ChunkKind::Filter, level, slice, voxels, &[], payload)?;
        self.extend_colours(section, start)
    }

    /// Version 2: adds the colour residual of `level`, after its filters: the payload of each slice of voxels.
    ///
    /// # Errors
    /// [`Error::Usage`] if the stream has no such level, the number of slices is wrong, or a payload is too long.
    pub fn residual(&mut self, level: u8, slices: &[impl AsRef<[u8]>]) -> Result<()> {
        let section = self.header.index(level)?;
        let counts = self.slices(section, slices.len())?;
        let start = self.body.len();
        for (slice, (count, bytes)) in counts.into_iter().zip(slices).enumerate() {
            let bytes = bytes.as_ref();
            self.chunk(ChunkKind::Residual, level, slice, count, &[], bytes)?;
        }
        self.extend_colours(section, start)
    }

    /// Version 3: adds the geometry trunk. `levels` has the number of voxels and the payload of level 1 and the
    /// following, each of one slice. Adds nothing if it is empty, as for base level 0.
    ///
    /// # Errors
    /// [`Error::Usage`] if a payload is too long.
    pub fn geometry_trunk(&mut self, levels: &[(u32, impl AsRef<[u8]>)]) -> Result<()> {
        let Some((count, _)) = levels.last() else {
            return Ok(());
        };
        let (mut payload, start) = (Vec::new(), self.body.len());
        for (voxels, bytes) in levels {
            let bytes = bytes.as_ref();
            put_varint(&mut payload, *voxels);
            put_varint(&mut payload, extended(0, bytes.len())?);
            payload.extend(bytes);
        }
        let (kind, level) = (ChunkKind::GeometryTrunk, levels.len() as u8);
        self.chunk(kind, level, 0, *count, &[], &payload)?;
        let length = &mut self.header.sections[0].geometry;
        *length = extended(*length, self.body.len() - start)?;
        Ok(())
    }

    /// Version 3: adds the colour trunk: the colours of the levels 0 to `level`, which has `voxels` voxels. `hash` is
    /// that of the colours of the base level.
    ///
    /// # Errors
    /// [`Error::Usage`] if the payload is too long.
    pub fn colour_trunk(&mut self, level: u8, voxels: u32, hash: u64, payload: &[u8]) -> Result<()> {
        let start = self.body.len();
        let kind = ChunkKind::ColourTrunk;
        self.chunk(kind, level, 0, voxels, &hash.to_le_bytes(), payload)?;
        self.extend_colours(0, start)
    }

    /// Version 3: adds the colours of `level`: for each slice of parents their number, and the payload. `hash` is that
    /// of the level's colours; `None` for the levels between the trunk and the base level.
    ///
    /// # Errors
    /// [`Error::Usage`] if the stream has no such level or a payload is too long.
    pub fn colours(&mut self, level: u8, hash: Option<u64>, slices: &[(u32, impl AsRef<[u8]>)]) -> Result<()> {
        let section = self.header.index(level.max(self.header.base))?;
        let start = self.body.len();
        for (slice, (count, bytes)) in slices.iter().enumerate() {
            let hash = hash.filter(|_| slice == 0).map(u64::to_le_bytes);
            let prefix = hash.as_ref().map_or(&[][..], |hash| hash);
            let kind = ChunkKind::Colours;
            self.chunk(kind, level, slice, *count, prefix, bytes.as_ref())?;
        }
        self.extend_colours(section, start)
    }

    /// Version 3: adds the colour filter of `level`, after its colours.
    ///
    /// # Errors
    /// [`Error::Usage`] if the stream has no such level.
    pub fn post_filter(&mut self, level: u8, payload: &[u8]) -> Result<()> {
        let section = self.header.index(level)?;
        let (voxels, start) = (self.header.voxels[section], self.body.len());
        self.chunk(ChunkKind::PostFilter, level, 0, voxels, &[], payload)?;
        self.extend_colours(section, start)
    }

    /// Version 3: adds the head map of `level`, as the last chunk of its section, with learned Gaussians and
    /// surfels that are thicker by so many 128ths of a voxel, at most 127.
    ///
    /// # Errors
    /// [`Error::Usage`] if the stream has no such level.
    pub fn head_map(&mut self, level: u8, thickness: [u8; 2], payload: &[u8]) -> Result<()> {
        let [learned, surfels] = thickness.map(u32::from);
        let thickness = learned + 128 * surfels;
        let (section, start) = (self.header.index(level)?, self.body.len());
        self.chunk(ChunkKind::HeadMap, level, 0, thickness, &[], payload)?;
        self.extend_colours(section, start)
    }

    fn extend_colours(&mut self, section: usize, start: usize) -> Result<()> {
        let length = &mut self.header.sections[section].colours;
        *length = extended(*length, self.body.len() - start)?;
        Ok(())
    }

    /// Voxel counts of the slices of a level.
    ///
    /// # Errors
    /// [`Error::Usage`] if their number is not `found`.
    fn slices(&self, section: usize, found: usize) -> Result<Vec<u32>> {
        let voxels = self.header.voxels[section].into();
        let counts: Vec<u32> = sliced(voxels, self.header.slice_voxels)
            .map(|(_, count)| count as u32)
            .collect();
        if counts.len() != found {
            return Err(Error::Usage(format!(
                "{voxels} voxels need {} slices, not {found}",
                counts.len(),
            )));
        }
        Ok(counts)
    }

    /// Returns the stream, after parsing it to check that every level is complete.
    ///
    /// # Errors
    /// Those of [`Stream::parse`], or the [`Stream::damage`]: levels that are missing, out of order, or have other
    /// voxel counts than in the header.
    pub fn finish(self) -> Result<Vec<u8>> {
        let mut bytes = self.header.write();
        bytes.extend(self.body);
        let stream = Stream::parse(&bytes, &UNLIMITED)?;
        stream.require(self.header.top)?;
        Ok(bytes)
    }

    fn chunk(
        &mut self,
        kind: ChunkKind,
        level: u8,
        slice: usize,
        count: u32,
        prefix: &[u8],
        payload: &[u8],
    ) -> Result<()> {
        let chunk = Chunk {
            kind,
            level,
            slice: u16::try_from(slice)
                .map_err(|_| Error::Usage(format!("level {level} has more than 65536 slices")))?,
            count,
            payload,
            offset: 0,
            payload_at: 0,
        };
        let form = match self.header.format {
            Format::Learned { .. } => Form::Fixed,
            Format::Transform { .. } => Form::Short,
        };
        chunk.write(form, prefix, &mut self.body)
    }
}

/// `length + by`, which must fit in 32 bits.
fn extended(length: u32, by: usize) -> Result<u32> {
    u32::try_from(by)
        .ok()
        .and_then(|by| length.checked_add(by))
        .ok_or_else(|| Error::Usage("a section must be shorter than 4 GiB".into()))
}
