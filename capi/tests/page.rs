//! Pictures of files that the page's tests compare theirs with: `web/tests/data/pictures.txt` has their digests.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use b2p::{Camera, Decoder, Gaussians, HeadSet, HeadsModel, Limits, Renderer, SequenceDecoder, SequenceReader};
use b2p_formats::splats::{self, Format};
use sha2::{Digest, Sha256};

const FILES: [&str; 6] = [
    "ball.ply",
    "ball.compressed.ply",
    "ball.spz",
    "ball.sog",
    "ball.splat",
    "ball.glb",
];

const SEQUENCE: &str = "wave.b2p";
const FRAMES: [u64; 4] = [0, 6, 13, 23];
/// Of these, the pictures of learned heads are compared, too: the first frame of the file, and one that is predicted.
const LEARNED: [u64; 2] = [0, 13];

fn data() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../web/tests/data")
}

/// The digest of a picture by scalar kernels, which are those of WebAssembly.
fn digest(gaussians: &Gaussians) -> String {
    let scalar = "scalar".parse().unwrap();
    let camera = Camera::orbit(20.0, 20.0, 2.6, 45.0, 320, 240).unwrap();
    let image = Renderer::new().with_isa(scalar).render(gaussians, &camera).unwrap();
    let sum = Sha256::digest(image.to_pixmap().unwrap().data());
    sum.iter().fold(String::new(), |mut text, byte| {
        write!(text, "{byte:02x}").unwrap();
        text
    })
}

/// With `B2P_WRITE_PICTURES` set, the digests are written instead.
#[test]
fn the_page_is_compared_with_what_is_drawn_natively() {
    let mut made = String::new();
    for name in FILES {
        let path = data().join(name);
        let format = Format::of_path(&path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let splats = splats::read(&bytes, format, &splats::Options::default(), &Limits::default()).unwrap();
        writeln!(made, "{name} {}", digest(&splats.into_cloud())).unwrap();
    }
    let bytes = std::fs::read(data().join(SEQUENCE)).unwrap();
    let sequence = SequenceReader::new(bytes, &Limits::default()).unwrap();
    let mut drawn = |decoder: Decoder, frames: &[u64], heads: &str| {
        let mut decoder = SequenceDecoder::new(decoder);
        for number in frames {
            let frame = decoder.frame(&sequence, *number).unwrap();
            let sum = digest(&frame.gaussians().unwrap());
            writeln!(made, "{SEQUENCE}#{number}{heads} {sum}").unwrap();
        }
    };
    drawn(Decoder::new(), &FRAMES, "");
    let model = HeadsModel::open(&data().join("../../../models/heads.safetensors")).unwrap();
    let scalar = "scalar".parse().unwrap();
    for (heads, name) in [(HeadSet::Quick, ":quick"), (HeadSet::Best, ":best")] {
        let decoder = Decoder::new().with_heads_model(model.clone());
        drawn(decoder.with_heads(heads).with_isa(scalar), &LEARNED, name);
    }
    let path = data().join("pictures.txt");
    if std::env::var_os("B2P_WRITE_PICTURES").is_some() {
        std::fs::write(&path, &made).unwrap();
    }
    assert_eq!(made, std::fs::read_to_string(&path).unwrap_or_default());
}
