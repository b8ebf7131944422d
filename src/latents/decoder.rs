//! Decoding streams of version 2.

use std::borrow::Cow;

use super::LatentDecoding;
use super::network::Model;
use crate::cancel::Cancel;
use crate::container::Header;
use crate::container::feed::Goal;
use crate::error::{Error, Result};
use crate::gaussians::{Frame, Gaussians, Heads};
use crate::geometry::Octree;
use crate::limits::Limits;
use crate::log::Log;

/// Decodes streams with one model.
#[derive(Debug, Clone)]
pub struct LatentDecoder {
    pub(crate) model: Model,
    pub(crate) heads: Heads,
    pub(crate) limits: Limits,
    pub(super) cancel: Cancel,
}

/// A level, decoded in the exact zone: what the next level's context and the Gaussians are made from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Exact {
    /// The octree down to this level.
    pub octree: Octree,
    /// The latents, K per voxel; none if the level's role has none.
    pub latents: Vec<i16>,
    /// The reconstructed features, C per voxel.
    pub features: Vec<i16>,
}

impl LatentDecoder {
    /// A decoder with default limits and the model's best heads.
    pub fn new(model: &Model) -> Self {
        LatentDecoder {
            model: model.clone(),
            heads: Heads::Best,
            limits: Limits::default(),
            cancel: Cancel::default(),
        }
    }

    /// The same decoder with other heads of the model. Only Gaussians differ by them.
    ///
    /// # Errors
    /// [`Error::Unsupported`] if the model has no such heads.
    pub fn with_heads(mut self, heads: Heads) -> Result<Self> {
        self.model.check_heads(heads)?;
        self.heads = heads;
        Ok(self)
    }

    /// The same decoder under other limits.
    pub fn with_limits(mut self, limits: Limits) -> Self {
        self.limits = limits;
        self
    }

    /// The same decoder, stopped when `cancel` is thrown.
    pub fn with_cancel(mut self, cancel: Cancel) -> Self {
        self.cancel = cancel;
        self
    }

    /// The levels of a stream that can be decoded to Gaussians: those in its header for whose role the model has a
    /// head.
    ///
    /// # Errors
    /// Those of [`Header::parse`].
    pub fn levels(&self, bytes: &[u8]) -> Result<Vec<u8>> {
        let header = Header::parse(bytes, &self.limits)?;
        Ok(self.drawable(&header).collect())
    }

    /// Begins to decode a stream whose bytes are still to come, down to `level`: by default the finest that the stream
    /// has and the model has a head for.
    pub fn start(&self, level: Option<u8>) -> LatentDecoding<'static> {
        LatentDecoding::new(self.clone(), Goal::Gaussians(level), Cow::Owned(Vec::new()))
    }

    /// Decodes a stream to the Gaussians of `level`: by default the finest that the stream has and the model has a head
    /// for.
    ///
    /// A stream cut exactly after a level is a coarser stream. From one that is cut or damaged elsewhere, a level
    /// before the damage is decoded only when asked for.
    ///
    /// # Errors
    /// Those of [`LatentDecoding::finish`] and [`LatentDecoding::gaussians`].
    pub fn decode(&self, bytes: &[u8], level: Option<u8>, log: &Log) -> Result<Gaussians> {
        let goal = Goal::Gaussians(level);
        let mut decoding = LatentDecoding::new(self.clone(), goal, Cow::Borrowed(bytes));
        decoding.finish(log)?;
        decoding.gaussians(log)
    }

    /// Decodes a stream's exact zone down to `level`, which need not have a head.
    ///
    /// # Errors
    /// Those of [`LatentDecoding::finish`].
    pub fn exact(&self, bytes: &[u8], level: u8, log: &Log) -> Result<Exact> {
        let goal = Goal::Exact(level);
        let mut decoding = LatentDecoding::new(self.clone(), goal, Cow::Borrowed(bytes));
        decoding.finish(log)?;
        decoding.into_exact()
    }

    /// The cube that a stream's Gaussians refer to.
    ///
    /// # Errors
    /// Those of [`Header::parse`].
    pub fn frame(&self, bytes: &[u8]) -> Result<Frame> {
        let header = Header::parse(bytes, &self.limits)?;
        Ok(Frame {
            bits: header.bits,
            placement: header.placement,
        })
    }

    pub(crate) fn drawable(&self, header: &Header) -> impl Iterator<Item = u8> {
        let (base, top, shape) = (header.base, header.top, self.model.shape());
        let head = move |level: u8| shape.head(usize::from(level - base), self.heads);
        (base..=top).filter(move |level| head(*level).is_some())
    }

    /// Fails with [`Error::Unsupported`] unless the model has a head for `level`.
    pub(crate) fn check_drawable(&self, header: &Header, level: u8) -> Result<()> {
        let drawable: Vec<u8> = self.drawable(header).collect();
        if drawable.contains(&level) {
            return Ok(());
        }
        let names: Vec<_> = drawable.iter().map(u8::to_string).collect();
        let names = match names.is_empty() {
            true => "none".to_owned(),
            false => names.join(" and "),
        };
        Err(Error::Unsupported {
            what: "decoding to Gaussians",
            detail: format!("level {level} has none; levels of this stream that have them: {names}"),
        })
    }
}
