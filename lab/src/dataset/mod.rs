//! Training sets: crops of voxelised objects with ground-truth pictures of exactly that part of the mesh.
//!
//! Sample `i` of a seed is always the same, whatever the thread count and however many samples are made.
//!
//! Each sample is a safetensors file, `NAME.safetensors`, with `n_R` voxels at role R (3 is the finest level, 0 the
//! coarsest) and V pictures of S × S pixels:
//!
//! | tensor | type and shape | contents |
//! |---|---|---|
//! | `xyz.R`, R = 0…3 | i32 `[n_R, 3]` | voxel coordinates at the role's level, relative to the crop's origin; Morton order |
//! | `parent.R`, R = 1…3 | i32 `[n_R]` | index into `xyz.(R−1)` |
//! | `rgb` | u8 `[n_3, 3]` | sRGB colours of the finest voxels |
//! | `camera` | f32 `[V, 16]` | rotation to the camera row-major (9), translation (3), fx, fy, cx, cy, for `camera = R·p + t` with `p` in finest voxels; voxel `v` covers `[v, v + 1]` |
//! | `image` | u8 `[V, S, S, 4]` | sRGB premultiplied by coverage, and coverage |
//!
//! The metadata has `name`, `bits` (the depth of the cloud that the crop was cut from) and `size` (S).

mod crop;
mod variant;
mod views;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

pub use crop::Crop;
pub use variant::Kind;

use crate::error::{LabError, Result};
use crate::mesh::{Mesh, glb};
use crate::procedural;
use crate::random::Random;
use crate::raster::{self, Clip};
use crate::sample::{Grid, Sampler, VoxelBox, write_bytes};
use crate::surface::{Pyramid, Surface};

/// What to make.
#[derive(Debug, Clone)]
pub struct Options {
    /// How many samples.
    pub count: usize,
    /// Everything random follows from it.
    pub seed: u64,
    /// Bit depth of the clouds that crops are cut from, where the object is not sampled to fit a single crop.
    pub bits: u8,
    /// Side of a crop in finest voxels; a power of two, at least 16 and at most `2^bits`.
    pub crop: u32,
    /// Pictures per sample.
    pub views: usize,
    /// Pixels per side of a picture.
    pub size: u32,
    /// Samples per pixel and axis.
    pub supersampling: u32,
    /// The share of clouds with noise on their points and fewer of them, as captures have; pictures show the exact
    /// surface.
    pub noisy: f64,
}

/// A mesh to cut samples from.
#[derive(Debug)]
pub struct Object {
    /// The file's name without its extension.
    pub name: String,
    kind: Kind,
    surface: Surface,
}

impl Object {
    /// Prepares a mesh; the name tells its kind.
    pub fn new(name: String, mesh: &Mesh) -> Self {
        Object {
            kind: Kind::of(&name),
            surface: Surface::new(mesh),
            name,
        }
    }

    /// Reads mesh files, and all `.glb` files of folders, in the order of their paths.
    ///
    /// # Errors
    /// If a file or folder cannot be read.
    pub fn load_all(inputs: &[PathBuf]) -> Result<Vec<Self>> {
        let mut paths = Vec::new();
        for input in inputs {
            if input.is_dir() {
                for entry in std::fs::read_dir(input).map_err(LabError::io(input))? {
                    let path = entry.map_err(LabError::io(input))?.path();
                    if path.extension().is_some_and(|e| e == "glb") {
                        paths.push(path);
                    }
                }
            } else {
                paths.push(input.clone());
            }
        }
        paths.sort();
        paths.par_iter().map(|path| Object::load(path)).collect()
    }

    /// Objects of the project's own making.
    pub fn procedural(seed: u64) -> Vec<Self> {
        procedural::objects(seed)
            .into_par_iter()
            .map(|(name, mesh)| Object::new(format!("procedural_{name}"), &mesh))
            .collect()
    }

    fn load(path: &Path) -> Result<Self> {
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        Ok(Object::new(name.into_owned(), &glb::load(path)?))
    }
}

/// A photograph and its width over its height.
pub type Photo = (Arc<Pyramid>, f32);

/// Writes `options.count` samples into `folder`; calls `progress` after each.
///
/// Returns how many were written: an index is left out if no crop of its objects has a sensible number of voxels.
///
/// # Errors
/// If there are no objects, or a file cannot be written.
pub fn write(
    folder: &Path,
    objects: &[Object],
    photos: &[Photo],
    options: &Options,
    progress: impl Fn() + Sync,
) -> Result<usize> {
    if objects.is_empty() {
        return Err(LabError::Usage("no meshes to cut samples from".into()));
    }
    let sides = 16..=1u32 << options.bits.min(b2p::geometry::morton::MAX_DEPTH);
    if !options.crop.is_power_of_two() || !sides.contains(&options.crop) {
        return Err(LabError::Usage(format!(
            "crop is {}, expected a power of two from 16 to {}",
            options.crop,
            sides.end()
        )));
    }
    std::fs::create_dir_all(folder).map_err(LabError::io(folder))?;
    let written = AtomicUsize::new(0);
    (0..options.count).into_par_iter().try_for_each(|index| {
        if let Some((name, bytes)) = sample(objects, photos, options, index)? {
            write_bytes(&folder.join(format!("{name}.safetensors")), &bytes)?;
            written.fetch_add(1, Ordering::Relaxed);
        }
        progress();
        Ok::<(), LabError>(())
    })?;
    Ok(written.into_inner())
}

/// Tries with one object before the next one is tried.
const TRIES_PER_OBJECT: usize = 8;
/// Objects tried before a sample is left out.
const OBJECTS_TRIED: usize = 4;

/// Makes sample `index`: its name and its file.
fn sample(objects: &[Object], photos: &[Photo], options: &Options, index: usize) -> Result<Option<(String, Vec<u8>)>> {
    let mut random = Random::new(options.seed).fork(index as u64);
    for attempt in 0..TRIES_PER_OBJECT * OBJECTS_TRIED {
        let object = &objects[turn(objects, options.seed, index, attempt / TRIES_PER_OBJECT)];
        let variant = variant::Variant::random(object.kind, options, !photos.is_empty(), &mut random);
        let (surface, grid) = variant.apply(&object.surface, photos, &mut random)?;
        let sampler = Sampler::new(&surface, grid, variant.points, random.bits())?.with_noise(variant.noise);
        let only = crop::place(&sampler, &grid, variant.points, options.crop, &mut random);
        let cloud = sampler.cloud(Some(only));
        if !crop::is_sensible(cloud.keys.len(), options.crop) {
            continue;
        }
        let crop = Crop::new(&cloud, only.low);
        let local = surface.translated(only.low.map(|x| -(x as f32)));
        // A crop that is the whole cube has nothing to cut off, not even by rounding.
        let whole = 1 << grid.bits == options.crop;
        let clip = (!whole).then_some(Clip {
            low: [0.0; 3],
            high: [options.crop as f32; 3],
        });
        let views = views::random(&crop, options, &mut random);
        let pictures: Vec<Vec<[u8; 4]>> = views
            .iter()
            .map(|view| {
                let size = [options.size; 2];
                raster::render(&local, view, size, options.supersampling, clip).to_rgba8()
            })
            .collect();
        let name = format!("{index:05}_{}", object.name);
        let bytes = crop.to_safetensors(&name, grid.bits, &views, &pictures, options.size);
        return Ok(Some((name, bytes)));
    }
    Ok(None)
}

/// Which object sample `index` takes after `skipped` others: rounds through all objects in random order, people twice a
/// round.
fn turn(objects: &[Object], seed: u64, index: usize, skipped: usize) -> usize {
    let mut order: Vec<usize> = (0..objects.len())
        .flat_map(|i| std::iter::repeat_n(i, objects[i].kind.weight()))
        .collect();
    let round = (index / order.len()) as u64;
    let place = (index + skipped * 7) % order.len();
    Random::new(seed ^ 0x6f_7264_6572).fork(round).shuffle(&mut order);
    order[place]
}

/// The whole cube as a box.
fn whole(grid: &Grid) -> VoxelBox {
    VoxelBox {
        low: [0; 3],
        high: [1 << grid.bits; 3],
    }
}

#[cfg(test)]
mod tests;
