//! Compresses the model of learned streams, which the library carries with the feature `embedded`.

use std::error::Error;

#[cfg(not(feature = "embedded"))]
fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed=build.rs");
    Ok(())
}

#[cfg(feature = "embedded")]
fn main() -> Result<(), Box<dyn Error>> {
    use std::io::Write;

    const MODEL: &str = "models/lite.safetensors";
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed={MODEL}");
    let out = std::path::PathBuf::from(std::env::var("OUT_DIR")?);
    let mut zlib = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::best());
    zlib.write_all(&std::fs::read(MODEL)?)?;
    std::fs::write(out.join("lite.zlib"), zlib.finish()?)?;
    Ok(())
}
