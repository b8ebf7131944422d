//! Untrusted scenes of blocks.

use b2p::container::Header;
use b2p::container::scene::{BlockEntry, parse_index, write_index};
use b2p::{Decoder, Error, Limits, SceneDecoder, SceneReader, Wanted};

use crate::streams::check;
use crate::transform::limits;
use crate::{giving_back, within};

/// Blocks that are decoded of each input.
const BLOCKS: usize = 4;

/// Any bytes as a scene under small limits, as they are and with hashes and sums made right: every block is an error or
/// has as many colours as voxels, and is the same with others as alone. Memory stays within the limit, and all of it is
/// given back.
pub fn scene(bytes: &[u8]) {
    giving_back(|| {
        decoded(bytes);
        if let Some(bytes) = sealed(bytes) {
            decoded(&bytes);
        }
    });
}

fn decoded(bytes: &[u8]) {
    let scene = match SceneReader::new(bytes, &limits()) {
        Ok(scene) => scene,
        Err(error) => return check(&error),
    };
    let blocks: Vec<usize> = (0..scene.blocks().len().min(BLOCKS)).collect();
    let decoder = SceneDecoder::new(Decoder::new().with_limits(limits()));
    // Beside what is decoded stands the index.
    let most = (limits().max_bytes + Limits::OVERHEAD) as usize + 64 * bytes.len();
    let points = |blocks: &[usize]| match decoder.voxels(&scene, &Wanted::Blocks(blocks.to_vec())) {
        Ok(decoded) => {
            let (voxels, colours) = decoded.content;
            assert_eq!(voxels.len(), colours.len());
            decoded.lost.iter().for_each(faulty);
            Some((voxels.keys().to_vec(), colours))
        }
        Err(error) => {
            faulty(&error);
            None
        }
    };
    let together = within(most, || points(&blocks));
    if let Some(together) = together {
        let mut alone = (Vec::new(), Vec::new());
        for block in &blocks {
            if let Some((keys, colours)) = points(&[*block]) {
                alone.0.extend(keys);
                alone.1.extend(colours);
            }
        }
        assert!(alone == together, "a block depends on others");
    }
    let drawn = within(most, || decoder.gaussians(&scene, &Wanted::Blocks(blocks)));
    match drawn {
        Ok(drawn) => drawn.content.check_lengths().expect("as many of each"),
        Err(error) => faulty(&error),
    }
}

fn faulty(error: &Error) {
    match error {
        Error::Block { source, .. } => check(source),
        error => check(error),
    }
}

/// The same scene, each entry of its index as its block has it.
fn sealed(bytes: &[u8]) -> Option<Vec<u8>> {
    let header = Header::parse_scene(bytes, &limits()).ok()?;
    let mut blocks = parse_index(bytes, &header, &limits()).ok()?;
    let first = blocks.first()?.offset as usize;
    for block in &mut blocks {
        let start = usize::try_from(block.offset).ok()?;
        let content = bytes.get(start..start.checked_add(block.bytes as usize)?)?;
        if let Ok(entry) = BlockEntry::of(block.cube, content)
            && entry.voxels.len() == block.voxels.len()
        {
            *block = entry;
        }
    }
    let mut sealed = write_index(&header, &blocks).ok()?;
    sealed.extend(bytes.get(first..)?);
    Some(sealed)
}
