//! What decoding needs, known from the header alone.

use std::ops::Deref;

use crate::colour::LevelColours;
use crate::container::{Header, MAX_TRUNK_VOXELS};
use crate::error::Result;
use crate::latents::Decoder;
use crate::latents::network::{AT_ONCE, Model, RAW};

/// Bytes of a row of a 3³ kernel map arranged for the kernels.
const PLAN: u64 = 100;
/// Bytes of a row of a 3³ kernel map, and of the same arranged.
const MAP: u64 = 27 * 4 + PLAN;
/// Bytes of a voxel in the octree: its key, its occupancy, its first child.
const NODE: u64 = 8 + 1 + 4;
/// Bytes of a Gaussian.
const GAUSSIAN: u64 = 14 * 4;
/// Bytes of a voxel in a colour residual, which any stream may have.
const RESIDUAL: u64 = 3 * 2;
/// Bytes of a voxel and its parent where passes learn: what lies nearby, what surprised, and of a latent its residual.
const NEARBY: u64 = 144;
/// Slices of a stream in memory, over their bytes in the stream.
const SLICES: u64 = 4;

impl<M: Deref<Target = Model> + Clone> Decoder<M> {
    /// Bytes of memory that decoding a stream with this header down to `level` takes at most, its Gaussians included, beyond
    /// [`Limits::OVERHEAD`](crate::Limits::OVERHEAD) and the model itself.
    ///
    /// That is linear in the voxels: with C channels and K latents, 230 + 10·C + 7·K bytes for each voxel of a level, the level above it
    /// with its features, 112 bytes for each Gaussian, 100 + 6·H bytes more for each that a generator of H channels makes at once, 208 + 6·H if it
    /// makes one for each voxel, where a network of B channels predicts the base level 20 + 17·K + 4·B bytes for each of its voxels, where
    /// others correct the levels above it 9 + 3·K for each of the last one's, and where passes learn 144 + 2·K for each of these.
    ///
    /// # Errors
    /// [`crate::Error::Usage`] if the stream has no such level.
    pub fn memory(&self, header: &Header, level: u8) -> Result<u64> {
        let stream = SLICES * header.prefix_bytes(level)?;
        let shape = self.model.shape();
        let (c, k) = (shape.channels as u64, shape.latents as u64);
        let levels = usize::from(level - header.base) + 1;
        let counts = || header.voxels[..levels].iter().copied().map(u64::from);
        let octree = NODE * (counts().sum::<u64>() + u64::from(header.base) * counts().min().unwrap_or(0));
        let features = 2 * (c + k) + MAP + RESIDUAL;
        // Of all levels the last is the largest.
        let parents = counts().nth_back(1).unwrap_or(0);
        let voxels = counts().next_back().unwrap_or(0);
        // Context, four tensors of a block, latents with their means and scales.
        let exact = parents * features + voxels * (MAP + RESIDUAL + 16 + 10 * c + 7 * k);
        let learning = match shape.learning {
            true => NEARBY + 2 * k,
            false => 0,
        };
        let base = match shape.base_bytes() as u64 {
            0 => 0,
            bytes => counts().next().unwrap_or(0) * (bytes + learning),
        };
        // Octants, the order of a pass, its means and scales.
        let near = match shape.corrects_up_to(levels - 1) {
            true => voxels * (9 + 3 * k + learning),
            false => 0,
        };
        let head = shape.head(levels - 1, self.heads).map_or(0, |head| {
            let (h, children) = (head.channels as u64, head.children as u64);
            let (at_once, map) = match children {
                1 => (voxels, MAP),
                _ => (voxels.min(AT_ONCE as u64) * children, PLAN),
            };
            voxels * (6 * h + 2 * c + 40)
                + voxels * children * (4 * RAW as u64 + GAUSSIAN)
                + at_once * (map + 3 * 2 * h)
        });
        Ok(stream + octree + base + exact + near + head)
    }

    /// Fails with [`crate::Error::LimitExceeded`] if decoding down to `level` takes more than is allowed.
    pub(crate) fn check_memory(&self, header: &Header, level: u8) -> Result<()> {
        let bytes = self.memory(header, level)?;
        self.limits.check_bytes("memory to decode this stream", bytes)
    }
}

/// Bytes of a voxel's colours in version 3: decoded, in slices and joined; smoothed energies of its parents; as bytes, filtered and of the level
/// above.
const COLOURS: u64 = 3 * LevelColours::bytes_per_voxel() as u64 + 3 + 3 * 3;
/// Bytes of the sums that surfels are made of.
const SURFEL: u64 = 200;

/// Bytes of memory that decoding the colours of a stream of version 3 with this header down to `level` takes at most, beyond
/// [`Limits::OVERHEAD`](crate::Limits::OVERHEAD).
///
/// That is linear in the voxels, but for what slices of colours learn, one on each thread.
///
/// # Errors
/// [`crate::Error::Usage`] if the stream has no such level.
pub(super) fn transform(header: &Header, level: u8) -> Result<u64> {
    let stream = SLICES * header.prefix_bytes(level)?;
    let levels = usize::from(level - header.base) + 1;
    let counts = || header.voxels[..levels].iter().copied().map(u64::from);
    let base = counts().next().unwrap_or(0);
    // Of the levels above the base level no more is known than that they have no more voxels.
    let above = |most: u64| -> u64 {
        let level = |n: u64| most.min(1 << (3 * n).min(60));
        (0..u64::from(header.base)).map(level).sum()
    };
    let octree = NODE * (counts().sum::<u64>() + above(base));
    let trunk = (MAP - PLAN) * above(base.min(MAX_TRUNK_VOXELS.into()));
    let parents = counts().nth_back(1).unwrap_or(base);
    let voxels = counts().next_back().unwrap_or(0);
    // Of the level and the one above, joined from the slices that threads are at.
    let slices = parents.div_ceil(header.colour_slice().into());
    let learned = 3 + slices.min(rayon::current_num_threads() as u64);
    let colours = (parents + voxels) * (MAP + COLOURS) + learned * LevelColours::model_bytes() as u64;
    Ok(stream + octree + trunk + colours)
}

/// Bytes that making so many surfels of each of so many voxels takes at most, themselves included.
pub(super) fn surfels(voxels: u64, per_voxel: u64) -> u64 {
    voxels * (SURFEL + per_voxel * GAUSSIAN)
}
