//! Large blocks of memory.

use std::alloc::{Layout, handle_alloc_error};

use ::half::f16;
use ::half::vec::HalfBitsVecExt;
use bytemuck::Zeroable;

/// The pages that systems have beside their small ones, on most machines.
#[cfg(target_os = "linux")]
const HUGE: usize = 2 << 20;

/// Blocks that are larger go back to the system.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const MOST_KEPT: libc::c_int = 32 << 20;

/// So many zeros, from the system as they are touched: in huge pages where it has them, for every small one costs a
/// fault. If there is no memory the process ends, as with every other vector: it must not unwind, for reporting that takes
/// memory, too.
pub fn zeros<T: Zeroable>(len: usize) -> Vec<T> {
    let zeros = bytemuck::try_zeroed_vec(len).unwrap_or_else(|()| match Layout::array::<T>(len) {
        Ok(layout) => handle_alloc_error(layout),
        Err(_) => std::process::abort(),
    });
    #[cfg(target_os = "linux")]
    ask_for_huge_pages(&zeros);
    zeros
}

/// Numbers of which large blocks of zeros can be had as [`zeros`] are.
pub trait Zeros: Copy + Default {
    /// So many zeros.
    fn zeros(len: usize) -> Vec<Self>;
}

impl Zeros for i16 {
    fn zeros(len: usize) -> Vec<i16> {
        zeros(len)
    }
}

impl Zeros for f64 {
    fn zeros(len: usize) -> Vec<f64> {
        zeros(len)
    }
}

impl Zeros for f16 {
    fn zeros(len: usize) -> Vec<f16> {
        zeros::<u16>(len).reinterpret_into()
    }
}

/// Gives what is free back to the system, where the allocator keeps some for later: what is reserved next is as fresh
/// as in a process that has just begun.
pub fn give_back() {
    // SAFETY: nothing that is in use is touched.
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    unsafe {
        libc::malloc_trim(0)
    };
}

/// From now on keeps what is freed for what is reserved next, in one place for all threads: for processes that reserve the
/// same again and again, such as for frame after frame. To be called before threads start. It does nothing where the
/// allocator is not that of the GNU C library.
pub fn keep_freed() {
    // SAFETY: sets numbers of the allocator, which it guards with a lock.
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    unsafe {
        libc::mallopt(libc::M_ARENA_MAX, 1);
        libc::mallopt(libc::M_MMAP_THRESHOLD, MOST_KEPT);
        libc::mallopt(libc::M_TRIM_THRESHOLD, libc::c_int::MAX);
    }
}

/// Asks for huge pages where whole ones fit. It is up to the system to give them.
#[cfg(target_os = "linux")]
fn ask_for_huge_pages<T>(block: &[T]) {
    // Miri knows no such advice.
    if cfg!(miri) {
        return;
    }
    let start = block.as_ptr().addr().next_multiple_of(HUGE);
    let end = block.as_ptr_range().end.addr() / HUGE * HUGE;
    if start < end {
        let at = block.as_ptr().cast::<u8>().wrapping_add(start - block.as_ptr().addr());
        // SAFETY: these pages belong to the block alone, and the advice changes nothing but how the system backs them.
        unsafe { libc::madvise(at.cast_mut().cast(), end - start, libc::MADV_HUGEPAGE) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zeros_are_as_many_as_asked_for_and_zero() {
        for len in [0, 1, 1000, (3 << 20) + 5] {
            let zeros: Vec<u32> = zeros(len);
            assert_eq!(zeros.len(), len);
            assert!(zeros.iter().all(|&zero| zero == 0));
        }
    }
}
