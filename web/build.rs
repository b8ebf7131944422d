//! Compresses the WebAssembly module for the page, if `web/build.sh` has built it.

use std::error::Error;
use std::io::Write;
use std::path::{Path, PathBuf};

use flate2::Compression;
use flate2::write::GzEncoder;

fn main() -> Result<(), Box<dyn Error>> {
    let module = Path::new("b2p.wasm");
    println!("cargo::rerun-if-changed={}", module.display());
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    let expression = match module.exists() {
        false => "None".to_owned(),
        true => {
            let mut gzip = GzEncoder::new(Vec::new(), Compression::best());
            gzip.write_all(&std::fs::read(module)?)?;
            std::fs::write(out.join("b2p.wasm.gz"), gzip.finish()?)?;
            "Some(include_bytes!(\"b2p.wasm.gz\"))".to_owned()
        }
    };
    std::fs::write(out.join("module.rs"), expression)?;
    Ok(())
}
