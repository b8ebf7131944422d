//! Whether standard output was open when the process started.
//!
//! Before `main`, the standard library opens a null device in the place of a closed descriptor, and what is written is
//! lost without an error. A function that runs before that remembers.

#[cfg(target_os = "linux")]
mod linux {
    use std::sync::atomic::{AtomicBool, Ordering};

    static CLOSED: AtomicBool = AtomicBool::new(false);

    // SAFETY: the section holds pointers to functions that the loader calls before `main`, with arguments that this one
    // does not take. It makes one system call and stores into an atomic, for which nothing has to be set up.
    #[used]
    #[unsafe(link_section = ".init_array")]
    static LOOK: extern "C" fn() = {
        extern "C" fn look() {
            // SAFETY: asks for the flags of a descriptor, which may be closed.
            let flags = unsafe { libc::fcntl(libc::STDOUT_FILENO, libc::F_GETFD) };
            CLOSED.store(flags == -1, Ordering::Relaxed);
        }
        look
    };

    /// Whether standard output was closed.
    pub fn stdout_was_closed() -> bool {
        CLOSED.load(Ordering::Relaxed)
    }
}

#[cfg(target_os = "linux")]
pub use linux::stdout_was_closed;

/// Whether standard output was closed; false where that is not known.
#[cfg(not(target_os = "linux"))]
pub fn stdout_was_closed() -> bool {
    false
}
