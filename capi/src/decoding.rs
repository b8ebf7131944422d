//! Streams in pieces, and the Gaussians that come of them.

use std::ffi::c_char;

use b2p::gaussians::HeadSet;
use b2p::{Frame, SceneReader, Voxels};

use crate::boundary::{Fault, Status, borrowed, changed, give, guard, slice, take};
use crate::model::{HeadsModel, Limits, Model};

/// A switch that stops decodings from another thread.
#[derive(Default)]
pub struct Cancel(b2p::Cancel);

/// Bytes that tell a scene from a stream.
const START: usize = 16;

/// Voxels, their colours, and the cube that they lie in.
pub(crate) type DecodedPoints = (Voxels, Vec<[u8; 3]>, Frame);

/// A stream or a scene that is decoded as its bytes arrive.
pub struct Decoding {
    stream: b2p::Decoding<'static>,
    /// Once the first bytes say that a scene comes.
    scene: Option<b2p::SceneDecoding>,
    /// The first bytes.
    start: Vec<u8>,
    decoder: b2p::Decoder,
}

impl Decoding {
    fn new(decoder: b2p::Decoder) -> Self {
        Decoding {
            stream: decoder.start(),
            scene: None,
            start: Vec::new(),
            decoder,
        }
    }

    /// Takes the next bytes. The first ones tell what comes.
    fn push(&mut self, bytes: &[u8]) -> b2p::Result<()> {
        if let Some(scene) = &mut self.scene {
            return scene.push(bytes);
        }
        let (own, rest) = bytes.split_at(bytes.len().min(START - self.start.len()));
        self.start.extend(own);
        if !own.is_empty() && SceneReader::is_scene(&self.start) {
            let scene = self.scene.insert(b2p::SceneDecoding::new(self.decoder.clone()));
            scene.push(&self.start)?;
            return scene.push(rest);
        }
        self.stream.push(bytes);
        Ok(())
    }

    fn set_heads(&mut self, heads: HeadSet) -> b2p::Result<()> {
        self.stream.set_heads(heads)?;
        self.decoder = self.decoder.clone().with_heads(heads);
        if let Some(scene) = &mut self.scene {
            scene.set_heads(heads);
        }
        Ok(())
    }

    fn set_heads_model(&mut self, heads: b2p::HeadsModel) {
        self.stream.set_heads_model(heads.clone());
        self.decoder = self.decoder.clone().with_heads_model(heads.clone());
        if let Some(scene) = &mut self.scene {
            scene.set_heads_model(heads);
        }
    }

    fn advance(&mut self) -> b2p::Result<Option<u8>> {
        match &mut self.scene {
            Some(scene) => scene.advance(),
            None => self.stream.advance(),
        }
    }

    fn finish(&mut self) -> b2p::Result<()> {
        match &mut self.scene {
            Some(scene) => scene.finish(),
            None => self.stream.finish(),
        }
    }

    fn level(&self) -> Option<u8> {
        match &self.scene {
            Some(scene) => scene.level(),
            None => self.stream.level(),
        }
    }

    fn gaussians(&self) -> b2p::Result<b2p::Gaussians> {
        match &self.scene {
            Some(scene) => scene.gaussians(),
            None => self.stream.gaussians(),
        }
    }

    pub(crate) fn gaussians_in_parts(
        &self,
        mut each: impl FnMut(&b2p::Gaussians) -> b2p::Result<()>,
    ) -> b2p::Result<()> {
        match &self.scene {
            Some(scene) => each(&scene.gaussians()?),
            None => self.stream.gaussians_in_parts(each),
        }
    }

    /// Counts Gaussians in parts from now on, which is before the first bytes.
    pub(crate) fn use_parts(&mut self) -> Result<(), Fault> {
        if !self.start.is_empty() {
            return Err(Fault::usage("bytes have come already"));
        }
        self.decoder = self.decoder.clone().with_gaussians_in_parts();
        self.stream = self.decoder.start();
        Ok(())
    }

    /// The voxels of the level reached with their colours; `None` of streams that have no colours of voxels.
    pub(crate) fn points(&self) -> b2p::Result<Option<DecodedPoints>> {
        if let Some(scene) = &self.scene {
            let (voxels, colours) = scene.voxels()?;
            return Ok(Some((voxels, colours, scene.frame()?)));
        }
        let points = self.stream.points();
        Ok(points.map(|points| (points.voxels.clone(), points.colours.to_vec(), points.frame)))
    }

    /// Whether a level has been reached.
    pub(crate) fn has_level(&self) -> bool {
        self.level().is_some()
    }
}

/// Gaussians of a level.
pub struct Gaussians(pub(crate) b2p::gaussians::Gaussians);

/// Where the numbers of Gaussians lie, until these are freed. Coordinates are those of the cube frame, in which the voxel cube reaches
/// from -1 to 1; `origin` and `unit` lead to the world's: world = origin + (position + 1) * unit.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct Arrays {
    /// How many Gaussians.
    pub count: usize,
    /// Centres x, y, z: 3 * count numbers.
    pub position: *const f32,
    /// Standard deviations along the Gaussian's own axes: 3 * count numbers.
    pub scale: *const f32,
    /// Unit quaternions w, x, y, z: 4 * count numbers.
    pub rotation: *const f32,
    /// Opacities in [0, 1]: count numbers.
    pub opacity: *const f32,
    /// Red, green, blue in [0, 1], display-referred: 3 * count numbers.
    pub colour: *const f32,
    /// The world coordinates of the cube's lowest corner.
    pub origin: [f64; 3],
    /// One unit of the cube frame in the world's.
    pub unit: f64,
}

impl Arrays {
    /// Where those of `gaussians` lie.
    pub(crate) fn of(gaussians: &b2p::Gaussians) -> Arrays {
        Arrays {
            count: gaussians.len(),
            position: gaussians.position.as_ptr().cast(),
            scale: gaussians.scale.as_ptr().cast(),
            rotation: gaussians.rotation.as_ptr().cast(),
            opacity: gaussians.opacity.as_ptr(),
            colour: gaussians.colour.as_ptr().cast(),
            origin: gaussians.frame.placement.origin,
            unit: gaussians.frame.unit(),
        }
    }
}

/// A new switch.
///
/// # Safety
/// `cancel` is writable; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_cancel_new(cancel: *mut *mut Cancel, message: *mut c_char, size: usize) -> Status {
    // SAFETY: the caller vouches for `cancel`.
    let run = || unsafe { give(cancel, "cancel", Cancel::default()) };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Throws the switch, from any thread: what decodes with it ends with CANCELLED before it begins its next slice or step.
///
/// # Safety
/// `cancel` is NULL or a switch.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_cancel_throw(cancel: *const Cancel) {
    // SAFETY: the caller vouches for `cancel`.
    if let Ok(cancel) = unsafe { borrowed(cancel, "cancel") } {
        cancel.0.cancel();
    }
}

/// Frees a switch. Decodings that were started with it go on.
///
/// # Safety
/// `cancel` is NULL or came from this library, and is not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_cancel_free(cancel: *mut Cancel) {
    // SAFETY: the caller vouches for `cancel`.
    unsafe { take(cancel) }
}

/// What makes Gaussians of a level.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Heads {
    /// The best heads of a model.
    Best = 0,
    /// Its quick ones: less accurate in a fraction of the time. Only some models have them.
    Quick = 1,
    /// Opaque discs, which no model is needed for. Streams of version 2 have none.
    Surfels = 2,
}

/// What makes Gaussians, as C and the library name it.
pub(crate) const HEADS: [(Heads, HeadSet); 3] = [
    (Heads::Best, HeadSet::Best),
    (Heads::Quick, HeadSet::Quick),
    (Heads::Surfels, HeadSet::Surfels),
];

/// What makes Gaussians by its number, for C lets an enumeration hold any.
pub(crate) fn heads_of(number: i32) -> Result<HeadSet, Fault> {
    let known = HEADS.iter().find(|(heads, _)| *heads as i32 == number);
    let unknown = || Fault::usage("heads are none of b2p_heads");
    known.map(|(_, set)| *set).ok_or_else(unknown)
}

/// Begins to decode a stream of either version, or a scene of blocks, down to `level`, or, if that is negative, to the finest level that has Gaussians. `limits`
/// and `cancel` may be NULL, and so may `model`, which streams of version 3 do not need: one of version 2 then fails with MODEL. Fails with
/// USAGE.
///
/// # Safety
/// `model` is NULL or a model; `limits` and `cancel` are NULL or what they say; `decoding` is writable; `message` is NULL or leads to `size`
/// bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_decoding_start(
    model: *const Model,
    limits: *const Limits,
    cancel: *const Cancel,
    level: i32,
    decoding: *mut *mut Decoding,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `model`, `limits` and `cancel`.
        let (model, limits, cancel) = unsafe { (model.as_ref(), limits.as_ref(), cancel.as_ref()) };
        let mut decoder = b2p::Decoder::new();
        if let Some(model) = model {
            decoder = decoder.with_model(model.0.clone());
        }
        if let Some(limits) = limits {
            decoder = decoder.with_limits((*limits).into());
        }
        if let Some(cancel) = cancel {
            decoder = decoder.with_cancel(cancel.0.clone());
        }
        let level = match level {
            ..0 => None,
            _ => Some(u8::try_from(level).map_err(|_| Fault::usage("level is above 255"))?),
        };
        // SAFETY: the caller vouches for `decoding`.
        unsafe { give(decoding, "decoding", Decoding::new(decoder.with_level(level))) }
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Makes Gaussians with a model's quick heads from now on, or with its best. What has been decoded stays. Fails with UNSUPPORTED, USAGE.
///
/// # Safety
/// `decoding` is a decoding; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_decoding_use_quick_heads(
    decoding: *mut Decoding,
    quick: bool,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `decoding`.
        let decoding = unsafe { changed(decoding, "decoding") }?;
        let heads = if quick { HeadSet::Quick } else { HeadSet::Best };
        Ok(decoding.set_heads(heads)?)
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Makes Gaussians with these heads from now on: one of b2p_heads. At first they are the best there are. What has been decoded stays. Fails with
/// UNSUPPORTED, USAGE.
///
/// # Safety
/// `decoding` is a decoding; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_decoding_use_heads(
    decoding: *mut Decoding,
    heads: i32,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `decoding`.
        let decoding = unsafe { changed(decoding, "decoding") }?;
        let heads = heads_of(heads)?;
        Ok(decoding.set_heads(heads)?)
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Draws streams of version 3 with these learned heads from now on. What has been decoded stays. Fails with USAGE.
///
/// # Safety
/// `decoding` is a decoding; `heads` are learned heads; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_decoding_use_heads_model(
    decoding: *mut Decoding,
    heads: *const HeadsModel,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `decoding` and `heads`.
        let (decoding, heads) = unsafe { (changed(decoding, "decoding")?, borrowed(heads, "heads")?) };
        decoding.set_heads_model(heads.0.clone());
        Ok(())
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Takes the next bytes of the stream, which are not needed afterwards. Decodes nothing yet. Bytes of a scene of blocks are kept until
/// all of it is there; its levels are decoded when Gaussians or points are asked for. Fails with USAGE, and with LIMIT for a scene.
///
/// # Safety
/// `decoding` is a decoding; `bytes` leads to `length` bytes; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_decoding_push(
    decoding: *mut Decoding,
    bytes: *const u8,
    length: usize,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `decoding` and `bytes`.
        let (decoding, bytes) = unsafe { (changed(decoding, "decoding")?, slice(bytes, length, "bytes")?) };
        Ok(decoding.push(bytes)?)
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Decodes the next level if all of it has come: `level` is then its number, else -1. To be called until it is -1. After a failure
/// the level reached before can still be had. Fails with everything but IO, TRUNCATED and INTERNAL.
///
/// # Safety
/// `decoding` is a decoding; `level` is writable; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_decoding_advance(
    decoding: *mut Decoding,
    level: *mut i32,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `decoding` and `level`.
        let (decoding, level) = unsafe { (changed(decoding, "decoding")?, changed(level, "level")?) };
        *level = -1;
        *level = decoding.advance()?.map_or(-1, i32::from);
        Ok(())
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Decodes what is left, knowing that no more bytes will come. Fails as b2p_decoding_advance does, and with TRUNCATED if the level
/// to end with is not whole, or, where none was named, if the stream ends elsewhere than after one of its levels.
///
/// # Safety
/// `decoding` is a decoding; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_decoding_finish(decoding: *mut Decoding, message: *mut c_char, size: usize) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `decoding`.
        let decoding = unsafe { changed(decoding, "decoding") }?;
        Ok(decoding.finish()?)
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// The deepest level decoded so far, or -1.
///
/// # Safety
/// `decoding` is NULL or a decoding.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_decoding_level(decoding: *const Decoding) -> i32 {
    // SAFETY: the caller vouches for `decoding`.
    let decoding = unsafe { decoding.as_ref() };
    decoding.and_then(|decoding| decoding.level()).map_or(-1, i32::from)
}

/// Frees a decoding. Gaussians that were made of it stay.
///
/// # Safety
/// `decoding` is NULL or came from this library, and is not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_decoding_free(decoding: *mut Decoding) {
    // SAFETY: the caller vouches for `decoding`.
    unsafe { take(decoding) }
}

/// Makes the Gaussians of the deepest level decoded so far. Fails with UNSUPPORTED if it has none, LIMIT, CANCELLED, USAGE, and for a
/// scene as b2p_decoding_advance does.
///
/// # Safety
/// `decoding` is a decoding; `gaussians` is writable; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_decoding_gaussians(
    decoding: *const Decoding,
    gaussians: *mut *mut Gaussians,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `decoding`.
        let decoding = unsafe { borrowed(decoding, "decoding") }?;
        let made = decoding.gaussians()?;
        // SAFETY: the caller vouches for `gaussians`.
        unsafe { give(gaussians, "gaussians", Gaussians(made)) }
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Where the numbers of the Gaussians lie. Fails with USAGE.
///
/// # Safety
/// `gaussians` are Gaussians; `arrays` is writable; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_gaussians_arrays(
    gaussians: *const Gaussians,
    arrays: *mut Arrays,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `gaussians` and `arrays`.
        let (Gaussians(g), arrays) = unsafe { (borrowed(gaussians, "gaussians")?, changed(arrays, "arrays")?) };
        *arrays = Arrays::of(g);
        Ok(())
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Frees Gaussians, and with them what b2p_gaussians_arrays told.
///
/// # Safety
/// `gaussians` is NULL or came from this library, and is not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_gaussians_free(gaussians: *mut Gaussians) {
    // SAFETY: the caller vouches for `gaussians`.
    unsafe { take(gaussians) }
}
