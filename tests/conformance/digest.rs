//! What a stream decodes to, as hashes.

use b2p::gaussians::Gaussians;
use b2p::latents::network::Model;
use b2p::latents::{Exact, LatentDecoder, LatentDecoding};
use b2p::log::Log;
use b2p::{Error, Result};
use sha2::{Digest, Sha256};

pub fn hash(bytes: impl IntoIterator<Item = u8>) -> String {
    let bytes: Vec<u8> = bytes.into_iter().collect();
    let hash = Sha256::digest(bytes);
    hash.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// `level=geometry,latents,features` and `,gaussians` if there are any.
fn level(level: u8, exact: &Exact, gaussians: Option<&Gaussians>) -> String {
    let keys = exact.octree.level(level).keys();
    let numbers = |numbers: &[i16]| hash(numbers.iter().flat_map(|n| n.to_le_bytes()));
    let mut line = format!(
        "{level}={},{},{}",
        hash(keys.iter().flat_map(|key| key.to_le_bytes())),
        numbers(&exact.latents),
        numbers(&exact.features)
    );
    if let Some(gaussians) = gaussians {
        line += &format!(",{}", gaussians_hash(gaussians));
    }
    line
}

/// The hash of all their parameters.
pub fn gaussians_hash(g: &Gaussians) -> String {
    let floats = g.position.as_flattened().iter();
    let floats = floats.chain(g.scale.as_flattened());
    let floats = floats.chain(g.rotation.as_flattened()).chain(&g.opacity);
    let floats = floats.chain(g.colour.as_flattened());
    hash(floats.flat_map(|x| x.to_le_bytes()))
}

fn reached(decoding: &LatentDecoding, log: &Log) -> Result<String> {
    let gaussians = match decoding.gaussians(log) {
        Err(Error::Unsupported { .. }) => None,
        gaussians => Some(gaussians?),
    };
    let exact = decoding.exact().expect("a level has been reached");
    let deepest = exact.octree.depth();
    Ok(level(deepest, exact, gaussians.as_ref()))
}

/// The digests of a stream's levels, or why there are none.
pub type Levels = std::result::Result<Vec<String>, String>;

/// The digests of all levels, each decoded on its own from the whole stream.
pub fn whole(model: &Model, bytes: &[u8]) -> Levels {
    let header = b2p::container::Header::parse(bytes, &Default::default()).map_err(told)?;
    let decoder = LatentDecoder::new(model);
    let drawable = decoder.levels(bytes).map_err(told)?;
    let of = |n: u8| {
        let exact = decoder.exact(bytes, n, &Log::default())?;
        let gaussians = match drawable.contains(&n) {
            true => Some(decoder.decode(bytes, Some(n), &Log::default())?),
            false => None,
        };
        Ok(level(n, &exact, gaussians.as_ref()))
    };
    (header.base..=header.top).map(of).collect::<Result<_>>().map_err(told)
}

/// The same, each as it becomes whole while the stream comes in pieces.
pub fn in_pieces(model: &Model, bytes: &[u8]) -> Levels {
    let (mut decoding, log) = (LatentDecoder::new(model).start(None), Log::default());
    let mut levels = Vec::new();
    for piece in bytes.chunks(61) {
        decoding.push(piece);
        while decoding.advance(&log).map_err(told)?.is_some() {
            levels.push(reached(&decoding, &log).map_err(told)?);
        }
    }
    decoding.finish(&log).map_err(told)?;
    Ok(levels)
}

fn told(error: Error) -> String {
    error.to_string()
}
