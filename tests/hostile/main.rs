//! Untrusted streams: cut, damaged, lying, arriving in any pieces.

#[path = "../common/mod.rs"]
mod common;
mod damage;
mod incremental;
mod lies;
#[path = "../common/seal.rs"]
mod seal;
mod sequences;
mod stack;
mod transform;

use b2p::gaussians::Gaussians;
use b2p::latents::LatentDecoder;
use b2p::latents::network::Model;
use b2p::log::Log;

fn model() -> Model {
    Model::from_bytes(&common::tiny_model(0)).expect("an untrained model loads")
}

/// The Gaussians, or the error in all its detail.
fn decoded(model: &Model, bytes: &[u8], level: Option<u8>) -> Result<Gaussians, String> {
    LatentDecoder::new(model)
        .decode(bytes, level, &Log::default())
        .map_err(|error| format!("{error:?}"))
}

/// Pushes a stream in pieces of these sizes: the levels as they became whole, with the bytes that had come by then, and
/// what came of it.
fn pushed(
    model: &Model,
    bytes: &[u8],
    level: Option<u8>,
    sizes: impl IntoIterator<Item = usize>,
) -> (Vec<(u8, usize)>, Result<Gaussians, String>) {
    let mut decoding = LatentDecoder::new(model).start(level);
    let (mut levels, log) = (Vec::new(), Log::default());
    let mut sizes = sizes.into_iter();
    let mut at = 0;
    let result = (|| {
        while at < bytes.len() {
            let size = sizes.next().unwrap_or(usize::MAX).min(bytes.len() - at);
            decoding.push(&bytes[at..at + size]);
            at += size;
            while let Some(level) = decoding.advance(&log)? {
                levels.push((level, at));
            }
        }
        decoding.finish(&log)?;
        decoding.gaussians(&log)
    })();
    (levels, result.map_err(|error| format!("{error:?}")))
}

/// Where each level of an undamaged stream ends.
fn ends(bytes: &[u8]) -> Vec<(u8, usize)> {
    let header = b2p::container::Header::parse(bytes, &b2p::Limits::default()).unwrap();
    let end = |level| (level, header.prefix_bytes(level).unwrap() as usize);
    (header.base..=header.top).map(end).collect()
}
