//! One grid for several clouds, such as the frames of a sequence.

use rayon::prelude::*;

use super::voxelise::{finite_bounds, fit, fitted_key, mean};
use super::{Coordinates, PointCloud, voxelise_closed};
use crate::error::{Error, Result};
use crate::geometry::{Voxels, morton};
use crate::placement::Placement;

use super::ColouredVoxels;

/// What one cloud asks of a common grid.
#[derive(Debug, Clone, PartialEq)]
pub struct GridNeed {
    low: [f64; 3],
    high: [f64; 3],
    /// Coordinates are voxels from 0 on, and where the voxels lie if the cloud says so.
    integer: Option<Option<Placement>>,
}

/// A grid that several clouds share.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CommonGrid {
    /// The grid of level 21 in coordinates of the clouds.
    from: Placement,
    placement: Placement,
    bits: u8,
}

impl GridNeed {
    /// What `cloud` asks for.
    ///
    /// # Errors
    /// Those of [`voxelise`](super::voxelise) for a cloud without points or bounds.
    pub fn of(cloud: &PointCloud) -> Result<Self> {
        let (low, high) = finite_bounds(&cloud.positions)?;
        let side = f64::from(1u32 << morton::MAX_DEPTH);
        let is_voxel = |x: &f64| x.fract() == 0.0 && (0.0..side).contains(x);
        let integer = cloud.hints.coordinates != Coordinates::World
            && cloud.positions.par_iter().all(|position| position.iter().all(is_voxel));
        Ok(GridNeed {
            low,
            high,
            integer: integer.then_some(cloud.hints.placement),
        })
    }
}

impl CommonGrid {
    /// The grid of clouds with these needs. Without `bits`, its depth is that on which the surfaces of `first` are
    /// closed ([`voxelise_closed`]). Whole coordinates stay voxels if all clouds have them; else the box around all
    /// clouds spans the cube.
    ///
    /// # Errors
    /// [`Error::Usage`] if there are no clouds or the bit depth is not 1 to 21, and those of [`voxelise_closed`].
    pub fn new(first: &PointCloud, needs: &[GridNeed], bits: Option<u8>) -> Result<Self> {
        let Some(one) = needs.first() else {
            return Err(Error::Usage("a grid needs at least one cloud".into()));
        };
        let closed = || Ok(voxelise_closed(first)?.0.voxels.depth());
        let bits = bits.map_or_else(closed, Ok)?;
        if !(1..=morton::MAX_DEPTH).contains(&bits) {
            return Err(Error::Usage(format!("the bit depth is 1 to 21, not {bits}")));
        }
        let bound = |side: fn(&GridNeed) -> [f64; 3], pick: fn(f64, f64) -> f64| {
            let all = needs.iter().map(side);
            all.reduce(|a, b| [0, 1, 2].map(|i| pick(a[i], b[i])))
                .unwrap_or_default()
        };
        let (low, high) = (bound(|need| need.low, f64::min), bound(|need| need.high, f64::max));
        match one
            .integer
            .filter(|_| needs.iter().all(|need| need.integer == one.integer))
        {
            Some(placement) => Ok(Self::of_voxels(placement.unwrap_or(Placement::VOXEL_GRID), high, bits)),
            None => {
                let from = fit(low, high, morton::MAX_DEPTH);
                let placement = coarser(from, morton::MAX_DEPTH - bits);
                Ok(CommonGrid { from, placement, bits })
            }
        }
    }

    /// The grid of whole coordinates up to `high`, of which the lowest bits are dropped until they fit.
    fn of_voxels(placement: Placement, high: [f64; 3], bits: u8) -> Self {
        let largest = high.iter().fold(0.0f64, |a, b| a.max(*b)) as u32;
        let needed = (u32::BITS - largest.leading_zeros()) as u8;
        let dropped = needed.saturating_sub(bits);
        // Level 21 is `MAX_DEPTH − bits` below the grid's own.
        let scale = f64::from(1u32 << dropped) / f64::from(1u32 << (morton::MAX_DEPTH - bits));
        let from = Placement {
            origin: [0.0; 3],
            voxel_size: scale,
        };
        CommonGrid {
            from,
            placement: coarser(placement, dropped),
            bits,
        }
    }

    /// Bit depth.
    pub fn bits(&self) -> u8 {
        self.bits
    }

    /// The voxels of a cloud on the grid. Points outside of it go to its border.
    ///
    /// # Errors
    /// [`Error::Usage`] if colours and points differ in number; those of [`GridNeed::of`].
    pub fn voxelise(&self, cloud: &PointCloud) -> Result<ColouredVoxels> {
        let points = self.points(cloud)?;
        let (mut keys, mut colours) = (Vec::new(), Vec::new());
        for same in points.chunk_by(|a, b| a.0 == b.0) {
            keys.push(same[0].0);
            colours.push(mean(same));
        }
        Ok(ColouredVoxels {
            voxels: Voxels::from_sorted(self.bits, keys),
            colours,
            placement: self.placement,
        })
    }

    /// The key of the voxel that each point of a cloud lies in, and its colour, ascending. Points outside of the grid go
    /// to its border.
    ///
    /// # Errors
    /// Those of [`CommonGrid::voxelise`].
    pub fn points(&self, cloud: &PointCloud) -> Result<Vec<(u64, [u8; 3])>> {
        finite_bounds(&cloud.positions)?;
        if cloud.positions.len() != cloud.colours.len() {
            let (points, colours) = (cloud.positions.len(), cloud.colours.len());
            return Err(Error::Usage(format!("{points} points have {colours} colours")));
        }
        let down = 3 * (morton::MAX_DEPTH - self.bits);
        let pairs = cloud.positions.par_iter().zip(&cloud.colours);
        let mut points: Vec<_> = pairs
            .map(|(p, colour)| (fitted_key(p, &self.from) >> down, *colour))
            .collect();
        points.par_sort_unstable_by_key(|point| point.0);
        Ok(points)
    }

    /// Where the grid lies.
    pub fn placement(&self) -> Placement {
        self.placement
    }
}

/// The placement of the grid `levels` above.
fn coarser(placement: Placement, levels: u8) -> Placement {
    Placement {
        voxel_size: placement.voxel_size * f64::from(1u32 << levels),
        ..placement
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud(positions: &[[f64; 3]]) -> PointCloud {
        PointCloud {
            positions: positions.to_vec(),
            colours: vec![[10, 20, 30]; positions.len()],
            ..PointCloud::default()
        }
    }

    fn grid(clouds: &[PointCloud], bits: u8) -> CommonGrid {
        let needs: Vec<_> = clouds
            .iter()
            .map(|cloud| GridNeed::of(cloud).expect("points"))
            .collect();
        CommonGrid::new(&clouds[0], &needs, Some(bits)).expect("a grid")
    }

    #[test]
    fn whole_coordinates_stay_voxels_of_every_cloud() {
        let clouds = [cloud(&[[1.0, 2.0, 3.0]]), cloud(&[[60.0, 0.0, 5.0]])];
        let grid = grid(&clouds, 6);
        for cloud in &clouds {
            let voxels = grid.voxelise(cloud).expect("voxels");
            assert_eq!(voxels.voxels.coordinate(0).map(f64::from), cloud.positions[0]);
            assert_eq!(voxels.placement, Placement::VOXEL_GRID);
        }
    }

    #[test]
    fn too_large_coordinates_lose_the_same_bits_in_every_cloud() {
        let clouds = [cloud(&[[1.0, 2.0, 3.0]]), cloud(&[[250.0, 0.0, 5.0]])];
        let grid = grid(&clouds, 7);
        let first = grid.voxelise(&clouds[0]).expect("voxels");
        assert_eq!(first.voxels.coordinate(0), [0, 1, 1]);
        assert_eq!(first.placement.voxel_size, 2.0);
    }

    #[test]
    fn the_box_around_all_clouds_spans_the_cube() {
        let clouds = [cloud(&[[0.5, 0.0, 0.0]]), cloud(&[[2.5, 1.0, 0.25]])];
        let grid = grid(&clouds, 8);
        let places = clouds
            .each_ref()
            .map(|cloud| grid.voxelise(cloud).expect("voxels").voxels.coordinate(0));
        assert_eq!([places[0][0], places[1][0]], [0, 255]);
    }
}
