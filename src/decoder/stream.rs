//! Streams of either version to Gaussians.

use std::borrow::Cow;
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use b2p_kernels::Isa;

use super::decoding::nothing_reached;
use super::feed::{Goal, failed_before};
use super::transform::{Reached, Transform};
use super::{Decoder, Decoding};
#[cfg(feature = "render")]
use crate::bitstream::Stream;
use crate::bitstream::{Format, Header, MAGIC, version};
use crate::cancel::Cancel;
#[cfg(feature = "ply")]
use crate::cloud::{ColouredVoxels, PointCloud};
use crate::error::{Error, Result};
use crate::gaussians::learned::{HeadsModel, LevelInput, Set};
use crate::gaussians::surfels::{PerVoxel, surfels};
use crate::gaussians::{Frame, Gaussians};
use crate::geometry::Voxels;
use crate::limits::Limits;
use crate::log::Log;
use crate::network::{Heads, Model, Precision};
#[cfg(feature = "ply")]
use crate::placement::Placement;
#[cfg(feature = "render")]
use crate::projection::Camera;

/// What makes Gaussians of a level.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum HeadSet {
    /// The best heads of a model.
    Best,
    /// Its quick ones: less accurate in a fraction of the time.
    Quick,
    /// Opaque discs in closed form; no model file is needed. Of streams of version 3 alone.
    #[default]
    Surfels,
}

impl HeadSet {
    /// All, the most accurate first.
    pub const ALL: [HeadSet; 3] = [HeadSet::Best, HeadSet::Quick, HeadSet::Surfels];

    fn name(self) -> &'static str {
        match self {
            HeadSet::Best => "best",
            HeadSet::Quick => "quick",
            HeadSet::Surfels => "surfels",
        }
    }

    /// The heads of a model; surfels have none.
    pub fn learned(self) -> Option<Heads> {
        match self {
            HeadSet::Best => Some(Heads::Best),
            HeadSet::Quick => Some(Heads::Quick),
            HeadSet::Surfels => None,
        }
    }
}

impl From<Heads> for HeadSet {
    fn from(heads: Heads) -> Self {
        match heads {
            Heads::Best => HeadSet::Best,
            Heads::Quick => HeadSet::Quick,
        }
    }
}

impl fmt::Display for HeadSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for HeadSet {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        let all = HeadSet::ALL;
        all.into_iter().find(|h| h.name() == name).ok_or_else(|| {
            let names = all.map(HeadSet::name).join(", ");
            Error::Usage(format!("no heads `{name}`, but {names}"))
        })
    }
}

/// Decodes streams of either version. Version 3 needs no model; version 2 needs the one that the stream was coded with.
#[derive(Debug, Clone, Default)]
pub struct StreamDecoder {
    model: Option<Arc<Model>>,
    /// Asked for; otherwise the best there are.
    heads: Option<HeadSet>,
    heads_model: Option<Arc<HeadsModel>>,
    /// Gaussians a voxel, if asked for.
    per_voxel: Option<usize>,
    precision: Precision,
    isa: Option<Isa>,
    limits: Limits,
    cancel: Cancel,
}

/// The voxels of a level with their colours.
#[derive(Debug, Clone, Copy, PartialEq)]
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
        .to_cloud()
    }
}

impl StreamDecoder {
    /// A decoder with default limits and without a model, which makes Gaussians with the best heads there are.
    pub fn new() -> Self {
        Self::default()
    }

    /// The same decoder, which decodes streams of version 2 that this model coded.
    pub fn with_model(mut self, model: Arc<Model>) -> Self {
        self.model = Some(model);
        self
    }

    /// The same decoder with these heads. Only Gaussians differ by them. A stream that cannot be drawn with them is refused with
    /// [`Error::Unsupported`].
    pub fn with_heads(mut self, heads: HeadSet) -> Self {
        self.heads = Some(heads);
        self
    }

    /// The same decoder, which draws streams of version 3 with the heads of this model.
    pub fn with_heads_model(mut self, heads: Arc<HeadsModel>) -> Self {
        self.heads_model = Some(heads);
        self
    }

    /// The same decoder, whose heads of streams of version 3 make so many Gaussians of a voxel: learned heads 1 or 8, by default one where
    /// voxels are at most twice as wide as those of the cloud, else eight; surfels 1, the default, or 4.
    pub fn with_per_voxel(mut self, count: usize) -> Self {
        self.per_voxel = Some(count);
        self
    }

    /// The same decoder, whose learned heads of streams of version 3 calculate in this precision. Models of version 2 have their own.
    pub fn with_precision(mut self, precision: Precision) -> Self {
        self.precision = precision;
        self
    }

    /// The same decoder, which uses no better instructions than these; results are the same.
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

    /// Begins to decode a stream whose bytes are still to come, down to `level`: by default the finest that can be drawn.
    pub fn start(&self, level: Option<u8>) -> StreamDecoding<'static> {
        StreamDecoding::new(self.clone(), Goal::Gaussians(level), Cow::Owned(Vec::new()))
    }

    /// Decodes a stream to the Gaussians of `level`: by default the finest that can be drawn.
    ///
    /// A stream cut exactly after a level is a coarser stream. From one that is cut or damaged elsewhere, a level before the damage
    /// is decoded only when asked for.
    ///
    /// # Errors
    /// Those of [`StreamDecoding::finish`] and [`StreamDecoding::gaussians`].
    pub fn decode(&self, bytes: &[u8], level: Option<u8>, log: &mut Log) -> Result<Gaussians> {
        self.whole(bytes, level, log)?.gaussians(log)
    }

    /// The same, before Gaussians are made: [`StreamDecoding::points`] are there then, if the stream has version 3.
    ///
    /// # Errors
    /// Those of [`StreamDecoding::finish`].
    pub fn whole<'b>(
        &self,
        bytes: &'b [u8],
        level: Option<u8>,
        log: &mut Log,
    ) -> Result<StreamDecoding<'b>> {
        let goal = Goal::Gaussians(level);
        let mut decoding = StreamDecoding::new(self.clone(), goal, Cow::Borrowed(bytes));
        decoding.finish(log)?;
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

    /// The coarsest level with Gaussians whose voxels are nowhere wider than a pixel in the pictures that `cameras` take: what is finer
    /// is hardly seen. `None` if no level before the finest whole one does, so that the stream as it is serves best.
    ///
    /// # Errors
    /// Those of [`Stream::parse`], [`Error::ModelMissing`], and the damage of a stream that is cut or damaged elsewhere than right after a
    /// level.
    #[cfg(feature = "render")]
    pub fn level_for(&self, bytes: &[u8], cameras: &[Camera]) -> Result<Option<u8>> {
        let stream = Stream::parse(bytes, &self.limits)?.intact()?;
        let coarsest = coarsest_seen(&self.levels(bytes)?, cameras);
        Ok(coarsest.filter(|level| Some(*level) < stream.deepest()))
    }

    /// Bytes of memory that decoding a stream with this header down to `level` takes at most, its Gaussians included, beyond
    /// [`Limits::OVERHEAD`] and models.
    ///
    /// # Errors
    /// [`Error::Usage`] if the stream has no such level, [`Error::ModelMissing`].
    pub fn memory(&self, header: &Header, level: u8) -> Result<u64> {
        match header.format {
            Format::Learned { .. } => self.learned(header)?.memory(header, level),
            Format::Transform { .. } => {
                let drawing = self.drawing_bytes(header, level)?;
                Ok(drawing + super::memory::transform(header, level)?)
            }
        }
    }

    /// The model that decodes streams of version 2.
    pub fn model(&self) -> Option<&Model> {
        self.model.as_deref()
    }

    /// The heads that draw a stream with this header, if it can be drawn.
    pub fn heads_for(&self, header: &Header) -> HeadSet {
        match header.format {
            Format::Learned { .. } => self.heads.unwrap_or(HeadSet::Best),
            Format::Transform { .. } => self.heads(),
        }
    }

    /// What decodes a stream of version 2.
    fn learned(&self, header: &Header) -> Result<Decoder<Arc<Model>>> {
        let Some(model) = &self.model else {
            let expected = header.model().unwrap_or_default();
            return Err(Error::ModelMissing { expected });
        };
        let decoder = Decoder::new(Arc::clone(model))
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
    fn network(&self, header: &Header, level: u8) -> Result<Option<(&HeadsModel, Set)>> {
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

    fn surfels_per_voxel(&self) -> Result<PerVoxel> {
        match self.per_voxel {
            None | Some(1) => Ok(PerVoxel::One),
            Some(4) => Ok(PerVoxel::Four),
            Some(count) => Err(Error::Unsupported {
                what: "drawing with so many surfels a voxel",
                detail: format!("{count} were asked for, 1 or 4 would do"),
            }),
        }
    }

    /// Bytes of memory that making Gaussians of a level takes at most.
    fn drawing_bytes(&self, header: &Header, level: u8) -> Result<u64> {
        let voxels = header.voxels(level)?.into();
        let above = match level > header.base {
            true => header.voxels(level - 1)?.into(),
            false => voxels,
        };
        Ok(match self.network(header, level)? {
            Some((model, set)) => model.bytes(set, voxels, above),
            None => super::memory::surfels(voxels, self.surfels_per_voxel()?.count() as u64),
        })
    }

    pub(super) fn isa(&self) -> Isa {
        self.isa.unwrap_or_else(Isa::detect)
    }

    pub(super) fn limits(&self) -> &Limits {
        &self.limits
    }

    pub(super) fn cancel(&self) -> &Cancel {
        &self.cancel
    }

    /// The levels of a stream of version 3 that can be drawn: learned heads read the level above.
    fn drawable(&self, header: &Header) -> impl Iterator<Item = u8> + use<> {
        let first = u8::from(self.heads().learned().is_some());
        header.base.max(first)..=header.top
    }

    /// Fails with [`Error::Unsupported`] unless `level` of a stream of version 3 can be drawn.
    pub(super) fn check_drawable(&self, header: &Header, level: u8) -> Result<()> {
        header.voxels(level)?;
        if self.network(header, level)?.is_none() {
            self.surfels_per_voxel()?;
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
        self.check_memory(header, last)?;
        Ok(last)
    }

    /// Fails with [`Error::LimitExceeded`] if decoding down to `level` takes more than is allowed.
    pub(super) fn check_memory(&self, header: &Header, level: u8) -> Result<()> {
        let bytes = self.memory(header, level)?;
        let what = "memory to decode this stream";
        self.limits.check_bytes(what, bytes)
    }

    /// The Gaussians of a level of a stream of version 3.
    pub(super) fn generate(&self, header: &Header, reached: &Reached) -> Result<Gaussians> {
        let frame = Frame {
            bits: header.bits,
            placement: header.placement,
        };
        let (octree, level) = (&reached.octree, reached.level);
        let (map, colours) = (&reached.map, &reached.colours);
        let network = self.network(header, level)?;
        let (Some((model, set)), Some(above)) = (network, &reached.above_map) else {
            let (voxels, per_voxel) = (octree.level(level), self.surfels_per_voxel()?);
            return Ok(surfels(self.isa(), voxels, map, colours, per_voxel, frame));
        };
        let input = LevelInput {
            octree,
            level,
            map,
            above,
            colours,
            colours_above: &reached.colours_above,
            luma_step: reached.coloured.steps().luma_step(),
        };
        model.generate(self.isa(), self.precision, set, input, frame)
    }
}

/// The heads of a model of version 2 that were asked for.
fn learned_heads(heads: Option<HeadSet>) -> Result<Heads> {
    let learned = heads.map_or(Some(Heads::default()), HeadSet::learned);
    learned.ok_or_else(|| Error::Unsupported {
        what: "drawing surfels",
        detail: "the stream has version 2, whose model has its own heads".into(),
    })
}

/// The coarsest of `levels` whose voxels are nowhere wider than a pixel in the pictures that `cameras` take.
#[cfg(feature = "render")]
pub(super) fn coarsest_seen(levels: &[u8], cameras: &[Camera]) -> Option<u8> {
    let pixels = cameras.iter().map(Camera::pixels_per_unit);
    let pixels = pixels.fold(0.0, f64::max);
    let seen = |level: &u8| 2.0 / f64::from(1u32 << level) * pixels <= 1.0;
    levels.iter().copied().find(seen)
}

/// A stream of either version that is decoded level by level as its bytes arrive.
///
/// Bytes are pushed in pieces of any size; [`StreamDecoding::advance`] decodes a level as soon as it is whole, and
/// [`StreamDecoding::gaussians`] gives those of the level that was reached. After an error what was reached before stays usable, and nothing
/// more is decoded.
#[derive(Debug)]
pub struct StreamDecoding<'b> {
    decoder: StreamDecoder,
    goal: Goal,
    state: State<'b>,
}

/// What is known of a stream.
#[derive(Debug)]
enum State<'b> {
    /// Not its version.
    Start(Cow<'b, [u8]>),
    Learned(Box<Decoding<'b, Arc<Model>>>),
    Transform(Box<Transform<'b>>),
    /// No stream that this decoder decodes.
    Refused,
}

impl<'b> StreamDecoding<'b> {
    fn new(decoder: StreamDecoder, goal: Goal, bytes: Cow<'b, [u8]>) -> Self {
        StreamDecoding {
            decoder,
            goal,
            state: State::Start(bytes),
        }
    }

    /// Takes the next bytes of the stream. No more are kept than the stream's header, once it is there, says are needed.
    pub fn push(&mut self, bytes: &[u8]) {
        match &mut self.state {
            State::Start(start) => start.to_mut().extend_from_slice(bytes),
            State::Learned(decoding) => decoding.push(bytes),
            State::Transform(decoding) => decoding.push(bytes),
            State::Refused => {}
        }
    }

    /// Decodes the next level, if all its bytes have come and it is not beyond the one that decoding is to end with: `None` otherwise.
    ///
    /// # Errors
    /// - [`Error::ChecksumMismatch`], [`Error::Malformed`]: the bytes are damaged, or no stream;
    /// - [`Error::Unsupported`]: a later version or a critical feature of one, or a level to end with that has no Gaussians;
    /// - [`Error::ModelMissing`], [`Error::ModelMismatch`]: a stream of version 2 without its model;
    /// - [`Error::DeterminismMismatch`], if all checksums hold but what was decoded is not what was coded;
    /// - [`Error::LimitExceeded`], before anything is reserved; [`Error::Cancelled`];
    /// - [`Error::Usage`] if the stream has no level to end with, or decoding has failed before.
    pub fn advance(&mut self, log: &mut Log) -> Result<Option<u8>> {
        self.step(false, log)
    }

    /// Decodes what is left, knowing that no more bytes will come.
    ///
    /// # Errors
    /// Those of [`StreamDecoding::advance`], and [`Error::Truncated`] if the level to end with is not whole. Where no such level was named,
    /// the stream must be whole, or end just where one of its levels ends.
    pub fn finish(&mut self, log: &mut Log) -> Result<()> {
        while self.step(true, log)?.is_some() {}
        Ok(())
    }

    /// The header, once [`StreamDecoding::advance`] found it whole.
    pub fn header(&self) -> Option<&Header> {
        match &self.state {
            State::Start(_) | State::Refused => None,
            State::Learned(decoding) => decoding.header(),
            State::Transform(decoding) => decoding.header(),
        }
    }

    /// The deepest level decoded so far.
    pub fn level(&self) -> Option<u8> {
        match &self.state {
            State::Start(_) | State::Refused => None,
            State::Learned(decoding) => decoding.level(),
            State::Transform(decoding) => decoding.level(),
        }
    }

    /// Makes Gaussians with other heads from now on; what has been decoded stays.
    ///
    /// # Errors
    /// [`Error::Unsupported`] if there are no such heads.
    pub fn set_heads(&mut self, heads: HeadSet) -> Result<()> {
        match (&mut self.state, &self.decoder.model, heads.learned()) {
            (State::Learned(decoding), ..) => decoding.set_heads(learned_heads(Some(heads))?)?,
            // Known before the stream is.
            (State::Start(_), Some(model), Some(heads)) if self.decoder.heads_model.is_none() => {
                model.check_heads(heads)?;
            }
            _ => {}
        }
        self.decoder.heads = Some(heads);
        if let State::Transform(decoding) = &mut self.state {
            decoding.decoder.heads = Some(heads);
        }
        Ok(())
    }

    /// Draws streams of version 3 with the heads of this model from now on; what has been decoded stays.
    pub fn set_heads_model(&mut self, heads: Arc<HeadsModel>) {
        if let State::Transform(decoding) = &mut self.state {
            decoding.decoder.heads_model = Some(Arc::clone(&heads));
        }
        self.decoder.heads_model = Some(heads);
    }

    /// Whether the level reached has Gaussians: [`StreamDecoding::gaussians`] will not fail with [`Error::Unsupported`].
    pub fn is_drawable(&self) -> bool {
        match &self.state {
            State::Start(_) | State::Refused => false,
            State::Learned(decoding) => decoding.is_drawable(),
            State::Transform(decoding) => match (decoding.header(), decoding.level()) {
                (Some(header), Some(level)) => self.decoder.drawable(header).any(|l| l == level),
                _ => false,
            },
        }
    }

    /// The voxels of the level reached with their colours, if the stream has version 3.
    pub fn points(&self) -> Option<Points<'_>> {
        let State::Transform(decoding) = &self.state else {
            return None;
        };
        let (reached, header) = (decoding.reached()?, decoding.header()?);
        Some(Points {
            voxels: reached.octree.level(reached.level),
            colours: &reached.colours,
            frame: Frame {
                bits: header.bits,
                placement: header.placement,
            },
        })
    }

    /// The Gaussians of the level reached.
    ///
    /// # Errors
    /// [`Error::Unsupported`] if it has none, naming the levels that have; [`Error::LimitExceeded`]; [`Error::Cancelled`];
    /// [`Error::Usage`] if no level has been reached.
    pub fn gaussians(&self, log: &mut Log) -> Result<Gaussians> {
        match &self.state {
            State::Start(_) | State::Refused => Err(nothing_reached()),
            State::Learned(decoding) => decoding.gaussians(log),
            State::Transform(decoding) => decoding.gaussians(log),
        }
    }

    fn step(&mut self, ended: bool, log: &mut Log) -> Result<Option<u8>> {
        if let Err(error) = self.open(ended) {
            self.state = State::Refused;
            return Err(error);
        }
        match &mut self.state {
            State::Start(_) => Ok(None),
            State::Refused => Err(failed_before()),
            State::Learned(decoding) => decoding.step(ended, log),
            State::Transform(decoding) => decoding.step(ended, log),
        }
    }

    /// Finds out the version, if enough has come. What is no stream, or one of an unknown version, is for the header's parser to refuse.
    fn open(&mut self, ended: bool) -> Result<()> {
        let State::Start(bytes) = &mut self.state else {
            return Ok(());
        };
        let known = bytes.len() >= MAGIC.len() && !bytes.starts_with(&MAGIC);
        if !ended && !known && bytes.len() < MAGIC.len() + 2 {
            return Ok(());
        }
        if version(bytes) == Some(2) {
            // Of a missing model the header tells which it is.
            let header = match Header::parse(bytes, &self.decoder.limits) {
                Err(Error::Truncated { .. }) if !ended => return Ok(()),
                header => header?,
            };
            let decoder = self.decoder.learned(&header)?;
            let bytes = std::mem::take(bytes);
            let decoding = Decoding::new(decoder, self.goal, bytes);
            self.state = State::Learned(Box::new(decoding));
            return Ok(());
        }
        let bytes = std::mem::take(bytes);
        let decoding = Transform::new(self.decoder.clone(), self.goal, bytes);
        self.state = State::Transform(Box::new(decoding));
        Ok(())
    }
}
