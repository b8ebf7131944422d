//! Clouds of any size: objects placed many times at random poses, written object by object.

use std::fs::File;
use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::path::Path;

use b2p::geometry::morton;

use crate::error::{LabError, Result};
use crate::random::Random;
use crate::sample::{Grid, Sampler};
use crate::surface::Surface;

/// Points of an object of 2¹⁰ voxels a side, as the evaluation samples objects.
const POINTS: f64 = 15e6;
/// The share of its cell that an object's longest side spans.
const FILL: f64 = 0.9;
/// Digits of the number of points in the file's header: it is known when all are written.
const DIGITS: usize = 12;

/// How objects are placed: one in each cell of a square floor, the last cells empty.
#[derive(Debug, Clone, Copy)]
pub struct Options {
    /// Objects.
    pub count: u32,
    /// A cell has 2^this voxels a side.
    pub bits: u8,
    /// Share of the usual number of samples.
    pub density: f64,
    /// Which poses.
    pub seed: u64,
}

/// Writes the cloud of `count` objects, by turns those of `surfaces`, as PLY with whole coordinates in Morton order of
/// each object. Returns the number of points and the bit depth.
///
/// # Errors
/// If there are no objects, one has no extent, the floor is too large for a grid, or the file cannot be written.
pub fn write(path: &Path, surfaces: &[Surface], options: &Options) -> Result<(u64, u8)> {
    if surfaces.is_empty() || options.count == 0 {
        return Err(LabError::Usage("a scene needs at least one object".into()));
    }
    let side = f64::from(options.count).sqrt().ceil() as u32;
    let bits = options.bits + (side.next_power_of_two().trailing_zeros() as u8);
    if bits > morton::MAX_DEPTH {
        return Err(LabError::Usage(format!("{bits} bits are too many for a grid")));
    }
    let failed = |source| LabError::io(path)(source);
    let mut file = BufWriter::new(File::create(path).map_err(failed)?);
    let (before, after) = header(bits);
    let zeros = [b' '; DIGITS];
    [before.as_bytes(), &zeros, after.as_bytes()]
        .iter()
        .try_for_each(|part| file.write_all(part))
        .map_err(failed)?;
    let random = Random::new(options.seed);
    let mut points = 0u64;
    for object in 0..options.count {
        let mut random = random.fork(object.into());
        let surface = &surfaces[object as usize % surfaces.len()];
        let voxels = placed(surface, options, &mut random)?;
        let cell = [object % side, 0, object / side].map(|at| at << options.bits);
        for (key, rgb) in voxels.keys.iter().zip(&voxels.rgb) {
            let at = morton::decode(*key);
            let mut row = [0; 15];
            for axis in 0..3 {
                let x = (at[axis] + cell[axis]) as f32;
                row[4 * axis..4 * axis + 4].copy_from_slice(&x.to_le_bytes());
            }
            row[12..].copy_from_slice(rgb);
            file.write_all(&row).map_err(failed)?;
        }
        points += voxels.keys.len() as u64;
    }
    file.seek(SeekFrom::Start(before.len() as u64)).map_err(failed)?;
    file.write_all(format!("{points:<DIGITS$}").as_bytes())
        .map_err(failed)?;
    file.flush().map_err(failed)?;
    Ok((points, bits))
}

/// The header before and after the number of points.
fn header(bits: u8) -> (String, String) {
    let before = format!("ply\nformat binary_little_endian 1.0\ncomment bits {bits}\nelement vertex ");
    let after = "\nproperty float x\nproperty float y\nproperty float z\n\
                 property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
    (before, after.into())
}

/// An object turned at random, in a cell of its own.
fn placed(surface: &Surface, options: &Options, random: &mut Random) -> Result<crate::sample::Sampled> {
    let turn = glam::DQuat::from_array(std::array::from_fn(|_| random.normal())).normalize();
    let turned = surface.map(|p| (turn * glam::Vec3::from(p).as_dvec3()).as_vec3().into());
    let grid = Grid::fit(turned.bounds(), options.bits, FILL * random.range(0.7, 1.0))?;
    let share = 4f64.powi(i32::from(options.bits) - 10);
    let points = (POINTS * share * options.density).max(1.0) as u64;
    Ok(Sampler::new(&turned, grid, points, random.bits())?.cloud(None))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::procedural;
    use b2p::{Limits, PointCloud};

    #[test]
    fn objects_lie_in_cells_of_their_own_and_the_header_counts_them() {
        let surface = Surface::new(&procedural::scene());
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.ply");
        let options = Options {
            count: 5,
            bits: 5,
            density: 1.0,
            seed: 3,
        };
        let (points, bits) = write(&path, &[surface], &options).unwrap();
        let cloud = PointCloud::open(&path, &Limits::default()).unwrap();
        assert_eq!(
            (cloud.positions.len() as u64, bits, cloud.hints.bits),
            (points, 7, Some(7))
        );
        let mut cells: Vec<[u32; 3]> = cloud.positions.iter().map(|p| p.map(|x| x as u32 >> 5)).collect();
        cells.sort_unstable();
        cells.dedup();
        assert_eq!(cells, [[0, 0, 0], [0, 0, 1], [1, 0, 0], [1, 0, 1], [2, 0, 0]]);
    }
}
