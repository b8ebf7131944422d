//! Memory for callers outside a WebAssembly module, who cannot pass pointers into their own.

use std::alloc::{Layout, alloc, dealloc};

const ALIGN: usize = 8;

/// Memory for `size` bytes, aligned to 8; NULL if there is none.
///
/// cbindgen:ignore
#[unsafe(no_mangle)]
pub extern "C" fn b2p_alloc(size: usize) -> *mut u8 {
    match Layout::from_size_align(size.max(1), ALIGN) {
        // SAFETY: the size is not zero.
        Ok(layout) => unsafe { alloc(layout) },
        Err(_) => std::ptr::null_mut(),
    }
}

/// Frees memory.
///
/// cbindgen:ignore
///
/// # Safety
/// `memory` came from [`b2p_alloc`] with this `size`, and is not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_dealloc(memory: *mut u8, size: usize) {
    if let Ok(layout) = Layout::from_size_align(size.max(1), ALIGN) {
        // SAFETY: as the caller vouches, the layout is that of the allocation.
        unsafe { dealloc(memory, layout) }
    }
}
