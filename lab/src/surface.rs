//! A mesh that can be asked for its colour: what the sampler and the rasteriser share.

use std::collections::HashMap;
use std::sync::Arc;

use rayon::prelude::*;

use crate::mesh::{Mesh, Texture};
use crate::triplanar::Photograph;

/// A mesh with filtered textures, and optionally a photograph over it and a change of colour.
///
/// Copies share textures and topology, so that an object can be moved about cheaply.
#[derive(Debug, Clone)]
pub struct Surface {
    parts: Vec<Piece>,
    photograph: Option<Photograph>,
    tint: Option<Tint>,
}

#[derive(Debug, Clone)]
struct Piece {
    positions: Arc<[[f32; 3]]>,
    normals: Arc<[[f32; 3]]>,
    uvs: Arc<[[f32; 2]]>,
    triangles: Arc<[[u32; 3]]>,
    skin: Arc<Skin>,
}

#[derive(Debug)]
struct Skin {
    pyramid: Option<Pyramid>,
    factor: [f32; 4],
    /// Whether any of it may fail the alpha test.
    masked: bool,
}

/// A triangle of a [`Surface`]: part and index in the part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Face {
    /// Which part.
    pub part: u32,
    /// Which triangle of it.
    pub triangle: u32,
}

/// A place on a triangle, and how far its neighbours on the picture are: barycentric coordinates here, one sample to
/// the right and one sample down. For a lookup without filtering all three are the same.
pub type Footprint = [[f32; 3]; 3];

impl Surface {
    /// Prepares a mesh's textures.
    pub fn new(mesh: &Mesh) -> Self {
        let parts = mesh
            .parts
            .par_iter()
            .map(|part| {
                let alpha = part
                    .texture
                    .as_ref()
                    .map_or(255, |t| t.rgba.iter().map(|p| p[3]).min().unwrap_or_default());
                Piece {
                    positions: part.positions.as_slice().into(),
                    normals: Arc::new([]),
                    uvs: part.uvs.as_slice().into(),
                    triangles: part.triangles.as_slice().into(),
                    skin: Arc::new(Skin {
                        pyramid: part.texture.as_ref().map(Pyramid::new),
                        factor: part.factor,
                        masked: f32::from(alpha) * part.factor[3] <= ALPHA_TEST,
                    }),
                }
            })
            .collect();
        Surface {
            parts,
            photograph: None,
            tint: None,
        }
    }

    /// The surface with every position mapped by `f`; a photograph stays where it was in space (but see
    /// [`Surface::translated`]).
    pub fn map(&self, f: impl Fn([f32; 3]) -> [f32; 3] + Sync) -> Self {
        let mut surface = self.clone();
        for part in &mut surface.parts {
            part.positions = part.positions.par_iter().map(|&p| f(p)).collect();
        }
        if surface.photograph.is_some() {
            surface.find_normals();
        }
        surface
    }

    /// The surface with other positions, part by part and vertex by vertex; a photograph stays where it was in space.
    ///
    /// # Panics
    /// If the number of parts or of a part's vertices is another.
    pub fn with_positions(&self, positions: Vec<Vec<[f32; 3]>>) -> Self {
        assert_eq!(positions.len(), self.parts.len(), "every part has positions");
        let mut surface = self.clone();
        for (part, positions) in surface.parts.iter_mut().zip(positions) {
            assert_eq!(positions.len(), part.positions.len(), "every vertex has a position");
            part.positions = positions.into();
        }
        if surface.photograph.is_some() {
            surface.find_normals();
        }
        surface
    }

    /// The surface elsewhere, with all that is on it.
    pub fn translated(&self, by: [f32; 3]) -> Self {
        let mut surface = self.map(|p| std::array::from_fn(|a| p[a] + by[a]));
        surface.photograph = surface.photograph.map(|photograph| photograph.translated(by));
        surface
    }

    /// The surface with a photograph projected onto it.
    pub fn with_photograph(mut self, photograph: Photograph) -> Self {
        self.photograph = Some(photograph);
        self.find_normals();
        self
    }

    /// The surface in other colours.
    pub fn with_tint(mut self, tint: Tint) -> Self {
        self.tint = Some(tint);
        self
    }

    /// All triangles, in the mesh's order.
    pub fn faces(&self) -> impl Iterator<Item = Face> + '_ {
        self.parts.iter().enumerate().flat_map(|(part, piece)| {
            (0..piece.triangles.len()).map(move |triangle| Face {
                part: part as u32,
                triangle: triangle as u32,
            })
        })
    }

    /// The corners of a triangle.
    pub fn corners(&self, face: Face) -> [[f32; 3]; 3] {
        let piece = &self.parts[face.part as usize];
        piece.triangles[face.triangle as usize].map(|v| piece.positions[v as usize])
    }

    /// The texture coordinates of a triangle's corners, if it has any.
    pub fn corner_uvs(&self, face: Face) -> Option<[[f32; 2]; 3]> {
        let piece = &self.parts[face.part as usize];
        (!piece.uvs.is_empty()).then(|| piece.triangles[face.triangle as usize].map(|v| piece.uvs[v as usize]))
    }

    /// The bounding box of all triangles: lowest and highest corner.
    pub fn bounds(&self) -> [[f64; 3]; 2] {
        let mut bounds = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
        for piece in &self.parts {
            for vertex in piece.triangles.iter().flatten() {
                for (axis, &x) in piece.positions[*vertex as usize].iter().enumerate() {
                    bounds[0][axis] = bounds[0][axis].min(f64::from(x));
                    bounds[1][axis] = bounds[1][axis].max(f64::from(x));
                }
            }
        }
        bounds
    }

    /// Whether any place on a triangle may fail the alpha test.
    pub fn is_masked(&self, face: Face) -> bool {
        self.parts[face.part as usize].skin.masked
    }

    /// Whether a place on a triangle passes the alpha test: alpha above 127 of 255.
    pub fn is_opaque(&self, face: Face, at: [f32; 3]) -> bool {
        let skin = &self.parts[face.part as usize].skin;
        if !skin.masked {
            return true;
        }
        let alpha = match (&skin.pyramid, self.corner_uvs(face)) {
            (Some(pyramid), Some(uvs)) => pyramid.bilinear(0, mix(uvs, at))[3],
            _ => 255.0,
        };
        alpha * skin.factor[3] > ALPHA_TEST
    }

    /// Red, green and blue at a place on a triangle, 0 to 255.
    pub fn colour(&self, face: Face, at: &Footprint) -> [f32; 3] {
        let piece = &self.parts[face.part as usize];
        let skin = &*piece.skin;
        let own = || match (&skin.pyramid, self.corner_uvs(face)) {
            (Some(pyramid), Some(uvs)) => {
                let [here, right, down] = at.map(|b| mix(uvs, b));
                let [r, g, b, _] = pyramid.filtered(here, right, down);
                [r * skin.factor[0], g * skin.factor[1], b * skin.factor[2]]
            }
            _ => std::array::from_fn(|i| 255.0 * skin.factor[i]),
        };
        let colour = match &self.photograph {
            None => own(),
            Some(photograph) => {
                let positions = self.corners(face);
                let normals = piece.triangles[face.triangle as usize].map(|v| piece.normals[v as usize]);
                let colour = photograph.colour(at.map(|b| mix(positions, b)), mix(normals, at[0]));
                if photograph.shaded {
                    let map = own();
                    std::array::from_fn(|i| colour[i] * map[i] / 255.0)
                } else {
                    colour
                }
            }
        };
        match &self.tint {
            None => colour,
            Some(tint) => tint.apply(colour),
        }
    }

    /// Smooth normals: triangles that meet in a position share one, also across seams of the texture.
    fn find_normals(&mut self) {
        for piece in &mut self.parts {
            let key = |p: [f32; 3]| p.map(|x| (x + 0.0).to_bits());
            let mut sums: HashMap<[u32; 3], glam::DVec3> = HashMap::new();
            for triangle in piece.triangles.iter() {
                let corner = triangle.map(|v| piece.positions[v as usize]);
                let [a, b, c] = corner.map(|p| glam::Vec3::from(p).as_dvec3());
                let normal = (b - a).cross(c - a);
                for p in corner {
                    *sums.entry(key(p)).or_default() += normal;
                }
            }
            piece.normals = piece
                .positions
                .iter()
                .map(|&p| {
                    let sum = sums.get(&key(p)).copied().unwrap_or_default();
                    sum.normalize_or(glam::DVec3::Y).as_vec3().into()
                })
                .collect();
        }
    }
}

/// Alpha, of 255, that a fragment must exceed to be seen.
const ALPHA_TEST: f32 = 127.0;

/// The mean of three corners' values.
fn mix<const N: usize>(corners: [[f32; N]; 3], weights: [f32; 3]) -> [f32; N] {
    std::array::from_fn(|i| corners[0][i] * weights[0] + corners[1][i] * weights[1] + corners[2][i] * weights[2])
}

/// A linear change of colour, in values 0 to 255.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tint {
    /// Rows of the matrix.
    pub matrix: [[f32; 3]; 3],
    /// Added afterwards.
    pub offset: [f32; 3],
}

impl Tint {
    /// Turns hues by `angle` (radians), stretches contrast about mid-grey, then multiplies each channel by its gain.
    pub fn new(angle: f32, contrast: f32, gain: [f32; 3]) -> Self {
        let turn = glam::Mat3::from_axis_angle(glam::Vec3::ONE.normalize(), angle) * contrast;
        Tint {
            matrix: std::array::from_fn(|i| (turn.row(i) * gain[i]).into()),
            offset: gain.map(|g| g * 127.5 * (1.0 - contrast)),
        }
    }

    fn apply(&self, c: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|i| {
            let m = self.matrix[i];
            (m[0] * c[0] + m[1] * c[1] + m[2] * c[2] + self.offset[i]).clamp(0.0, 255.0)
        })
    }
}

/// A texture at every resolution, from its own down to one texel, each half of the one before.
#[derive(Debug, Clone)]
pub struct Pyramid {
    levels: Vec<Texture>,
}

impl Pyramid {
    /// Halves a texture until one texel is left.
    pub fn new(texture: &Texture) -> Self {
        let mut levels = vec![texture.clone()];
        while let Some(last) = levels.last()
            && last.width.max(last.height) > 1
        {
            levels.push(half(last));
        }
        Pyramid { levels }
    }

    /// Bilinear lookup in one level, repeating; texel centres are at half-integers. RGBA, 0 to 255.
    pub fn bilinear(&self, level: usize, [u, v]: [f32; 2]) -> [f32; 4] {
        let texture = &self.levels[level.min(self.levels.len() - 1)];
        let (w, h) = (texture.width as i32, texture.height as i32);
        let (x, y) = (u * w as f32 - 0.5, v * h as f32 - 0.5);
        let (fx, fy) = (x - x.floor(), y - y.floor());
        let (x0, y0) = (wrap(x.floor() as i32, w), wrap(y.floor() as i32, h));
        let (x1, y1) = (next(x0, w), next(y0, h));
        let at = |x: i32, y: i32| texture.rgba[(y * w + x) as usize].map(f32::from);
        let (a, b, c, d) = (at(x0, y0), at(x1, y0), at(x0, y1), at(x1, y1));
        std::array::from_fn(|i| {
            let top = a[i] + (b[i] - a[i]) * fx;
            let bottom = c[i] + (d[i] - c[i]) * fx;
            top + (bottom - top) * fy
        })
    }

    /// Trilinear lookup for a sample whose neighbours to the right and below are at these coordinates.
    ///
    /// The resolution follows the geometric mean of the two distances: at grazing angles the supersampling, not the
    /// texture, filters along the longer one.
    pub fn filtered(&self, here: [f32; 2], right: [f32; 2], down: [f32; 2]) -> [f32; 4] {
        let size = [self.levels[0].width as f32, self.levels[0].height as f32];
        let distance = |to: [f32; 2]| {
            let d = [(to[0] - here[0]) * size[0], (to[1] - here[1]) * size[1]];
            d[0] * d[0] + d[1] * d[1]
        };
        let square = distance(right) * distance(down);
        // One texel per sample or fewer; also where there are no neighbours.
        if square.is_nan() || square <= 1.0 {
            return self.bilinear(0, here);
        }
        let level = (square.log2() / 4.0).min((self.levels.len() - 1) as f32);
        let (fine, t) = (level as usize, level.fract());
        let (a, b) = (self.bilinear(fine, here), self.bilinear(fine + 1, here));
        std::array::from_fn(|i| a[i] + (b[i] - a[i]) * t)
    }
}

fn wrap(i: i32, n: i32) -> i32 {
    if (0..n).contains(&i) { i } else { i.rem_euclid(n) }
}

fn next(i: i32, n: i32) -> i32 {
    if i + 1 == n { 0 } else { i + 1 }
}

/// Means of 2×2 texels, colours weighted by alpha so that what is cut away does not bleed.
fn half(texture: &Texture) -> Texture {
    let (width, height) = ((texture.width / 2).max(1), (texture.height / 2).max(1));
    let at = |x: u32, y: u32| {
        let (x, y) = (x.min(texture.width - 1), y.min(texture.height - 1));
        texture.rgba[(y * texture.width + x) as usize].map(u32::from)
    };
    let mut rgba = Vec::with_capacity((width * height) as usize);
    for y in 0..height {
        for x in 0..width {
            let block = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(i, j)| at(2 * x + i, 2 * y + j));
            let alpha: u32 = block.iter().map(|p| p[3]).sum();
            let colour = |i: usize| {
                let weighted: u32 = block.iter().map(|p| p[i] * p[3]).sum();
                let plain: u32 = block.iter().map(|p| p[i]).sum();
                (weighted + alpha / 2).checked_div(alpha).unwrap_or((plain + 2) / 4)
            };
            rgba.push([colour(0), colour(1), colour(2), (alpha + 2) / 4].map(|c| c as u8));
        }
    }
    Texture { width, height, rgba }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::fixtures::{mesh, quad, texture};

    fn grid() -> Pyramid {
        Pyramid::new(&texture(4, 4, |x, y| [(x * 10) as u8, (y * 20) as u8, 0, 255]))
    }

    #[test]
    fn a_texels_centre_has_its_value_and_half_way_the_mean() {
        let grid = grid();
        assert_eq!(grid.bilinear(0, [0.375, 0.625])[..2], [10.0, 40.0]);
        assert_eq!(grid.bilinear(0, [0.5, 0.5])[..2], [15.0, 30.0]);
    }

    #[test]
    fn textures_repeat() {
        let grid = grid();
        assert_eq!(grid.bilinear(0, [0.375, 0.625]), grid.bilinear(0, [5.375, -3.375]));
        // Across the edge: the mean of the last column and the first.
        assert_eq!(grid.bilinear(0, [0.0, 0.625])[0], 15.0);
    }

    #[test]
    fn a_distant_checkerboard_is_grey_and_a_near_one_sharp() {
        let board = Pyramid::new(&texture(64, 64, |x, y| {
            if (x + y) % 2 == 0 { [255; 4] } else { [0, 0, 0, 255] }
        }));
        let at = [0.5 / 64.0, 0.5 / 64.0];
        let far = board.filtered(at, [at[0] + 0.25, at[1]], [at[0], at[1] + 0.25]);
        assert!((far[0] - 127.5).abs() < 1.0, "{far:?}");
        let near = board.filtered(at, [at[0] + 0.001, at[1]], [at[0], at[1] + 0.001]);
        assert_eq!(near[0], 255.0);
    }

    #[test]
    fn what_is_cut_away_does_not_bleed_into_coarser_levels() {
        let half_seen = texture(2, 1, |x, _| if x == 0 { [200, 100, 50, 255] } else { [0, 0, 0, 0] });
        let coarse = half(&half_seen);
        assert_eq!(coarse.rgba, [[200, 100, 50, 128]]);
    }

    #[test]
    fn a_tint_of_nothing_changes_nothing_and_a_third_of_a_turn_swaps_channels() {
        let colour = [200.0, 100.0, 50.0];
        let close = |a: [f32; 3], b: [f32; 3]| (0..3).all(|i| (a[i] - b[i]).abs() < 0.01);
        assert!(close(Tint::new(0.0, 1.0, [1.0; 3]).apply(colour), colour));
        let third = Tint::new(std::f32::consts::TAU / 3.0, 1.0, [1.0; 3]);
        assert!(close(third.apply(colour), [50.0, 200.0, 100.0]));
    }

    #[test]
    fn alpha_of_127_is_hidden_and_of_128_seen() {
        for (alpha, seen) in [(127, false), (128, true)] {
            let skin = texture(1, 1, |_, _| [0, 0, 0, alpha]);
            let part = quad([0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], Some(skin));
            let surface = Surface::new(&mesh(part));
            let face = surface.faces().next().unwrap();
            assert_eq!(surface.is_opaque(face, [0.2, 0.3, 0.5]), seen, "{alpha}");
        }
    }

    #[test]
    fn normals_are_smooth_across_a_seam_of_the_texture() {
        // A roof of two quads that meet at x = 1 but share no vertex index.
        let mut roof = quad([0.0; 3], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0], None);
        let other = quad([1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 0.0, 1.0], None);
        let shift = roof.positions.len() as u32;
        roof.positions.extend(other.positions);
        roof.triangles
            .extend(other.triangles.iter().map(|t| t.map(|v| v + shift)));
        let mut surface = Surface::new(&mesh(roof));
        surface.find_normals();
        let piece = &surface.parts[0];
        for end in 0..2 {
            let place = [1.0, 1.0, end as f32];
            let normals: Vec<[f32; 3]> = (piece.positions.iter().zip(piece.normals.iter()))
                .filter(|(p, _)| **p == place)
                .map(|(_, n)| *n)
                .collect();
            assert_eq!(normals.len(), 2);
            assert_eq!(normals[0], normals[1]);
            // The slopes' own normals have 0.71 along both.
            assert!(normals[0][0].abs() < 0.4 && normals[0][1].abs() > 0.9);
        }
    }
}
