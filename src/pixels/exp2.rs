//! Powers of two, fast enough for every pixel of every ellipse.

/// The least exponent whose power is not subnormal.
const LOWEST: f32 = -126.0;
/// Adding this to a small float leaves its nearest integer in the low bits: `1.5·2²³`.
const ROUND: f32 = 12_582_912.0;

/// `2^x` for `x ≤ 127`, with a relative error below `3.1·10⁻⁶`, exact for integers; `2⁻¹²⁶` for what is below −126, and for NaN.
///
/// No branch and no table, so that a loop over it becomes vector instructions: `x` is split into an integer, which goes into the
/// exponent bits, and a fraction in `[−½, ½]`, whose power is the polynomial of degree 4 through (0, 1) with the least largest
/// relative error.
#[inline(always)]
pub(super) fn exp2(x: f32) -> f32 {
    let x = if x > LOWEST { x } else { LOWEST };
    let shifted = x + ROUND;
    let f = x - (shifted - ROUND);
    let p = 9.582_853e-3;
    let p = p * f + 5.590_642_6e-2;
    let p = p * f + 2.402_41e-1;
    let p = p * f + 6.931_242e-1;
    let p = p * f + 1.0;
    f32::from_bits(f32::to_bits(p).wrapping_add(shifted.to_bits() << 23))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_power_is_within_its_error_over_the_whole_range() {
        let mut largest = 0.0f64;
        for step in 0..=127 * 5000 {
            let x = 1.0 - step as f32 / 5000.0;
            let exact = f64::from(x).exp2();
            largest = largest.max((f64::from(exp2(x)) / exact - 1.0).abs());
        }
        assert!(largest < 3.1e-6, "{largest:e}");
        assert!(
            largest > 2.5e-6,
            "the stated error is too careful: {largest:e}"
        );
    }

    #[test]
    fn integers_are_exact_and_the_rest_of_the_line_stays_tiny() {
        for n in -126..=127 {
            assert_eq!(exp2(n as f32), 2.0f32.powi(n));
        }
        for x in [-126.5, -1e9, f32::MIN, f32::NEG_INFINITY, f32::NAN] {
            assert_eq!(exp2(x), f32::MIN_POSITIVE);
        }
    }
}
