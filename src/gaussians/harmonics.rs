//! View-dependent colour: real spherical harmonics of degree 1 to 3, in the convention of splat files.

/// View-dependent part of the colour, which is added to [`Gaussians::colour`](super::Gaussians::colour).
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Harmonics {
    /// Coefficients per Gaussian: 0, 3, 8 or 15 for degree 0 to 3.
    pub count: usize,
    /// [`Harmonics::count`] RGB coefficients per Gaussian, by ascending degree and order.
    pub coefficients: Vec<[f32; 3]>,
}

const C1: f32 = 0.488_602_5;
const C2: [f32; 5] = [1.092_548_4, -1.092_548_4, 0.315_391_57, -1.092_548_4, 0.546_274_2];
const C3: [f32; 7] = [
    -0.590_043_6,
    2.890_611_4,
    -0.457_045_8,
    0.373_176_34,
    -0.457_045_8,
    1.445_305_7,
    -0.590_043_6,
];

impl Harmonics {
    /// Evaluates the colour of Gaussian `i` along a unit vector from the eye to it, and clamps it to 0 from below.
    /// `colour` is the coefficient of degree 0.
    ///
    /// # Panics
    /// If Gaussian `i` has no coefficients.
    #[doc(hidden)]
    pub fn seen(&self, i: usize, colour: [f32; 3], [x, y, z]: [f32; 3]) -> [f32; 3] {
        let coefficients = &self.coefficients[i * self.count..][..self.count];
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let basis = [
            -C1 * y,
            C1 * z,
            -C1 * x,
            C2[0] * x * y,
            C2[1] * y * z,
            C2[2] * (2.0 * zz - xx - yy),
            C2[3] * x * z,
            C2[4] * (xx - yy),
            C3[0] * y * (3.0 * xx - yy),
            C3[1] * x * y * z,
            C3[2] * y * (4.0 * zz - xx - yy),
            C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            C3[4] * x * (4.0 * zz - xx - yy),
            C3[5] * z * (xx - yy),
            C3[6] * x * (xx - 3.0 * yy),
        ];
        let mut sum = colour;
        for (c, b) in coefficients.iter().zip(basis) {
            for k in 0..3 {
                sum[k] += b * c[k];
            }
        }
        // `max` would replace NaN.
        sum.map(|s| if s < 0.0 { 0.0 } else { s })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_basis_is_orthonormal_over_the_sphere() {
        // Directions on a spiral sample the sphere evenly, so the mean of the products is their integral over 4π.
        let count = 20_000;
        let golden = std::f32::consts::PI * (3.0 - 5f32.sqrt());
        let mut products = [[0.0f64; 15]; 15];
        for i in 0..count {
            let y = 1.0 - 2.0 * (i as f32 + 0.5) / count as f32;
            let (sin, cos) = (golden * i as f32).sin_cos();
            let ring = (1.0 - y * y).sqrt();
            let basis: [f64; 15] = std::array::from_fn(|k| {
                let mut one = Harmonics {
                    count: 15,
                    coefficients: vec![[0.0; 3]; 15],
                };
                one.coefficients[k][0] = 1.0;
                let seen = one.seen(0, [9.0; 3], [cos * ring, y, sin * ring]);
                f64::from(seen[0] - 9.0)
            });
            for (a, row) in basis.iter().zip(&mut products) {
                for (b, sum) in basis.iter().zip(row) {
                    *sum += a * b * 4.0 * std::f64::consts::PI / f64::from(count);
                }
            }
        }
        for (i, row) in products.iter().enumerate() {
            for (j, product) in row.iter().enumerate() {
                let expected = f64::from(u8::from(i == j));
                assert!((product - expected).abs() < 2e-3, "{i} {j}: {product}");
            }
        }
    }
}
