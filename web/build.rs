//! Compresses the WebAssembly modules for the page, if `web/build.sh` has built them.

use std::error::Error;
use std::io::Write;
use std::path::{Path, PathBuf};

use flate2::Compression;
use flate2::write::GzEncoder;

fn main() -> Result<(), Box<dyn Error>> {
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    for name in ["b2p", "b2p-threads"] {
        let module = format!("{name}.wasm");
        println!("cargo::rerun-if-changed={module}");
        let expression = match Path::new(&module).exists() {
            false => "None".to_owned(),
            true => {
                let mut gzip = GzEncoder::new(Vec::new(), Compression::best());
                gzip.write_all(&std::fs::read(&module)?)?;
                std::fs::write(out.join(format!("{module}.gz")), gzip.finish()?)?;
                format!("Some(include_bytes!(\"{module}.gz\"))")
            }
        };
        std::fs::write(out.join(format!("{name}.rs")), expression)?;
    }
    Ok(())
}
