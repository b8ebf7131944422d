//! Compresses the WebAssembly modules for the page, if `web/build.sh` has built them.

use std::error::Error;
use std::io::Write;
use std::path::PathBuf;

use lzma_rust2::{LzmaOptions, LzmaWriter};

fn main() -> Result<(), Box<dyn Error>> {
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    let mut all = Vec::new();
    let lengths = ["b2p.wasm", "b2p-threads.wasm"].map(|module| {
        println!("cargo::rerun-if-changed={module}");
        std::fs::read(module).map_or(0, |bytes| {
            all.extend(&bytes);
            bytes.len()
        })
    });
    // One after the other, within one window: the second repeats most of the first.
    let mut options = LzmaOptions::with_preset(9);
    options.dict_size = u32::try_from(all.len())?
        .next_power_of_two()
        .max(LzmaOptions::DICT_SIZE_DEFAULT);
    options.nice_len = LzmaOptions::NICE_LEN_MAX;
    let mut lzma = LzmaWriter::new_use_header(Vec::new(), &options, Some(all.len() as u64))?;
    lzma.write_all(&all)?;
    std::fs::write(out.join("modules.lzma"), lzma.finish()?)?;
    std::fs::write(out.join("lengths.rs"), format!("{lengths:?}"))?;
    Ok(())
}
