//! YCoCg-R in fixed point, and the quantisation steps of its channels.

/// Y, Co and Cg of a voxel, in units of 2^−fraction of one 255th.
pub type Ycc = [i16; 3];

/// Fractional bits of lossy colours. Lossless colours have none.
pub const FRACTION: u32 = 6;

/// How finely a slice's coefficients are quantised.
///
/// An index `i` below [`Steps::ABSENT`] stands for a step of about `2^(i/8 − 1)` 255ths, exactly
/// `[32, 35, 38, 41, 45, 49, 54, 59][i mod 8] · 2^⌊i/8⌋ / 64`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Steps {
    /// Index of luma's step: 0 to 87, or [`Steps::EXACT`].
    pub luma: u8,
    /// Index of Cg's step: 0 to 87, [`Steps::ABSENT`], or [`Steps::EXACT`] if luma's is. Co's step is two indices greater.
    pub chroma: u8,
}

impl Steps {
    /// The greatest index of a step.
    pub const MAX: u8 = 87;
    /// As a chroma index: chroma coefficients are all 0 and are not coded.
    pub const ABSENT: u8 = 254;
    /// As both indices: coefficients are integers, and colours exact.
    pub const EXACT: u8 = 255;
    /// Exact colours.
    pub const LOSSLESS: Steps = Steps {
        luma: Steps::EXACT,
        chroma: Steps::EXACT,
    };

    /// Whether these are indices that a stream may have.
    pub fn is_valid(self) -> bool {
        let lossy = self.luma <= Steps::MAX && (self.chroma <= Steps::MAX || self.chroma == Steps::ABSENT);
        lossy || self == Steps::LOSSLESS
    }

    /// Whether colours are exact.
    pub fn is_lossless(self) -> bool {
        self == Steps::LOSSLESS
    }

    /// Fractional bits of the colours that are coded in these steps.
    pub(crate) fn fraction(self) -> u32 {
        if self.is_lossless() { 0 } else { FRACTION }
    }

    /// The steps of the level above: half as large, down to the finest there is.
    pub(crate) fn above(self) -> Steps {
        if self.is_lossless() {
            return self;
        }
        let chroma = if self.chroma == Steps::ABSENT {
            self.chroma
        } else {
            self.chroma.saturating_sub(8)
        };
        Steps {
            luma: self.luma.saturating_sub(8),
            chroma,
        }
    }

    /// The steps of Y, Co and Cg in units of 2^−[`Steps::fraction`]; 0 for a channel without coefficients.
    pub(crate) fn units(self) -> [i32; 3] {
        if self.is_lossless() {
            return [1; 3];
        }
        let chroma = |more: u8| {
            if self.chroma == Steps::ABSENT {
                0
            } else {
                units(self.chroma + more)
            }
        };
        [units(self.luma), chroma(2), chroma(0)]
    }

    /// The step of luma in 255ths; 1 for exact colours.
    pub fn luma_step(self) -> f32 {
        if self.is_lossless() {
            1.0
        } else {
            units(self.luma) as f32 / 64.0
        }
    }
}

/// The step of an index, in 64ths of a 255th.
fn units(index: u8) -> i32 {
    const MANTISSA: [i32; 8] = [32, 35, 38, 41, 45, 49, 54, 59];
    MANTISSA[usize::from(index % 8)] << (index / 8)
}

/// YCoCg of red, green and blue. Shifts round down, so that [`to_rgb`] undoes it exactly.
#[cfg(any(test, feature = "encoder"))]
pub(crate) fn from_rgb([r, g, b]: [i32; 3]) -> [i32; 3] {
    let co = r - b;
    let t = b + (co >> 1);
    let cg = g - t;
    [t + (cg >> 1), co, cg]
}

/// Red, green and blue of YCoCg.
pub(crate) fn to_rgb([y, co, cg]: [i32; 3]) -> [i32; 3] {
    let t = y - (cg >> 1);
    let b = t - (co >> 1);
    [b + co, cg + t, b]
}

/// The nearest display colour.
pub(crate) fn display(ycc: Ycc, fraction: u32) -> [u8; 3] {
    let half = (1 << fraction) >> 1;
    to_rgb(ycc.map(i32::from)).map(|x| ((x + half) >> fraction).clamp(0, 255) as u8)
}

/// The values that channels are kept within: what valid colours have, and a little more.
#[inline(always)]
pub(crate) fn clamp(value: i32, fraction: u32) -> i16 {
    let limit = 256 << fraction;
    value.clamp(-limit, limit) as i16
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_sixth_display_colour_comes_back() {
        for r in (0..256).step_by(6).chain([255]) {
            for g in (0..256).step_by(6).chain([255]) {
                for b in (0..256).step_by(6).chain([255]) {
                    for fraction in [0, FRACTION] {
                        let ycc = from_rgb([r << fraction, g << fraction, b << fraction]);
                        assert!(ycc.iter().all(|x| i32::from(clamp(*x, fraction)) == *x));
                        let back = display(ycc.map(|x| x as i16), fraction);
                        assert_eq!(back.map(i32::from), [r, g, b]);
                    }
                }
            }
        }
    }

    #[test]
    fn steps_double_every_eight_indices() {
        for luma in 0..=Steps::MAX {
            let steps = Steps { luma, chroma: luma };
            let exact = f32::from(luma) / 8.0 - 1.0;
            assert!((steps.luma_step() / exact.exp2() - 1.0).abs() < 0.013, "{luma}");
            if luma >= 8 {
                assert_eq!(steps.above().luma_step() * 2.0, steps.luma_step());
            }
        }
    }

    #[test]
    fn only_exact_luma_has_exact_chroma() {
        let steps = |luma, chroma| Steps { luma, chroma };
        assert!(steps(0, 87).is_valid() && steps(87, Steps::ABSENT).is_valid());
        assert!(Steps::LOSSLESS.is_valid());
        assert!(!steps(88, 0).is_valid() && !steps(0, Steps::EXACT).is_valid());
        assert!(!steps(Steps::EXACT, 0).is_valid() && !steps(Steps::ABSENT, 0).is_valid());
    }
}
