//! Photographs projected onto a surface along the three axes, blended by the normal.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::error::{LabError, Result};
use crate::mesh::Texture;
use crate::surface::Pyramid;

/// A photograph laid over a surface.
#[derive(Debug, Clone)]
pub struct Photograph {
    /// The picture.
    pub pyramid: Arc<Pyramid>,
    /// Height of one repetition in the surface's units.
    pub period: f32,
    /// Width of one repetition over its height.
    pub aspect: f32,
    /// Shift of the picture, in repetitions, per axis of projection.
    pub offset: [[f32; 2]; 3],
    /// Whether the surface's own texture darkens the photograph, as an occlusion map does.
    pub shaded: bool,
}

impl Photograph {
    /// Red, green and blue, 0 to 255, at a position (and its neighbours on the picture) with this normal.
    pub fn colour(&self, at: [[f32; 3]; 3], normal: [f32; 3]) -> [f32; 3] {
        // The fourth power keeps the zones where two projections blend, and blur each other, narrow.
        let weight = normal.map(|n| n * n * n * n);
        let total: f32 = weight.iter().sum();
        let mut colour = [0.0; 3];
        for (axis, weight) in weight.into_iter().enumerate() {
            let w = weight / total;
            // A weight this small changes no 8-bit value.
            if w < 0.001 {
                continue;
            }
            let [here, right, down] = at.map(|p| self.coordinates(axis, p));
            let sample = self.pyramid.filtered(here, right, down);
            for (sum, value) in colour.iter_mut().zip(sample) {
                *sum += w * value;
            }
        }
        colour.map(|c| c.clamp(0.0, 255.0))
    }

    /// The photograph on a surface that moved by so much.
    pub fn translated(mut self, by: [f32; 3]) -> Self {
        self.offset = std::array::from_fn(|axis| self.coordinates(axis, by.map(|x| -x)));
        self
    }

    fn coordinates(&self, axis: usize, [x, y, z]: [f32; 3]) -> [f32; 2] {
        let (right, up) = match axis {
            0 => (z, y),
            1 => (x, z),
            _ => (x, y),
        };
        [
            right / (self.period * self.aspect) + self.offset[axis][0],
            self.offset[axis][1] - up / self.period,
        ]
    }
}

/// Reads all photographs (JPEG, PNG) of a folder, in the order of their names.
///
/// # Errors
/// If the folder or a picture cannot be read.
pub fn load_folder(folder: &Path) -> Result<Vec<(Arc<Pyramid>, f32)>> {
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(LabError::io(folder))? {
        let path: PathBuf = entry.map_err(LabError::io(folder))?.path();
        let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("");
        if ["jpg", "jpeg", "png"].contains(&extension) {
            paths.push(path);
        }
    }
    paths.sort();
    paths
        .iter()
        .map(|path| {
            let picture = image::open(path).map_err(|source| LabError::Picture {
                path: path.clone(),
                source,
            })?;
            let texture = Texture::from(picture);
            let aspect = texture.width as f32 / texture.height as f32;
            Ok((Arc::new(Pyramid::new(&texture)), aspect))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::fixtures::texture;

    fn photograph() -> Photograph {
        Photograph {
            pyramid: Arc::new(Pyramid::new(&texture(8, 4, |x, y| {
                [(x * 30) as u8, (y * 60) as u8, 0, 255]
            }))),
            period: 4.0,
            aspect: 2.0,
            offset: [[0.0; 2]; 3],
            shaded: false,
        }
    }

    #[test]
    fn a_wall_that_faces_an_axis_shows_the_picture_upright_and_undistorted() {
        let photograph = photograph();
        // One texel is one unit of length; the picture's top is up.
        let at = |x: f32, y: f32| photograph.colour([[x, y, 7.0]; 3], [0.0, 0.0, 1.0]);
        assert_eq!(at(2.5, -1.5), [60.0, 60.0, 0.0]);
        assert_eq!(at(3.5, -2.5), [90.0, 120.0, 0.0]);
        let side = photograph.colour([[7.0, -1.5, 2.5]; 3], [-1.0, 0.0, 0.0]);
        assert_eq!(side, [60.0, 60.0, 0.0]);
    }

    #[test]
    fn between_two_axes_both_projections_count_alike() {
        let photograph = photograph();
        let place = [[2.5, -1.5, 3.5]; 3];
        let (x, z) = (
            photograph.colour(place, [1.0, 0.0, 0.0]),
            photograph.colour(place, [0.0, 0.0, 1.0]),
        );
        let between = photograph.colour(place, [0.5f32.sqrt(), 0.0, 0.5f32.sqrt()]);
        for i in 0..3 {
            assert!((between[i] - (x[i] + z[i]) / 2.0).abs() < 1e-3);
        }
    }
}
