//! The page that shows streams in a browser, as files for a server.
#![forbid(unsafe_code)]

/// A file of the page.
#[derive(Debug, Clone, Copy)]
pub struct PageFile {
    /// Where the page expects it, from its root, without a slash in front.
    pub path: &'static str,
    /// Its media type.
    pub media_type: &'static str,
    /// Its content.
    pub bytes: &'static [u8],
}

const HTML: &str = "text/html; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";

macro_rules! files {
    ($($path:literal: $kind:ident),* $(,)?) => {
        &[$(PageFile { path: $path, media_type: $kind, bytes: include_bytes!($path) }),*]
    };
}

/// All files but the WebAssembly modules.
pub const FILES: &[PageFile] = files![
    "index.html": HTML,
    "src/b2p.js": SCRIPT,
    "src/controls.js": SCRIPT,
    "src/error.js": SCRIPT,
    "src/page.js": SCRIPT,
    "src/playing.js": SCRIPT,
    "src/system.js": SCRIPT,
    "src/thread.js": SCRIPT,
    "src/threads.js": SCRIPT,
    "src/viewer.js": SCRIPT,
    "src/worker.js": SCRIPT,
];

/// The WebAssembly module `b2p.wasm`, compressed by gzip, if it was built (`web/build.sh`) before this crate.
pub const MODULE_GZIP: Option<&[u8]> = include!(concat!(env!("OUT_DIR"), "/b2p.rs"));

/// As [`MODULE_GZIP`], `b2p-threads.wasm`: the module with threads, for pages that are isolated from other origins.
pub const THREADS_GZIP: Option<&[u8]> = include!(concat!(env!("OUT_DIR"), "/b2p-threads.rs"));
