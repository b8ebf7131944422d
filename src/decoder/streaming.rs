//! Streams of either version as they arrive.

use std::borrow::Cow;

use super::drawing::{Each, LevelVoxels};
use super::stream::{Decoder, Points, learned_heads};
use super::transform::Transform;
use crate::container::feed::{Goal, failed_before};
use crate::container::{Header, MAGIC, version};
use crate::error::{Error, Result};
use crate::gaussians::HeadSet;
use crate::gaussians::learned::{HeadsModel, LevelInput};
use crate::gaussians::{Frame, Gaussians};
use crate::geometry::Voxels;
use crate::latents::{LatentDecoding, nothing_reached};
use crate::motion::{Inter, Previous};

/// A stream of either version that is decoded level by level as its bytes arrive.
///
/// Bytes are pushed in pieces of any size; [`Decoding::advance`] decodes a level as soon as it is whole, and
/// [`Decoding::gaussians`] gives those of the level that was reached. After an error what was reached before stays
/// usable, and nothing more is decoded.
#[derive(Debug)]
pub struct Decoding<'b> {
    decoder: Decoder,
    goal: Goal,
    pub(super) state: State<'b>,
}

/// What is known of a stream.
#[derive(Debug)]
pub(super) enum State<'b> {
    /// Not its version.
    Start(Cow<'b, [u8]>),
    Learned(Box<LatentDecoding<'b>>),
    Transform(Box<Transform<'b>>),
    /// No stream that this decoder decodes.
    Refused,
}

impl<'b> Decoding<'b> {
    pub(super) fn new(decoder: Decoder, goal: Goal, bytes: Cow<'b, [u8]>) -> Self {
        Decoding {
            decoder,
            goal,
            state: State::Start(bytes),
        }
    }

    /// A frame of a sequence: a stream of version 3 that `inter` predicts, if it is not whole.
    pub(crate) fn of_frame(decoder: Decoder, goal: Goal, bytes: Vec<u8>, inter: Option<Inter>) -> Self {
        let frame = Transform::new(decoder.clone(), goal, Cow::Owned(bytes)).into_frame(inter);
        Decoding {
            decoder,
            goal,
            state: State::Transform(Box::new(frame)),
        }
    }

    /// A copy of the level reached, which is not decoded any further. `None` if this is no frame of a sequence.
    pub(crate) fn so_far(&self) -> Option<Self> {
        let State::Transform(decoding) = &self.state else {
            return None;
        };
        Some(Decoding {
            decoder: self.decoder.clone(),
            goal: self.goal,
            state: State::Transform(Box::new(decoding.so_far())),
        })
    }

    /// What the next frame of a sequence is predicted from. `None` if this is no frame, or it was taken before.
    pub(crate) fn take_previous(&mut self) -> Option<Previous> {
        match &mut self.state {
            State::Transform(decoding) => decoding.previous(&self.decoder.log()),
            _ => None,
        }
    }

    /// Takes the next bytes of the stream. No more are kept than the stream's header, once it is there, says are
    /// needed.
    pub fn push(&mut self, bytes: &[u8]) {
        match &mut self.state {
            State::Start(start) => start.to_mut().extend_from_slice(bytes),
            State::Learned(decoding) => decoding.push(bytes),
            State::Transform(decoding) => decoding.push(bytes),
            State::Refused => {}
        }
    }

    /// Decodes the next level, if all its bytes have come and it is not beyond the one that decoding is to end with:
    /// `None` otherwise.
    ///
    /// # Errors
    /// - [`Error::ChecksumMismatch`], [`Error::Malformed`]: the bytes are damaged, or no stream;
    /// - [`Error::Unsupported`]: a later version or a critical feature of one, or a level to end with that has no
    ///   Gaussians;
    /// - [`Error::ModelMissing`], [`Error::ModelMismatch`]: a stream of version 2 without its model;
    /// - [`Error::DeterminismMismatch`], if all checksums hold but what was decoded is not what was coded;
    /// - [`Error::LimitExceeded`], before anything is reserved; [`Error::Cancelled`];
    /// - [`Error::Usage`] if the stream has no level to end with, or decoding has failed before.
    pub fn advance(&mut self) -> Result<Option<u8>> {
        self.step(false)
    }

    /// Decodes what is left, knowing that no more bytes will come.
    ///
    /// # Errors
    /// Those of [`Decoding::advance`], and [`Error::Truncated`] if the level to end with is not whole. Where no such
    /// level was named, the stream must be whole, or end just where one of its levels ends.
    pub fn finish(&mut self) -> Result<()> {
        while self.step(true)?.is_some() {}
        Ok(())
    }

    /// The header, once [`Decoding::advance`] found it whole.
    pub fn header(&self) -> Option<&Header> {
        match &self.state {
            State::Start(_) | State::Refused => None,
            State::Learned(decoding) => decoding.header(),
            State::Transform(decoding) => decoding.header(),
        }
    }

    /// The cube that Gaussians refer to, once [`Decoding::header`] is there.
    pub fn frame(&self) -> Option<Frame> {
        self.header().map(|header| Frame {
            bits: header.bits,
            placement: header.placement,
        })
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
    pub fn set_heads_model(&mut self, heads: HeadsModel) {
        if let State::Transform(decoding) = &mut self.state {
            decoding.decoder.heads_model = Some(heads.clone());
        }
        self.decoder.heads_model = Some(heads);
    }

    /// Whether the level reached has Gaussians: [`Decoding::gaussians`] will not fail with [`Error::Unsupported`].
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

    /// The voxels of the level reached, once there is one.
    pub fn voxels(&self) -> Option<&Voxels> {
        let octree = match &self.state {
            State::Start(_) | State::Refused => return None,
            State::Learned(decoding) => &decoding.exact()?.octree,
            State::Transform(decoding) => &decoding.reached()?.octree,
        };
        Some(octree.level(self.level()?))
    }

    /// The voxels of the level reached with their colours, if the stream has version 3.
    pub fn points(&self) -> Option<Points<'_>> {
        let State::Transform(decoding) = &self.state else {
            return None;
        };
        let reached = decoding.reached()?;
        Some(Points {
            voxels: reached.octree.level(reached.level),
            colours: reached.colours(self.decoder.isa()),
            frame: self.frame()?,
        })
    }

    /// The voxels of the level reached and how they are to be drawn, if the stream has version 3.
    pub(crate) fn level_voxels(&self) -> Option<LevelVoxels> {
        match &self.state {
            State::Transform(decoding) => Some(LevelVoxels::of(&self.decoder, decoding.reached()?)),
            _ => None,
        }
    }

    /// Calls `with` with what learned heads read of the level reached, and gives its result; `None` if they draw
    /// nothing of it, or the stream has version 2.
    #[doc(hidden)]
    pub fn with_heads_input<T>(&self, with: impl FnOnce(LevelInput<'_>) -> T) -> Option<T> {
        let State::Transform(decoding) = &self.state else {
            return None;
        };
        decoding.reached()?.with_heads_input(self.decoder.isa(), with)
    }

    /// The Gaussians of the level reached.
    ///
    /// # Errors
    /// [`Error::Unsupported`] if it has none, naming the levels that have; [`Error::LimitExceeded`];
    /// [`Error::Cancelled`]; [`Error::Usage`] if no level has been reached.
    pub fn gaussians(&self) -> Result<Gaussians> {
        let log = &self.decoder.log();
        match &self.state {
            State::Start(_) | State::Refused => Err(nothing_reached()),
            State::Learned(decoding) => decoding.gaussians(log),
            State::Transform(decoding) => decoding.gaussians(log),
        }
    }

    /// Calls `each` with the Gaussians of the level reached, part by part, and keeps none: the parts one after the other
    /// are what [`Decoding::gaussians`] gives. A part has 131,072 at most, and may have none; there is one at least. The
    /// Gaussians of a stream of version 2 come in one part.
    ///
    /// # Errors
    /// Those of [`Decoding::gaussians`], and the first of `each`, after which it is not called again.
    pub fn gaussians_in_parts(&self, mut each: impl FnMut(&Gaussians) -> Result<()>) -> Result<()> {
        let (log, each): (_, &mut Each<'_>) = (&self.decoder.log(), &mut each);
        match &self.state {
            State::Start(_) | State::Refused => Err(nothing_reached()),
            State::Learned(decoding) => each(&decoding.gaussians(log)?),
            State::Transform(decoding) => decoding.gaussians_in_parts(log, each),
        }
    }

    /// Whether [`Decoding::gaussians_in_parts`] takes less memory than [`Decoding::gaussians`]: the stream has version 3.
    pub fn has_parts(&self) -> bool {
        matches!(self.state, State::Transform(_))
    }

    /// How many Gaussians the level reached has, if that is known before they are made: heads with eight of a voxel
    /// leave faint ones out.
    ///
    /// # Errors
    /// Those of [`Decoding::gaussians`] but for limits.
    pub fn gaussian_count(&self) -> Result<Option<usize>> {
        match &self.state {
            State::Start(_) | State::Refused => Err(nothing_reached()),
            State::Learned(_) => Ok(None),
            State::Transform(decoding) => decoding.gaussian_count(),
        }
    }

    fn step(&mut self, ended: bool) -> Result<Option<u8>> {
        let log = &self.decoder.log();
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

    /// Finds out the version, if enough has come. What is no stream, or one of an unknown version, is for the header's
    /// parser to refuse.
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
            let header = match Header::parse(bytes, self.decoder.limits()) {
                Err(Error::Truncated { .. }) if !ended => return Ok(()),
                header => header?,
            };
            let decoder = self.decoder.learned(&header)?;
            let bytes = std::mem::take(bytes);
            let decoding = LatentDecoding::new(decoder, self.goal, bytes);
            self.state = State::Learned(Box::new(decoding));
            return Ok(());
        }
        let bytes = std::mem::take(bytes);
        let decoding = Transform::new(self.decoder.clone(), self.goal, bytes);
        self.state = State::Transform(Box::new(decoding));
        Ok(())
    }
}
