//! Rotation of whole scenes, with their view-dependent colours.

use b2p::gaussians::{Frame, Gaussians};
use b2p::{Placement, Up};
use rayon::prelude::*;

use super::Axes;

/// Coefficients of degree 1, 2 and 3.
const BANDS: [(usize, usize); 3] = [(0, 3), (3, 5), (8, 7)];
/// Directions by which rotated harmonics are determined: more than coefficients of a degree.
const DIRECTIONS: usize = 40;

/// A rotation.
#[derive(Debug, Clone)]
pub(super) struct Turn {
    quaternion: [f64; 4],
    matrix: [[f64; 3]; 3],
    /// Of each degree the matrix of its coefficients, row by row.
    bands: [Vec<f64>; 3],
}

impl Turn {
    /// The rotation of a quaternion w, x, y, z, which need not be of unit length but must not be 0.
    pub fn new(quaternion: [f64; 4]) -> Self {
        let quaternion = unit(quaternion);
        let matrix = matrix(quaternion);
        Turn {
            quaternion,
            matrix,
            bands: BANDS.map(|band| rotated_band(band, &matrix)),
        }
    }

    /// From the axes `from` to the axes `to`. `None` if they are alike.
    pub fn between(from: Axes, to: Axes) -> Option<Self> {
        let (from, to) = (to_gltf(from), to_gltf(to));
        // The inverse of a rotation is its transpose.
        let product = |i: usize, j: usize| (0..3).map(|k| to[k][i] * from[k][j]).sum();
        let matrix: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| product(i, j)));
        let identity = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))));
        (matrix != identity).then(|| Turn {
            quaternion: quaternion(&matrix),
            bands: BANDS.map(|band| rotated_band(band, &matrix)),
            matrix,
        })
    }

    /// The cube of a scene after a rotation that maps axes to axes.
    pub fn frame(&self, frame: Frame) -> Frame {
        let side = 2.0 * frame.unit();
        let Placement { origin, voxel_size } = frame.placement;
        let corners = [origin, origin.map(|x| x + side)].map(|corner| self.point(corner));
        let origin = std::array::from_fn(|k| corners[0][k].min(corners[1][k]));
        Frame {
            placement: Placement { origin, voxel_size },
            ..frame
        }
    }

    /// Rotates a scene by a rotation that maps axes to axes: positions change their signs and places, exactly.
    pub fn apply(&self, gaussians: &mut Gaussians) {
        gaussians.frame = self.frame(gaussians.frame);
        let positions = gaussians.position.par_iter_mut();
        positions.for_each(|p| *p = self.point(p.map(f64::from)).map(|x| x as f32));
        let rotations = gaussians.rotation.par_iter_mut();
        rotations.for_each(|q| *q = self.rotation(q.map(f64::from)).map(|x| x as f32));
        let count = gaussians.harmonics.count;
        if count == 0 {
            return;
        }
        let own = gaussians.harmonics.coefficients.par_chunks_exact_mut(count);
        own.for_each(|own| {
            let mut turned: Vec<[f64; 3]> = own.iter().map(|c| c.map(f64::from)).collect();
            self.coefficients(&mut turned);
            for (to, c) in own.iter_mut().zip(turned) {
                *to = c.map(|x| x as f32);
            }
        });
    }

    /// A rotated point.
    pub fn point(&self, p: [f64; 3]) -> [f64; 3] {
        self.matrix.map(|row| row[0] * p[0] + row[1] * p[1] + row[2] * p[2])
    }

    /// The rotation of a rotated Gaussian.
    pub fn rotation(&self, q: [f64; 4]) -> [f64; 4] {
        product(self.quaternion, q)
    }

    /// The coefficients of a rotated Gaussian: 0, 3, 8 or 15.
    pub fn coefficients(&self, coefficients: &mut [[f64; 3]]) {
        for ((first, count), rows) in BANDS.into_iter().zip(&self.bands) {
            if coefficients.len() < first + count {
                return;
            }
            let band = &mut coefficients[first..first + count];
            let mut rotated = [[0.0; 3]; 7];
            for (to, row) in rotated.iter_mut().zip(rows.chunks_exact(count)) {
                for (c, r) in band.iter().zip(row) {
                    (0..3).for_each(|k| to[k] += r * c[k]);
                }
            }
            band.copy_from_slice(&rotated[..count]);
        }
    }
}

/// The rotation to the axes of glTF, row by row.
fn to_gltf(axes: Axes) -> [[f64; 3]; 3] {
    match axes {
        Axes::Gltf => Up::Y.to_y(),
        // 180° about z: what programs do to PLY files.
        Axes::Ply | Axes::Cloud(Up::MinusY) => [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]],
        Axes::Cloud(up) => up.to_y(),
    }
}

/// The quaternion w, x, y, z of a rotation.
fn quaternion(m: &[[f64; 3]; 3]) -> [f64; 4] {
    // Four times the square of each component; the largest one divides.
    let squares = [
        1.0 + m[0][0] + m[1][1] + m[2][2],
        1.0 + m[0][0] - m[1][1] - m[2][2],
        1.0 - m[0][0] + m[1][1] - m[2][2],
        1.0 - m[0][0] - m[1][1] + m[2][2],
    ];
    let largest = (1..4).fold(0, |best, k| if squares[k] > squares[best] { k } else { best });
    let [a, b, c] = [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]];
    let [d, e, f] = [m[1][0] + m[0][1], m[0][2] + m[2][0], m[2][1] + m[1][2]];
    unit(match largest {
        0 => [squares[0], a, b, c],
        1 => [a, squares[1], d, e],
        2 => [b, d, squares[2], f],
        _ => [c, e, f, squares[3]],
    })
}

/// The quaternion of unit length.
pub(super) fn unit(q: [f64; 4]) -> [f64; 4] {
    // The largest component first, so that the squares neither overflow nor vanish.
    let largest = q.iter().fold(0.0, |m: f64, x| m.max(x.abs()));
    let q = q.map(|x| x / largest);
    let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    q.map(|x| x / norm)
}

/// The product of two quaternions w, x, y, z.
pub(super) fn product([aw, ax, ay, az]: [f64; 4], [bw, bx, by, bz]: [f64; 4]) -> [f64; 4] {
    [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
}

/// The matrix of a unit quaternion.
pub(super) fn matrix([w, x, y, z]: [f64; 4]) -> [[f64; 3]; 3] {
    [
        [
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y - w * z),
            2.0 * (x * z + w * y),
        ],
        [
            2.0 * (x * y + w * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z - w * x),
        ],
        [
            2.0 * (x * z - w * y),
            2.0 * (y * z + w * x),
            1.0 - 2.0 * (x * x + y * y),
        ],
    ]
}

/// The harmonics of degree 1 to 3 along a direction, in the convention of splat files.
fn basis([x, y, z]: [f64; 3]) -> [f64; 15] {
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        -0.488_602_511_902_919_9 * y,
        0.488_602_511_902_919_9 * z,
        -0.488_602_511_902_919_9 * x,
        1.092_548_430_592_079 * x * y,
        -1.092_548_430_592_079 * y * z,
        0.315_391_565_252_52 * (2.0 * zz - xx - yy),
        -1.092_548_430_592_079 * x * z,
        0.546_274_215_296_039_5 * (xx - yy),
        -0.590_043_589_926_643_5 * y * (3.0 * xx - yy),
        2.890_611_442_640_554 * x * y * z,
        -0.457_045_799_464_465_7 * y * (4.0 * zz - xx - yy),
        0.373_176_332_590_115_4 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.457_045_799_464_465_7 * x * (4.0 * zz - xx - yy),
        1.445_305_721_320_277 * z * (xx - yy),
        -0.590_043_589_926_643_5 * x * (xx - 3.0 * yy),
    ]
}

/// The matrix that rotates coefficients of a degree: the function that has them, seen along a direction turned back, is
/// the function of the rotated ones, so the matrix solves least squares over directions, exactly.
fn rotated_band((first, count): (usize, usize), rotation: &[[f64; 3]; 3]) -> Vec<f64> {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    let mut normal = vec![0.0; count * count];
    let mut right = vec![0.0; count * count];
    for i in 0..DIRECTIONS {
        let z = 1.0 - 2.0 * (i as f64 + 0.5) / DIRECTIONS as f64;
        let (sin, cos) = (golden * i as f64).sin_cos();
        let ring = (1.0 - z * z).sqrt();
        let direction = [ring * cos, ring * sin, z];
        let back = std::array::from_fn(|k| (0..3).map(|r| rotation[r][k] * direction[r]).sum());
        let (here, there) = (basis(direction), basis(back));
        for r in 0..count {
            for c in 0..count {
                normal[r * count + c] += here[first + r] * here[first + c];
                right[r * count + c] += here[first + r] * there[first + c];
            }
        }
    }
    solve(count, normal, right)
}

/// Solves `a·x = b` for square matrices by elimination; `a` is positive definite.
fn solve(n: usize, mut a: Vec<f64>, mut b: Vec<f64>) -> Vec<f64> {
    for pivot in 0..n {
        let inverse = 1.0 / a[pivot * n + pivot];
        for k in 0..n {
            a[pivot * n + k] *= inverse;
            b[pivot * n + k] *= inverse;
        }
        for row in (0..n).filter(|&row| row != pivot) {
            let factor = a[row * n + pivot];
            for k in 0..n {
                a[row * n + k] -= factor * a[pivot * n + k];
                b[row * n + k] -= factor * b[pivot * n + k];
            }
        }
    }
    b
}

#[cfg(test)]
mod tests {
    use b2p::gaussians::Harmonics;

    use super::*;

    #[test]
    fn a_turned_gaussian_has_along_turned_directions_the_colours_it_had() {
        let coefficients: Vec<[f64; 3]> = (0..15).map(|i| [0.1 * i as f64, 0.3 - 0.05 * i as f64, 0.2]).collect();
        for quaternion in [[0.0, 0.0, 0.0, 1.0], [0.5, 0.5, -0.5, 0.5], [0.8, 0.1, -0.5, 0.3]] {
            let turn = Turn::new(quaternion);
            let mut turned = coefficients.clone();
            turn.coefficients(&mut turned);
            let harmonics = |of: &[[f64; 3]]| Harmonics {
                count: 15,
                coefficients: of.iter().map(|c| c.map(|x| x as f32)).collect(),
            };
            let (before, after) = (harmonics(&coefficients), harmonics(&turned));
            for direction in [[1.0, 0.0, 0.0], [0.0, 0.6, -0.8], [0.48, 0.6, 0.64], [-0.36, 0.48, 0.8]] {
                let seen = before.seen(0, [9.0; 3], direction.map(|x: f64| x as f32));
                let rotated = turn.point(direction).map(|x| x as f32);
                let again = after.seen(0, [9.0; 3], rotated);
                for k in 0..3 {
                    assert!((seen[k] - again[k]).abs() < 1e-5, "{quaternion:?} {direction:?}");
                }
            }
        }
    }

    const UPS: [Up; 6] = [Up::X, Up::MinusX, Up::Y, Up::MinusY, Up::Z, Up::MinusZ];

    #[test]
    fn the_axis_that_pointed_up_points_where_the_format_has_up() {
        for up in UPS {
            let (axis, negative) = up.axis();
            let mut way = [0.0; 3];
            way[axis] = if negative { -1.0 } else { 1.0 };
            for (to, expected) in [(Axes::Ply, [0.0, -1.0, 0.0]), (Axes::Gltf, [0.0, 1.0, 0.0])] {
                let turn = Turn::between(Axes::Cloud(up), to);
                assert_eq!(
                    turn.is_none(),
                    way == expected && (up == Up::Y || up == Up::MinusY),
                    "{up}"
                );
                let Some(turn) = turn else { continue };
                assert_eq!(turn.point(way), expected, "{up}");
                let back = Turn::between(to, Axes::Cloud(up)).unwrap();
                assert_eq!(back.point(turn.point([1.0, 2.0, 3.0])), [1.0, 2.0, 3.0]);
                // The quaternion is the same rotation as the matrix.
                let from = matrix(turn.quaternion);
                let same = from.as_flattened().iter().zip(turn.matrix.as_flattened());
                assert!(same.into_iter().all(|(a, b)| (a - b).abs() < 1e-12), "{up}");
            }
        }
        assert!(Turn::between(Axes::Cloud(Up::MinusY), Axes::Ply).is_none());
    }

    #[test]
    fn a_cube_is_turned_with_its_scene() {
        let mut g = Gaussians {
            position: vec![[0.5, -0.25, 1.0]],
            rotation: vec![[1.0, 0.0, 0.0, 0.0]],
            frame: Frame {
                bits: 3,
                placement: Placement {
                    origin: [10.0, 20.0, 30.0],
                    voxel_size: 0.5,
                },
            },
            ..Gaussians::default()
        };
        let place = |g: &Gaussians| g.frame.placement.from_cube(g.frame.bits, g.position[0]);
        for up in UPS {
            let Some(turn) = Turn::between(Axes::Cloud(up), Axes::Ply) else {
                continue;
            };
            let expected = turn.point(place(&g));
            let before = g.clone();
            turn.apply(&mut g);
            assert_eq!(place(&g), expected, "{up}");
            Turn::between(Axes::Ply, Axes::Cloud(up)).unwrap().apply(&mut g);
            assert_eq!((g.frame, &g.position), (before.frame, &before.position));
        }
    }

    #[test]
    fn half_a_turn_about_z_negates_x_and_y() {
        let turn = Turn::between(Axes::Ply, Axes::Gltf).unwrap();
        assert_eq!(turn.point([1.0, 2.0, 3.0]), [-1.0, -2.0, 3.0]);
        let mut coefficients = [[1.0; 3]; 15];
        turn.coefficients(&mut coefficients);
        let odd = [0, 2, 4, 6, 8, 10, 12, 14];
        for (i, c) in coefficients.iter().enumerate() {
            let sign = if odd.contains(&i) { -1.0 } else { 1.0 };
            assert!((c[0] - sign).abs() < 1e-12, "{i}: {c:?}");
        }
    }
}
