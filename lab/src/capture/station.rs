//! One place that an instrument looks from: what it sees, and a photograph with its own exposure.

use image::codecs::jpeg::{JpegDecoder, JpegEncoder};
use image::{DynamicImage, ExtendedColorType, ImageEncoder};

use crate::random::Random;
use crate::raster::{self, Hit, View};
use crate::surface::{Face, Surface};

/// Samples per pixel and axis of photographs.
const SAMPLES: u32 = 2;
/// What is behind the object in photographs. Pixels at the object's edges take some of it.
const BACKDROP: [f32; 3] = [0.55; 3];
/// Range of the gain that a photograph's exposure makes, in natural logarithms, and of each channel's white balance.
const EXPOSURE: f64 = 0.08;
const WHITE_BALANCE: f64 = 0.02;
/// Quality of the photograph's JPEG.
const JPEG_QUALITY: [u64; 2] = [70, 92];

/// A camera with its photograph and the first surface along each pixel's ray.
pub struct Station {
    pub view: View,
    pub size: [u32; 2],
    hits: Vec<Option<Hit>>,
    photograph: Vec<[f32; 3]>,
}

/// Where a ray meets the surface.
#[derive(Debug, Clone, Copy)]
pub struct Return {
    /// Distance along the view's axis.
    pub depth: f64,
    /// Cosine of the angle between ray and surface normal, 0 to 1.
    pub cosine: f64,
    /// Unit normal of the triangle, towards the camera.
    pub normal: glam::DVec3,
}

impl Station {
    /// Looks from `view`.
    pub fn new(surface: &Surface, view: View, size: [u32; 2], random: &mut Random) -> Self {
        let drawn = raster::render(surface, &view, size, SAMPLES, None).over(BACKDROP);
        let gain = random.range(-EXPOSURE, EXPOSURE);
        let gains = [0; 3].map(|_| (gain + random.range(-WHITE_BALANCE, WHITE_BALANCE)).exp() as f32);
        let quality = JPEG_QUALITY[0] + random.below(JPEG_QUALITY[1] - JPEG_QUALITY[0]);
        let exposed = drawn.iter().map(|p| [0, 1, 2].map(|c| p[c] * gains[c]));
        Station {
            hits: raster::trace(surface, &view, size),
            photograph: through_jpeg(exposed, size, quality as u8),
            view,
            size,
        }
    }

    /// The first surface along the ray through the centre of a pixel; none outside of the picture.
    pub fn hit(&self, x: i64, y: i64) -> Option<Hit> {
        self.index(x, y).and_then(|i| self.hits[i])
    }

    fn index(&self, x: i64, y: i64) -> Option<usize> {
        let [w, h] = self.size.map(i64::from);
        ((0..w).contains(&x) && (0..h).contains(&y)).then_some((y * w + x) as usize)
    }

    /// Pixels that see the surface.
    pub fn covered(&self) -> usize {
        self.hits.iter().flatten().count()
    }

    /// Where the ray through any place on the picture meets the plane of the triangle that its pixel sees.
    pub fn trace(&self, surface: &Surface, at: [f64; 2]) -> Option<Return> {
        let Hit { face, depth } = self.hit(at[0].floor() as i64, at[1].floor() as i64)?;
        let ray = self.direction(at);
        let normal = normal(surface, face)?;
        let facing = normal.dot(ray);
        let corner = glam::Vec3::from(surface.corners(face)[0]).as_dvec3();
        let exact = (corner - self.eye()).dot(normal) / facing;
        // At grazing angles the plane may be far away at the pixel's other end.
        let depth = if (exact / depth - 1.0).abs() < 0.002 {
            exact
        } else {
            depth
        };
        Some(Return {
            depth,
            cosine: (facing / ray.length()).abs().min(1.0),
            normal: if facing > 0.0 { -normal } else { normal },
        })
    }

    /// The place at a depth on the ray through a place on the picture.
    pub fn place(&self, at: [f64; 2], depth: f64) -> glam::DVec3 {
        self.eye() + depth * self.direction(at)
    }

    /// Where the camera is.
    pub fn eye(&self) -> glam::DVec3 {
        -(self.turn().transpose() * glam::DVec3::from(self.view.translation))
    }

    /// Direction of a ray, of length 1 along the view's axis.
    pub fn direction(&self, at: [f64; 2]) -> glam::DVec3 {
        let View { focal, centre, .. } = self.view;
        let local = glam::DVec3::new((at[0] - centre[0]) / focal[0], (at[1] - centre[1]) / focal[1], 1.0);
        self.turn().transpose() * local
    }

    fn turn(&self) -> glam::DMat3 {
        let rows = self.view.rotation.map(glam::DVec3::from);
        glam::DMat3::from_cols(rows[0], rows[1], rows[2]).transpose()
    }

    /// The photograph's colour at a place on the picture, bilinear, 0 to 1.
    pub fn colour(&self, at: [f64; 2]) -> [f32; 3] {
        let [x, y] = at.map(|v| v - 0.5);
        let (fx, fy) = ((x - x.floor()) as f32, (y - y.floor()) as f32);
        let pixel = |dx: i64, dy: i64| {
            let [w, h] = self.size.map(i64::from);
            let (x, y) = (
                (x.floor() as i64 + dx).clamp(0, w - 1),
                (y.floor() as i64 + dy).clamp(0, h - 1),
            );
            self.photograph[(y * w + x) as usize]
        };
        let (a, b, c, d) = (pixel(0, 0), pixel(1, 0), pixel(0, 1), pixel(1, 1));
        std::array::from_fn(|i| {
            let top = a[i] + (b[i] - a[i]) * fx;
            let bottom = c[i] + (d[i] - c[i]) * fx;
            top + (bottom - top) * fy
        })
    }

    /// How much the photograph's brightness changes from a pixel to the next, 0 to 1.
    pub fn texture(&self, x: i64, y: i64) -> f64 {
        let luma = |dx, dy| {
            let [r, g, b] = self.colour([(x + dx) as f64 + 0.5, (y + dy) as f64 + 0.5]);
            f64::from(r + g + g + b) / 4.0
        };
        let (across, down) = (luma(1, 0) - luma(-1, 0), luma(0, 1) - luma(0, -1));
        0.5 * (across * across + down * down).sqrt()
    }

    /// Whether this camera sees a place, within a depth tolerance.
    pub fn sees(&self, place: glam::DVec3, tolerance: f64) -> bool {
        let local = self.view.to_camera(place.to_array());
        if local[2] <= self.view.near {
            return false;
        }
        let [x, y] = self.view.to_pixel(local);
        self.hit(x.floor() as i64, y.floor() as i64)
            .is_some_and(|hit| (hit.depth - local[2]).abs() < tolerance)
    }
}

fn normal(surface: &Surface, face: Face) -> Option<glam::DVec3> {
    let [a, b, c] = surface.corners(face).map(|p| glam::Vec3::from(p).as_dvec3());
    (b - a).cross(c - a).try_normalize()
}

/// What is left of a picture after a JPEG.
fn through_jpeg(pixels: impl Iterator<Item = [f32; 3]>, size: [u32; 2], quality: u8) -> Vec<[f32; 3]> {
    let bytes: Vec<u8> = pixels.flatten().map(|v| (v * 255.0).round() as u8).collect();
    let mut file = Vec::new();
    let written = JpegEncoder::new_with_quality(&mut file, quality).write_image(
        &bytes,
        size[0],
        size[1],
        ExtendedColorType::Rgb8,
    );
    let read = written.and_then(|()| DynamicImage::from_decoder(JpegDecoder::new(std::io::Cursor::new(&file))?));
    let picture = read.map_or(bytes, |picture| picture.to_rgb8().into_raw());
    let colour = |p: &[u8]| [p[0], p[1], p[2]].map(|v| f32::from(v) / 255.0);
    picture.chunks_exact(3).map(colour).collect()
}
