//! Renders a stream from all sides, as numbered PNG files.
//!
//!     cargo run --release --example turntable -- models/scene.b2p turntable/ 24

use std::error::Error;
use std::fs;
use std::path::Path;

use b2p::{Background, Camera, Decoder, Image, Renderer};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [input, folder, rest @ ..] = args.as_slice() else {
        return Err("usage: turntable STREAM.b2p FOLDER [VIEWS]".into());
    };
    let views: u32 = rest.first().map_or(Ok(24), |views| views.parse())?;
    let gaussians = Decoder::new().decode(&fs::read(input)?)?;
    fs::create_dir_all(folder)?;

    // The renderer reuses its memory from picture to picture, and so does the image.
    let mut renderer = Renderer::new().with_background(Background::BLACK);
    let mut image = Image::default();
    for view in 0..views {
        let azimuth = f64::from(view) * 360.0 / f64::from(views);
        let camera = Camera::orbit(azimuth, 20.0, 2.6, 45.0, 640, 480)?;
        let stats = renderer.render_into(&gaussians, &camera, &mut image)?;
        let path = Path::new(folder).join(format!("{view:03}.png"));
        fs::write(&path, image.to_png()?)?;
        println!(
            "{}: {} Gaussians in {:?}",
            path.display(),
            stats.visible,
            stats.times.total()
        );
    }
    Ok(())
}
