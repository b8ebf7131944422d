//! Encodes a point cloud as a stream of at most so many bits per point.
//!
//!     cargo run --release --example encode -- CLOUD.ply STREAM.b2p 0.2

use std::error::Error;
use std::fs;

use b2p::{Encoder, Limits, Log, PointCloud, voxelise_closed};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [input, output, bits_per_point] = args.as_slice() else {
        return Err("usage: encode CLOUD.ply STREAM.b2p BITS_PER_POINT".into());
    };
    let cloud = PointCloud::open(input, &Limits::default())?;
    // The finest grid on which the points of a surface still touch.
    let (voxels, bits) = voxelise_closed(&cloud)?;
    println!(
        "{} points, {} voxels of {bits} bits",
        cloud.positions.len(),
        voxels.colours.len()
    );

    let log = Log::with_listener(|step| eprintln!("{step} …"));
    let encoder = Encoder::new().with_log(&log);
    let encoded = encoder.encode_to_rate(&voxels, bits_per_point.parse()?)?;
    for rate in &encoded.rates {
        let (geometry, colours) = (rate.geometry_bytes, rate.colour_bytes);
        println!(
            "level {}: {geometry} bytes of geometry, {colours} of colours",
            rate.level
        );
    }
    fs::write(output, &encoded.bytes)?;
    println!("{output}: {} bytes", encoded.bytes.len());
    Ok(())
}
