//! What a stream says of the colours that its heads generate: filters, and what is left after them.

use std::fmt;
use std::num::NonZeroU8;

use super::colours::{self, CHUNK};
use super::pooled;
use crate::cloud::ColouredVoxels;
use crate::error::Result;
use crate::gaussians::Heads;
use crate::gaussians::{Frame, Gaussians};
use crate::geometry::{KernelMap, Octree};
use crate::latents::network::Model;
use crate::latents::{ColourFilter, ColourResidual, ResidualSteps, Steps, Surroundings, activate};

/// How many times as much a decibel of what is wide is worth: pictures from afar and up close show it, where what is
/// narrow blurs or is too fine to trouble.
const WIDE: usize = 6;

/// The bit of Morton keys from which on voxels eight of their own apart join.
const BOUNDARY: u8 = 9;

/// How much is coded of what the colours of a level that is drawn are off those of the cloud: see [`ColourResidual`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Residual {
    /// Nothing.
    None,
    /// What is at least eight of its voxels wide and so shows as blotches from close up: where
    /// [`filter`](super::Options::filter) is on, and it is worth its bytes.
    #[default]
    Coarse,
    /// All of it, in these steps.
    Fine(Steps),
}

impl Residual {
    /// What is wide is told in these steps, if not more finely.
    pub const COARSE: Steps = Steps { luma: 32, chroma: 24 };

    pub(super) fn precision(self, filter: bool) -> Option<ResidualSteps> {
        let finer = |own: u8, coarse: u8| if own == 0 { coarse } else { own.min(coarse) };
        let (fine, coarse) = match self {
            Residual::Fine(fine) => {
                let luma = finer(fine.luma, Self::COARSE.luma);
                let chroma = finer(fine.chroma, Self::COARSE.chroma);
                (fine, Steps { luma, chroma })
            }
            Residual::Coarse if filter => (Steps::NONE, Self::COARSE),
            Residual::Coarse | Residual::None => return None,
        };
        Some(ResidualSteps {
            fine,
            coarse,
            boundary: BOUNDARY,
        })
    }
}

impl fmt::Display for Residual {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Residual::None => f.write_str("no residual"),
            Residual::Coarse => f.write_str("residual coarse"),
            Residual::Fine(steps) => {
                write!(f, "residual in steps of {}", steps.luma)?;
                match NonZeroU8::new(steps.luma).map(Steps::from) == Some(*steps) {
                    true => Ok(()),
                    false => write!(f, ",{}", steps.chroma),
                }
            }
        }
    }
}

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
    pub left: Option<Left>,
}

/// The filters that are worth it, and what is left for a residual, if one is wanted.
///
/// # Errors
/// Those of generating Gaussians and of drawing them.
pub(super) fn corrections(
    cloud: &ColouredVoxels,
    model: &Model,
    filter: bool,
    residual: bool,
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
    let mut kept = None;
    for heads in Heads::ALL {
        let keep = residual && heads == Heads::Best;
        if shape.head(at.role, heads).is_none() || !filter && !keep {
            continue;
        }
        let raw = model.generate_with(heads, at.role, at.features, map)?;
        let voxels = at.octree.level(at.level);
        let mut gaussians = activate(&raw, voxels, at.children, shape, Frame::default());
        drop(raw);
        if filter {
            let above = at.role.checked_sub(1).map(|role| &at.maps[role]);
            let around = Surroundings::of_level(&gaussians, at.octree, at.level, map, above);
            let filter = colours::fit(&gaussians, &around, &wanted, drawn, at.latents)?;
            if let (Some(filter), true) = (&filter, keep) {
                filter.apply(&mut gaussians, &around);
            }
            found.filters.extend(filter.map(|filter| (heads, filter)));
        }
        if keep {
            kept = Some(Gaussians {
                opacity: gaussians.opacity,
                colour: gaussians.colour,
                ..Gaussians::default()
            });
        }
    }
    found.left = kept.map(|gaussians| Left {
        level: at.level,
        children: at.children,
        gaussians,
        wanted,
        latents: at.latents,
    });
    Ok(found)
}

/// What a residual is of: the colours that are drawn of a level, with its filter, and those of the cloud.
pub(crate) struct Left {
    pub level: u8,
    /// Gaussians of each voxel.
    children: usize,
    /// Their opacities and colours.
    gaussians: Gaussians,
    /// What their colours should be.
    wanted: Vec<[f32; 3]>,
    /// Bytes of latents up to here.
    latents: usize,
}

impl Left {
    /// The payloads of a residual as finely told as this, for the voxels `keys` in slices; `None` if it has nothing
    /// fine and is not worth its bytes.
    pub fn payloads(&self, keys: &[u64], slice: usize, precision: ResidualSteps) -> Option<Vec<Vec<u8>>> {
        let before = missing(&self.gaussians, &self.wanted, self.children);
        let residual = ColourResidual::of(&before, keys, slice, precision);
        let payloads = residual.to_payloads(keys);
        if precision.fine != Steps::NONE {
            return Some(payloads);
        }
        let mut gaussians = self.gaussians.clone();
        residual.apply(&mut gaussians, keys);
        let after = missing(&gaussians, &self.wanted, self.children);
        let squares = [&before, &after].map(|missing| squares(missing));
        let bytes = payloads.iter().map(|payload| CHUNK + payload.len()).sum();
        colours::worth(squares, bytes, WIDE * self.latents).then_some(payloads)
    }
}

/// What the colours of each voxel's Gaussians are short of, on average, by opacity.
fn missing(gaussians: &Gaussians, wanted: &[[f32; 3]], children: usize) -> Vec<[f32; 3]> {
    let voxel = |first: usize| {
        let (mut sum, mut weights) = ([0.0; 3], 0.0);
        let own = first..first + children;
        let colours = gaussians.colour[own.clone()].iter().zip(&wanted[own.clone()]);
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

fn squares(missing: &[[f32; 3]]) -> f64 {
    let values = missing.as_flattened().iter();
    values.map(|&x| f64::from(x).powi(2)).sum()
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
