//! Mesh to cloud: points drawn uniformly by area, averaged per voxel.
//!
//! Point number `j` of a seed is always the same point, whatever thread draws it and whatever others are wanted: a box
//! of the cloud can be sampled alone. Triangles get their share of the points by rounding the running sum of their
//! areas. Colour sums are integers, so their order does not matter.

use std::path::Path;

use b2p::Placement;
use b2p::geometry::morton;
use rayon::prelude::*;

use crate::error::{LabError, Result};
use crate::random::Random;
use crate::surface::{Face, Surface};

/// Where voxels lie in a surface's space: `voxel = floor((p − origin) / unit + shift)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grid {
    /// Voxels per side are `2^bits`.
    pub bits: u8,
    /// Edge of a voxel.
    pub unit: f64,
    /// Lowest corner of the surface's bounding box.
    pub origin: [f64; 3],
    /// Whole voxels between the grid's lowest corner and the bounding box's.
    pub shift: [f64; 3],
}

impl Grid {
    /// The grid in which the longest side of the bounding box spans `fill · 2^bits` voxels and the box is centred.
    ///
    /// # Errors
    /// If `bits` is not in 1..=21, `fill` not in (0, 1], or the box empty.
    pub fn fit([low, high]: [[f64; 3]; 2], bits: u8, fill: f64) -> Result<Self> {
        if !(1..=morton::MAX_DEPTH).contains(&bits) {
            return Err(LabError::Usage(format!("bits is {bits}, expected 1 to 21")));
        }
        if !(fill > 0.0 && fill <= 1.0) {
            return Err(LabError::Usage(format!(
                "fill is {fill}, expected above 0 and at most 1"
            )));
        }
        let extent: [f64; 3] = std::array::from_fn(|i| high[i] - low[i]);
        let longest = extent.iter().copied().fold(0.0, f64::max);
        if !(longest > 0.0 && longest.is_finite()) {
            return Err(LabError::Usage("the mesh has no extent".into()));
        }
        let side = f64::from(1u32 << bits);
        let unit = longest / (fill * side);
        Ok(Grid {
            bits,
            unit,
            origin: low,
            shift: extent.map(|e| ((side - e / unit) / 2.0).floor()),
        })
    }

    /// A grid whose units are the surface's own.
    pub fn unit(bits: u8) -> Self {
        Grid {
            bits,
            unit: 1.0,
            origin: [0.0; 3],
            shift: [0.0; 3],
        }
    }

    /// Where the grid lies in the surface's space.
    pub fn placement(&self) -> Placement {
        Placement {
            origin: std::array::from_fn(|i| self.origin[i] - self.shift[i] * self.unit),
            voxel_size: self.unit,
        }
    }

    /// Continuous voxel coordinates of a point.
    pub fn coordinate(&self, p: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|i| (p[i] - self.origin[i]) / self.unit + self.shift[i])
    }
}

/// A half-open box of voxels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VoxelBox {
    /// The lowest voxel.
    pub low: [u32; 3],
    /// One above the highest, per axis.
    pub high: [u32; 3],
}

/// Voxels and their mean colours.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Sampled {
    /// Morton keys, ascending.
    pub keys: Vec<u64>,
    /// 8-bit sRGB.
    pub rgb: Vec<[u8; 3]>,
}

/// Draws points of a surface.
#[derive(Debug)]
pub struct Sampler<'a> {
    surface: &'a Surface,
    grid: Grid,
    seed: u64,
    /// Standard deviation of the points' places in voxels, per axis.
    noise: f64,
    faces: Vec<Face>,
    /// `ends[i]` points belong to the triangles up to and with `faces[i]`.
    ends: Vec<u64>,
}

/// Points drawn and sorted at a time: few enough for a fast cache.
const CHUNK: u64 = 1 << 15;

/// Parts the random numbers of noise from those of places.
const NOISE: u64 = 0x6e6f_6973_65;

/// Voxel sums of a chunk. Colours have 8 fractional bits.
#[derive(Debug, Clone, Copy)]
struct Sum {
    key: u64,
    rgb: [u32; 3],
    count: u32,
}

impl<'a> Sampler<'a> {
    /// Shares `points` among the triangles.
    ///
    /// # Errors
    /// If the surface has no area.
    pub fn new(surface: &'a Surface, grid: Grid, points: u64, seed: u64) -> Result<Self> {
        let faces: Vec<Face> = surface.faces().collect();
        let areas: Vec<f64> = faces
            .par_iter()
            .map(|&face| {
                let [a, b, c] = corners(surface, face);
                (b - a).cross(c - a).length()
            })
            .collect();
        let total: f64 = areas.iter().sum();
        if !(total > 0.0 && total.is_finite()) {
            return Err(LabError::Usage("the mesh has no area".into()));
        }
        let mut sum = 0.0;
        let mut ends: Vec<u64> = areas
            .iter()
            .map(|area| {
                sum += area;
                ((points as f64 * (sum / total)) as u64).min(points)
            })
            .collect();
        if let Some(last) = ends.last_mut() {
            *last = points;
        }
        Ok(Sampler {
            surface,
            grid,
            seed,
            noise: 0.0,
            faces,
            ends,
        })
    }

    /// With normal noise on the places of points: its standard deviation in voxels along each axis. Points that it
    /// takes out of the grid are left out.
    pub fn with_noise(mut self, deviation: f64) -> Self {
        self.noise = deviation;
        self
    }

    /// Where point `index` is, in continuous voxel coordinates.
    pub fn point(&self, index: u64) -> [f64; 3] {
        let face = self.faces[self.ends.partition_point(|&end| end <= index)];
        let corners = corners(self.surface, face);
        self.place(&corners, self.weights(index), index).to_array()
    }

    /// All voxels that hold a visible point, or those in a box.
    pub fn cloud(&self, only: Option<VoxelBox>) -> Sampled {
        let mut sums: Vec<Sum> = self
            .chunks(only)
            .par_iter()
            .flat_map_iter(|chunk| self.draw(chunk, only))
            .collect();
        sums.par_sort_unstable_by_key(|s| s.key);
        let mut cloud = Sampled::default();
        for group in sums.chunk_by(|a, b| a.key == b.key) {
            let count: u64 = group.iter().map(|s| u64::from(s.count)).sum();
            let mean = |i: usize| {
                let sum: u64 = group.iter().map(|s| u64::from(s.rgb[i])).sum();
                (sum as f64 / (256 * count) as f64).round_ties_even() as u8
            };
            cloud.keys.push(group[0].key);
            cloud.rgb.push([mean(0), mean(1), mean(2)]);
        }
        cloud
    }

    /// Runs of points of at most [`CHUNK`], each on consecutive triangles: face index, first point, end.
    fn chunks(&self, only: Option<VoxelBox>) -> Vec<Vec<(usize, u64, u64)>> {
        let mut chunks = Vec::new();
        let mut chunk = Vec::new();
        let mut room = CHUNK;
        let mut first = 0;
        for (i, &end) in self.ends.iter().enumerate() {
            if self.noise > 0.0 || only.is_none_or(|b| self.may_touch(self.faces[i], b)) {
                while first < end {
                    let take = room.min(end - first);
                    chunk.push((i, first, first + take));
                    first += take;
                    room -= take;
                    if room == 0 {
                        chunks.push(std::mem::take(&mut chunk));
                        room = CHUNK;
                    }
                }
            }
            first = end;
        }
        chunks.push(chunk);
        chunks
    }

    /// Whether a triangle's bounding box meets the box, with a voxel's margin for rounding.
    fn may_touch(&self, face: Face, only: VoxelBox) -> bool {
        let corners = corners(self.surface, face).map(|p| self.grid.coordinate(p.to_array()));
        (0..3).all(|axis| {
            let x = corners.map(|c| c[axis]);
            let low = x.iter().copied().fold(f64::INFINITY, f64::min);
            let high = x.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            high >= f64::from(only.low[axis]) - 1.0 && low <= f64::from(only.high[axis]) + 1.0
        })
    }

    fn draw(&self, chunk: &[(usize, u64, u64)], only: Option<VoxelBox>) -> Vec<Sum> {
        let side = 1u32 << self.grid.bits;
        let mut sums = Vec::new();
        for &(i, first, end) in chunk {
            let face = self.faces[i];
            let corners = corners(self.surface, face);
            for index in first..end {
                let weights = self.weights(index);
                let place = self.place(&corners, weights, index).to_array();
                if self.noise > 0.0 && place.iter().any(|x| !(0.0..f64::from(side)).contains(x)) {
                    continue;
                }
                // Saturates below 0, which rounding may reach.
                let voxel = place.map(|x| (x as u32).min(side - 1));
                let inside = |b: VoxelBox| (0..3).all(|a| (b.low[a]..b.high[a]).contains(&voxel[a]));
                let weights = weights.map(|w| w as f32);
                if !only.is_none_or(inside) || !self.surface.is_opaque(face, weights) {
                    continue;
                }
                let colour = self.surface.colour(face, &[weights; 3]);
                sums.push(Sum {
                    key: morton::encode(voxel),
                    rgb: colour.map(|c| (c.clamp(0.0, 255.0) * 256.0).round() as u32),
                    count: 1,
                });
            }
        }
        sums.sort_unstable_by_key(|s| s.key);
        sums.dedup_by(|next, sum| {
            let same = next.key == sum.key;
            if same {
                sum.count += next.count;
                for (a, b) in sum.rgb.iter_mut().zip(next.rgb) {
                    *a += b;
                }
            }
            same
        });
        sums
    }

    /// Barycentric coordinates of point `index`, uniform over the triangle.
    fn weights(&self, index: u64) -> [f64; 3] {
        let mut random = Random::at(self.seed, 2 * index);
        let (r, s) = (random.unit().sqrt(), random.unit());
        [1.0 - r, r * (1.0 - s), r * s]
    }

    fn place(&self, corners: &[glam::DVec3; 3], weights: [f64; 3], index: u64) -> glam::DVec3 {
        let p = corners[0] * weights[0] + corners[1] * weights[1] + corners[2] * weights[2];
        let place = glam::DVec3::from(self.grid.coordinate(p.to_array()));
        if self.noise == 0.0 {
            return place;
        }
        let mut random = Random::at(self.seed ^ NOISE, 6 * index);
        place + self.noise * glam::DVec3::from_array(std::array::from_fn(|_| random.normal()))
    }
}

fn corners(surface: &Surface, face: Face) -> [glam::DVec3; 3] {
    surface.corners(face).map(|p| glam::Vec3::from(p).as_dvec3())
}

/// Writes a cloud as binary little-endian PLY: float x y z, uchar red green blue, and comments that map it back to the
/// mesh.
///
/// # Errors
/// If the file cannot be written; nothing is left behind then.
pub fn write_ply(path: &Path, cloud: &Sampled, grid: &Grid) -> Result<()> {
    let list = |x: [f64; 3]| format!("{:?} {:?} {:?}", x[0], x[1], x[2]);
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\ncomment bits {}\ncomment unit {:?}\ncomment origin {}\ncomment shift {}\n\
         element vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
        grid.bits,
        grid.unit,
        list(grid.origin),
        list(grid.shift),
        cloud.keys.len()
    )
    .into_bytes();
    bytes.reserve(15 * cloud.keys.len());
    for (&key, rgb) in cloud.keys.iter().zip(&cloud.rgb) {
        for x in morton::decode(key) {
            bytes.extend_from_slice(&(x as f32).to_le_bytes());
        }
        bytes.extend_from_slice(rgb);
    }
    write_bytes(path, &bytes)
}

/// Writes a file whole or not at all.
pub(crate) fn write_bytes(path: &Path, bytes: &[u8]) -> Result<()> {
    b2p::output::write_file(path, |w| {
        w.write_all(bytes).map_err(|source| b2p::Error::Io {
            path: path.to_owned(),
            source,
        })
    })?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::fixtures::{mesh, quad, texture};

    /// A square of 16 × 16 voxels in the plane z = 8.5, red rising along x.
    fn square() -> Surface {
        let red = texture(16, 16, |x, _| [(x * 10) as u8, 20, 30, 255]);
        Surface::new(&mesh(quad(
            [0.0, 0.0, 8.5],
            [16.0, 0.0, 0.0],
            [0.0, 16.0, 0.0],
            Some(red),
        )))
    }

    fn sample(surface: &Surface, only: Option<VoxelBox>) -> Sampled {
        Sampler::new(surface, Grid::unit(4), 50_000, 3).unwrap().cloud(only)
    }

    #[test]
    fn a_square_fills_its_voxels_with_the_textures_colours() {
        let cloud = sample(&square(), None);
        assert_eq!(cloud.keys.len(), 256);
        for (&key, rgb) in cloud.keys.iter().zip(&cloud.rgb) {
            let [x, _, z] = morton::decode(key);
            assert_eq!((z, rgb[1], rgb[2]), (8, 20, 30));
            // At the borders the texture repeats, so the mean leans to the other side's colour.
            if (1..15).contains(&x) {
                assert!(rgb[0].abs_diff(10 * x as u8) <= 1, "{x}: {rgb:?}");
            }
        }
    }

    #[test]
    fn a_box_of_a_cloud_is_what_the_whole_cloud_has_there() {
        let surface = square();
        let only = VoxelBox {
            low: [3, 5, 0],
            high: [9, 16, 16],
        };
        let whole = sample(&surface, None);
        let part = sample(&surface, Some(only));
        let inside = |key: u64| {
            let v = morton::decode(key);
            (0..3).all(|a| (only.low[a]..only.high[a]).contains(&v[a]))
        };
        let expected: Vec<_> = (whole.keys.iter().zip(&whole.rgb))
            .filter(|(k, _)| inside(**k))
            .collect();
        assert_eq!(expected.len(), 6 * 11);
        assert!(expected.into_iter().eq(part.keys.iter().zip(&part.rgb)));
    }

    #[test]
    fn the_number_of_threads_changes_nothing() {
        let surface = square();
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
            pool.build().unwrap().install(|| sample(&surface, None))
        };
        assert_eq!(with(1), with(5));
    }

    #[test]
    fn points_follow_the_area_and_the_seed() {
        // A second quad of a third of the area.
        let mut both = mesh(quad([0.0; 3], [12.0, 0.0, 0.0], [0.0, 1.0, 0.0], None));
        both.parts
            .push(quad([0.0, 8.0, 0.0], [4.0, 0.0, 0.0], [0.0, 1.0, 0.0], None));
        let surface = Surface::new(&both);
        let sampler = Sampler::new(&surface, Grid::unit(4), 40_000, 9).unwrap();
        assert_eq!(sampler.ends[1], 30_000);
        assert!(sampler.point(29_999)[1] < 2.0 && sampler.point(30_000)[1] > 7.0);
        let other = Sampler::new(&surface, Grid::unit(4), 40_000, 10).unwrap();
        assert_ne!(sampler.point(5), other.point(5));
    }

    #[test]
    fn transparent_texels_give_no_voxels() {
        let left = texture(16, 16, |x, _| [255, 255, 255, if x < 8 { 200 } else { 0 }]);
        let surface = Surface::new(&mesh(quad(
            [0.0, 0.0, 8.5],
            [16.0, 0.0, 0.0],
            [0.0, 16.0, 0.0],
            Some(left),
        )));
        let cloud = sample(&surface, None);
        let columns: Vec<u32> = cloud.keys.iter().map(|&k| morton::decode(k)[0]).collect();
        assert!(columns.iter().all(|&x| x < 8), "{columns:?}");
        assert!((0..8).all(|x| columns.contains(&x)));
    }

    #[test]
    fn the_longest_side_spans_the_fill_and_the_box_is_centred() {
        let grid = Grid::fit([[1.0, 2.0, 3.0], [5.0, 4.0, 3.5]], 8, 0.5).unwrap();
        assert_eq!(grid.unit, 4.0 / 128.0);
        assert_eq!(grid.shift, [64.0, 96.0, 120.0]);
        assert_eq!(grid.coordinate([5.0, 2.0, 3.0]), [192.0, 96.0, 120.0]);
    }

    #[test]
    fn noise_has_its_deviation_and_leaves_colours_where_they_were_drawn() {
        let surface = square();
        let exact = Sampler::new(&surface, Grid::unit(4), 20_000, 3).unwrap();
        let noisy = Sampler::new(&surface, Grid::unit(4), 20_000, 3)
            .unwrap()
            .with_noise(0.5);
        let off = |i| noisy.point(i)[2] - exact.point(i)[2];
        let mean = (0..20_000).map(off).sum::<f64>() / 20_000.0;
        let variance = (0..20_000).map(|i| off(i).powi(2)).sum::<f64>() / 20_000.0;
        assert!(mean.abs() < 0.02 && (variance - 0.25).abs() < 0.02, "{mean} {variance}");
        let cloud = noisy.cloud(None);
        assert!(cloud.keys.len() > 256);
        assert!(cloud.rgb.iter().all(|rgb| rgb[1..] == [20, 30]));
    }

    #[test]
    fn nonsense_is_refused() {
        let unit = [[0.0; 3], [1.0; 3]];
        assert!(Grid::fit(unit, 0, 0.9).is_err());
        assert!(Grid::fit(unit, 22, 0.9).is_err());
        assert!(Grid::fit(unit, 10, 1.5).is_err());
        assert!(Grid::fit([[0.0; 3]; 2], 10, 0.9).is_err());
        let flat = Surface::new(&mesh(quad([0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], None)));
        assert!(Sampler::new(&flat, Grid::unit(4), 10, 0).is_err());
    }

    #[test]
    fn the_codec_reads_the_cloud_back_where_the_mesh_was() {
        let surface = square();
        let grid = Grid::fit(surface.bounds(), 5, 0.75).unwrap();
        let cloud = Sampler::new(&surface, grid, 50_000, 3).unwrap().cloud(None);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("square.ply");
        write_ply(&path, &cloud, &grid).unwrap();
        let read = b2p::cloud::PointCloud::open(&path, &b2p::Limits::default()).unwrap();
        let voxels = b2p::cloud::voxelise(&read, None).unwrap();
        assert_eq!(voxels.voxels.depth(), 5);
        assert_eq!(voxels.voxels.keys(), cloud.keys);
        assert_eq!(voxels.colours, cloud.rgb);
        let point = [4.0, 9.0, 8.5];
        let voxel = grid.coordinate(point);
        let placement = voxels.placement;
        for a in 0..3 {
            let world = placement.origin[a] + placement.voxel_size * voxel[a];
            assert!((world - point[a]).abs() < 1e-9);
        }
    }
}
