//! One stream on its way to Gaussians.

use std::borrow::Cow;
use std::sync::{Mutex, PoisonError};

use super::{Exact, LatentDecoder};
use crate::container::feed::{Feed, Goal};
use crate::container::{Header, Level};
use crate::error::{Error, Result};
use crate::gaussians::Heads;
use crate::gaussians::{Frame, Gaussians};
use crate::geometry::{KernelMap, Octree, codec};
use crate::latents::entropy::{Condition, decode_level, decode_passes, expect_no_latents, latent_hash};
use crate::latents::network::Module;
use crate::latents::{ColourContexts, ColourFilter, ColourResidual, activate};
use crate::layers::Pool;
use crate::log::Log;

/// A stream that is decoded level by level as its bytes arrive.
///
/// Bytes are pushed in pieces of any size; [`LatentDecoding::advance`] decodes a level as soon as it is whole, and
/// [`LatentDecoding::gaussians`] gives those of the level that was reached. After an error what was reached before
/// stays usable, and nothing more is decoded.
///
/// ```
/// # #[cfg(feature = "embedded-learned")]
/// # fn main() -> b2p::Result<()> {
/// use b2p::{Log, Model, latents::LatentDecoder};
///
/// let model = Model::from_bytes(b2p::embedded::model())?;
/// let (mut decoding, log) = (LatentDecoder::new(&model).start(Some(8)), Log::new());
/// for packet in b2p::embedded::SAMPLE.chunks(1400) {
///     decoding.push(packet);
///     while let Some(level) = decoding.advance(&log)? {
///         println!("level {level} is there");
///     }
/// }
/// decoding.finish(&log)?;
/// let gaussians = decoding.gaussians(&log)?;
/// # assert!(gaussians.len() > 0);
/// # Ok(())
/// # }
/// # #[cfg(not(feature = "embedded-learned"))]
/// # fn main() {}
/// ```
#[derive(Debug)]
pub struct LatentDecoding<'b> {
    decoder: LatentDecoder,
    feed: Feed<'b>,
    reached: Option<Reached>,
    /// Between two steps, what the last has left.
    pool: Mutex<Pool<i16>>,
}

/// The deepest level so far.
#[derive(Debug)]
struct Reached {
    level: u8,
    exact: Exact,
    map: KernelMap,
    /// The map of the level above, where a filter reads it.
    above: Option<KernelMap>,
    /// What the stream says of the colours, for each set of heads.
    filters: [Option<ColourFilter>; Heads::ALL.len()],
    /// And the remaining error.
    residual: Option<ColourResidual>,
}

impl<'b> LatentDecoding<'b> {
    pub(crate) fn new(decoder: LatentDecoder, goal: Goal, bytes: Cow<'b, [u8]>) -> Self {
        LatentDecoding {
            decoder,
            feed: Feed::new(goal, bytes),
            reached: None,
            pool: Mutex::new(Pool::new()),
        }
    }

    /// Takes the next bytes of the stream. No more are kept than the stream's header, once it is there, says are
    /// needed.
    pub fn push(&mut self, bytes: &[u8]) {
        self.feed.push(bytes);
    }

    /// Decodes the next level, if all its bytes have come and it is not beyond the one that decoding is to end with:
    /// `None` otherwise.
    ///
    /// # Errors
    /// - [`Error::ChecksumMismatch`], [`Error::Malformed`]: the bytes are damaged, or no stream;
    /// - [`Error::Unsupported`]: a later version or a critical feature of one, or a level to end with that has no
    ///   Gaussians;
    /// - [`Error::ModelMismatch`]; [`Error::DeterminismMismatch`], if all checksums hold but the latents are not those
    ///   that were coded;
    /// - [`Error::LimitExceeded`], before anything is reserved; [`Error::Cancelled`];
    /// - [`Error::Usage`] if the stream has no level to end with, or decoding has failed before.
    pub fn advance(&mut self, log: &Log) -> Result<Option<u8>> {
        self.step(false, log)
    }

    /// Decodes what is left, knowing that no more bytes will come.
    ///
    /// # Errors
    /// Those of [`LatentDecoding::advance`], and [`Error::Truncated`] if the level to end with is not whole. Where no
    /// such level was named, the stream must be whole, or end just where one of its levels ends.
    pub fn finish(&mut self, log: &Log) -> Result<()> {
        while self.step(true, log)?.is_some() {}
        Ok(())
    }

    /// The header, once [`LatentDecoding::advance`] found it whole.
    pub fn header(&self) -> Option<&Header> {
        self.feed.header()
    }

    /// The deepest level decoded so far.
    pub fn level(&self) -> Option<u8> {
        self.reached.as_ref().map(|reached| reached.level)
    }

    /// Generates Gaussians with other heads of the model from now on; what has been decoded stays.
    ///
    /// # Errors
    /// [`Error::Unsupported`] if the model has no such heads.
    pub fn set_heads(&mut self, heads: Heads) -> Result<()> {
        self.decoder = self.decoder.clone().with_heads(heads)?;
        Ok(())
    }

    /// Whether the level reached has Gaussians: [`LatentDecoding::gaussians`] will not fail with
    /// [`Error::Unsupported`].
    pub fn is_drawable(&self) -> bool {
        let level = self.level();
        self.header()
            .is_some_and(|header| self.decoder.drawable(header).any(|l| Some(l) == level))
    }

    /// The level reached, as decoded in the exact zone.
    pub fn exact(&self) -> Option<&Exact> {
        self.reached.as_ref().map(|reached| &reached.exact)
    }

    pub(super) fn into_exact(self) -> Result<Exact> {
        self.reached.map(|reached| reached.exact).ok_or_else(nothing_reached)
    }

    /// The Gaussians of the level reached.
    ///
    /// # Errors
    /// [`Error::Unsupported`] if it has none, naming the levels that have; [`Error::LimitExceeded`];
    /// [`Error::Cancelled`]; [`Error::Usage`] if no level has been reached.
    pub fn gaussians(&self, log: &Log) -> Result<Gaussians> {
        let (Some(header), Some(reached)) = (self.header(), &self.reached) else {
            return Err(nothing_reached());
        };
        let (decoder, level) = (&self.decoder, reached.level);
        decoder.check_drawable(header, level)?;
        decoder.check_memory(header, level)?;
        decoder.cancel.check()?;
        let role = usize::from(level - header.base);
        let shape = decoder.model.shape();
        let heads = decoder.heads;
        let children = shape.head(role, heads).map_or(1, |head| head.children);
        let voxels = reached.exact.octree.level(level);
        let raw = log.step(Module::Gaussians(role, heads).at(level), voxels.len(), "voxels", || {
            let Reached { exact, map, .. } = reached;
            let mut pool = self.take_pool();
            let model = &decoder.model;
            let raw = model.generate_in(&mut pool, heads, role, &exact.features, map);
            self.return_pool(pool);
            raw
        })?;
        let frame = Frame {
            bits: header.bits,
            placement: header.placement,
        };
        let count = voxels.len() * children;
        let mut gaussians = log.step("activate", count, "Gaussians", || {
            Ok(activate(&raw, voxels, children, shape, frame))
        })?;
        drop(raw);
        if let Some(filter) = &reached.filters[heads as usize] {
            log.step("filter colours", count, "Gaussians", || {
                let (octree, map) = (&reached.exact.octree, &reached.map);
                let above = reached.above.as_ref();
                let around = ColourContexts::of_level(&gaussians, octree, level, map, above);
                filter.apply(&mut gaussians, &around);
                Ok(())
            })?;
        }
        if let Some(residual) = &reached.residual {
            log.step("add residual", count, "Gaussians", || {
                residual.apply(&mut gaussians, voxels.keys());
                Ok(())
            })?;
        }
        Ok(gaussians)
    }

    fn take_pool(&self) -> Pool<i16> {
        let pool = self.pool.lock();
        std::mem::replace(&mut *pool.unwrap_or_else(PoisonError::into_inner), Pool::new())
    }

    fn return_pool(&self, pool: Pool<i16>) {
        *self.pool.lock().unwrap_or_else(PoisonError::into_inner) = pool;
    }

    /// Takes the next step; `ended` tells that all bytes have come.
    pub(crate) fn step(&mut self, ended: bool, log: &Log) -> Result<Option<u8>> {
        self.feed.check_usable()?;
        let (decoder, level) = (&self.decoder, self.level());
        let plan = |header: &Header, goal| decoder.plan(header, goal);
        let next = self.feed.next_level(ended, level, &decoder.limits, plan);
        let step = next.and_then(|next| match next {
            Some(level) => self.decode(level, log).map(|()| Some(level)),
            None => Ok(None),
        });
        if step.is_err() {
            self.feed.fail();
        }
        step
    }

    /// Decodes a level, all or nothing.
    fn decode(&mut self, level: u8, log: &Log) -> Result<()> {
        let Some(header) = self.feed.header() else {
            return Err(nothing_reached());
        };
        let level = Level::read(self.feed.bytes(), header, level)?;
        let mut filters = [const { None }; Heads::ALL.len()];
        for (filter, payload) in filters.iter_mut().zip(&level.filters) {
            let parse = |payload| ColourFilter::parse(payload, level.level);
            *filter = payload.as_ref().map(parse).transpose()?;
        }
        let mut octree = match &mut self.reached {
            Some(above) => std::mem::replace(&mut above.exact.octree, Octree::root()),
            None => Octree::root(),
        };
        let above = self.reached.as_ref();
        let mut pool = self.take_pool();
        let decoder = &self.decoder;
        let done = decoder.exact_level(&mut pool, header, &level, &mut octree, above, log);
        let done = done.and_then(|exact| Ok((exact, residual(header, &level, &octree, log)?)));
        self.return_pool(pool);
        match (done, &mut self.reached) {
            (Ok(((latents, features, map), residual)), reached) => {
                let read = filters.iter().any(Option::is_some);
                let above = reached.take().map(|above| above.map);
                *reached = Some(Reached {
                    level: level.level,
                    above: above.filter(|_| read),
                    filters,
                    residual,
                    exact: Exact {
                        octree,
                        latents,
                        features,
                    },
                    map,
                });
                Ok(())
            }
            (Err(error), None) => Err(error),
            (Err(error), Some(above)) => {
                octree.truncate(above.level);
                above.exact.octree = octree;
                Err(error)
            }
        }
    }
}

/// Decodes the colour residual of a level, if it has one.
fn residual(header: &Header, level: &Level, octree: &Octree, log: &Log) -> Result<Option<ColourResidual>> {
    if level.residual.is_empty() {
        return Ok(None);
    }
    let (n, slice) = (level.level, header.slice_voxels as usize);
    let voxels = level.voxels as usize;
    log.step(format!("residual of level {n}"), voxels, "voxels", || {
        ColourResidual::parse(&level.residual, octree.level(n).keys(), slice, n)
    })
}

pub(crate) fn nothing_reached() -> Error {
    Error::Usage("no level has been decoded yet".into())
}

impl LatentDecoder {
    /// The last level to decode of a stream with this header, if that is possible and allowed.
    fn plan(&self, header: &Header, goal: Goal) -> Result<u8> {
        header.check_model(&self.model.id())?;
        let last = match goal {
            Goal::Exact(level) => level,
            Goal::Gaussians(Some(level)) => {
                self.check_drawable(header, level)?;
                level
            }
            // Without any, the whole stream is decoded as far as there is something to decode.
            Goal::Gaussians(None) => self.drawable(header).last().unwrap_or(header.top),
        };
        self.check_memory(header, last)?;
        Ok(last)
    }

    /// Grows `octree` to a level; its latents, features and kernel map.
    fn exact_level(
        &self,
        pool: &mut Pool<i16>,
        header: &Header,
        level: &Level,
        octree: &mut Octree,
        above: Option<&Reached>,
        log: &Log,
    ) -> Result<(Vec<i16>, Vec<i16>, KernelMap)> {
        let (n, count) = (level.level, level.voxels as usize);
        let (role, slice) = (usize::from(n - header.base), header.slice_voxels as usize);
        let isa = self.model.isa();
        let root = KernelMap::root();
        let mut map = Cow::Borrowed(above.map_or(&root, |above| &above.map));
        log.step(format!("geometry of level {n}"), count, "voxels", || {
            level.geometry.iter().try_for_each(|part| {
                codec::decode_level(isa, octree, &map, &part.slices, slice, &self.cancel)?;
                if part.level < n {
                    map = Cow::Owned(octree.child_map(part.level - 1, &map));
                }
                Ok(())
            })
        })?;
        if n > 0 {
            map = log.step(format!("kernel map of level {n}"), count, "voxels", || {
                Ok(Cow::Owned(octree.child_map(n - 1, &map)))
            })?;
        }
        let context = match above {
            None => None,
            Some(above) => {
                self.cancel.check()?;
                Some(log.step(Module::Context(role).at(n), count, "voxels", || {
                    let occupancy = octree.occupancy(n - 1);
                    let features = &above.exact.features;
                    Ok(self.model.upsample_in(pool, role, features, occupancy))
                })?)
            }
        };
        let latents = self.latents(pool, header, level, context.as_deref(), octree, &map, log)?;
        self.cancel.check()?;
        let features = match context {
            Some(context) if !self.model.makes_features(role) => context,
            context => log.step(Module::Features(role).at(n), count, "voxels", || {
                let model = &self.model;
                Ok(model.reconstruct_in(pool, role, &latents, context, &map))
            })?,
        };
        Ok((latents, features, map.into_owned()))
    }

    fn latents(
        &self,
        pool: &mut Pool<i16>,
        header: &Header,
        level: &Level,
        context: Option<&[i16]>,
        octree: &Octree,
        map: &KernelMap,
        log: &Log,
    ) -> Result<Vec<i16>> {
        let (n, count) = (level.level, level.voxels as usize);
        let (role, slice) = (usize::from(n - header.base), header.slice_voxels as usize);
        self.cancel.check()?;
        if !self.model.has_latents(role) {
            expect_no_latents(&level.features, n)?;
            return Ok(Vec::new());
        }
        let parameters = context
            .map(|context| {
                log.step(Module::Probabilities(role).at(n), count, "voxels", || {
                    Ok(self.model.entropy_parameters_in(pool, role, context, map))
                })
            })
            .transpose()?;
        let symbols = count * self.model.shape().latents;
        let latents = log.step(format!("latents of level {n}"), symbols, "symbols", || {
            let (tables, cancel) = (self.model.tables(), &self.cancel);
            let slices = &level.features;
            let latents = if self.model.has_passes(role) {
                let (keys, octants) = (octree.level(n).keys(), octree.level(n).octants());
                let predict = self.model.passes(role, &octants, map, parameters.as_ref());
                decode_passes(tables, keys, &predict, slices, slice, n, cancel)?
            } else {
                let condition = match &parameters {
                    Some((mu, sigma)) => Condition::Gauss { mu, sigma },
                    None => Condition::Prior,
                };
                decode_level(tables, condition, slices, count, slice, n, cancel)?
            };
            level.check_latents(latent_hash(&latents))?;
            Ok(latents)
        });
        if let Some((mu, _)) = parameters {
            pool.give(mu);
        }
        latents
    }
}
