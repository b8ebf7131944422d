//! What a stream of version 3 decodes to, as hashes.

use b2p::Error;
use b2p::container::Header;
use b2p::{Decoder, Decoding};

use crate::digest::{Levels, gaussians_hash, hash};

/// The digest of the level reached; none of level 0, which learned heads do not draw.
fn reached(decoding: &Decoding) -> b2p::Result<Option<String>> {
    let points = decoding.points().expect("a level has been reached");
    let (level, keys) = (points.voxels.depth(), points.voxels.keys());
    let gaussians = match decoding.gaussians() {
        Err(Error::Unsupported { .. }) if level == 0 => return Ok(None),
        gaussians => gaussians?,
    };
    Ok(Some(format!(
        "{level}={},{},{}",
        hash(keys.iter().flat_map(|key| key.to_le_bytes())),
        hash(points.colours.iter().flatten().copied()),
        gaussians_hash(&gaussians),
    )))
}

/// The digests of all levels, each decoded on its own from the whole stream.
pub fn levels(decoder: &Decoder, bytes: &[u8]) -> b2p::Result<Vec<String>> {
    let of = |level: u8| {
        let decoder = decoder.clone().with_level(level);
        match decoder.whole(bytes) {
            Err(Error::Unsupported { .. }) if level == 0 => Ok(None),
            decoding => reached(&decoding?),
        }
    };
    let header = Header::parse(bytes, &Default::default())?;
    let levels = (header.base..=header.top).map(of);
    levels.filter_map(b2p::Result::transpose).collect()
}

/// The same, or why there are none.
pub fn whole(decoder: &Decoder, bytes: &[u8]) -> Levels {
    levels(decoder, bytes).map_err(|error: Error| error.to_string())
}

/// The same, each as it becomes whole while the stream comes in pieces.
pub fn in_pieces(decoder: &Decoder, bytes: &[u8]) -> Levels {
    let mut decoding = decoder.start();
    let mut decode = || {
        let mut levels = Vec::new();
        for piece in bytes.chunks(61) {
            decoding.push(piece);
            while decoding.advance()?.is_some() {
                levels.extend(reached(&decoding)?);
            }
        }
        decoding.finish()?;
        Ok(levels)
    };
    decode().map_err(|error: Error| error.to_string())
}
