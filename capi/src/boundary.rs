//! The FFI boundary: statuses, messages, pointers.

use std::ffi::c_char;
use std::panic::{AssertUnwindSafe, catch_unwind};

use b2p::Error;

/// How a function ended.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// As it should.
    Ok = 0,
    /// A file could not be read.
    Io = 1,
    /// The input ends before it is complete.
    Truncated = 2,
    /// The bytes are not what was written.
    Checksum = 3,
    /// The stream was made with another model.
    Model = 4,
    /// Encoder and decoder did not compute the same.
    Determinism = 5,
    /// The input asks for more than the limits allow.
    Limit = 6,
    /// Well-formed, but not supported.
    Unsupported = 7,
    /// The input breaks the format.
    Malformed = 8,
    /// Another thread has cancelled.
    Cancelled = 9,
    /// The caller asked for something that makes no sense: an argument is NULL, out of range, or too small.
    Usage = 10,
    /// A defect in the library.
    Internal = 11,
}

/// What went wrong.
pub struct Fault(Status, String);

impl Fault {
    /// A mistake of the caller.
    pub fn usage(text: impl Into<String>) -> Fault {
        Fault(Status::Usage, text.into())
    }

    /// A file that nothing here reads.
    #[cfg(feature = "page")]
    pub fn unsupported(text: impl Into<String>) -> Fault {
        Fault(Status::Unsupported, text.into())
    }
}

impl From<Error> for Fault {
    fn from(error: Error) -> Fault {
        // Of a block or a frame, its own fault counts.
        let cause = match &error {
            Error::Block { source, .. } | Error::Frame { source, .. } => source,
            error => error,
        };
        let status = match cause {
            Error::Io { .. } => Status::Io,
            Error::Truncated { .. } => Status::Truncated,
            Error::ChecksumMismatch { .. } => Status::Checksum,
            Error::ModelMismatch { .. } | Error::ModelMissing { .. } => Status::Model,
            Error::DeterminismMismatch { .. } => Status::Determinism,
            Error::LimitExceeded { .. } => Status::Limit,
            Error::Unsupported { .. } => Status::Unsupported,
            Error::Malformed { .. } => Status::Malformed,
            Error::Cancelled => Status::Cancelled,
            Error::Usage(_) | Error::TooFewBits { .. } => Status::Usage,
            _ => Status::Internal,
        };
        Fault(status, error.to_string())
    }
}

/// Runs what is behind a function of the interface: its status, and the message where the caller wants it.
///
/// # Safety
/// `message` is NULL or leads to `size` writable bytes.
pub unsafe fn guard(message: *mut c_char, size: usize, run: impl FnOnce() -> Result<(), Fault>) -> Status {
    let done = catch_unwind(AssertUnwindSafe(run));
    let (status, text) = match done {
        Ok(Ok(())) => (Status::Ok, String::new()),
        Ok(Err(Fault(status, text))) => (status, text),
        Err(panic) => {
            let told = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
            let told = told.or_else(|| panic.downcast_ref::<String>().cloned());
            (Status::Internal, told.unwrap_or_else(|| "a defect".into()))
        }
    };
    if !message.is_null() && size > 0 {
        // No character is cut in two.
        let length = text.floor_char_boundary(text.len().min(size - 1));
        // SAFETY: the caller vouches for `size` bytes, and length + 1 ≤ size.
        unsafe {
            std::ptr::copy_nonoverlapping(text.as_ptr(), message.cast(), length);
            *message.add(length) = 0;
        }
    }
    status
}

/// What a pointer leads to.
///
/// # Safety
/// It is NULL or leads to a `T` that nothing changes while `'a` lasts.
pub unsafe fn borrowed<'a, T>(pointer: *const T, name: &str) -> Result<&'a T, Fault> {
    // SAFETY: as the caller vouches.
    unsafe { pointer.as_ref() }.ok_or_else(|| Fault::usage(format!("{name} is NULL")))
}

/// What a pointer leads to, to be changed.
///
/// # Safety
/// It is NULL or leads to a `T` that nothing else uses while `'a` lasts.
pub unsafe fn changed<'a, T>(pointer: *mut T, name: &str) -> Result<&'a mut T, Fault> {
    // SAFETY: as the caller vouches.
    unsafe { pointer.as_mut() }.ok_or_else(|| Fault::usage(format!("{name} is NULL")))
}

/// The bytes that a pointer leads to.
///
/// # Safety
/// It is NULL or leads to `length` bytes that nothing changes while `'a` lasts.
pub unsafe fn slice<'a>(bytes: *const u8, length: usize, name: &str) -> Result<&'a [u8], Fault> {
    if length == 0 {
        return Ok(&[]);
    }
    if bytes.is_null() || length > isize::MAX as usize {
        return Err(Fault::usage(format!("{name} is NULL or too long")));
    }
    // SAFETY: as the caller vouches; the length is one that a slice may have.
    Ok(unsafe { std::slice::from_raw_parts(bytes, length) })
}

/// Puts a new object where the caller wants it.
///
/// # Safety
/// `out` is NULL or writable.
pub unsafe fn give<T>(out: *mut *mut T, name: &str, value: T) -> Result<(), Fault> {
    // SAFETY: as the caller vouches.
    let out = unsafe { changed(out, name) }?;
    *out = Box::into_raw(Box::new(value));
    Ok(())
}

/// Frees an object.
///
/// # Safety
/// `object` is NULL or came from [`give`], and is not used any more.
pub unsafe fn take<T>(object: *mut T) {
    if !object.is_null() {
        // SAFETY: it came from `Box::into_raw`. A panic while it is dropped would be a defect, and must not cross the FFI boundary.
        let dropped = catch_unwind(AssertUnwindSafe(|| drop(unsafe { Box::from_raw(object) })));
        debug_assert!(dropped.is_ok());
    }
}
