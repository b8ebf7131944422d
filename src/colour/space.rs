//! YCoCg-R in fixed point, and the quantisation steps of its channels (`docs/format.md`, clauses 5.1 and 5.2).

/// Y, Co and Cg of a voxel in units of `2^−fraction` of one 255th.
pub type Ycc = [i16; 3];

/// Fractional bits of lossy colours. Lossless colours have none.
pub const FRACTION: u32 = 6;

/// Quantisation steps of a slice, as indices.
///
/// An index `i` from 0 to [`Steps::MAX`] is a step of about `2^(i/8 − 1)` 255ths, exactly
/// `[32, 35, 38, 41, 45, 49, 54, 59][i mod 8] · 2^⌊i/8⌋ / 64`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Steps {
    /// Index of Y's step: 0 to 87, or [`Steps::EXACT`].
    pub luma: u8,
    /// Index of Cg's step: 0 to 87, [`Steps::ABSENT`], or [`Steps::EXACT`] exactly if luma's is. Co's index is greater
    /// by 2.
    pub chroma: u8,
}

impl Steps {
    /// Maximum index of a step.
    pub const MAX: u8 = 87;
    /// Chroma index: chroma has no coefficients.
    pub const ABSENT: u8 = 254;
    /// Both indices: coding is lossless, with steps of 1.
    pub const EXACT: u8 = 255;
    /// Steps of lossless colours.
    pub const LOSSLESS: Steps = Steps {
        luma: Steps::EXACT,
        chroma: Steps::EXACT,
    };

    /// Whether the format allows these indices.
    pub fn is_valid(self) -> bool {
        let lossy = self.luma <= Steps::MAX && (self.chroma <= Steps::MAX || self.chroma == Steps::ABSENT);
        lossy || self == Steps::LOSSLESS
    }

    /// Steps that are coarser by so many indices, as far as there are any; of lossy ones.
    #[cfg(feature = "encoder")]
    pub fn coarser(self, by: u8) -> Steps {
        let coarser = |index: u8, most: u8| if index <= most { (index + by).min(most) } else { index };
        Steps {
            luma: coarser(self.luma, Steps::MAX),
            // Co's index is greater by 2.
            chroma: coarser(self.chroma, Steps::MAX - 2),
        }
    }

    /// Whether coding is lossless.
    pub fn is_lossless(self) -> bool {
        self == Steps::LOSSLESS
    }

    /// Number of fractional bits of the coded colours: 0 if lossless, else [`FRACTION`].
    pub(crate) fn fraction(self) -> u32 {
        if self.is_lossless() { 0 } else { FRACTION }
    }

    /// The steps of the level above: half as large, but not below index 0.
    pub(crate) fn above(self) -> Steps {
        self.finer(8)
    }

    /// Steps that are finer by so many indices, but not below index 0.
    pub(crate) fn finer(self, indices: u8) -> Steps {
        if self.is_lossless() {
            return self;
        }
        let chroma = if self.chroma == Steps::ABSENT {
            self.chroma
        } else {
            self.chroma.saturating_sub(indices)
        };
        Steps {
            luma: self.luma.saturating_sub(indices),
            chroma,
        }
    }

    /// Steps of Y, Co and Cg in units of `2^−fraction` ([`Steps::fraction`]); 0 for a channel without coefficients.
    pub(crate) fn units(self) -> [i32; 3] {
        if self.is_lossless() {
            return [1; 3];
        }
        let chroma = |index_offset: u8| {
            if self.chroma == Steps::ABSENT {
                0
            } else {
                units(self.chroma + index_offset)
            }
        };
        [units(self.luma), chroma(2), chroma(0)]
    }

    /// Step of luma in 255ths; 1 if lossless.
    pub fn luma_step(self) -> f32 {
        if self.is_lossless() {
            1.0
        } else {
            units(self.luma) as f32 / 64.0
        }
    }
}

/// Step of an index in units of 1/64 of a 255th.
fn units(index: u8) -> i32 {
    const MANTISSA: [i32; 8] = [32, 35, 38, 41, 45, 49, 54, 59];
    MANTISSA[usize::from(index % 8)] << (index / 8)
}

/// Converts RGB to YCoCg-R. Exactly reversible by [`to_rgb`].
#[cfg(any(test, feature = "encoder"))]
pub(crate) fn from_rgb([r, g, b]: [i32; 3]) -> [i32; 3] {
    let co = r - b;
    let t = b + (co >> 1);
    let cg = g - t;
    [t + (cg >> 1), co, cg]
}

/// Converts YCoCg-R to RGB.
pub(crate) fn to_rgb([y, co, cg]: [i32; 3]) -> [i32; 3] {
    let t = y - (cg >> 1);
    let b = t - (co >> 1);
    [b + co, cg + t, b]
}

/// Converts to 8-bit RGB, rounded to the nearest integer.
pub(crate) fn display(ycc: Ycc, fraction: u32) -> [u8; 3] {
    let half = (1 << fraction) >> 1;
    to_rgb(ycc.map(i32::from)).map(|x| ((x + half) >> fraction).clamp(0, 255) as u8)
}

/// Clamps a channel to ±256 (in units of one 255th), slightly beyond the range of valid colours.
#[inline(always)]
pub(crate) fn clamp(value: i32, fraction: u32) -> i16 {
    let limit = 256 << fraction;
    value.clamp(-limit, limit) as i16
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_sixth_display_colour_survives_the_round_trip() {
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
