//! Streams of either version to Gaussians.

use std::borrow::Cow;

use b2p_kernels::Isa;

use super::Decoding;
use crate::cancel::Cancel;
#[cfg(feature = "ply")]
use crate::cloud::{ColouredVoxels, PointCloud};
use crate::container::feed::Goal;
use crate::container::{Format, Header, Stream};
use crate::error::{Error, Result};
use crate::gaussians::learned::{HeadsModel, Set, span_rows};
use crate::gaussians::surfels::PerVoxel;
use crate::gaussians::{Frame, Gaussians};
use crate::gaussians::{HeadSet, Heads};
use crate::geometry::Voxels;
use crate::latents::LatentDecoder;
use crate::latents::network::Model;
use crate::layers::Precision;
use crate::limits::Limits;
use crate::log::Log;
use crate::motion::Inter;
#[cfg(feature = "ply")]
use crate::placement::Placement;

/// Decodes streams of either version. Version 3 needs no model; version 2 needs the one that the stream was coded with.
#[derive(Debug, Clone, Default)]
pub struct Decoder {
    pub(super) model: Option<Model>,
    /// Asked for; otherwise the best there are.
    pub(super) heads: Option<HeadSet>,
    pub(super) heads_model: Option<HeadsModel>,
    /// Whether memory is for Gaussians in parts.
    in_parts: bool,
    /// Gaussians a voxel, if asked for.
    per_voxel: Option<usize>,
    pub(super) precision: Precision,
    isa: Option<Isa>,
    pub(super) limits: Limits,
    cancel: Cancel,
    /// The last level, if not the finest that can be drawn.
    level: Option<u8>,
    log: Option<Log>,
}

/// The voxels of a level with their colours.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct Points<'a> {
    /// The voxels.
    pub voxels: &'a Voxels,
    /// Display colours, one per voxel.
    pub colours: &'a [[u8; 3]],
    /// Where the cube lies.
    pub frame: Frame,
}

impl Points<'_> {
    /// The points as a cloud with whole coordinates, whose hints say where the grid lies.
    #[cfg(feature = "ply")]
    pub fn to_cloud(&self) -> PointCloud {
        self.to_voxels().to_cloud()
    }

    /// The points as voxels of the level's own grid.
    #[cfg(feature = "ply")]
    pub fn to_voxels(&self) -> ColouredVoxels {
        let Frame { bits, placement } = self.frame;
        let coarser = bits - self.voxels.depth();
        ColouredVoxels {
            voxels: self.voxels.clone(),
            colours: self.colours.to_vec(),
            placement: Placement {
                voxel_size: placement.voxel_size * f64::from(1u32 << coarser),
                ..placement
            },
        }
    }
}

impl Decoder {
    /// A decoder with default limits and without a model, which makes Gaussians with the best heads there are.
    pub fn new() -> Self {
        Self::default()
    }

    /// The same decoder, which decodes streams of version 2 that this model coded.
    pub fn with_model(mut self, model: Model) -> Self {
        self.model = Some(model);
        self
    }

    /// The same decoder with these heads. Only Gaussians differ by them. A stream that cannot be drawn with them is
    /// refused with [`Error::Unsupported`].
    pub fn with_heads(mut self, heads: HeadSet) -> Self {
        self.heads = Some(heads);
        self
    }

    /// The same decoder, which draws streams of version 3 with the heads of this model.
    pub fn with_heads_model(mut self, heads: HeadsModel) -> Self {
        self.heads_model = Some(heads);
        self
    }

    /// The same decoder, whose heads of streams of version 3 make so many Gaussians of a voxel: learned heads 1 or 8,
    /// surfels 1 or 4. By default it is one where voxels are at most twice as wide as those of the cloud, else more.
    pub fn with_per_voxel(mut self, count: usize) -> Self {
        self.per_voxel = Some(count);
        self
    }

    /// The same decoder, whose learned heads of streams of version 3 calculate in this precision. Models of version 2
    /// have their own.
    pub fn with_precision(mut self, precision: Precision) -> Self {
        self.precision = precision;
        self
    }

    /// The same decoder, which holds against the limits what [`Decoding::gaussians_in_parts`] takes, not
    /// [`Decoding::gaussians`]: it accepts larger streams of version 3.
    pub fn with_gaussians_in_parts(mut self) -> Self {
        self.in_parts = true;
        self
    }

    /// The same decoder, which uses at most this instruction set; results are the same.
    pub fn with_isa(mut self, isa: Isa) -> Self {
        self.isa = Some(isa);
        self
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

    /// The same decoder, which decodes down to this level; `None` stands for the finest that can be drawn, the default.
    pub fn with_level(mut self, level: impl Into<Option<u8>>) -> Self {
        self.level = level.into();
        self
    }

    /// The same decoder, whose steps `log` collects.
    pub fn with_log(mut self, log: &Log) -> Self {
        self.log = Some(log.clone());
        self
    }

    /// Begins to decode a stream whose bytes are still to come.
    pub fn start(&self) -> Decoding<'static> {
        let goal = Goal::Gaussians(self.level);
        Decoding::new(self.clone(), goal, Cow::Owned(Vec::new()))
    }

    /// Begins to decode a frame of a sequence, as [`Decoder::start`] does with all its bytes.
    pub(crate) fn start_frame(&self, stream: Vec<u8>, inter: Option<Inter>) -> Decoding<'static> {
        Decoding::of_frame(self.clone(), Goal::Gaussians(self.level), stream, inter)
    }

    /// Decodes a stream to Gaussians.
    ///
    /// A stream cut exactly after a level is a coarser stream. From one that is cut or damaged elsewhere, a level
    /// before the damage is decoded only when [asked for](Decoder::with_level).
    ///
    /// # Errors
    /// Those of [`Decoding::finish`] and [`Decoding::gaussians`].
    pub fn decode(&self, bytes: &[u8]) -> Result<Gaussians> {
        self.whole(bytes)?.gaussians()
    }

    /// Decodes a stream, and calls `each` with its Gaussians, part by part: see [`Decoding::gaussians_in_parts`].
    ///
    /// # Errors
    /// Those of [`Decoding::finish`] and [`Decoding::gaussians_in_parts`].
    pub fn decode_in_parts(&self, bytes: &[u8], each: impl FnMut(&Gaussians) -> Result<()>) -> Result<()> {
        let decoder = self.clone().with_gaussians_in_parts();
        decoder.whole(bytes)?.gaussians_in_parts(each)
    }

    /// Decodes a stream down to a level, which need not have Gaussians.
    ///
    /// # Errors
    /// Those of [`Decoding::finish`].
    pub(crate) fn exact<'b>(&self, bytes: impl Into<Cow<'b, [u8]>>, level: u8) -> Result<Decoding<'b>> {
        let mut decoding = Decoding::new(self.clone(), Goal::Exact(level), bytes.into());
        decoding.finish()?;
        Ok(decoding)
    }

    /// Decodes a whole stream, but makes no Gaussians yet. [`Decoding::points`] are the voxels with their colours.
    ///
    /// # Errors
    /// Those of [`Decoding::finish`].
    pub fn whole<'b>(&self, bytes: &'b [u8]) -> Result<Decoding<'b>> {
        let goal = Goal::Gaussians(self.level);
        let mut decoding = Decoding::new(self.clone(), goal, Cow::Borrowed(bytes));
        decoding.finish()?;
        Ok(decoding)
    }

    /// The levels of a stream that can be decoded to Gaussians.
    ///
    /// # Errors
    /// Those of [`Header::parse`], and [`Error::ModelMissing`].
    pub fn levels(&self, bytes: &[u8]) -> Result<Vec<u8>> {
        let header = Header::parse(bytes, &self.limits)?;
        match header.format {
            Format::Learned { .. } => self.learned(&header)?.levels(bytes),
            Format::Transform { .. } => Ok(self.drawable(&header).collect()),
        }
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

    /// The coarsest level with Gaussians whose voxels are nowhere wider than a pixel, in pictures where a cube-frame
    /// unit takes `pixels_per_unit` pixels at most: what is finer is hardly seen. `None` if no level before the finest
    /// whole one does, so that the stream as it is serves best.
    ///
    /// # Errors
    /// Those of [`Stream::parse`], [`Error::ModelMissing`], and the damage of a stream that is cut or damaged elsewhere
    /// than right after a level.
    pub fn level_for(&self, bytes: &[u8], pixels_per_unit: f64) -> Result<Option<u8>> {
        let stream = Stream::parse(bytes, &self.limits)?.intact()?;
        let seen = |level: &u8| 2.0 / f64::from(1u32 << level) * pixels_per_unit <= 1.0;
        let coarsest = self.levels(bytes)?.into_iter().find(seen);
        Ok(coarsest.filter(|level| Some(*level) < stream.deepest()))
    }

    /// Bytes of memory that decoding a stream with this header down to `level` takes at most, its Gaussians included, or
    /// a part of them if they come [in parts](Decoder::with_gaussians_in_parts), beyond [`Limits::OVERHEAD`] and models.
    ///
    /// # Errors
    /// [`Error::Usage`] if the stream has no such level, [`Error::ModelMissing`].
    #[doc(hidden)]
    pub fn memory(&self, header: &Header, level: u8) -> Result<u64> {
        self.memory_for(header, level, self.in_parts)
    }

    fn memory_for(&self, header: &Header, level: u8, in_parts: bool) -> Result<u64> {
        match header.format {
            Format::Learned { .. } => self.learned(header)?.memory(header, level),
            Format::Transform { .. } => {
                let drawing = self.drawing_bytes(header, level, in_parts)?;
                super::memory::transform(header, level, drawing)
            }
        }
    }

    /// The model that decodes streams of version 2.
    #[doc(hidden)]
    pub fn model(&self) -> Option<&Model> {
        self.model.as_ref()
    }

    /// The heads that draw a stream with this header, if it can be drawn.
    #[doc(hidden)]
    pub fn heads_for(&self, header: &Header) -> HeadSet {
        match header.format {
            Format::Learned { .. } => self.heads.unwrap_or(HeadSet::Best),
            Format::Transform { .. } => self.heads(),
        }
    }

    /// What decodes a stream of version 2.
    pub(super) fn learned(&self, header: &Header) -> Result<LatentDecoder> {
        let Some(model) = &self.model else {
            let expected = header.model().unwrap_or_default();
            return Err(Error::ModelMissing { expected });
        };
        let decoder = LatentDecoder::new(model)
            .with_limits(self.limits.clone())
            .with_cancel(self.cancel.clone());
        decoder.with_heads(learned_heads(self.heads)?)
    }

    /// The heads that draw streams of version 3.
    pub(super) fn heads(&self) -> HeadSet {
        let has = |heads: &HeadSet| {
            let own = self.heads_model.iter().flat_map(|model| model.sets());
            let own = own.map(|(heads, _)| HeadSet::from(heads));
            own.into_iter().any(|own| own == *heads)
        };
        let best = HeadSet::ALL.into_iter().find(has);
        self.heads.or(best).unwrap_or_default()
    }

    /// The network that draws a level of a stream of version 3; none if it is drawn as surfels.
    pub(super) fn network(&self, header: &Header, level: u8) -> Result<Option<(&HeadsModel, Set)>> {
        let Some(heads) = self.heads().learned() else {
            return Ok(None);
        };
        let Some(model) = &self.heads_model else {
            return Err(Error::Unsupported {
                what: "drawing with learned heads",
                detail: format!("no file of them is loaded, which the {heads} heads are in"),
            });
        };
        let wide = level + 1 < header.bits;
        let wanted = self.per_voxel.unwrap_or(if wide { 8 } else { 1 });
        let has = |count| model.sets().any(|set| set == (heads, count));
        let count = match self.per_voxel {
            // What the model has not, it will say itself.
            Some(count) => count,
            None if has(wanted) => wanted,
            None => 9 - wanted,
        };
        Ok(Some((model, (heads, count))))
    }

    pub(super) fn surfels_per_voxel(&self, header: &Header, level: u8) -> Result<PerVoxel> {
        let wide = level + 1 < header.bits;
        let usual = if wide { 4 } else { 1 };
        let asked = match (self.per_voxel, self.heads().learned()) {
            // Among learned Gaussians, eight of a voxel stand for four surfels.
            (Some(8), Some(_)) => Some(4),
            (asked, _) => asked,
        };
        match asked.unwrap_or(usual) {
            1 => Ok(PerVoxel::One),
            4 => Ok(PerVoxel::Four),
            count => Err(Error::Unsupported {
                what: "drawing with so many surfels a voxel",
                detail: format!("{count} were asked for, 1 or 4 would do"),
            }),
        }
    }

    /// Bytes of memory that making Gaussians of a level takes at most.
    fn drawing_bytes(&self, header: &Header, level: u8, in_parts: bool) -> Result<u64> {
        let voxels = header.voxels(level)?.into();
        let above = match level > header.base {
            true => header.voxels(level - 1)?.into(),
            false => voxels,
        };
        self.drawing_bytes_of(header, level, [voxels, above], in_parts)
    }

    /// The same of so many voxels of a level, and of the level above.
    pub(crate) fn drawing_bytes_of(
        &self,
        header: &Header,
        level: u8,
        [voxels, above]: [u64; 2],
        in_parts: bool,
    ) -> Result<u64> {
        let per_voxel = self.surfels_per_voxel(header, level)?.count() as u64;
        let surfels = super::memory::surfels(voxels, per_voxel, in_parts);
        Ok(match self.network(header, level)? {
            // Some voxels may become surfels after all, once the network is done.
            Some((model, set)) => {
                let [gaussians, network] = model.bytes(set, [voxels, above], self.span_rows(), in_parts);
                gaussians.saturating_add(network.max(surfels))
            }
            None => surfels,
        })
    }

    /// Bytes of memory that the Gaussians of so many voxels of a level take at most.
    pub(crate) fn gaussian_bytes(&self, header: &Header, level: u8, voxels: u64) -> Result<u64> {
        let surfels = self.surfels_per_voxel(header, level)?.count();
        let learned = self.network(header, level)?.map_or(0, |(_, (_, count))| count);
        let each = size_of::<[f32; 14]>() as u64;
        Ok(voxels.saturating_mul(surfels.max(learned) as u64 * each))
    }

    /// Rows of a level that learned heads are evaluated on at a time, at most: less memory takes more time.
    pub(super) fn span_rows(&self) -> usize {
        span_rows(self.limits.max_bytes)
    }

    /// The level that was asked for.
    pub(crate) fn level(&self) -> Option<u8> {
        self.level
    }

    /// The level that decoding a stream with this header ends with.
    pub(crate) fn last_level(&self, header: &Header) -> u8 {
        self.level.unwrap_or(header.top).clamp(header.base, header.top)
    }

    pub(crate) fn log(&self) -> Log {
        self.log.clone().unwrap_or(Log::off())
    }

    pub(crate) fn isa(&self) -> Isa {
        self.isa.unwrap_or_else(Isa::detect)
    }

    pub(crate) fn limits(&self) -> &Limits {
        &self.limits
    }

    pub(crate) fn cancel(&self) -> &Cancel {
        &self.cancel
    }

    /// The levels of a stream of version 3 that can be drawn: learned heads read the level above.
    pub(super) fn drawable(&self, header: &Header) -> impl Iterator<Item = u8> + use<> {
        let first = u8::from(self.heads().learned().is_some());
        header.base.max(first)..=header.top
    }

    /// Fails with [`Error::Unsupported`] unless `level` of a stream of version 3 can be drawn.
    pub(crate) fn check_drawable(&self, header: &Header, level: u8) -> Result<()> {
        header.voxels(level)?;
        if self.network(header, level)?.is_none() {
            self.surfels_per_voxel(header, level)?;
        }
        match self.drawable(header).any(|l| l == level) {
            true => Ok(()),
            false => Err(Error::Unsupported {
                what: "decoding to Gaussians",
                detail: format!("the {} heads do not draw level {level}", self.heads()),
            }),
        }
    }

    /// The last level to decode of a stream of version 3, if that is possible and allowed.
    pub(super) fn plan(&self, header: &Header, goal: Goal) -> Result<u8> {
        let last = match goal {
            Goal::Exact(level) => level,
            Goal::Gaussians(Some(level)) => {
                self.check_drawable(header, level)?;
                level
            }
            Goal::Gaussians(None) => header.top,
        };
        self.check_memory(header, last, self.in_parts)?;
        Ok(last)
    }

    /// Fails with [`Error::LimitExceeded`] if decoding down to `level`, with Gaussians all at once or in parts, takes more
    /// than is allowed.
    pub(super) fn check_memory(&self, header: &Header, level: u8, in_parts: bool) -> Result<()> {
        let bytes = self.memory_for(header, level, in_parts)?;
        let what = "memory to decode this stream";
        self.limits.check_bytes(what, bytes)
    }
}

/// The heads of a model of version 2 that were asked for.
pub(super) fn learned_heads(heads: Option<HeadSet>) -> Result<Heads> {
    let learned = heads.map_or(Some(Heads::default()), HeadSet::learned);
    learned.ok_or_else(|| Error::Unsupported {
        what: "drawing surfels",
        detail: "the stream has version 2, whose model has its own heads".into(),
    })
}
