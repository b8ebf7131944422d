//! The page that shows streams in a browser, as files for a server.
#![forbid(unsafe_code)]

use std::io::{self, Read, Write};
use std::sync::OnceLock;

use flate2::Compression;
use flate2::write::GzEncoder;
use lzma_rust2::LzmaReader;

/// A file of the page.
#[derive(Debug, Clone, Copy)]
pub struct PageFile {
    /// Where the page expects it, from its root, without a slash in front.
    pub path: &'static str,
    /// Its content.
    pub bytes: &'static [u8],
}

macro_rules! files {
    ($($path:literal),* $(,)?) => {
        &[$(PageFile { path: $path, bytes: include_bytes!($path) }),*]
    };
}

/// All files but the WebAssembly modules.
pub const FILES: &[PageFile] = files![
    "index.html",
    "src/b2p.js",
    "src/controls.js",
    "src/error.js",
    "src/page.js",
    "src/playing.js",
    "src/system.js",
    "src/thread.js",
    "src/threads.js",
    "src/viewer.js",
    "src/worker.js",
];

/// Bytes of `b2p.wasm` and `b2p-threads.wasm`, none of those that were not built (`web/build.sh`) before this crate.
const LENGTHS: [usize; 2] = include!(concat!(env!("OUT_DIR"), "/lengths.rs"));

/// Both, one after the other, compressed by LZMA: less than half of what gzip makes of each.
static MODULES: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/modules.lzma"));

/// Whether the page has its WebAssembly module, `b2p.wasm`.
pub const HAS_MODULE: bool = LENGTHS[0] > 0;

/// The WebAssembly module of this name, compressed by gzip as servers send it: `b2p.wasm`, or `b2p-threads.wasm`, which
/// has threads, for pages that are isolated from other origins. `None` if it was not built before this crate.
///
/// The first call takes some tenths of a second: modules are stored smaller than by gzip.
pub fn module_gzip(name: &str) -> Option<&'static [u8]> {
    static GZIP: OnceLock<[Vec<u8>; 2]> = OnceLock::new();
    let which = match name {
        "b2p.wasm" => 0,
        "b2p-threads.wasm" => 1,
        _ => return None,
    };
    let gzip = || {
        let modules = modules();
        // What the build script has compressed can be read: a test does.
        debug_assert!(modules.is_ok());
        modules
            .unwrap_or_default()
            .map(|module| gzip(&module).unwrap_or_default())
    };
    (LENGTHS[which] > 0).then(|| GZIP.get_or_init(gzip)[which].as_slice())
}

/// The modules as they were built.
fn modules() -> io::Result<[Vec<u8>; 2]> {
    let mut all = LzmaReader::new_mem_limit(MODULES, u32::MAX, None)?;
    let [mut first, mut second] = LENGTHS.map(|length| vec![0; length]);
    all.read_exact(&mut first)?;
    all.read_exact(&mut second)?;
    Ok([first, second])
}

fn gzip(bytes: &[u8]) -> io::Result<Vec<u8>> {
    let mut gzip = GzEncoder::new(Vec::new(), Compression::default());
    gzip.write_all(bytes)?;
    gzip.finish()
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;

    #[test]
    fn modules_are_the_files_that_were_compressed() {
        for name in ["b2p.wasm", "b2p-threads.wasm"] {
            let mut read = Vec::new();
            if let Some(gzip) = module_gzip(name) {
                flate2::read::GzDecoder::new(gzip).read_to_end(&mut read).unwrap();
            }
            let built = std::fs::read(name).unwrap_or_default();
            assert!(read == built, "{name}: {} bytes of {}", read.len(), built.len());
        }
        assert_eq!(HAS_MODULE, module_gzip("b2p.wasm").is_some());
        assert!(module_gzip("index.html").is_none());
    }
}
