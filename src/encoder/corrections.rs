//! What a stream says of the colours that its heads generate: filters, and what is left after them.

use super::{Options, colours, pooled};
use crate::cloud::ColouredVoxels;
use crate::error::Result;
use crate::gaussians::{ColourFilter, ColourResidual, Frame, Gaussians, Surroundings, activate};
use crate::geometry::{KernelMap, Octree};
use crate::network::{Heads, Model};

/// A level whose latents are coded, and which is drawn.
pub(crate) struct Level<'a> {
    pub role: usize,
    pub level: u8,
    /// Whether it is the finest of the stream that is drawn.
    pub finest: bool,
    /// Gaussians of each voxel.
    pub children: usize,
    pub octree: &'a Octree,
    pub maps: &'a [KernelMap],
    pub features: &'a [i16],
    /// Bytes of latents up to here.
    pub latents: usize,
}

/// A level's corrections.
#[derive(Default)]
pub(crate) struct Corrections {
    pub filters: Vec<(Heads, ColourFilter)>,
    pub residual: Option<ColourResidual>,
}

/// Those that are worth it, and those that were asked for.
///
/// # Errors
/// Those of generating Gaussians and of drawing them.
pub(super) fn corrections(
    cloud: &ColouredVoxels,
    model: &Model,
    options: &Options,
    at: Level<'_>,
) -> Result<Corrections> {
    let (shape, map) = (model.shape(), &at.maps[at.role]);
    let (_, mut wanted) = pooled(cloud, at.level);
    let mut drawn = at.level;
    if at.children == 8 {
        drawn += 1;
        let finer = pooled(cloud, drawn).1;
        wanted = of_children(&wanted, &finer, at.octree.occupancy(at.level));
    }
    let mut found = Corrections::default();
    for heads in Heads::ALL {
        let left = match heads {
            Heads::Best if at.finest => options.residual,
            _ => None,
        };
        if shape.head(at.role, heads).is_none() || !options.filter && left.is_none() {
            continue;
        }
        let raw = model.generate_with(heads, at.role, at.features, map)?;
        let voxels = at.octree.level(at.level);
        let mut gaussians = activate(&raw, voxels, at.children, shape, Frame::default());
        drop(raw);
        if options.filter {
            let above = at.role.checked_sub(1).map(|role| &at.maps[role]);
            let around = Surroundings::of_level(&gaussians, at.octree, at.level, map, above);
            let filter = colours::fit(&gaussians, &around, &wanted, drawn, at.latents)?;
            if let (Some(filter), Some(_)) = (&filter, left) {
                filter.apply(&mut gaussians, &around);
            }
            found.filters.extend(filter.map(|filter| (heads, filter)));
        }
        if let Some(steps) = left {
            let missing = missing(&gaussians, &wanted, at.children);
            let slice = options.slice_voxels as usize;
            let residual = ColourResidual::of(&missing, voxels.keys(), slice, steps);
            found.residual = Some(residual);
        }
    }
    Ok(found)
}

/// What the colours of each voxel's Gaussians are short of, on average, by opacity.
fn missing(gaussians: &Gaussians, wanted: &[[f32; 3]], children: usize) -> Vec<[f32; 3]> {
    let voxel = |first: usize| {
        let (mut sum, mut weights) = ([0.0; 3], 0.0);
        let own = first..first + children;
        let colours = gaussians.colour[own.clone()]
            .iter()
            .zip(&wanted[own.clone()]);
        for (weight, (own, wanted)) in gaussians.opacity[own].iter().zip(colours) {
            weights += weight;
            for (sum, (own, wanted)) in sum.iter_mut().zip(own.iter().zip(wanted)) {
                *sum += weight * (wanted - own);
            }
        }
        sum.map(|sum| if weights > 0.0 { sum / weights } else { 0.0 })
    };
    (0..wanted.len()).step_by(children).map(voxel).collect()
}

/// The colours of all eight children of each voxel: where there is no such child, the voxel's.
fn of_children(voxels: &[[f32; 3]], children: &[[f32; 3]], occupancy: &[u8]) -> Vec<[f32; 3]> {
    let mut children = children.iter();
    let mut all = Vec::with_capacity(8 * voxels.len());
    for (voxel, mask) in voxels.iter().zip(occupancy) {
        for octant in 0..8 {
            let there = mask >> octant & 1 == 1;
            let child = if there { children.next() } else { None };
            all.push(*child.unwrap_or(voxel));
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_voxel_lacks_is_the_mean_of_its_gaussians_by_opacity() {
        let gaussians = Gaussians {
            opacity: vec![1.0, 0.25, 0.0, 0.0],
            colour: vec![[0.5; 3], [0.0; 3], [0.3; 3], [0.9; 3]],
            ..Gaussians::default()
        };
        let wanted = [[0.5, 0.75, 0.25], [1.0; 3], [0.0; 3], [0.0; 3]];
        assert_eq!(missing(&gaussians, &wanted, 2), [[0.2, 0.4, 0.0], [0.0; 3]]);
    }

    #[test]
    fn missing_children_have_the_colour_of_their_voxel() {
        let all = of_children(&[[0.5; 3]], &[[0.1; 3], [0.2; 3]], &[0b1000_0010]);
        let mut want = vec![[0.5; 3]; 8];
        (want[1], want[7]) = ([0.1; 3], [0.2; 3]);
        assert_eq!(all, want);
    }
}
