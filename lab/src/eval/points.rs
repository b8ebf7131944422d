//! Point clouds drawn the two plain ways: as squares that close up, and as one Gaussian a point.

use std::collections::HashSet;

use b2p::cloud::PointCloud;
use b2p::gaussians::{Frame, Gaussians};
use b2p::renderer::Image;
use b2p::renderer::camera::Camera;

use super::nearest::mean_nearest_distance;

/// The share of a round Gaussian's variance that is blur.
const OWN_BLUR: f64 = 0.01;

/// A cloud's points in the cube frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Points {
    /// Positions; the voxel cube is `[−1, 1]³`.
    pub positions: Vec<[f32; 3]>,
    /// sRGB colours.
    pub colours: Vec<[u8; 3]>,
    /// The distance between points that are next to each other on their lattice.
    pub spacing: f64,
}

impl Points {
    /// Takes a cloud whose coordinates are voxels of a grid of `2^bits`, voxel `v` being centred on `v + ½`.
    ///
    /// A decoder that dropped low bits leaves a coarser lattice in these coordinates: its spacing is the greatest
    /// common divisor of all differences, and a point stands for a cell of voxels. Whether the codec rounded to the
    /// lattice (the point is in the cell's middle) or cut off bits (in its lowest corner) is asked of the `finest`
    /// cloud, if there is one: whichever finds more of its voxels. Coordinates that are no integers have their mean
    /// distance to the nearest point as spacing.
    pub fn on_grid(cloud: &PointCloud, bits: u8, finest: Option<&PointCloud>) -> Points {
        let step = lattice(&cloud.positions);
        let middle = match (step, finest) {
            (Some(step @ 2..), Some(finest)) => cell_middle(&cloud.positions, step, finest),
            _ => 0.5,
        };
        let scale = 2.0 / f64::from(1u32 << bits);
        let positions: Vec<[f32; 3]> = cloud
            .positions
            .iter()
            .map(|p| p.map(|v| ((v + middle) * scale - 1.0) as f32))
            .collect();
        let spacing = match step {
            Some(step) => step as f64 * scale,
            None => mean_nearest_distance(&positions).unwrap_or(scale),
        };
        Points {
            positions,
            colours: cloud.colours.clone(),
            spacing,
        }
    }

    /// Squares that face the camera, with a depth buffer, on white: each is drawn on the pixels whose centres it
    /// covers, and at least on the one it lies in. A square's side is the `factor`-fold projected spacing.
    pub fn draw_squares(&self, camera: &Camera, factor: f64) -> Image {
        let (width, height) = (camera.width as usize, camera.height as usize);
        let mut image = Image {
            width: camera.width,
            height: camera.height,
            pixels: vec![[1.0; 4]; width * height],
        };
        let mut depths = vec![f64::INFINITY; width * height];
        for (position, colour) in self.positions.iter().zip(&self.colours) {
            let place = camera.pose.transform_point3(position.map(f64::from).into());
            if place.z <= camera.near {
                continue;
            }
            let x = camera.fx * place.x / place.z + camera.cx;
            let y = camera.fy * place.y / place.z + camera.cy;
            let half = 0.5 * factor * self.spacing / place.z;
            let columns = covered(x, half * camera.fx, width);
            let [r, g, b] = colour.map(|v| f32::from(v) / 255.0);
            for row in covered(y, half * camera.fy, height) {
                for pixel in columns.clone().map(|column| row * width + column) {
                    if place.z < depths[pixel] {
                        depths[pixel] = place.z;
                        image.pixels[pixel] = [r, g, b, 1.0];
                    }
                }
            }
        }
        image
    }

    /// One round Gaussian a point: σ is the `factor`-fold mean distance from a point to the nearest other, opacity 1.
    /// Some of σ² counts as a blur of their own, so that pictures widen them by no more than a stream's.
    pub fn to_gaussians(&self, frame: Frame, factor: f64) -> Gaussians {
        let nearest = mean_nearest_distance(&self.positions).unwrap_or(self.spacing);
        let variance = (factor * nearest).powi(2);
        let sigma = ((1.0 - OWN_BLUR) * variance).sqrt() as f32;
        let count = self.positions.len();
        Gaussians {
            position: self.positions.clone(),
            scale: vec![[sigma; 3]; count],
            rotation: vec![[1.0, 0.0, 0.0, 0.0]; count],
            opacity: vec![1.0; count],
            blur: (OWN_BLUR * variance) as f32,
            colour: self.colours.iter().map(|c| c.map(|v| f32::from(v) / 255.0)).collect(),
            frame,
            ..Gaussians::default()
        }
    }
}

/// The pixels whose centres lie within `half` of `centre`, or the one that holds it; only those of the picture.
fn covered(centre: f64, half: f64, size: usize) -> std::ops::Range<usize> {
    let (mut first, mut end) = ((centre - half - 0.5).ceil(), (centre + half - 0.5).ceil());
    if first >= end {
        first = centre.floor();
        end = first + 1.0;
    }
    // A cast saturates, so that what lies far outside becomes an empty range.
    let inside = |v: f64| (v.max(0.0) as usize).min(size);
    inside(first)..inside(end)
}

/// The greatest common divisor of the differences of all coordinates; none if they are no integers, or all the same.
fn lattice(positions: &[[f64; 3]]) -> Option<u64> {
    let first = positions.first()?;
    let mut step = 0u64;
    for p in positions {
        for (a, b) in p.iter().zip(first) {
            let difference = (a - b).abs();
            if difference.fract() != 0.0 || difference >= (1u64 << 53) as f64 {
                return None;
            }
            step = greatest_common_divisor(step, difference as u64);
        }
    }
    (step > 0).then_some(step)
}

/// From a point's coordinate to the middle of the cell of `step`³ voxels that it stands for.
fn cell_middle(coarse: &[[f64; 3]], step: u64, finest: &PointCloud) -> f64 {
    let step = step as f64;
    let key = |p: [f64; 3]| p.map(|v| v as i64);
    let known: HashSet<[i64; 3]> = coarse.iter().copied().map(key).collect();
    let found = |shift: f64| {
        let cell = |p: &[f64; 3]| key(p.map(|v| ((v + shift) / step).floor() * step));
        finest.positions.iter().filter(|p| known.contains(&cell(p))).count()
    };
    if found(step / 2.0) > found(0.0) {
        0.0
    } else {
        step / 2.0
    }
}

fn greatest_common_divisor(mut a: u64, mut b: u64) -> u64 {
    while b != 0 {
        (a, b) = (b, a % b);
    }
    a
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        Camera::orbit(0.0, 0.0, 3.0, 45.0, 64, 64).unwrap()
    }

    fn one(position: [f32; 3], spacing: f64) -> Points {
        Points {
            positions: vec![position],
            colours: vec![[255, 0, 0]],
            spacing,
        }
    }

    fn red(image: &Image) -> usize {
        image.pixels.iter().filter(|p| p[1] == 0.0).count()
    }

    #[test]
    fn a_square_covers_its_projected_area() {
        let side = 10.0;
        let spacing = side * 3.0 / camera().fx;
        let image = one([0.0; 3], spacing).draw_squares(&camera(), 1.0);
        assert_eq!(red(&image), 100);
        assert_eq!(image.pixel(27, 27)[1], 0.0);
        assert_eq!(image.pixel(26, 27)[1], 1.0);
        let larger = one([0.0; 3], spacing).draw_squares(&camera(), 2.0);
        assert_eq!(red(&larger), 400);
    }

    #[test]
    fn a_square_smaller_than_a_pixel_is_one_pixel() {
        let image = one([0.01, 0.02, 0.0], 1e-6).draw_squares(&camera(), 1.0);
        assert_eq!(red(&image), 1);
    }

    #[test]
    fn what_is_behind_the_camera_or_beside_the_picture_is_not_drawn() {
        for position in [[0.0, 0.0, 3.5], [0.0, 0.0, 3.0], [90.0, 0.0, 0.0], [0.0, -90.0, 0.0]] {
            assert_eq!(red(&one(position, 0.1).draw_squares(&camera(), 1.0)), 0);
        }
    }

    #[test]
    fn the_nearer_of_two_squares_is_seen_whichever_comes_first() {
        let mut points = one([0.0, 0.0, 0.5], 0.3);
        points.positions.push([0.0; 3]);
        points.colours.push([0, 0, 255]);
        let image = points.draw_squares(&camera(), 1.0);
        points.positions.reverse();
        points.colours.reverse();
        assert_eq!(image, points.draw_squares(&camera(), 1.0));
        assert_eq!(image.pixel(32, 32), [1.0, 0.0, 0.0, 1.0]);
    }

    #[test]
    fn a_face_of_voxels_seen_from_the_front_has_no_holes_at_factor_one() {
        let cloud = PointCloud {
            positions: (0..32 * 32)
                .map(|i| [f64::from(i % 32), f64::from(i / 32), 31.0])
                .collect(),
            colours: vec![[255, 0, 0]; 32 * 32],
            ..PointCloud::default()
        };
        let points = Points::on_grid(&cloud, 5, None);
        assert_eq!(points.spacing, 2.0 / 32.0);
        let image = points.draw_squares(&camera(), 1.0);
        let rows: Vec<usize> = (0..64)
            .map(|y| (0..64).filter(|&x| image.pixel(x, y)[1] == 0.0).count())
            .filter(|&n| n > 0)
            .collect();
        assert!(rows.iter().all(|&n| n == rows[0]), "{rows:?}");
    }

    #[test]
    fn a_coarser_lattice_is_found_in_the_coordinates() {
        let on = |positions: Vec<[f64; 3]>| lattice(&positions);
        assert_eq!(on(vec![[2.0, 6.0, 10.0], [6.0, 2.0, 10.0]]), Some(4));
        assert_eq!(on(vec![[3.0, 5.0, 7.0], [3.0, 7.0, 7.0]]), Some(2));
        assert_eq!(on(vec![[1.0, 2.0, 3.0], [2.0, 4.0, 4.0]]), Some(1));
        assert_eq!(on(vec![[1.0, 2.0, 3.5], [2.0, 4.0, 3.0]]), None);
        assert_eq!(on(vec![[1.0; 3]; 2]), None);
    }

    #[test]
    fn a_point_of_a_coarser_lattice_stands_in_the_middle_of_its_cell() {
        let cloud = |positions: Vec<[f64; 3]>| PointCloud {
            colours: vec![[0; 3]; positions.len()],
            positions,
            ..PointCloud::default()
        };
        let finest = cloud((3..29).map(|i| [f64::from(i), 7.0, 9.0]).collect());
        let coarse = |f: fn(f64) -> f64| cloud(finest.positions.iter().map(|p| p.map(|v| 4.0 * f(v / 4.0))).collect());
        let cells_of = |cloud: &PointCloud| Points::on_grid(cloud, 5, Some(&finest)).positions[4];
        let voxels = |p: f32| (p + 1.0) * 16.0;
        // Voxel 7 is in [6, 10) rounded, in [4, 8) cut off.
        let (rounded, cut) = (coarse(|v| (v + 0.5).floor()), coarse(f64::floor));
        assert_eq!(cells_of(&rounded).map(voxels), [8.0, 8.0, 8.0]);
        assert_eq!(cells_of(&cut).map(voxels), [6.0, 6.0, 10.0]);
        let alone = Points::on_grid(&rounded, 5, None).positions[4];
        assert_eq!(alone.map(voxels), [8.5, 8.5, 8.5]);
    }

    #[test]
    fn a_global_gaussian_is_as_wide_as_the_wanted_part_of_what_points_are_apart() {
        let mut points = one([0.0; 3], 0.1);
        points.positions.push([0.0, 0.2, 0.0]);
        points.colours.push([0; 3]);
        let gaussians = points.to_gaussians(Frame::default(), 0.5);
        let variance = gaussians.scale[1][2].powi(2) + gaussians.blur;
        assert!((variance - 0.01).abs() < 1e-6, "{variance}");
        assert_eq!(gaussians.opacity, [1.0; 2]);
    }
}
