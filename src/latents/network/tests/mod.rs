//! The network as a whole: against its definition, against the trainer's, against bad files.

mod definition;
mod files;
mod golden;
mod half;
mod predict;

use b2p_kernels::Isa;

use super::reference::{Rows, Sites};
use super::{Model, Pass};
use crate::geometry::{KernelMap, Octree, Voxels, morton};

/// A cloud of which levels are coded, role 3 being the deepest.
struct Cloud {
    octree: Octree,
    maps: Vec<KernelMap>,
}

impl Cloud {
    /// Takes the voxels of role 3, at level `depth`.
    fn new(depth: u8, voxels: &[[u32; 3]]) -> Self {
        let keys = voxels.iter().map(|v| morton::encode(*v)).collect();
        let octree = Octree::new(Voxels::new(depth, keys)).unwrap();
        let maps = (depth - 3..=depth).map(|level| octree.kernel_map(level)).collect();
        Cloud { octree, maps }
    }

    /// A thin bumpy sheet with holes and a voxel all alone, whose coordinates are below 32.
    fn sheet() -> Self {
        let mut voxels = vec![[31, 31, 0]];
        for x in 0..24u32 {
            for y in 0..24u32 {
                if (x / 3 + y / 5) % 4 != 0 {
                    voxels.push([x, y, 8 + (x * x / 40 + 3 * y / 4) % 15]);
                }
            }
        }
        Cloud::new(5, &voxels)
    }

    fn level(&self, role: usize) -> u8 {
        self.octree.depth() - 3 + role as u8
    }

    fn sites(&self, role: usize) -> Sites {
        let voxels = self.octree.level(self.level(role));
        Sites::new(
            (0..voxels.len())
                .map(|i| voxels.coordinate(i).map(|c| c as i32))
                .collect(),
        )
    }

    /// Which children the voxels of a role have.
    fn occupancy(&self, role: usize) -> &[u8] {
        self.octree.occupancy(self.level(role))
    }

    fn len(&self, role: usize) -> usize {
        self.maps[role].len()
    }

    /// The encoder's features of roles 0, 1, 2.
    fn features(&self, model: &Model, colours: &[[f32; 3]]) -> [Vec<b2p_kernels::f16>; 3] {
        let maps: Vec<&KernelMap> = self.maps.iter().rev().collect();
        let occupancy = [self.occupancy(2), self.occupancy(1), self.occupancy(0)];
        let mut features = model.features(colours, &maps, &occupancy).unwrap();
        features.reverse();
        features.try_into().unwrap()
    }
}

/// By how much the encoder is coarser than f16 with these instructions: tiles hold bf16, of eight significant bits
/// instead of eleven.
fn coarser(isa: Isa) -> f64 {
    if isa.has_tiles() { 8.0 } else { 1.0 }
}

/// The parameters of all voxels of a level that is one slice, pass by pass.
fn all_passes(
    model: &Model,
    role: usize,
    octants: &[u8],
    map: &KernelMap,
    latents: &[i16],
    level: Option<(&[i16], &[u8])>,
) -> (Vec<i16>, Vec<u8>) {
    let k = model.shape().latents;
    let (mut mu, mut sigma) = (vec![0; latents.len()], vec![0; latents.len()]);
    for octant in 0..8 {
        let voxels = 0..map.len() as u32;
        let voxels: Vec<u32> = voxels.filter(|&v| octants[v as usize] == octant).collect();
        let pass = Pass {
            octants,
            map,
            slice: 0..map.len(),
            voxels: &voxels,
            latents,
        };
        let (m, s) = model.pass_parameters(role, &pass, level);
        for (i, &v) in voxels.iter().enumerate() {
            let (from, to) = (i * k..(i + 1) * k, v as usize * k..(v as usize + 1) * k);
            mu[to.clone()].copy_from_slice(&m[from.clone()]);
            sigma[to].copy_from_slice(&s[from]);
        }
    }
    (mu, sigma)
}

/// Rows of `width` numbers.
fn rows<T: Copy + Into<f64>>(values: &[T], width: usize) -> Rows {
    values
        .chunks(width)
        .map(|row| row.iter().map(|&v| v.into()).collect())
        .collect()
}

/// The largest difference, and the largest magnitude of what was to be had.
fn error<T: Copy + Into<f64>>(got: &[T], want: &Rows) -> (f64, f64) {
    let want: Vec<f64> = want.iter().flatten().copied().collect();
    assert_eq!(got.len(), want.len());
    let error = got
        .iter()
        .zip(&want)
        .map(|(&a, b)| (a.into() - b).abs())
        .fold(0.0, f64::max);
    (error, want.iter().fold(0.0, |m, v| v.abs().max(m)))
}
