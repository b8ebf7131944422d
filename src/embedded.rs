//! The models and sample streams that the program carries.

/// The heads that draw streams of version 3 unless others are named, as a safetensors file: see
/// [`crate::gaussians::learned`]. They are not compressed: it would take longer to load them.
pub static HEADS: &[u8] = include_bytes!("../models/heads.safetensors");

/// A procedural still life, 10 bits, as a stream of version 3: made by `b2p-lab scene` and `b2p encode`.
pub static SCENE: &[u8] = include_bytes!("../models/scene.b2p");

#[cfg(feature = "embedded-learned")]
pub use learned::{MODEL_ZLIB, SAMPLE, model};

#[cfg(feature = "embedded-learned")]
mod learned {
    use std::io::Read;
    use std::sync::OnceLock;

    /// [`model`], compressed by zlib: every other byte from the first on, then those between them.
    pub static MODEL_ZLIB: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/lite.zlib"));

    /// The model that learned streams (version 2) are coded with unless another is named, as a safetensors file. See
    /// `models/README.md`. The first call inflates it.
    pub fn model() -> &'static [u8] {
        static MODEL: OnceLock<Vec<u8>> = OnceLock::new();
        MODEL.get_or_init(|| {
            let mut planes = Vec::new();
            // What the build script has compressed can be read: a test does.
            let read = flate2::read::ZlibDecoder::new(MODEL_ZLIB).read_to_end(&mut planes);
            debug_assert!(read.is_ok());
            let (first, second) = planes.split_at(planes.len() / 2);
            first.iter().zip(second).flat_map(|(&a, &b)| [a, b]).collect()
        })
    }

    /// The still life as a learned stream (version 2), coded with [`model`]: made by `b2p-lab scene` and `b2p encode
    /// --colours learned`.
    pub static SAMPLE: &[u8] = include_bytes!("../models/sample.b2p");

    #[cfg(test)]
    mod tests {
        #[test]
        fn the_model_is_the_file_that_was_compressed() {
            assert!(super::model() == include_bytes!("../models/lite.safetensors"));
        }
    }
}
