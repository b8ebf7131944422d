//! Stream to Gaussians: drives the stages, holds no algorithm.

use crate::bitstream::{Header, Level, Stream};
use crate::entropy::{Condition, decode_level, latent_hash};
use crate::error::{Error, Result};
use crate::gaussians::{Frame, Gaussians, activate};
use crate::geometry::{KernelMap, Octree, codec};
use crate::limits::Limits;
use crate::log::Log;
use crate::network::{Model, Module};
use crate::projection::Camera;

/// Decodes streams with one model.
pub struct Decoder<'m> {
    model: &'m Model,
    limits: Limits,
}

/// A level, decoded in the exact zone: what the next level's context and the Gaussians are made from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Exact {
    /// The octree down to this level.
    pub octree: Octree,
    /// The latents, K per voxel.
    pub latents: Vec<i16>,
    /// The reconstructed features, C per voxel.
    pub features: Vec<i16>,
}

impl<'m> Decoder<'m> {
    /// A decoder with default limits.
    pub fn new(model: &'m Model) -> Self {
        Decoder {
            model,
            limits: Limits::default(),
        }
    }

    /// The same decoder under other limits.
    pub fn with_limits(mut self, limits: Limits) -> Self {
        self.limits = limits;
        self
    }

    /// The levels of a stream that can be decoded to Gaussians: those in its header for whose role the model has a head.
    ///
    /// # Errors
    /// Those of [`Stream::parse`].
    pub fn levels(&self, bytes: &[u8]) -> Result<Vec<u8>> {
        let stream = Stream::parse(bytes, &self.limits)?;
        Ok(self.drawable(&stream).collect())
    }

    /// Decodes a stream to the Gaussians of `level`: by default the finest that the stream has and the model has a head for.
    ///
    /// A stream cut exactly after a level is a coarser stream. From one that is cut or damaged elsewhere, a level before the damage
    /// is decoded only when asked for.
    ///
    /// # Errors
    /// [`Error::Unsupported`] if `level` has no head, naming those that have; [`Error::ModelMismatch`]; what the header or the levels
    /// up to `level` have wrong: [`Error::Truncated`], [`Error::ChecksumMismatch`], [`Error::Malformed`]; [`Error::LimitExceeded`];
    /// [`Error::DeterminismMismatch`] if checksums hold but the latents are not those that were coded.
    pub fn decode(&self, bytes: &[u8], level: Option<u8>, log: &mut Log) -> Result<Gaussians> {
        let stream = self.open(bytes)?;
        let (stream, level) = match level {
            Some(level) => {
                self.check_drawable(&stream, level)?;
                (stream.require(level)?, level)
            }
            None => {
                let stream = stream.intact()?;
                let level = self.finest(&stream)?;
                (stream, level)
            }
        };
        let header = stream.header();
        let (exact, map) = self.exact_levels(&stream, level, log)?;
        let role = usize::from(level - header.base);
        let children = self
            .model
            .shape()
            .head(role)
            .map_or(1, |head| head.children);
        let voxels = exact.octree.level(level);
        let raw = log.step(
            Module::Gaussians(role).at(level),
            voxels.len(),
            "voxels",
            || self.model.generate(role, &exact.features, &map),
        )?;
        let frame = frame_of(header);
        log.step("activate", voxels.len() * children, "Gaussians", || {
            Ok(activate(&raw, voxels, children, self.model.shape(), frame))
        })
    }

    /// The cube that a stream's Gaussians refer to.
    ///
    /// # Errors
    /// Those of [`Stream::parse`].
    pub fn frame(&self, bytes: &[u8]) -> Result<Frame> {
        let stream = Stream::parse(bytes, &self.limits)?;
        Ok(frame_of(stream.header()))
    }

    /// The coarsest level with Gaussians whose voxels are nowhere wider than a pixel in the pictures that `cameras` take: what is finer
    /// is hardly seen. The finest level where even its voxels are.
    ///
    /// # Errors
    /// Those of [`Decoder::decode`] that the header and a scan of the chunks show.
    pub fn level_for(&self, bytes: &[u8], cameras: &[Camera]) -> Result<u8> {
        let stream = self.open(bytes)?.intact()?;
        let finest = self.finest(&stream)?;
        let pixels = cameras.iter().map(Camera::pixels_per_unit);
        let pixels = pixels.fold(0.0, f64::max);
        let seen = |level: &u8| 2.0 / f64::from(1u32 << level) * pixels <= 1.0;
        Ok(self
            .drawable(&stream)
            .find(seen)
            .map_or(finest, |level| level.min(finest)))
    }

    /// Decodes a stream's exact zone down to `level`, which need not have a head.
    ///
    /// # Errors
    /// Those of [`Decoder::decode`], heads apart.
    pub fn exact(&self, bytes: &[u8], level: u8, log: &mut Log) -> Result<Exact> {
        let stream = self.open(bytes)?.require(level)?;
        Ok(self.exact_levels(&stream, level, log)?.0)
    }

    fn open<'b>(&self, bytes: &'b [u8]) -> Result<Stream<'b>> {
        let stream = Stream::parse(bytes, &self.limits)?;
        stream.header().check_model(&self.model.id())?;
        Ok(stream)
    }

    fn drawable(&self, stream: &Stream) -> impl Iterator<Item = u8> {
        let header = stream.header();
        let (base, top) = (header.base, header.top);
        (base..=top)
            .filter(move |level| self.model.shape().head(usize::from(level - base)).is_some())
    }

    /// Fails unless the model has a head for `level`.
    fn check_drawable(&self, stream: &Stream, level: u8) -> Result<()> {
        let drawable: Vec<u8> = self.drawable(stream).collect();
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
            detail: format!(
                "level {level} has none; levels of this stream that have them: {names}"
            ),
        })
    }

    /// The finest whole level with Gaussians.
    fn finest(&self, stream: &Stream) -> Result<u8> {
        let last = stream.deepest().unwrap_or(stream.header().base);
        self.drawable(stream)
            .filter(|level| *level <= last)
            .last()
            .ok_or_else(|| Error::Unsupported {
                what: "decoding to Gaussians",
                detail: format!(
                    "the stream ends with level {last}, and no level up to there has them"
                ),
            })
    }

    fn exact_levels(&self, stream: &Stream, last: u8, log: &mut Log) -> Result<(Exact, KernelMap)> {
        let header = stream.header();
        self.check_memory(stream, last)?;
        let slice = header.slice_voxels as usize;
        let mut octree = Octree::root();
        let mut map = KernelMap::root();
        let mut latents = Vec::new();
        let mut features = Vec::new();
        let levels = stream
            .levels()
            .iter()
            .take_while(|level| level.level <= last);
        for (role, level) in levels.enumerate() {
            let (n, count) = (level.level, level.voxels as usize);
            log.step(format!("geometry of level {n}"), count, "voxels", || {
                level.geometry.iter().try_for_each(|part| {
                    let slices: Vec<_> = part.slices.iter().map(|s| (s.voxels, s.bytes)).collect();
                    codec::decode_level(&mut octree, &map, &slices, slice)?;
                    if part.level < n {
                        map = octree.child_map(part.level - 1, &map);
                    }
                    Ok(())
                })
            })?;
            if n > 0 {
                map = log.step(format!("kernel map of level {n}"), count, "voxels", || {
                    Ok(octree.child_map(n - 1, &map))
                })?;
            }
            let context = match role {
                0 => None,
                _ => Some(log.step(Module::Context(role).at(n), count, "voxels", || {
                    let occupancy = octree.occupancy(n - 1);
                    Ok(self.model.upsample(role, &features, occupancy))
                })?),
            };
            latents = self.latents(role, level, context.as_deref(), &map, slice, log)?;
            features = log.step(Module::Features(role).at(n), count, "voxels", || {
                let context = context.as_deref();
                Ok(self.model.reconstruct(role, &latents, context, &map))
            })?;
        }
        Ok((
            Exact {
                octree,
                latents,
                features,
            },
            map,
        ))
    }

    fn latents(
        &self,
        role: usize,
        level: &Level,
        context: Option<&[i16]>,
        map: &KernelMap,
        slice: usize,
        log: &mut Log,
    ) -> Result<Vec<i16>> {
        let (n, count) = (level.level, level.voxels as usize);
        let parameters = context
            .map(|context| {
                log.step(Module::Probabilities(role).at(n), count, "voxels", || {
                    Ok(self.model.entropy_parameters(role, context, map))
                })
            })
            .transpose()?;
        let condition = match &parameters {
            Some((mu, sigma)) => Condition::Gauss { mu, sigma },
            None => Condition::Prior,
        };
        let slices: Vec<_> = level.features.iter().map(|s| s.bytes).collect();
        let symbols = count * self.model.shape().latents;
        log.step(format!("latents of level {n}"), symbols, "symbols", || {
            let latents = decode_level(self.model.tables(), condition, &slices, count, slice, n)?;
            level.check_latents(latent_hash(&latents))?;
            Ok(latents)
        })
    }

    /// What decoding to `last` reserves at its widest, estimated from the header's counts alone.
    fn check_memory(&self, stream: &Stream, last: u8) -> Result<()> {
        let header = stream.header();
        let shape = self.model.shape();
        let channels = shape.channels as u64;
        let peak = (header.base..=last)
            .enumerate()
            .map(|(role, level)| {
                let voxels = u64::from(header.voxels[usize::from(level - header.base)]);
                // Keys, links and a 3³ kernel map; five tensors of 16-bit features in an Inception block.
                let exact = voxels * (16 + 4 * 27 + 5 * 2 * channels);
                let head = shape
                    .head(role)
                    .filter(|_| level == last)
                    .map_or(0, |head| {
                        let each = 4 * 27 + 3 * 2 * head.channels as u64 + 4 * 14 + 15 * 4;
                        voxels * head.children as u64 * each
                    });
                exact + head
            })
            .max()
            .unwrap_or(0);
        self.limits
            .check_bytes("memory to decode this stream", peak)
    }
}

fn frame_of(header: &Header) -> Frame {
    Frame {
        bits: header.bits,
        placement: header.placement,
    }
}
