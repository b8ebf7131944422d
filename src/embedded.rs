//! The models and sample streams that the program carries.

/// The model that learned streams (version 2) are coded with unless another is named, as a safetensors file. See
/// `models/README.md`.
pub static MODEL: &[u8] = include_bytes!("../models/lite.safetensors");

/// The heads that draw streams of version 3 unless others are named, as a safetensors file: see
/// [`crate::gaussians::learned`].
pub static HEADS: &[u8] = include_bytes!("../models/heads.safetensors");

/// A procedural still life, 10 bits, as a stream of version 3: made by `b2p-lab scene` and `b2p encode`.
pub static SCENE: &[u8] = include_bytes!("../models/scene.b2p");

/// The same still life as a learned stream (version 2), coded with [`MODEL`]: made by `b2p-lab scene` and `b2p encode
/// --colours learned`.
pub static SAMPLE: &[u8] = include_bytes!("../models/sample.b2p");
