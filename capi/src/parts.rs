//! Gaussians that are handed over as they are made, and not kept.

use std::ffi::{c_char, c_void};

use crate::boundary::{Fault, Status, borrowed, changed, guard};
use crate::decoding::{Arrays, Decoding};

/// Takes a part of the Gaussians, whose numbers are there until it returns. Gives false to have no more of them. It must not unwind,
/// and may not call functions with the decoding that the Gaussians come from.
pub type Part = Option<unsafe extern "C" fn(arrays: *const Arrays, context: *mut c_void) -> bool>;

/// Says, before the first bytes come, that Gaussians will be asked for in parts alone: limits then count no more of them than there are
/// in memory. Fails with USAGE.
///
/// # Safety
/// `decoding` is a decoding; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_decoding_use_parts(decoding: *mut Decoding, message: *mut c_char, size: usize) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `decoding`.
        let decoding = unsafe { changed(decoding, "decoding") }?;
        decoding.use_parts()
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Makes the Gaussians of the deepest level decoded so far, and calls `each` with `context` and one part of them after the other, in
/// order. No more than a part of a stream is in memory at a time, 131,072 Gaussians; those of a scene, or of a stream of version 2, come
/// in one part. A part may be empty. Fails as b2p_decoding_gaussians does, and with CANCELLED when `each` gives false.
///
/// # Safety
/// `decoding` is a decoding; `each` may be called with `context`; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_decoding_gaussians_in_parts(
    decoding: *const Decoding,
    each: Part,
    context: *mut c_void,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `decoding`.
        let decoding = unsafe { borrowed(decoding, "decoding") }?;
        let each = each.ok_or_else(|| Fault::usage("each is NULL"))?;
        decoding.gaussians_in_parts(|part| {
            let arrays = Arrays::of(part);
            // SAFETY: the caller vouches for `each` and `context`.
            match unsafe { each(&raw const arrays, context) } {
                true => Ok(()),
                false => Err(b2p::Error::Cancelled),
            }
        })?;
        Ok(())
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}
