//! Models and limits.

use std::ffi::{CStr, c_char};
use std::path::Path;

use crate::border::{Fault, Status, give, guard, slice, take};

/// A model, ready to run. Any number of decodings share it, in any threads.
pub struct Model(pub(crate) b2p::Model);

/// Learned heads that draw streams of version 3, ready to run. Any number of decodings share them, in any threads.
pub struct HeadsModel(pub(crate) b2p::HeadsModel);

/// What an input may ask for.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Voxels of a level.
    pub max_points: u64,
    /// Pixels of a picture.
    pub max_pixels: u64,
    /// Bytes that one input may make the library reserve.
    pub max_bytes: u64,
    /// Octree levels.
    pub max_depth: u8,
}

impl From<b2p::Limits> for Limits {
    fn from(limits: b2p::Limits) -> Self {
        Limits {
            max_points: limits.max_points,
            max_pixels: limits.max_pixels,
            max_bytes: limits.max_bytes,
            max_depth: limits.max_depth,
        }
    }
}

impl From<Limits> for b2p::Limits {
    fn from(limits: Limits) -> Self {
        b2p::Limits::default()
            .with_max_points(limits.max_points)
            .with_max_pixels(limits.max_pixels)
            // As in the presets.
            .with_max_pairs(limits.max_pixels.saturating_mul(4))
            .with_max_bytes(limits.max_bytes)
            .with_max_depth(limits.max_depth)
    }
}

/// Limits for anything: 2^26 points, 2^26 pixels, 2 GiB. What NULL stands for.
#[unsafe(no_mangle)]
pub extern "C" fn b2p_limits_default() -> Limits {
    b2p::Limits::default().into()
}

/// Limits for boards with 512 MB of memory.
#[unsafe(no_mangle)]
pub extern "C" fn b2p_limits_embedded() -> Limits {
    b2p::Limits::embedded().into()
}

/// No limits but the format's, for input that is trusted.
#[unsafe(no_mangle)]
pub extern "C" fn b2p_limits_unlimited() -> Limits {
    b2p::Limits::unlimited().into()
}

/// The library's version, such as "0.1.0".
#[unsafe(no_mangle)]
pub extern "C" fn b2p_version() -> *const c_char {
    const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), "\0");
    VERSION.as_ptr().cast()
}

/// Loads a model file. Fails with IO, MALFORMED, UNSUPPORTED, USAGE.
///
/// # Safety
/// `path` is NULL or a string; `model` is writable; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_model_open(
    path: *const c_char,
    model: *mut *mut Model,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        if path.is_null() {
            return Err(Fault::usage("path is NULL"));
        }
        // SAFETY: the caller vouches for a string.
        let path = unsafe { CStr::from_ptr(path) };
        let path = path.to_str().map_err(|_| Fault::usage("path is not UTF-8"))?;
        let loaded = b2p::latents::network::Model::open(Path::new(path))?;
        // SAFETY: the caller vouches for `model`.
        unsafe { give(model, "model", Model(loaded)) }
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Loads a model file's content, which is not needed afterwards. Fails with MALFORMED, UNSUPPORTED, USAGE.
///
/// # Safety
/// `bytes` leads to `length` bytes; `model` is writable; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_model_from_bytes(
    bytes: *const u8,
    length: usize,
    model: *mut *mut Model,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `bytes`.
        let bytes = unsafe { slice(bytes, length, "bytes") }?;
        let loaded = b2p::latents::network::Model::from_bytes(bytes)?;
        // SAFETY: the caller vouches for `model`.
        unsafe { give(model, "model", Model(loaded)) }
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Frees a model. Decodings that were started with it go on.
///
/// # Safety
/// `model` is NULL or came from this library, and is not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_model_free(model: *mut Model) {
    // SAFETY: the caller vouches for `model`.
    unsafe { take(model) }
}

/// Loads the content of a file of learned heads, which is not needed afterwards. Fails with MALFORMED, UNSUPPORTED, USAGE.
///
/// # Safety
/// `bytes` leads to `length` bytes; `heads` is writable; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_heads_model_from_bytes(
    bytes: *const u8,
    length: usize,
    heads: *mut *mut HeadsModel,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `bytes`.
        let bytes = unsafe { slice(bytes, length, "bytes") }?;
        let loaded = b2p::gaussians::learned::HeadsModel::from_bytes(bytes)?;
        // SAFETY: the caller vouches for `heads`.
        unsafe { give(heads, "heads", HeadsModel(loaded)) }
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Frees learned heads. Decodings that draw with them go on.
///
/// # Safety
/// `heads` is NULL or came from this library, and is not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_heads_model_free(heads: *mut HeadsModel) {
    // SAFETY: the caller vouches for `heads`.
    unsafe { take(heads) }
}
