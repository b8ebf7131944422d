//! Finds the blocks of a scene (`docs/format.md`, clauses 18.1 and 18.2).

use std::borrow::Cow;

use super::decoder::frame_of;
use super::source::Source;
use crate::axes::Axes;
use crate::container::scene::{BlockEntry, parse_index};
use crate::container::{Header, axes};
use crate::decoder::{Checked, Decoder, Fault};
use crate::error::{Error, Result, Stage};
use crate::gaussians::Frame;
use crate::limits::Limits;

/// Bytes that are read first: header and index of most scenes.
const FIRST_READ: u64 = 1 << 16;

/// Header and index of a scene. Its blocks are read when they are asked for, so that one that is damaged or missing
/// leaves the others usable.
#[derive(Debug)]
pub struct SceneReader<S> {
    source: S,
    header: Header,
    blocks: Vec<BlockEntry>,
}

/// What [`SceneReader::check`] found.
#[derive(Debug)]
pub struct Checks {
    /// For every block what was found, or why it could not be read. Offsets count from the start of the scene, levels are
    /// those of the block's own stream.
    pub blocks: Vec<Result<Checked>>,
    /// What is wrong with the scene as a whole.
    pub end: Option<Error>,
}

impl SceneReader<()> {
    /// Whether these bytes start like a scene of blocks, and not like a stream of one frame.
    pub fn is_scene(bytes: &[u8]) -> bool {
        Header::is_of_scene(bytes)
    }
}

impl<S: Source> SceneReader<S> {
    /// Reads header and index. The blocks may be missing, in part or all.
    ///
    /// # Errors
    /// [`Error::Truncated`], [`Error::ChecksumMismatch`], [`Error::Malformed`]; [`Error::Unsupported`] for a stream of
    /// one frame or a later version; [`Error::LimitExceeded`] for a block with too many points or levels;
    /// [`Error::Io`].
    pub fn new(source: S, limits: &Limits) -> Result<Self> {
        let length = source.length();
        let mut first = length.min(FIRST_READ);
        let (header, blocks) = loop {
            // No more is read than the parts so far say there is, which their checksums hold.
            limits.check_bytes("index of the scene", first)?;
            let bytes = source.read(0, usize::try_from(first).unwrap_or(usize::MAX))?;
            let parsed = Header::parse_scene(&bytes, limits);
            let parsed = parsed.and_then(|header| Ok((parse_index(&bytes, &header, limits)?, header)));
            match parsed {
                Ok((blocks, header)) => break (header, blocks),
                Err(Error::Truncated { needed, .. }) if first.saturating_add(needed) <= length => {
                    first += needed.max(1)
                }
                Err(error) => return Err(error),
            }
        };
        Ok(SceneReader { source, header, blocks })
    }

    /// What all blocks have in common. Voxels and points are the sums over all blocks; section lengths are 0.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The cube that the scene's Gaussians refer to.
    pub fn frame(&self) -> Frame {
        frame_of(&self.header)
    }

    /// The index.
    pub fn blocks(&self) -> &[BlockEntry] {
        &self.blocks
    }

    /// The stream of a block, once its hash is checked.
    ///
    /// # Errors
    /// [`Error::Block`] if it is damaged, missing, or not what the index says.
    pub fn block(&self, block: usize) -> Result<Cow<'_, [u8]>> {
        let Some(entry) = self.blocks.get(block) else {
            let last = self.blocks.len() - 1;
            return Err(Error::Usage(format!(
                "the scene has the blocks 0 to {last}, not {block}"
            )));
        };
        let read = || {
            let bytes = self.source.read(entry.offset, entry.bytes as usize)?;
            entry.check_hash(&bytes)?;
            let header = Header::parse(&bytes, &Limits::unlimited());
            let header = header.map_err(|error| error.moved(|byte| entry.offset + byte))?;
            entry.check_header(&header, &self.header)?;
            Ok(bytes)
        };
        read().map_err(|source| Error::Block {
            block,
            source: Box::new(source),
        })
    }

    /// What the scene says of its coordinates: what its first block does.
    ///
    /// # Errors
    /// Those of [`SceneReader::block`].
    pub fn axes(&self) -> Result<Axes> {
        axes(&self.block(0)?)
    }

    /// Bytes that the index says the scene has.
    pub fn bytes(&self) -> u64 {
        let last = self.blocks.last();
        last.map_or(0, |block| block.offset + u64::from(block.bytes))
    }

    /// Checks that the file ends with the last block.
    ///
    /// # Errors
    /// [`Error::Truncated`] or [`Error::Malformed`] if not.
    pub fn check_end(&self) -> Result<()> {
        let (end, length) = (self.bytes(), self.source.length());
        match length.checked_sub(end) {
            Some(0) => Ok(()),
            None => Err(Error::Truncated {
                stage: Stage::Bitstream,
                offset: length,
                field: "block",
                needed: end - length,
            }),
            Some(rest) => {
                let field = "number of bytes after the last block";
                Err(Error::malformed(Stage::Bitstream, format!("byte {end}"), field, rest, 0).breaks("18.1.1"))
            }
        }
    }

    /// Validates every block to the last bit with `decoder`. Of a block whose hash is wrong, or whose header is not what
    /// the index says, it finds out the place.
    pub fn check(&self, decoder: &Decoder) -> Checks {
        Checks {
            blocks: (0..self.blocks.len())
                .map(|block| self.check_block(block, decoder))
                .collect(),
            end: self.check_end().err(),
        }
    }

    fn check_block(&self, block: usize, decoder: &Decoder) -> Result<Checked> {
        let entry = &self.blocks[block];
        let check = |bytes: &[u8]| decoder.check(bytes).moved(entry.offset);
        let error = match self.block(block) {
            Ok(bytes) => return Ok(check(&bytes)),
            Err(error) => error,
        };
        let Ok(bytes) = self.source.read(entry.offset, entry.bytes as usize) else {
            return Err(error);
        };
        let mut checked = check(&bytes);
        let error = match error {
            Error::Block { source, .. } => *source,
            error => error,
        };
        let fault = Fault {
            level: None,
            offset: error.offset(),
            error,
        };
        checked.faults.insert(0, fault);
        checked.valid_to = None;
        Ok(checked)
    }
}
