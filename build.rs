//! Compresses the model of learned streams, which the library carries with the feature `embedded-learned`.

use std::error::Error;

#[cfg(not(feature = "embedded-learned"))]
fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed=build.rs");
    Ok(())
}

#[cfg(feature = "embedded-learned")]
fn main() -> Result<(), Box<dyn Error>> {
    use std::io::Write;

    const MODEL: &str = "models/lite.safetensors";
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed={MODEL}");
    let out = std::path::PathBuf::from(std::env::var("OUT_DIR")?);
    let mut zlib = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::best());
    let model = std::fs::read(MODEL)?;
    // Signs, exponents and leading bits of its 16-bit weights repeat; the bytes between them do not.
    for byte in [0, 1] {
        let plane: Vec<u8> = model.iter().skip(byte).step_by(2).copied().collect();
        zlib.write_all(&plane)?;
    }
    std::fs::write(out.join("lite.zlib"), zlib.finish()?)?;
    Ok(())
}
