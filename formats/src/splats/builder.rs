//! Rows of a file to Gaussians.

use b2p::gaussians::{Frame, Gaussians, Harmonics};
use b2p::{Limits, Result};

use super::rows::Row;

/// Collects rows in world units.
pub(super) struct Builder {
    gaussians: Gaussians,
    positions: Vec<[f64; 3]>,
    /// Added to all coordinates.
    pub offset: [f64; 3],
    /// Trained for rendering with opacity compensation.
    pub compensated: bool,
}

impl Builder {
    /// Reserves memory for `count` rows with so many coefficients of view-dependent colour each.
    pub fn new(count: u64, harmonics: usize, limits: &Limits) -> Result<Self> {
        check(count, harmonics, limits)?;
        let count = count as usize;
        let mut gaussians = Gaussians::default();
        gaussians.position.reserve_exact(count);
        gaussians.scale.reserve_exact(count);
        gaussians.rotation.reserve_exact(count);
        gaussians.opacity.reserve_exact(count);
        gaussians.colour.reserve_exact(count);
        gaussians.harmonics = Harmonics {
            count: harmonics,
            coefficients: Vec::with_capacity(count * harmonics),
        };
        Ok(Builder {
            gaussians,
            positions: Vec::with_capacity(count),
            offset: [0.0; 3],
            compensated: false,
        })
    }

    pub fn push(&mut self, row: Row) {
        self.positions.push(row.position);
        self.gaussians.scale.push(row.scale.map(|s| s as f32));
        self.gaussians.rotation.push(row.rotation.map(|q| q as f32));
        self.gaussians.opacity.push(row.opacity as f32);
        self.gaussians.colour.push(row.colour.map(|c| c as f32));
    }

    pub fn push_coefficients(&mut self, coefficients: impl IntoIterator<Item = [f64; 3]>) {
        let coefficients = coefficients.into_iter().map(|c| c.map(|x| x as f32));
        self.gaussians.harmonics.coefficients.extend(coefficients);
    }

    /// The Gaussians in the cube `frame`, or in one that is fitted to their centres.
    pub fn finish(self, frame: Option<Frame>) -> Gaussians {
        let mut gaussians = self.gaussians;
        let world = |p: &[f64; 3]| std::array::from_fn(|k| p[k] + self.offset[k]);
        let frame = frame.unwrap_or_else(|| Frame::fitted(self.positions.iter().map(world)));
        let to_cube = |p: &[f64; 3]| frame.placement.to_cube(frame.bits, world(p));
        gaussians.position.extend(self.positions.iter().map(to_cube));
        let unit = frame.unit();
        for scale in gaussians.scale.as_flattened_mut() {
            *scale = (f64::from(*scale) / unit) as f32;
        }
        gaussians.frame = frame;
        gaussians.compensated = self.compensated;
        gaussians
    }
}

/// Holds the counts of a file against the limits.
pub(super) fn check(count: u64, harmonics: usize, limits: &Limits) -> Result<()> {
    limits.check_points("Gaussians of the file", count)?;
    let each = size_of::<[f32; 14]>() + size_of::<[f64; 3]>() + size_of::<[f32; 3]>() * harmonics;
    limits.check_bytes("bytes of the Gaussians", count.saturating_mul(each as u64))
}
