//! The functions between raw numbers and Gaussians, in IEEE f32 additions, multiplications and divisions alone: the
//! same bits on every machine, which no mathematical library promises. No branch, so that loops over them become vector
//! instructions.

/// Adding this to a small float leaves its nearest integer in the low bits: `1.5·2²³`.
const ROUND: f32 = 12_582_912.0;
/// ln 2 = HIGH + LOW; HIGH has few enough bits that its products by small integers are exact.
const LN2_HIGH: f32 = 0.693_359_4;
const LN2_LOW: f32 = -2.121_944_4e-4;

/// `eˣ` with a relative error below 2·10⁻⁷; beyond ±87 that of ±87.
#[inline(always)]
fn exp(x: f32) -> f32 {
    let x = x.clamp(-87.0, 87.0);
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = x - n * LN2_HIGH - n * LN2_LOW;
    // The series up to r⁷/7!, |r| ≤ ln 2 / 2.
    let p = r * (1.0 / 5040.0) + 1.0 / 720.0;
    let p = p * r + 1.0 / 120.0;
    let p = p * r + 1.0 / 24.0;
    let p = p * r + 1.0 / 6.0;
    let p = p * r + 0.5;
    let p = p * r + 1.0;
    let p = p * r + 1.0;
    f32::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 23))
}

/// `1 / (1 + e⁻ˣ)`, within 10⁻⁷.
#[inline(always)]
pub(crate) fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// The hyperbolic tangent, within 3·10⁻⁷.
#[inline(always)]
pub(crate) fn tanh(x: f32) -> f32 {
    1.0 - 2.0 / (1.0 + exp(2.0 * x))
}

/// `ln(1 + eˣ)`, with a relative error below 5·10⁻⁷ down to x = −87.
#[inline(always)]
pub(crate) fn softplus(x: f32) -> f32 {
    // ln(1 + t) = 2 artanh(s), s = t / (2 + t) ≤ 1/3.
    let t = exp(-x.abs());
    let s = t / (2.0 + t);
    let q = s * s;
    let p = q * (1.0 / 13.0) + 1.0 / 11.0;
    let p = p * q + 1.0 / 9.0;
    let p = p * q + 1.0 / 7.0;
    let p = p * q + 1.0 / 5.0;
    let p = p * q + 1.0 / 3.0;
    let p = p * q + 1.0;
    x.max(0.0) + 2.0 * s * p
}

/// The logarithm to base 2 of a normal number above 0, within 10⁻⁷ of its size or of 1.
pub(crate) fn log2(x: f32) -> f32 {
    let bits = x.to_bits();
    let exponent = (bits >> 23) as i32 - 127;
    let mantissa = f64::from(f32::from_bits(bits & 0x7f_ffff | 0x3f80_0000));
    // ln m = 2 artanh(s), s = (m − 1) / (m + 1) < 1/3.
    let s = (mantissa - 1.0) / (mantissa + 1.0);
    let q = s * s;
    let mut series = 0.0;
    for k in (0..10).rev() {
        series = series * q + 1.0 / f64::from(2 * k + 1);
    }
    (f64::from(exponent) + 2.0 * s * series * std::f64::consts::LOG2_E) as f32
}

/// Gaussians whose numbers are computed side by side.
pub(crate) const GROUP: usize = 16;

pub(crate) type Lane = [f32; GROUP];

/// The unit quaternions along `q`; the identity for zero.
pub(crate) fn normalised(mut q: [Lane; 4]) -> [Lane; 4] {
    let mut norm = [0.0f64; GROUP];
    for component in &q {
        for (norm, x) in norm.iter_mut().zip(component) {
            *norm += f64::from(*x).powi(2);
        }
    }
    let norm = norm.map(f64::sqrt);
    for (i, component) in q.iter_mut().enumerate() {
        let identity = if i == 0 { 1.0 } else { 0.0 };
        for (x, norm) in component.iter_mut().zip(norm) {
            let unit = (f64::from(*x) / norm) as f32;
            *x = if norm > 0.0 { unit } else { identity };
        }
    }
    q
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The largest error of `f` against `exact` on a fine grid over ±limit, each divided by `unit(exact)`.
    fn worst(limit: f32, f: fn(f32) -> f32, exact: fn(f64) -> f64, unit: fn(f64) -> f64) -> f64 {
        (-200_000..=200_000)
            .map(|i| {
                let x = i as f32 / 200_000.0 * limit;
                let wanted = exact(f64::from(x));
                (f64::from(f(x)) - wanted).abs() / unit(wanted)
            })
            .fold(0.0, f64::max)
    }

    #[test]
    fn the_functions_keep_their_stated_errors() {
        assert!(worst(86.9, exp, f64::exp, |y| y) < 2e-7);
        assert!(worst(30.0, sigmoid, |x| 1.0 / (1.0 + (-x).exp()), |_| 1.0) < 1e-7);
        assert!(worst(12.0, tanh, f64::tanh, |_| 1.0) < 3e-7);
        assert!(worst(60.0, softplus, |x| x.max(0.0) + (-x.abs()).exp().ln_1p(), |y| y) < 5e-7);
    }

    #[test]
    fn logarithms_are_exact_at_powers_of_two_and_close_between() {
        for k in -20..=20 {
            assert_eq!(log2(2f32.powi(k)), k as f32);
        }
        for i in 1..100_000 {
            let x = i as f32 * 0.037;
            let exact = f64::from(x).log2();
            assert!((f64::from(log2(x)) - exact).abs() < 1e-7 * exact.abs().max(1.0), "{x}");
        }
    }

    #[test]
    fn the_ends_of_the_line_give_finite_limits() {
        for (x, s, t) in [(f32::MAX, 1.0, 1.0), (f32::MIN, 0.0, -1.0)] {
            assert!((sigmoid(x) - s).abs() < 1e-30 && tanh(x) == t);
            assert!(softplus(x).is_finite() && softplus(x) >= 0.0);
        }
        assert_eq!(tanh(0.0), 0.0);
    }

    #[test]
    fn the_bits_are_those_of_every_other_machine() {
        // Computed once; any machine that keeps IEEE 754 finds the same.
        let mut hash = 0u64;
        for i in -4000..=4000 {
            let x = i as f32 / 100.0;
            for y in [exp(x), sigmoid(x), tanh(x), softplus(x)] {
                hash = (hash ^ u64::from(y.to_bits())).wrapping_mul(0x100_0000_01b3);
            }
        }
        assert_eq!(hash, 18_409_397_396_707_136_996);
    }
}
