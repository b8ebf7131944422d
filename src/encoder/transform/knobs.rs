//! Quality and effort as one number each: what they stand for.

use super::{Options, QualityTarget, Tune};

/// A stretch of the scale, from one quality to the next stretch's: how many levels above the cloud's own the finest
/// coded level is, and the quantisation steps of luma at both ends. Streams of the sample are about as long where a
/// stretch ends as where the next begins.
struct Stretch {
    from: u8,
    above: u8,
    steps: [f32; 2],
}

const STRETCHES: [Stretch; 3] = [
    Stretch {
        from: 0,
        above: 2,
        steps: [64.0, 9.0],
    },
    Stretch {
        from: 20,
        above: 1,
        steps: [64.0, 10.0],
    },
    Stretch {
        from: 50,
        above: 0,
        steps: [64.0, 1.0],
    },
];

/// The level above the cloud's own, and the step of luma, of a quality below 100.
fn place(quality: u8) -> (u8, f32) {
    let i = STRETCHES
        .iter()
        .rposition(|stretch| stretch.from <= quality)
        .unwrap_or(0);
    let Stretch { from, above, steps } = STRETCHES[i];
    let end = STRETCHES.get(i + 1).map_or(100, |next| next.from);
    let share = f32::from(quality - from) / f32::from(end - from - 1);
    (above, steps[0] * (steps[1] / steps[0]).powf(share))
}

impl Options {
    /// Sets what a quality from 0 to 100 stands for, for a cloud of bit depth `bits`. Levels that were asked for stay.
    pub fn set_quality(&mut self, quality: u8, bits: u8) {
        let (above, fineness) = match quality {
            100.. => (0, QualityTarget::Lossless),
            _ => {
                let (above, step) = place(quality);
                (above, QualityTarget::Step(step))
            }
        };
        self.fineness = fineness;
        let top = bits.saturating_sub(above);
        let levels = self.levels.take();
        self.levels = Some(levels.unwrap_or(bits.saturating_sub(3).min(top)..=top));
    }

    /// Sets what an effort from 0 to 9 stands for; 7 is the default. Efforts above 7 draw the stream from all sides, and
    /// move colours by the gradient of the squared error, in up to 2 or 8 [`rounds`](Options::rounds).
    pub fn set_effort(&mut self, effort: u8) {
        self.optimised = effort > 0;
        self.filter &= effort > 1;
        if effort < 3 {
            self.tune = Tune::Psnr;
        }
        self.tries = match effort {
            7.. => usize::MAX,
            _ => 2 + usize::from(effort),
        };
        self.rounds = match effort {
            9.. => 8,
            8 => 2,
            _ => 0,
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_quality_is_a_finer_level_or_a_finer_step() {
        let mut last = (2, f32::INFINITY);
        for quality in 0..100 {
            let (above, step) = place(quality);
            assert!(
                above < last.0 || (above == last.0 && step < last.1),
                "{quality}: {above} {step}"
            );
            last = (above, step);
        }
        assert_eq!(last, (0, 1.0));
        let mut options = Options::default();
        options.set_quality(100, 10);
        assert_eq!(options.fineness, QualityTarget::Lossless);
        assert_eq!(options.levels, Some(7..=10));
    }

    #[test]
    fn the_default_is_a_quality_of_about_38() {
        let QualityTarget::Step(usual) = Options::default().fineness else {
            panic!("a step");
        };
        let (above, step) = place(38);
        assert_eq!(above, 1);
        assert!((step / usual).ln().abs() < 0.05, "{step}");
    }

    #[test]
    fn levels_that_are_asked_for_stay() {
        let mut options = Options {
            levels: Some(5..=7),
            ..Options::default()
        };
        options.set_quality(90, 10);
        assert_eq!(options.levels, Some(5..=7));
        options.levels = None;
        options.set_quality(90, 1);
        assert_eq!(options.levels, Some(0..=1));
    }

    #[test]
    fn an_effort_of_7_is_the_default_and_more_has_rounds() {
        let usual = Options::default();
        let of = |effort| {
            let mut options = Options::default();
            options.set_effort(effort);
            options
        };
        assert_eq!(format!("{:?}", of(7)), format!("{usual:?}"));
        let rounds: Vec<usize> = (0..10).map(|effort| of(effort).rounds).collect();
        assert_eq!(rounds, [0, 0, 0, 0, 0, 0, 0, 0, 2, 8]);
    }
}
