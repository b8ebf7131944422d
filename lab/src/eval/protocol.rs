//! The views that everything is judged by.
//!
//! Twelve cameras on a circle around the cube's centre, 30° apart, at its height, three cube-frame units away, with a
//! field of view of 45°. Methods are drawn at 1024² on white and averaged 2×2 to 512², then rounded to 8 bits. The
//! truth is the mesh itself, unlit, at 512² with 4×4 samples a pixel. The foreground is where the mesh covers more than
//! half of a pixel.

use b2p::Gaussians;
use b2p::renderer::camera::Camera;
use b2p::renderer::{Image, Renderer};
use rayon::prelude::*;
use serde::Serialize;

use super::metrics::{self, Ssimulacra2};
use super::picture::Picture;
use crate::error::{LabError, Result};
use crate::raster::{self, View};
use crate::surface::Surface;

/// How many cameras there are.
pub const VIEWS: usize = 12;
/// Pixels across and down the pictures that are compared.
pub const SIDE: u32 = 512;
/// Samples across and down a pixel of the truth.
const SAMPLES: u32 = 4;

/// Pixels around the foreground that belong to its extent.
const MARGIN: usize = 8;

/// What a method scored, each the mean over the views.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Scores {
    /// PSNR in dB over whole pictures.
    pub psnr: f64,
    /// PSNR in dB over the foreground.
    pub foreground_psnr: f64,
    /// Multi-scale structural similarity.
    pub ms_ssim: f64,
    /// SSIMULACRA2.
    pub ssimulacra2: f64,
}

/// A method's pictures and their scores, view by view.
#[derive(Debug, Clone)]
pub struct Judged {
    /// The pictures.
    pub pictures: Vec<Picture>,
    /// What each scored.
    pub views: Vec<Scores>,
    /// Their means.
    pub mean: Scores,
}

/// The truth from every camera.
pub struct Truth {
    views: Vec<TrueView>,
}

/// The truth from one camera.
pub(super) struct TrueView {
    pub camera: Camera,
    pub picture: Picture,
    /// The pixels of which the surface covers more than half.
    pub foreground: Vec<bool>,
    pub ssimulacra2: Ssimulacra2,
}

impl Truth {
    /// Draws a surface that is in the cube frame, from [`VIEWS`] cameras.
    ///
    /// # Errors
    /// [`LabError::Usage`] if no camera sees any of it.
    pub fn new(surface: &Surface) -> Result<Self> {
        Truth::from_first(VIEWS, surface)
    }

    /// The truth from the first `count` cameras alone.
    ///
    /// # Errors
    /// As [`Truth::new`].
    pub fn from_first(count: usize, surface: &Surface) -> Result<Self> {
        let views: Vec<TrueView> = (0..count.min(VIEWS))
            .map(|i| TrueView::new(surface, i))
            .collect::<Result<_>>()?;
        if !views.iter().any(|v| v.foreground.contains(&true)) {
            return Err(LabError::Usage(
                "no camera of the protocol sees the mesh: is it the cloud's?".into(),
            ));
        }
        Ok(Truth { views })
    }

    /// The truth's pictures.
    pub fn pictures(&self) -> impl Iterator<Item = &Picture> {
        self.views.iter().map(|v| &v.picture)
    }

    /// The smallest rectangle that holds the foreground of every view and a little around it: first column, first row,
    /// width, height.
    pub fn extent(&self) -> [usize; 4] {
        let side = SIDE as usize;
        let (mut low, mut high) = ([side; 2], [0; 2]);
        for view in &self.views {
            for (i, _) in view.foreground.iter().enumerate().filter(|(_, f)| **f) {
                for (k, v) in [i % side, i / side].into_iter().enumerate() {
                    low[k] = low[k].min(v);
                    high[k] = high[k].max(v + 1);
                }
            }
        }
        let low = low.map(|v| v.saturating_sub(MARGIN));
        let high = high.map(|v| (v + MARGIN).min(side));
        [low[0], low[1], high[0] - low[0], high[1] - low[1]]
    }

    /// Judges what `draw` makes of every camera, at 1024²; views are drawn side by side.
    ///
    /// # Errors
    /// What `draw` fails with.
    pub fn judge(&self, draw: impl Fn(&Camera) -> Result<Image> + Sync) -> Result<Judged> {
        let judged: Vec<(Picture, Scores)> = self
            .views
            .par_iter()
            .map(|view| {
                let picture = Picture::from(&draw(&view.camera)?.box_half());
                let scores = view.compare(&picture)?;
                Ok((picture, scores))
            })
            .collect::<Result<_>>()?;
        let (pictures, views): (Vec<_>, Vec<_>) = judged.into_iter().unzip();
        let mean = Scores::mean(&views);
        Ok(Judged { pictures, views, mean })
    }

    /// Judges Gaussians, drawn by `b2p`'s renderer.
    ///
    /// # Errors
    /// If they cannot be drawn.
    pub fn judge_gaussians(&self, gaussians: &Gaussians) -> Result<Judged> {
        self.judge(|camera| Ok(Renderer::new().render(gaussians, camera)?))
    }
}

impl TrueView {
    fn new(surface: &Surface, index: usize) -> Result<Self> {
        let azimuth = 360.0 * index as f64 / VIEWS as f64;
        TrueView::from_camera(surface, Camera::orbit(azimuth, 0.0, 3.0, 45.0, 2 * SIDE, 2 * SIDE)?)
    }

    /// The truth from a camera of 1024² pixels.
    pub fn from_camera(surface: &Surface, camera: Camera) -> Result<Self> {
        let rotation = camera.pose.matrix3.transpose();
        let half = View {
            rotation: [rotation.x_axis, rotation.y_axis, rotation.z_axis].map(|r| r.to_array()),
            translation: camera.pose.translation.to_array(),
            focal: [camera.fx / 2.0, camera.fy / 2.0],
            centre: [camera.cx / 2.0, camera.cy / 2.0],
            near: camera.near,
        };
        let drawn = raster::render(surface, &half, [SIDE; 2], SAMPLES, None);
        let side = SIDE as usize;
        let picture = Picture::quantise(side, side, drawn.over([1.0; 3]).into_iter());
        let foreground = drawn.rgba.iter().map(|p| p[3] > 0.5).collect();
        let ssimulacra2 = Ssimulacra2::new(&picture).map_err(metric_failed)?;
        Ok(TrueView {
            camera,
            picture,
            foreground,
            ssimulacra2,
        })
    }

    fn compare(&self, picture: &Picture) -> Result<Scores> {
        let small = || LabError::Usage("the pictures are too small for MS-SSIM".into());
        Ok(Scores {
            psnr: metrics::psnr(&self.picture, picture),
            foreground_psnr: metrics::masked_psnr(&self.picture, picture, &self.foreground),
            ms_ssim: metrics::ms_ssim(&self.picture, picture).ok_or_else(small)?,
            ssimulacra2: self.ssimulacra2.score(picture).map_err(metric_failed)?,
        })
    }
}

fn metric_failed(error: fast_ssim2::Ssimulacra2Error) -> LabError {
    LabError::Usage(format!("SSIMULACRA2 failed: {error}"))
}

impl Scores {
    fn mean(views: &[Scores]) -> Scores {
        let of = |f: fn(&Scores) -> f64| views.iter().map(f).sum::<f64>() / views.len() as f64;
        Scores {
            psnr: of(|s| s.psnr),
            foreground_psnr: of(|s| s.foreground_psnr),
            ms_ssim: of(|s| s.ms_ssim),
            ssimulacra2: of(|s| s.ssimulacra2),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::{Affine3A, Vec3};

    use super::*;
    use crate::eval::points::Points;
    use crate::mesh::Mesh;
    use crate::procedural::patch::Pattern;
    use crate::procedural::shapes;

    /// A ball off the centre whose colour tells directions apart, and points all over it.
    fn ball() -> (Surface, Points) {
        let place = Affine3A::from_translation(Vec3::new(0.3, 0.2, -0.1)) * Affine3A::from_scale(Vec3::splat(0.4));
        let ball = shapes::sphere().placed(place);
        let colour = |p: Vec3| 0.5 + p.clamp(Vec3::splat(-0.5), Vec3::splat(0.5));
        let paint: Pattern = Arc::new(move |s| colour(s.position));
        let mesh = Mesh {
            parts: vec![ball.part(200.0, &paint, None)],
        };
        let grid = || (0..600).flat_map(|i| (0..300).map(move |j| (i as f32 / 600.0, j as f32 / 299.0)));
        let places = || grid().map(|(u, v)| ball.point(u, v));
        let points = Points {
            positions: places().map(|p| p.to_array()).collect(),
            colours: places()
                .map(|p| (colour(p) * 255.0).round().to_array().map(|v| v as u8))
                .collect(),
            spacing: 0.005,
        };
        (Surface::new(&mesh), points)
    }

    #[test]
    fn truth_points_and_gaussians_are_seen_at_the_same_place_from_every_side() {
        let (surface, points) = ball();
        let gaussians = points.to_gaussians(Default::default(), 1.0);
        for index in [0, 4, 9] {
            let view = TrueView::new(&surface, index).unwrap();
            let squares = points.draw_squares(&view.camera, 1.0).box_half();
            let splats = Renderer::new().render(&gaussians, &view.camera).unwrap();
            for image in [squares, splats.box_half()] {
                let scores = view.compare(&Picture::from(&image)).unwrap();
                assert!(scores.psnr > 28.0, "view {index}: {scores:?}");
                assert!(scores.foreground_psnr > 33.0, "view {index}: {scores:?}");
            }
        }
    }

    #[test]
    fn the_foreground_is_what_the_mesh_covers() {
        let (surface, _) = ball();
        let view = TrueView::new(&surface, 0).unwrap();
        let covered = view.foreground.iter().filter(|f| **f).count() as f64;
        let radius = 0.4 / 3.1 * view.camera.fx / 2.0;
        let disc = std::f64::consts::PI * radius * radius;
        assert!((covered / disc - 1.0).abs() < 0.03, "{covered} {disc}");
        let outside = view.picture.rgb.iter().zip(&view.foreground);
        let white = outside.filter(|(p, f)| !**f && **p == [255; 3]).count();
        assert!(white as f64 > 0.98 * (512.0 * 512.0 - covered));
    }
}
