//! What a scene decodes to, as hashes, and which clause a damaged one breaks.

use b2p::decoder::Checked;
use b2p::geometry::Voxels;
use b2p::{Decoder, Limits, SceneDecoder, SceneReader, Source, Wanted};

use crate::digest::{gaussians_hash, hash};

/// The whole scene, then each of its blocks: the name of the part behind that of the scene, and the digests of its
/// levels.
pub fn parts(decoder: &Decoder, bytes: &[u8]) -> b2p::Result<Vec<(String, Vec<String>)>> {
    let scene = SceneReader::new(bytes, &Limits::default())?;
    scene.check_end()?;
    let mut parts = vec![(String::new(), levels(decoder, &scene, &Wanted::All)?)];
    for block in 0..scene.blocks().len() {
        let wanted = Wanted::Blocks(vec![block]);
        parts.push((format!("/{block}"), levels(decoder, &scene, &wanted)?));
    }
    Ok(parts)
}

/// The lines of the suite that these parts make.
pub fn lines(name: &str, parts: &[(String, Vec<String>)]) -> String {
    let line = |(part, levels): &(String, Vec<String>)| format!("{name}{part} {}\n", levels.join(" "));
    parts.iter().map(line).collect()
}

/// `level=geometry,colours,surfels` of each level of a part.
fn levels(decoder: &Decoder, scene: &SceneReader<impl Source>, wanted: &Wanted) -> b2p::Result<Vec<String>> {
    let digest = |level: u8| -> b2p::Result<String> {
        let decoder = SceneDecoder::new(decoder.clone().with_level(level));
        let (voxels, colours): (Voxels, _) = decoder.voxels(scene, wanted)?.content;
        let drawn = decoder.gaussians(scene, wanted)?;
        match drawn.lost.into_iter().next() {
            Some(error) => Err(error),
            None => Ok(format!(
                "{level}={},{},{}",
                hash(voxels.keys().iter().flat_map(|key| key.to_le_bytes())),
                hash(colours.iter().flatten().copied()),
                gaussians_hash(&drawn.content),
            )),
        }
    };
    (scene.header().base..=scene.header().top).map(digest).collect()
}

/// The clause that a scene breaks first, in its index, a block, or at its end.
pub fn broken_clause(bytes: &[u8]) -> Option<&'static str> {
    let decoder = Decoder::new().with_limits(Limits::unlimited());
    let scene = match SceneReader::new(bytes, &Limits::unlimited()) {
        Ok(scene) => scene,
        Err(error) => return error.clause(),
    };
    let checks = scene.check(&decoder);
    let of_block = |found: &b2p::Result<Checked>| match found {
        Ok(checked) => checked.faults.first().and_then(|fault| fault.error.clause()),
        Err(error) => error.clause(),
    };
    let found = checks.blocks.iter().find_map(of_block);
    found.or_else(|| checks.end.and_then(|error| error.clause()))
}
