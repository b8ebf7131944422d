//! Decodes a stream to Gaussians, and writes them as a PLY file for viewers of Gaussian splats.
//!
//!     cargo run --release --example decode -- models/scene.b2p scene.ply models/heads.safetensors
//!
//! Without the last argument, the Gaussians are surfels in closed form.

use std::error::Error;
use std::fs::{self, File};
use std::io::BufWriter;
use std::path::Path;

use b2p::{Decoder, HeadsModel, Limits};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [input, output, heads @ ..] = args.as_slice() else {
        return Err("usage: decode STREAM.b2p GAUSSIANS.ply [HEADS.safetensors]".into());
    };
    // An untrusted stream may ask for at most this much memory.
    let mut decoder = Decoder::new().with_limits(Limits::default().with_max_bytes(512 << 20));
    if let Some(heads) = heads.first() {
        decoder = decoder.with_heads_model(HeadsModel::open(Path::new(heads))?);
    }
    let bytes = fs::read(input)?;
    println!("levels that can be drawn: {:?}", decoder.levels(&bytes)?);
    let gaussians = decoder.decode(&bytes)?;
    let mut file = BufWriter::new(File::create(output)?);
    gaussians.write_ply(&mut file, Path::new(output))?;
    println!("{output}: {} Gaussians", gaussians.len());
    Ok(())
}
