//! How much thicker Gaussians must be for the outline of the cloud's own surfels (`docs/format.md`, clause 7.5.5).
//!
//! Surfels of a cloud overlap, and together reach a little beyond the surface that its points sample. Learned heads end at
//! that surface. Thicker Gaussians reach farther at the outline, and look the same elsewhere.

use b2p_kernels::Isa;

use crate::container::Stream;
use crate::decoder::Decoding;
use crate::error::Result;
use crate::gaussians::{Gaussians, HeadMap, HeadSet};
use crate::limits::Limits;

use super::reference::{Errors, VIEWS, Views};

/// Distances in 128ths of a voxel that the search goes by, one after the other.
const STRIDES: [i32; 3] = [16, 8, 4];
/// Gaussians that are thicker are round.
const MOST: i32 = 64;

/// The map with the thicknesses at which the level that was decoded looks most like the cloud as surfels with the same
/// blur: drawn by the best heads, and as surfels.
pub fn of_level(
    isa: Isa,
    map: HeadMap,
    cloud: &mut Gaussians,
    decoding: &mut Decoding<'_>,
    level: u8,
) -> Result<HeadMap> {
    let mut views = Views::of_level(isa, level);
    let mut thickness = [0; 2];
    for (thickness, heads) in thickness.iter_mut().zip([HeadSet::Best, HeadSet::Surfels]) {
        decoding.set_heads(heads)?;
        let mut drawn = decoding.gaussians()?;
        let usual = drawn.scale.clone();
        cloud.blur = drawn.blur;
        let pictures = views.first(VIEWS.len(), cloud)?;
        *thickness = least(|thickness| {
            drawn.scale.clone_from(&usual);
            let [by, _] = map.clone().with_thickness([thickness; 2]).thickness_at(level);
            drawn.thicken(by);
            views.errors(&pictures, &drawn)
        })?;
    }
    Ok(map.with_thickness(thickness))
}

/// The levels of a stream that state how thick Gaussians are, and what they state.
pub fn of_stream(bytes: &[u8]) -> Result<Vec<(u8, [u8; 2])>> {
    let stream = Stream::parse(bytes, &Limits::unlimited())?;
    let stated = stream.levels().iter().filter_map(|level| {
        let map = level.colours.as_ref()?.head_map?;
        Some((level.level, HeadMap::thickness_of(map.voxels)))
    });
    Ok(stated.filter(|(_, thickness)| *thickness != [0; 2]).collect())
}

/// The thickness that leaves the least errors. Whole pictures and the foreground count alike.
fn least(mut errors: impl FnMut(u8) -> Result<Errors>) -> Result<u8> {
    let [whole, foreground] = errors(0)?.map(|sum| sum.max(1e-12));
    let (mut best, mut least) = (0i32, 2.0);
    for stride in STRIDES {
        let from = best;
        for step in [stride, -stride] {
            let mut at = from + step;
            while (1..=MOST).contains(&at) {
                let errors = errors(at as u8)?;
                let total = errors[0] / whole + errors[1] / foreground;
                if total >= least {
                    break;
                }
                (best, least) = (at, total);
                at += step;
            }
        }
    }
    Ok(best as u8)
}
