//! What decoding needs, known from the header alone: upper bounds as sums of terms.

use crate::colour::LevelColours;
use crate::container::{Header, MAX_TRUNK_VOXELS};
use crate::error::Result;
use crate::gaussians::surfels::{PART, TASK, WALK_BYTES};
use crate::geometry::SiblingMap;
use crate::latents::LatentDecoder;
use crate::latents::network::{AT_ONCE, RAW};
use crate::memory::{NOTHING, Sizes, Term, total};

/// Bytes of a row of a 3³ kernel map, and of the same arranged for the kernels.
const MAP: u64 = 27 * 4;
const PLAN: u64 = 100;
/// Bytes of a Gaussian, and of the network's output for it.
const GAUSSIAN: u64 = 14 * 4;
const OUTPUT: u64 = 4 * RAW as u64;
/// Bytes of a voxel in a colour residual, which any stream of version 2 may have.
const RESIDUAL: u64 = 3 * 2;

const SLICES: Term = Term {
    each: "byte of the stream up to the end of the level",
    takes: "slices in memory",
    fixed: 4,
    by: NOTHING,
};
const OCTREE: Term = Term {
    each: "voxel of all levels",
    takes: "key, occupancy and first child in the octree",
    fixed: 8 + 1 + 4,
    by: NOTHING,
};

// Version 2.

const ABOVE: Term = Term {
    each: "voxel of the level above",
    takes: "kernel map, features, latents, colour residual",
    fixed: MAP + PLAN + RESIDUAL,
    by: Sizes {
        channels: 2,
        latents: 2,
        ..NOTHING
    },
};
const EXACT: Term = Term {
    each: "voxel of the level",
    takes: "kernel map, context, four tensors of a block, latents with means and scales, colour residual",
    fixed: MAP + PLAN + RESIDUAL + 16,
    by: Sizes {
        channels: 10,
        latents: 7,
        ..NOTHING
    },
};
const BASE: Term = Term {
    each: "voxel of the base level, if a network of B channels predicts it",
    takes: "inputs and two hidden layers of that network, means and scales",
    fixed: 20,
    by: Sizes {
        latents: 17,
        base: 4,
        ..NOTHING
    },
};
const BASE_LEARNING: Term = Term {
    each: "the same, if corrections are learned",
    ..LEARNING
};
const NEAR: Term = Term {
    each: "voxel of the level, if a network corrects its prediction or that of a level below",
    takes: "octants, order of a pass, means and scales",
    fixed: 9,
    by: Sizes { latents: 3, ..NOTHING },
};
const NEAR_LEARNING: Term = Term {
    each: "the same, if corrections are learned",
    ..LEARNING
};
const LEARNING: Term = Term {
    each: "",
    takes: "residuals and likelihood gradients of the neighbourhood, residuals of the latents",
    fixed: 144,
    by: Sizes { latents: 2, ..NOTHING },
};
const GENERATOR: Term = Term {
    each: "voxel of the level",
    takes: "features and hidden layers of the generator",
    fixed: 40,
    by: Sizes {
        channels: 2,
        generator: 6,
        ..NOTHING
    },
};
const GAUSSIANS: Term = Term {
    each: "Gaussian",
    takes: "itself and the generator's output",
    fixed: OUTPUT + GAUSSIAN,
    by: NOTHING,
};
const EIGHT: Term = Term {
    each: "Gaussian of a part of at most 131,072 voxels, if each voxel has eight",
    takes: "kernel map and hidden layers",
    fixed: PLAN,
    by: Sizes {
        generator: 6,
        ..NOTHING
    },
};
const ONE: Term = Term {
    each: "Gaussian, if each voxel has one",
    takes: "kernel map and hidden layers",
    fixed: MAP + PLAN,
    by: Sizes {
        generator: 6,
        ..NOTHING
    },
};

// Version 3.

const KEPT: Term = Term {
    each: "voxel of the level and of the level above",
    takes: "neighbours, colours decoded and as bytes",
    fixed: SiblingMap::BYTES_PER_VOXEL + LevelColours::bytes_per_voxel() as u64 + 3,
    by: NOTHING,
};
const WINDOWS: Term = Term {
    each: "voxel of the level above and two levels above",
    takes: "which neighbours its children have",
    fixed: SiblingMap::BYTES_PER_PARENT,
    by: NOTHING,
};
const TRUNK: Term = Term {
    each: "voxel of the levels above the base, at most 65,536 in each, while colours are decoded",
    takes: "neighbours, weight of colours",
    fixed: SiblingMap::BYTES_PER_VOXEL + SiblingMap::BYTES_PER_PARENT + 2,
    by: NOTHING,
};
const KEPT_ABOVE: Term = Term {
    each: "voxel two levels above the level, at the same time",
    takes: "neighbours, colours decoded and as bytes",
    fixed: KEPT.fixed + WINDOWS.fixed,
    by: NOTHING,
};
const TABLE: Term = Term {
    each: "voxel of the level above, while the geometry of the level is decoded",
    takes: "kernel map",
    fixed: MAP,
    by: NOTHING,
};
const CODING: Term = Term {
    each: "voxel of the level, while its colours are decoded",
    takes: "colours in slices",
    fixed: 8 + 6,
    by: NOTHING,
};
const CODING_ABOVE: Term = Term {
    each: "voxel of the level above, at the same time",
    takes: "coefficients, energies in slices and joined",
    fixed: 32 + 3 + 3 + 8,
    by: NOTHING,
};
const FILTERING: Term = Term {
    each: "voxel of the level, while its colours are filtered",
    takes: "colours as a pass reads them, and after it",
    fixed: 16 + 6,
    by: NOTHING,
};
const CONTEXTS: Term = Term {
    each: "slice of colours while it is decoded, at most one on each thread, and 3 more",
    takes: "adaptive contexts",
    fixed: LevelColours::model_bytes() as u64,
    by: NOTHING,
};
const STEPS: Term = Term {
    each: "voxel of the level, before surfels are made all at once",
    takes: "sums of moments, before and after a step",
    fixed: 2 * 32,
    by: NOTHING,
};
const SUMS: Term = Term {
    each: "voxel of the level, while surfels are made all at once",
    takes: "sums of moments",
    fixed: 32,
    by: NOTHING,
};
const WALKS: Term = Term {
    each: "4096 voxels of the level while surfels are made in parts, at most once on each thread",
    takes: "neighbours and sums of moments around them",
    fixed: WALK_BYTES,
    by: NOTHING,
};
const SURFELS: Term = Term {
    each: "surfel",
    takes: "itself",
    fixed: GAUSSIAN,
    by: NOTHING,
};

impl LatentDecoder {
    /// Bytes of memory that decoding a stream with this header down to `level` takes at most, its Gaussians included,
    /// beyond [`Limits::OVERHEAD`](crate::Limits::OVERHEAD) and the model itself.
    ///
    /// `SECURITY.md` shows the terms of the sum.
    ///
    /// # Errors
    /// [`crate::Error::Usage`] if the stream has no such level.
    pub fn memory(&self, header: &Header, level: u8) -> Result<u64> {
        header.voxels(level)?;
        let shape = self.model.shape();
        let levels = usize::from(level - header.base) + 1;
        let head = shape.head(levels - 1, self.heads);
        let sizes = Sizes {
            channels: shape.channels as u64,
            latents: shape.latents as u64,
            generator: head.map_or(0, |head| head.channels as u64),
            base: shape.base_channels as u64,
        };
        let counts = || header.voxels[..levels].iter().copied().map(u64::from);
        // Levels above the base have no more voxels than the level with the fewest.
        let all = counts().sum::<u64>() + u64::from(header.base) * counts().min().unwrap_or(0);
        // Of all levels the last is the largest.
        let parents = counts().nth_back(1).unwrap_or(0);
        let voxels = counts().next_back().unwrap_or(0);
        let only_if = |condition: bool, count: u64| if condition { count } else { 0 };
        let base = only_if(shape.base_channels > 0, counts().next().unwrap_or(0));
        let near = only_if(shape.corrects_up_to(levels - 1), voxels);
        let children = head.map_or(0, |head| head.children as u64);
        let at_a_time = voxels.min(AT_ONCE as u64) * children;
        let terms = [
            (SLICES, header.prefix_bytes(level)?),
            (OCTREE, all),
            (ABOVE, parents),
            (EXACT, voxels),
            (BASE, base),
            (BASE_LEARNING, only_if(shape.learning, base)),
            (NEAR, near),
            (NEAR_LEARNING, only_if(shape.learning, near)),
            (GENERATOR, only_if(children > 0, voxels)),
            (GAUSSIANS, voxels * children),
            (EIGHT, only_if(children > 1, at_a_time)),
            (ONE, only_if(children == 1, voxels)),
        ];
        Ok(total(&terms, sizes))
    }

    /// Fails with [`crate::Error::LimitExceeded`] if decoding down to `level` takes more than is allowed.
    pub(crate) fn check_memory(&self, header: &Header, level: u8) -> Result<()> {
        let bytes = self.memory(header, level)?;
        self.limits.check_bytes("memory to decode this stream", bytes)
    }
}

/// Bytes of memory that decoding a stream of version 3 with this header down to `level` takes at most, and drawing it
/// with so many bytes of `drawing`, beyond [`Limits::OVERHEAD`](crate::Limits::OVERHEAD).
///
/// # Errors
/// [`crate::Error::Usage`] if the stream has no such level.
pub(super) fn transform(header: &Header, level: u8, drawing: u64) -> Result<u64> {
    header.voxels(level)?;
    let levels = usize::from(level - header.base) + 1;
    let counts = || header.voxels[..levels].iter().copied().map(u64::from);
    let base = counts().next().unwrap_or(0);
    // Of the levels above the base level no more is known than that they have no more voxels, nor than there are places.
    let places = |level: u8| 1 << (3 * u64::from(level)).min(60);
    let above = |most: u64| -> u64 { (0..header.base).map(|level| most.min(places(level))).sum() };
    let [grandparents, parents] = [2, 1].map(|up: u8| {
        let unknown = base.min(places(level.saturating_sub(up)));
        counts().nth_back(up.into()).unwrap_or(unknown)
    });
    let voxels = counts().next_back().unwrap_or(0);
    let slices = |nodes: u64| nodes.div_ceil(header.colour_slice().into());
    let threads = rayon::current_num_threads() as u64;
    let terms = [
        (SLICES, header.prefix_bytes(level)?),
        (OCTREE, counts().sum::<u64>() + above(base)),
        (KEPT, parents + voxels),
        (WINDOWS, grandparents + parents),
        (CONTEXTS, 3),
    ];
    let colours = |voxels, parents| {
        let terms = [
            (TRUNK, above(base.min(MAX_TRUNK_VOXELS.into()))),
            (KEPT_ABOVE, grandparents),
            (CONTEXTS, slices(parents).min(threads)),
            (CODING, voxels),
            (CODING_ABOVE, parents),
        ];
        total(&terms, NOTHING)
    };
    // These do not coexist. The geometry of a level is decoded beside the colours of the level above.
    let geometry = colours(parents, grandparents).saturating_add(TABLE.times(parents, NOTHING));
    let filtering = total(&[(FILTERING, voxels)], NOTHING);
    let most = geometry.max(colours(voxels, parents)).max(filtering).max(drawing);
    Ok(total(&terms, NOTHING).saturating_add(most))
}

/// Bytes that making so many surfels of each of so many voxels takes at most, themselves or a part of them included.
pub(super) fn surfels(voxels: u64, per_voxel: u64, in_parts: bool) -> u64 {
    if in_parts {
        let tasks = voxels.div_ceil(TASK as u64).min(rayon::current_num_threads() as u64);
        let surfels = voxels.min(PART as u64).saturating_mul(per_voxel);
        return total(&[(WALKS, tasks), (SURFELS, surfels)], NOTHING);
    }
    let made = total(&[(SUMS, voxels), (SURFELS, voxels.saturating_mul(per_voxel))], NOTHING);
    total(&[(STEPS, voxels)], NOTHING).max(made)
}

#[cfg(test)]
mod tests;
