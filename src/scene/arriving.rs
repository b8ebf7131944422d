//! Scenes that arrive in pieces, for whoever takes streams that do.

use super::decoder::{SceneDecoder, Wanted};
use super::reader::SceneReader;
use crate::axes::Axes;
#[cfg(feature = "ply")]
use crate::cloud::ColouredVoxels;
use crate::decoder::Decoder;
use crate::error::{Error, Result};
use crate::gaussians::learned::HeadsModel;
use crate::gaussians::{Frame, Gaussians, HeadSet};
use crate::geometry::Voxels;

/// A scene that arrives in pieces of any size. Every block has all levels, so that all levels are there as soon as the
/// last byte is, the coarsest first. Blocks are decoded when Gaussians or points are asked for.
#[derive(Debug)]
pub struct SceneDecoding {
    decoder: Decoder,
    bytes: Vec<u8>,
    /// Once header and index are there.
    known: Option<Known>,
    level: Option<u8>,
}

/// What the index tells.
#[derive(Debug, Clone, Copy)]
struct Known {
    /// Bytes of the scene.
    length: u64,
    /// The first level, and the last that is wanted.
    levels: [u8; 2],
}

impl SceneDecoding {
    /// Begins to take a scene, down to the decoder's level.
    pub fn new(decoder: Decoder) -> Self {
        SceneDecoding {
            decoder,
            bytes: Vec::new(),
            known: None,
            level: None,
        }
    }

    /// Draws with these heads from now on.
    pub fn set_heads(&mut self, heads: HeadSet) {
        self.decoder = self.decoder.clone().with_heads(heads);
    }

    /// Draws with these learned heads from now on.
    pub fn set_heads_model(&mut self, heads: HeadsModel) {
        self.decoder = self.decoder.clone().with_heads_model(heads);
    }

    /// Takes the next bytes. What follows the scene is dropped.
    ///
    /// # Errors
    /// [`Error::LimitExceeded`] if there are more than memory is allowed.
    pub fn push(&mut self, bytes: &[u8]) -> Result<()> {
        let length = (self.bytes.len() as u64).saturating_add(bytes.len() as u64);
        let kept = self.known.map_or(length, |known| length.min(known.length));
        let limits = self.decoder.limits();
        limits.check_bytes("size of the scene, as far as it has arrived,", kept)?;
        let room = (kept as usize).saturating_sub(self.bytes.len());
        self.bytes.extend(&bytes[..room]);
        Ok(())
    }

    /// Goes to the next level if the scene is all there, and returns its number. `None` if more bytes are needed, or
    /// there is no finer one.
    ///
    /// # Errors
    /// Those of [`SceneReader::new`], and [`Error::Usage`] if the decoder's level is none of the scene's.
    pub fn advance(&mut self) -> Result<Option<u8>> {
        let known = match self.known {
            Some(known) => known,
            None => match self.read() {
                Ok(known) => known,
                Err(Error::Truncated { .. }) => return Ok(None),
                Err(error) => return Err(error),
            },
        };
        self.known = Some(known);
        let [first, last] = known.levels;
        let next = self.level.map_or(first, |level| level + 1);
        if (self.bytes.len() as u64) < known.length || next > last {
            return Ok(None);
        }
        self.level = Some(next);
        Ok(self.level)
    }

    /// Goes to the last level, knowing that no more bytes will come.
    ///
    /// # Errors
    /// Those of [`SceneDecoding::advance`], and [`Error::Truncated`] if the scene is not all there.
    pub fn finish(&mut self) -> Result<()> {
        let known = self.read()?;
        self.known = Some(known);
        self.bytes.truncate(usize::try_from(known.length).unwrap_or(usize::MAX));
        SceneReader::new(&self.bytes[..], self.decoder.limits())?.check_end()?;
        while self.advance()?.is_some() {}
        Ok(())
    }

    fn read(&self) -> Result<Known> {
        let scene = SceneReader::new(&self.bytes[..], self.decoder.limits())?;
        let header = scene.header();
        let last = self.decoder.level().unwrap_or(header.top);
        header.voxels(last)?;
        Ok(Known {
            length: scene.bytes(),
            levels: [header.base, last],
        })
    }

    /// The level reached.
    pub fn level(&self) -> Option<u8> {
        self.level
    }

    /// Whether the last level has been reached: the decoder's, or the scene's finest.
    pub fn is_complete(&self) -> bool {
        self.known.is_some_and(|known| self.level == Some(known.levels[1]))
    }

    /// Whether the level reached has Gaussians.
    pub fn is_drawable(&self) -> bool {
        let levels = self.reached().and_then(|(scene, decoder)| decoder.levels(&scene));
        levels.is_ok_and(|levels| levels.last() == self.level.as_ref())
    }

    /// The Gaussians of the level reached.
    ///
    /// # Errors
    /// [`Error::Usage`] if there is none yet; those of [`SceneDecoder::gaussians`], also of a single block.
    pub fn gaussians(&self) -> Result<Gaussians> {
        let (scene, decoder) = self.reached()?;
        decoder.gaussians(&scene, &Wanted::All)?.whole()
    }

    /// The voxels of the level reached with their colours, in the order of space.
    ///
    /// # Errors
    /// Those of [`SceneDecoding::gaussians`].
    pub fn voxels(&self) -> Result<(Voxels, Vec<[u8; 3]>)> {
        let (scene, decoder) = self.reached()?;
        decoder.voxels(&scene, &Wanted::All)?.whole()
    }

    /// The cube that the scene's Gaussians refer to.
    ///
    /// # Errors
    /// Those of [`SceneReader::new`].
    pub fn frame(&self) -> Result<Frame> {
        Ok(SceneReader::new(&self.bytes[..], self.decoder.limits())?.frame())
    }

    /// The voxels of the level reached, on a grid of their own.
    ///
    /// # Errors
    /// Those of [`SceneDecoding::gaussians`].
    #[cfg(feature = "ply")]
    pub fn points(&self) -> Result<ColouredVoxels> {
        let (scene, decoder) = self.reached()?;
        decoder.points(&scene, &Wanted::All)?.whole()
    }

    /// What the scene says of its coordinates.
    ///
    /// # Errors
    /// Those of [`SceneReader::axes`]; [`Error::Usage`] if it is not all there.
    pub fn axes(&self) -> Result<Axes> {
        self.reached()?.0.axes()
    }

    fn reached(&self) -> Result<(SceneReader<&[u8]>, SceneDecoder)> {
        let Some(level) = self.level else {
            return Err(Error::Usage("no level has been decoded yet".into()));
        };
        let scene = SceneReader::new(&self.bytes[..], self.decoder.limits())?;
        Ok((scene, SceneDecoder::new(self.decoder.clone().with_level(level))))
    }
}
