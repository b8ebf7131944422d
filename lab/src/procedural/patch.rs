//! Parametric surfaces, and how they become textured triangles.

use std::sync::Arc;

use glam::{Affine3A, Vec2, Vec3};
use rayon::prelude::*;

use super::light::Light;
use crate::mesh::{Part, Texture};

/// Texels across or down a texture, at most.
const LARGEST_TEXTURE: f32 = 2048.0;

/// A place on a patch, as patterns see it.
#[derive(Debug, Clone, Copy)]
pub struct Spot {
    /// Parameters in `[0, 1]`: u to the right, v down, seen from outside.
    pub uv: Vec2,
    /// The parameters times the patch's lengths: about distances along the surface.
    pub st: Vec2,
    /// Where it is in space.
    pub position: Vec3,
}

/// A colour for every place, sRGB in `[0, 1]`.
pub type Pattern = Arc<dyn Fn(&Spot) -> Vec3 + Send + Sync>;

/// A surface over the unit square. Outside is where u runs to the right and v down.
#[derive(Clone)]
pub struct Patch {
    map: Arc<dyn Fn(f32, f32) -> Vec3 + Send + Sync>,
    steps: [u32; 2],
}

impl Patch {
    /// A surface drawn with `steps` quadrilaterals along u and v.
    pub fn new(steps: [u32; 2], map: impl Fn(f32, f32) -> Vec3 + Send + Sync + 'static) -> Self {
        let map = Arc::new(map);
        Patch { map, steps }
    }

    /// The surface bent by a map of space.
    pub fn warped(&self, warp: impl Fn(Vec3) -> Vec3 + Send + Sync + 'static) -> Self {
        let map = self.map.clone();
        Patch::new(self.steps, move |u, v| warp(map(u, v)))
    }

    /// The surface moved, turned or stretched.
    pub fn placed(&self, place: Affine3A) -> Self {
        self.warped(move |p| place.transform_point3(p))
    }

    /// The place of `(u, v)`.
    pub fn point(&self, u: f32, v: f32) -> Vec3 {
        (self.map)(u, v)
    }

    /// Derivatives by u and v, from finite differences inside the square.
    fn tangents(&self, u: f32, v: f32) -> [Vec3; 2] {
        const STEP: f32 = 1.0 / 512.0;
        let ends = |t: f32| ((t - STEP).clamp(0.0, 1.0 - STEP), (t + STEP).clamp(STEP, 1.0));
        let ((u0, u1), (v0, v1)) = (ends(u), ends(v));
        [
            (self.point(u1, v) - self.point(u0, v)) / (u1 - u0),
            (self.point(u, v1) - self.point(u, v0)) / (v1 - v0),
        ]
    }

    /// The unit normal to the outside; at a pole, that of a place close by.
    pub fn normal(&self, u: f32, v: f32) -> Vec3 {
        let inside = |t: f32| t.clamp(2e-3, 1.0 - 2e-3);
        outside(self.tangents(inside(u), inside(v)))
    }

    /// The greatest of a few lengths of lines of constant v, and of constant u.
    pub fn lengths(&self) -> Vec2 {
        const LINES: u32 = 5;
        const STEPS: u32 = 64;
        let length = |at: &dyn Fn(f32) -> Vec3| -> f32 {
            (0..STEPS)
                .map(|i| at(i as f32 / STEPS as f32).distance(at((i + 1) as f32 / STEPS as f32)))
                .sum()
        };
        let longest = |line: &dyn Fn(f32, f32) -> Vec3| {
            (0..LINES)
                .map(|i| {
                    let fixed = i as f32 / (LINES - 1) as f32;
                    length(&|t| line(t, fixed))
                })
                .fold(0.0, f32::max)
        };
        Vec2::new(
            longest(&|t, fixed| self.point(t, fixed)),
            longest(&|t, fixed| self.point(fixed, t)),
        )
    }

    /// Triangles with a texture of its own, painted with `pattern` at `density` texels per unit of length and lit by
    /// `light`. The outermost texels' centres lie on the patch's border, so that no texture lookup reaches across it.
    pub fn part(&self, density: f32, pattern: &Pattern, light: Option<&Light>) -> Part {
        let lengths = self.lengths();
        let texels = |length: f32| (length * density).ceil().clamp(2.0, LARGEST_TEXTURE) as u32;
        let texture = self.paint([texels(lengths.x), texels(lengths.y)], lengths, pattern, light);
        let [nu, nv] = self.steps;
        let grid = |n: u32| (0..=n).map(move |i| i as f32 / n as f32);
        let corners: Vec<(f32, f32)> = grid(nv).flat_map(|v| grid(nu).map(move |u| (u, v))).collect();
        let positions: Vec<[f32; 3]> = corners.par_iter().map(|&(u, v)| self.point(u, v).to_array()).collect();
        let inset = |t: f32, n: u32| (0.5 + t * (n - 1) as f32) / n as f32;
        let uvs = corners
            .iter()
            .map(|&(u, v)| [inset(u, texture.width), inset(v, texture.height)])
            .collect();
        let mut triangles = Vec::with_capacity((2 * nu * nv) as usize);
        for row in 0..nv {
            for column in 0..nu {
                let a = row * (nu + 1) + column;
                let (b, c) = (a + 1, a + nu + 1);
                for triangle in [[a, c, b], [b, c, c + 1]] {
                    let [p, q, r] = triangle.map(|i| Vec3::from(positions[i as usize]));
                    if (q - p).cross(r - p) != Vec3::ZERO {
                        triangles.push(triangle);
                    }
                }
            }
        }
        Part {
            positions,
            uvs,
            triangles,
            texture: Some(texture),
            factor: [1.0; 4],
        }
    }

    /// Every texel is the mean of 2×2 looks at the pattern.
    fn paint(&self, [width, height]: [u32; 2], lengths: Vec2, pattern: &Pattern, light: Option<&Light>) -> Texture {
        let step = Vec2::new(1.0 / (width - 1) as f32, 1.0 / (height - 1) as f32);
        let texel = |x: u32, y: u32| {
            let uv = Vec2::new(x as f32, y as f32) * step;
            let (position, [du, dv]) = (self.point(uv.x, uv.y), self.tangents(uv.x, uv.y));
            let mut colour = Vec3::ZERO;
            for look in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] {
                let offset = Vec2::from(look) * step;
                let near = (uv + offset).clamp(Vec2::ZERO, Vec2::ONE);
                colour += pattern(&Spot {
                    uv: near,
                    st: near * lengths,
                    position: position + du * offset.x + dv * offset.y,
                });
            }
            colour *= 0.25;
            if let Some(light) = light {
                let at_border = uv.min_element() < 2e-3 || uv.max_element() > 1.0 - 2e-3;
                let normal = if at_border {
                    self.normal(uv.x, uv.y)
                } else {
                    outside([du, dv])
                };
                colour *= light.shade(position, normal);
            }
            let [r, g, b] = (colour.clamp(Vec3::ZERO, Vec3::ONE) * 255.0).round().to_array();
            [r as u8, g as u8, b as u8, 255]
        };
        let rgba = (0..height)
            .into_par_iter()
            .flat_map_iter(|y| (0..width).map(move |x| (x, y)))
            .map(|(x, y)| texel(x, y))
            .collect();
        Texture { width, height, rgba }
    }
}

/// The unit normal to the side from which u runs to the right and v down.
fn outside([du, dv]: [Vec3; 2]) -> Vec3 {
    dv.cross(du).normalize_or(Vec3::Y)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square() -> Patch {
        Patch::new([2, 3], |u, v| Vec3::new(2.0 * u, -v, 0.0))
    }

    #[test]
    fn outside_is_where_u_runs_right_and_v_down() {
        assert!(square().normal(0.0, 1.0).distance(Vec3::Z) < 1e-5);
        let white: Pattern = Arc::new(|_| Vec3::ONE);
        let part = square().part(10.0, &white, None);
        for t in &part.triangles {
            let [a, b, c] = t.map(|i| Vec3::from(part.positions[i as usize]));
            assert!((b - a).cross(c - a).z > 0.0);
        }
        assert_eq!(part.triangles.len(), 12);
    }

    #[test]
    fn the_texture_covers_the_patch_from_border_to_border() {
        let ramp: Pattern = Arc::new(|s| Vec3::new(s.uv.x, s.uv.y, s.st.x / 2.0));
        let part = square().part(50.0, &ramp, None);
        let texture = part.texture.unwrap();
        assert_eq!((texture.width, texture.height), (100, 50));
        assert!(texture.rgba[0][..3].iter().all(|&v| v <= 1));
        assert_eq!(texture.rgba[99][0], 255);
        assert!(texture.rgba[99][2] >= 254);
        assert_eq!(part.uvs[0], [0.005, 0.01]);
    }

    #[test]
    fn a_placed_patch_moves_whole() {
        let up = square().placed(Affine3A::from_translation(Vec3::Y));
        assert_eq!(up.point(0.5, 0.5), Vec3::new(1.0, 0.5, 0.0));
        assert!((up.lengths() - Vec2::new(2.0, 1.0)).length() < 1e-4);
    }
}
