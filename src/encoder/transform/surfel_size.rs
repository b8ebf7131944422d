//! How wide surfels should be at the two finest levels, which learned heads draw alone otherwise.
//!
//! Level N − 1 is compared with the cloud's surfels. At level N, surfels of the cloud would tell no more than their own size,
//! and the best heads make more of the exact cloud than surfels of any size: the size is taken whose pictures are nearest
//! to theirs.

use b2p_kernels::Isa;

use crate::cloud::ColouredVoxels;
use crate::decoder::{Decoder, Decoding};
use crate::error::Result;
use crate::gaussians::learned::{HeadsModel, LevelInput};
use crate::gaussians::{Gaussians, HeadMap, HeadSet, Heads};
use crate::geometry::Octree;
use crate::renderer::Image;

use super::reference::{Views, frame, maps};

/// Sizes to choose from, in 64ths of the usual radius.
pub const SIZES: [u8; 3] = [54, 64, 74];
/// So many of the views are compared: two sides of an object ask for the same size as four.
const VIEWS: usize = 2;
/// Rows that heads work on at a time.
const ROWS: usize = 1 << 16;

/// Pictures of a cloud as the best heads draw it, if they do.
pub fn pictures(isa: Isa, cloud: &ColouredVoxels, heads: &HeadsModel) -> Result<Option<Vec<Image>>> {
    let level = cloud.voxels.depth();
    let gaussians = with_heads(isa, cloud, heads)?;
    gaussians
        .map(|gaussians| Views::of_level(isa, level).first(VIEWS, &gaussians))
        .transpose()
}

/// A cloud as the best heads draw it. `None` if it has no level but the root, or the model no best heads.
pub fn with_heads(isa: Isa, cloud: &ColouredVoxels, heads: &HeadsModel) -> Result<Option<Gaussians>> {
    let best = heads.sets().filter(|set| set.0 == Heads::Best);
    let Some(best) = best.min_by_key(|set| set.1) else {
        return Ok(None);
    };
    let (octree, Some(above), map) = maps(cloud)? else {
        return Ok(None);
    };
    let level = octree.depth();
    let input = LevelInput {
        octree: &octree,
        level,
        map: &map,
        above: &above,
        colours: &cloud.colours,
        colours_above: &Decoder::colours_above(&octree, level, &cloud.colours),
        luma_step: 1.0,
        without: None,
        range: None,
    };
    let (precision, rows) = (Default::default(), (ROWS, true));
    let gaussians = heads.generate_in_parts(isa, precision, best, input, frame(cloud), rows, &mut |_| Ok(()))?;
    Ok(Some(gaussians))
}

/// The map of the level that was decoded: it tells the size of surfels with which it looks most like these pictures, and
/// leaves all voxels to the heads that are asked for.
pub fn of_level(
    isa: Isa,
    octree: &Octree,
    pictures: &[Image],
    decoding: &mut Decoding<'_>,
    level: u8,
) -> Result<HeadMap> {
    decoding.set_heads(HeadSet::Surfels)?;
    let mut surfels = decoding.gaussians()?;
    let usual = surfels.scale.clone();
    let mut views = Views::of_level(isa, level);
    let mut errors = [[0.0; 2]; SIZES.len()];
    for (errors, size) in errors.iter_mut().zip(SIZES) {
        scale(&mut surfels, &usual, f32::from(size) / 64.0);
        *errors = views.errors(&pictures[..VIEWS], &surfels)?;
    }
    // Whole pictures and the foreground count alike.
    let [whole, foreground] = errors[0].map(|sum: f64| sum.max(1e-12));
    let total = |i: usize| errors[i][0] / whole + errors[i][1] / foreground;
    let best = (0..SIZES.len()).min_by(|a, b| total(*a).total_cmp(&total(*b)));
    let size = SIZES[best.unwrap_or(1)];
    Ok(HeadMap::new(
        size,
        size,
        vec![false; HeadMap::block_count(octree, level)],
    ))
}

/// Sets the radii of surfels to a multiple of the usual ones.
pub fn scale(surfels: &mut Gaussians, usual: &[[f32; 3]], factor: f32) {
    for (scale, [a, b, c]) in surfels.scale.iter_mut().zip(usual) {
        *scale = [a * factor, b * factor, *c];
    }
}
