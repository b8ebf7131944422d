//! The model and the sample stream that the program carries.

/// The model that streams are coded with unless another is named, as a safetensors file. See `models/README.md`.
pub static MODEL: &[u8] = include_bytes!("../models/lite.safetensors");

/// A procedural still life, 10 bits, coded with [`MODEL`]: made by `b2p-lab scene` and `b2p encode`.
pub static SAMPLE: &[u8] = include_bytes!("../models/sample.b2p");
