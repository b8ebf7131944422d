//! Ground-truth pictures of a mesh: a supersampled z-buffer with perspective-correct texture.
//!
//! Triangles are drawn in homogeneous form (Olano and Greer, "Triangle Scan Conversion using 2D Homogeneous
//! Coordinates"): with the corners P as columns and a pixel's ray d = ((x − cx)/fx, (y − cy)/fy, 1), λ = P⁻¹ d are the
//! barycentric coordinates over the depth, so λ ≥ 0 says inside, 1/Σλ is the depth, and no triangle has to be cut at
//! the near plane. Both sides of a triangle are seen. Visibility is settled first, for every sample; then each sample
//! is coloured once.

use rayon::prelude::*;

use crate::surface::{Face, Footprint, Surface};

/// A pinhole camera: x right, y down, z forward; pixel `i` covers `[i, i + 1]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// Rows of the rotation from the surface's space to the camera's.
    pub rotation: [[f64; 3]; 3],
    /// `camera = rotation · p + translation`.
    pub translation: [f64; 3],
    /// Focal lengths in pixels.
    pub focal: [f64; 2],
    /// Principal point in pixels.
    pub centre: [f64; 2],
    /// Nothing nearer than this depth is seen. Positive.
    pub near: f64,
}

impl View {
    /// A camera at `eye` that looks at `target`, with the surface's y up on the picture (z where y is the line of
    /// sight).
    pub fn look_at(eye: [f64; 3], target: [f64; 3], focal: f64, size: [u32; 2]) -> Self {
        let eye = glam::DVec3::from(eye);
        let forward = (glam::DVec3::from(target) - eye).normalize_or(glam::DVec3::NEG_Z);
        let up = if forward.y.abs() > 0.9999 {
            glam::DVec3::Z
        } else {
            glam::DVec3::Y
        };
        let right = forward.cross(up).normalize();
        let down = forward.cross(right);
        let rows = [right, down, forward];
        View {
            rotation: rows.map(|r| r.to_array()),
            translation: rows.map(|r| -r.dot(eye)),
            focal: [focal; 2],
            centre: size.map(|s| f64::from(s) / 2.0),
            near: 1e-3 * (glam::DVec3::from(target) - eye).length(),
        }
    }

    /// Camera coordinates of a point.
    pub fn to_camera(&self, p: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|i| {
            let r = self.rotation[i];
            r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + self.translation[i]
        })
    }

    /// Where on the picture a camera-space point in front of the camera is.
    pub fn to_pixel(&self, [x, y, z]: [f64; 3]) -> [f64; 2] {
        [
            self.focal[0] * x / z + self.centre[0],
            self.focal[1] * y / z + self.centre[1],
        ]
    }
}

/// An axis-aligned box: what lies outside is not drawn. Half-open.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Clip {
    /// Lowest corner.
    pub low: [f32; 3],
    /// Highest corner.
    pub high: [f32; 3],
}

/// A picture, row by row from the top.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
    /// Red, green, blue times coverage, and coverage; each in `[0, 1]`, display-referred (sRGB).
    pub rgba: Vec<[f32; 4]>,
}

impl Picture {
    /// The picture in 8 bits, still premultiplied.
    pub fn to_rgba8(&self) -> Vec<[u8; 4]> {
        let byte = |x: f32| (x * 255.0).round() as u8;
        self.rgba.iter().map(|p| p.map(byte)).collect()
    }

    /// The picture over a background colour.
    pub fn over(&self, background: [f32; 3]) -> Vec<[f32; 3]> {
        self.rgba
            .iter()
            .map(|p| std::array::from_fn(|i| p[i] + (1.0 - p[3]) * background[i]))
            .collect()
    }
}

/// Draws a surface, unlit, with `samples` × `samples` samples a pixel.
pub fn render(surface: &Surface, view: &View, size: [u32; 2], samples: u32, clip: Option<Clip>) -> Picture {
    let [width, height] = size;
    let frame = Frame {
        surface,
        view,
        width: width as usize,
        samples: samples.max(1) as usize,
        extent: size.map(|s| s as usize * samples.max(1) as usize),
        clip,
    };
    let faces: Vec<Face> = surface.faces().collect();
    let setups: Vec<Setup> = faces.par_iter().filter_map(|&f| frame.setup(f)).collect();
    let mut rgba = vec![[0.0; 4]; frame.width * height as usize];
    let bands = (height as usize).div_ceil(BAND);
    let mut members: Vec<Vec<u32>> = vec![Vec::new(); bands];
    let band_samples = BAND * frame.samples;
    for (i, setup) in setups.iter().enumerate() {
        for band in &mut members[setup.y[0] / band_samples..=(setup.y[1] - 1) / band_samples] {
            band.push(i as u32);
        }
    }
    rgba.par_chunks_mut((BAND * frame.width).max(1))
        .zip(&members)
        .enumerate()
        .for_each(|(band, (pixels, members))| {
            frame.draw_band(band * BAND, pixels, &setups, members);
        });
    Picture { width, height, rgba }
}

/// What the ray through a pixel's centre meets first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// The triangle.
    pub face: Face,
    /// Distance along the view's axis.
    pub depth: f64,
}

/// What each pixel sees, row by row from the top: one ray through its centre. Both sides of a triangle are hit.
pub fn trace(surface: &Surface, view: &View, size: [u32; 2]) -> Vec<Option<Hit>> {
    let extent = size.map(|s| s as usize);
    let frame = Frame {
        surface,
        view,
        width: extent[0],
        samples: 1,
        extent,
        clip: None,
    };
    let faces: Vec<Face> = surface.faces().collect();
    let setups: Vec<Setup> = faces.par_iter().filter_map(|&f| frame.setup(f)).collect();
    let mut seen = vec![NOTHING; extent[0] * extent[1]];
    let mut by_row: Vec<Vec<u32>> = vec![Vec::new(); extent[1]];
    for (i, setup) in setups.iter().enumerate() {
        for row in &mut by_row[setup.y[0]..setup.y[1]] {
            row.push(i as u32);
        }
    }
    let rows = seen.par_chunks_mut(extent[0].max(1)).zip(&by_row).enumerate();
    rows.for_each(|(y, (line, members))| {
        for &member in members {
            frame.draw_line(&setups, member, y, line);
        }
    });
    let hit = |s: Sample| Hit {
        face: setups[s.setup as usize].face,
        depth: 1.0 / s.nearness,
    };
    seen.into_iter().map(|s| (s.nearness > 0.0).then(|| hit(s))).collect()
}

/// Rows of pixels drawn together.
const BAND: usize = 8;

struct Frame<'a> {
    surface: &'a Surface,
    view: &'a View,
    width: usize,
    samples: usize,
    /// Samples across and down.
    extent: [usize; 2],
    clip: Option<Clip>,
}

/// A triangle on the picture.
struct Setup {
    face: Face,
    /// Rows of P⁻¹, applied to (x, y, 1) in samples' indices.
    edges: [[f64; 3]; 3],
    /// Samples it may cover: first and end.
    x: [usize; 2],
    y: [usize; 2],
    /// Whether parts of it may lie outside of the clip box, or fail the alpha test.
    tested: bool,
}

impl Setup {
    fn lambda(&self, x: f64, y: f64) -> [f64; 3] {
        self.edges.map(|e| e[0] * x + e[1] * y + e[2])
    }

    fn barycentric(&self, x: f64, y: f64) -> [f32; 3] {
        let lambda = self.lambda(x, y);
        let sum = lambda[0] + lambda[1] + lambda[2];
        lambda.map(|l| (l / sum) as f32)
    }
}

/// What a sample sees so far.
#[derive(Clone, Copy)]
struct Sample {
    /// 1 / depth; 0 is the background.
    nearness: f64,
    setup: u32,
}

const NOTHING: Sample = Sample {
    nearness: 0.0,
    setup: u32::MAX,
};

impl Frame<'_> {
    fn setup(&self, face: Face) -> Option<Setup> {
        let corners = self.surface.corners(face);
        let mut tested = false;
        if let Some(clip) = self.clip {
            let outside = (0..3)
                .any(|a| corners.iter().all(|c| c[a] < clip.low[a]) || corners.iter().all(|c| c[a] >= clip.high[a]));
            if outside {
                return None;
            }
            tested = corners.iter().any(|&c| !clip.contains(c));
        }
        let p = corners.map(|c| self.view.to_camera(c.map(f64::from)));
        let [x, y] = self.bounds(p)?;
        let columns = p.map(glam::DVec3::from);
        let matrix = glam::DMat3::from_cols(columns[0], columns[1], columns[2]);
        let determinant = matrix.determinant();
        if determinant == 0.0 || !determinant.is_finite() {
            return None;
        }
        let inverse = matrix.inverse();
        let scale = 1.0 / self.samples as f64;
        let edges = std::array::from_fn(|i| {
            let row = inverse.row(i);
            let a = row.x / self.view.focal[0];
            let b = row.y / self.view.focal[1];
            let c = row.z - a * self.view.centre[0] - b * self.view.centre[1];
            // Sample k is at (k + ½) / samples pixels.
            [a * scale, b * scale, c + 0.5 * scale * (a + b)]
        });
        Some(Setup {
            face,
            edges,
            x,
            y,
            tested: tested || self.surface.is_masked(face),
        })
    }

    /// The samples in the bounding box of what lies beyond the near plane; none if there are none.
    fn bounds(&self, p: [[f64; 3]; 3]) -> Option<[[usize; 2]; 2]> {
        let near = self.view.near;
        let mut low = [f64::INFINITY; 2];
        let mut high = [f64::NEG_INFINITY; 2];
        let mut grow = |q: [f64; 3]| {
            let pixel = self.view.to_pixel(q);
            for i in 0..2 {
                low[i] = low[i].min(pixel[i]);
                high[i] = high[i].max(pixel[i]);
            }
        };
        for i in 0..3 {
            let (a, b) = (p[i], p[(i + 1) % 3]);
            if a[2] >= near {
                grow(a);
            }
            if (a[2] >= near) != (b[2] >= near) {
                let t = (near - a[2]) / (b[2] - a[2]);
                let cut = [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), near];
                grow(cut);
            }
        }
        let mut ranges = [[0; 2]; 2];
        for i in 0..2 {
            // Rounded outwards: the edges decide; a cast saturates.
            let first = (low[i] * self.samples as f64 - 1.0).floor().max(0.0) as usize;
            let end = (high[i] * self.samples as f64 + 1.0).ceil().max(0.0) as usize;
            let end = end.min(self.extent[i]);
            if first >= end {
                return None;
            }
            ranges[i] = [first, end];
        }
        Some(ranges)
    }

    fn draw_band(&self, row: usize, pixels: &mut [[f32; 4]], setups: &[Setup], members: &[u32]) {
        if pixels.is_empty() {
            return;
        }
        let rows = pixels.len() / self.width;
        let (first, end) = (row * self.samples, (row + rows) * self.samples);
        let across = self.extent[0];
        let mut seen = vec![NOTHING; across * (end - first)];
        for &member in members {
            let setup = &setups[member as usize];
            for y in setup.y[0].max(first)..setup.y[1].min(end) {
                let line = &mut seen[(y - first) * across..][..across];
                self.draw_line(setups, member, y, line);
            }
        }
        let weight = 1.0 / (self.samples * self.samples) as f32;
        for (i, pixel) in pixels.iter_mut().enumerate() {
            let (px, py) = (i % self.width, i / self.width);
            let mut sum = [0.0; 4];
            for y in py * self.samples..(py + 1) * self.samples {
                for x in px * self.samples..(px + 1) * self.samples {
                    let sample = seen[y * across + x];
                    if sample.nearness == 0.0 {
                        continue;
                    }
                    let setup = &setups[sample.setup as usize];
                    let colour = self.shade(setup, x, y + first);
                    for (s, c) in sum.iter_mut().zip(colour) {
                        *s += c;
                    }
                    sum[3] += 1.0;
                }
            }
            let [r, g, b] = [0, 1, 2].map(|i| sum[i] * weight / 255.0);
            *pixel = [r, g, b, sum[3] * weight];
        }
    }

    fn draw_line(&self, setups: &[Setup], member: u32, y: usize, line: &mut [Sample]) {
        let setup = &setups[member as usize];
        let farthest = 1.0 / self.view.near;
        let [first, end] = span(setup, y as f64);
        for (x, seen) in line.iter_mut().enumerate().take(end).skip(first) {
            let lambda = setup.lambda(x as f64, y as f64);
            let nearness = lambda[0] + lambda[1] + lambda[2];
            let inside = lambda.iter().all(|&l| l >= 0.0) && nearness > 0.0 && nearness <= farthest;
            if !inside || nearness < seen.nearness {
                continue;
            }
            if nearness == seen.nearness && !self.precedes(setup, &setups[seen.setup as usize]) {
                continue;
            }
            if setup.tested && !self.passes(setup, lambda.map(|l| (l / nearness) as f32)) {
                continue;
            }
            *seen = Sample {
                nearness,
                setup: member,
            };
        }
    }

    /// Decides between triangles at exactly the same depth by what they are, not by which comes first.
    fn precedes(&self, a: &Setup, b: &Setup) -> bool {
        let identity = |s: &Setup| {
            let bits = self.surface.corners(s.face).map(|c| c.map(f32::to_bits));
            let uvs = self.surface.corner_uvs(s.face);
            (bits, uvs.map(|u| u.map(|c| c.map(f32::to_bits))), s.face.part)
        };
        identity(a) < identity(b)
    }

    fn passes(&self, setup: &Setup, at: [f32; 3]) -> bool {
        if let Some(clip) = self.clip {
            let [a, b, c] = self.surface.corners(setup.face);
            let place = std::array::from_fn(|i| a[i] * at[0] + b[i] * at[1] + c[i] * at[2]);
            if !clip.contains(place) {
                return false;
            }
        }
        self.surface.is_opaque(setup.face, at)
    }

    fn shade(&self, setup: &Setup, x: usize, y: usize) -> [f32; 3] {
        let (x, y) = (x as f64, y as f64);
        let at: Footprint = [
            setup.barycentric(x, y),
            setup.barycentric(x + 1.0, y),
            setup.barycentric(x, y + 1.0),
        ];
        self.surface.colour(setup.face, &at)
    }
}

impl Clip {
    fn contains(&self, p: [f32; 3]) -> bool {
        (0..3).all(|a| self.low[a] <= p[a] && p[a] < self.high[a])
    }
}

/// The part of a line of samples that a triangle may cover: a superset, so that rounding loses nothing.
fn span(setup: &Setup, y: f64) -> [usize; 2] {
    let (mut low, mut high) = (setup.x[0] as f64, setup.x[1] as f64);
    for e in setup.edges {
        let rest = e[1] * y + e[2];
        let root = -rest / e[0];
        if e[0] > 0.0 {
            low = low.max(root.floor() - 1.0);
        } else if e[0] < 0.0 {
            high = high.min(root.ceil() + 2.0);
        } else if rest < 0.0 {
            return [0, 0];
        }
    }
    if low < high {
        [low as usize, high as usize]
    } else {
        [0, 0]
    }
}

#[cfg(test)]
#[path = "raster_tests.rs"]
mod tests;
