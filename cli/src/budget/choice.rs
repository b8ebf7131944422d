//! A time budget or a least accuracy, in place of single settings.

use std::time::Duration;

use super::calibration::{Calibration, DrawCost};
use b2p::Limits;
use b2p::container::Header;
use b2p::gaussians::Heads;
use b2p::latents::network::Model;
use b2p::layers::Precision;
use b2p::renderer::Quality;
use b2p::{Error, Result};

/// A time is promised only if the estimate, so many times and with so many nanoseconds more, keeps it: in short tasks
/// it shows when a thread wakes late, or a page is long in coming.
const MARGIN: f64 = 1.1;
const SPARE: f64 = 1e6;

/// A stream to measure with.
pub struct CalibrationInput<'a> {
    /// The stream.
    pub stream: &'a [u8],
    /// Loads the model that it was coded with.
    pub model: &'a dyn Fn() -> Result<Model>,
    /// Limits of decoding and drawing.
    pub limits: &'a Limits,
}

/// What is asked for. With a time, the most accurate setting that fits it; with an accuracy alone, the fastest that has
/// it.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Budget {
    /// The time that the task may take.
    pub time: Option<Duration>,
    /// The least PSNR in dB against pictures in double precision. It is an estimate: that of the stream that was
    /// calibrated with.
    pub min_psnr: Option<f64>,
}

/// What is to be done in the time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Task {
    /// From a stream in memory to its Gaussians.
    Decode,
    /// From Gaussians to one picture of so many pixels, from where the program's camera stands: from nearer, it shows
    /// more.
    Picture {
        /// Width times height.
        pixels: u64,
    },
}

/// A setting, and what is expected of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Choice {
    /// Octree level.
    pub level: u8,
    /// What generates Gaussians.
    pub heads: Heads,
    /// Precision of the network.
    pub precision: Precision,
    /// Quality of the renderer; it takes no part in decoding.
    pub quality: Quality,
    /// Time of the task.
    pub expected: Duration,
    /// PSNR in dB of the setting in the calibration.
    pub psnr: f64,
    /// Whether that fits the time budget, with a tenth and a millisecond to spare.
    pub in_time: bool,
    /// Whether it has the accuracy asked for.
    pub accurate: bool,
}

impl Budget {
    /// The setting for a stream with this header, of which `levels` can be decoded to Gaussians.
    ///
    /// If no setting both fits the budget and has the accuracy, the budget comes first; if none fits it either, it is
    /// the fastest.
    ///
    /// # Errors
    /// [`Error::Usage`] if the calibration knows none of the levels.
    pub fn choose(&self, calibration: &Calibration, header: &Header, levels: &[u8], task: Task) -> Result<Choice> {
        let of_level = |&level: &u8| {
            let role = usize::from(level.checked_sub(header.base)?);
            let draws = calibration.draws.iter().filter(move |d| d.role == role);
            Some(draws.filter_map(move |draw| self.rate(calibration, header, level, draw, task)))
        };
        let all: Vec<Choice> = levels.iter().filter_map(of_level).flatten().collect();
        let most_accurate = |a: &&Choice, b: &&Choice| {
            let faster = || b.expected.cmp(&a.expected);
            a.psnr.total_cmp(&b.psnr).then_with(faster)
        };
        let fits = |c: &&Choice| c.in_time && c.accurate;
        let best = match self.time {
            None => all.iter().filter(fits).min_by_key(|c| c.expected),
            Some(_) => all.iter().filter(fits).max_by(most_accurate),
        };
        let in_time = || match self.time {
            // No setting is accurate enough: the nearest to it.
            None => all.iter().max_by(most_accurate),
            Some(_) => all.iter().filter(|c| c.in_time).max_by(most_accurate),
        };
        let fastest = || all.iter().min_by_key(|c| c.expected);
        let chosen = best.or_else(in_time).or_else(fastest);
        chosen.copied().ok_or_else(|| {
            Error::Usage(format!(
                "nothing is known of what the levels {levels:?} of this stream take: calibrate again"
            ))
        })
    }

    fn rate(
        &self,
        calibration: &Calibration,
        header: &Header,
        level: u8,
        draw: &DrawCost,
        task: Task,
    ) -> Option<Choice> {
        let heads: Heads = draw.heads.parse().ok()?;
        let precision: Precision = draw.precision.parse().ok()?;
        let quality: Quality = draw.quality.parse().ok()?;
        let voxels = |role: usize| header.voxels.get(role).copied().map(f64::from);
        let here = voxels(draw.role)?;
        let nanoseconds = match task {
            Task::Decode => {
                let exact = calibration.exact.iter().zip(&header.voxels).take(draw.role + 1);
                let exact: f64 = exact.map(|(cost, &n)| cost.of(f64::from(n))).sum();
                calibration.start + exact + draw.generate.of(here)
            }
            Task::Picture { pixels } => {
                let gaussians = here * f64::from(draw.children);
                draw.draw.of(gaussians, faces(here, level), pixels as f64)
            }
        };
        let expected = Duration::try_from_secs_f64(nanoseconds / 1e9).ok()?;
        Some(Choice {
            level,
            heads,
            precision,
            quality,
            expected,
            psnr: draw.psnr,
            in_time: self
                .time
                .is_none_or(|time| nanoseconds * MARGIN + SPARE <= time.as_secs_f64() * 1e9),
            accurate: self.min_psnr.is_none_or(|least| draw.psnr >= least),
        })
    }
}

/// The area of a surface of so many voxels of a level, in faces of the cube.
pub(super) fn faces(voxels: f64, level: u8) -> f64 {
    voxels / 4f64.powi(level.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::budget::calibration::{LevelCost, PictureCost};
    use b2p::container::{Format, Section};
    use b2p::latents::network::Shape;
    use b2p::metrics::Machine;
    use b2p::placement::Placement;

    fn header() -> Header {
        Header {
            optional_flags: 0,
            bits: 10,
            base: 7,
            top: 9,
            points: 1_000_000,
            placement: Placement::VOXEL_GRID,
            format: Format::Learned { model: [0; 16] },
            slice_voxels: 16_384,
            voxels: vec![10_000, 50_000, 200_000],
            sections: vec![Section::default(); 3],
        }
    }

    fn calibration() -> Calibration {
        let draw = |role, children, generator: [&str; 2], quality: &str, costs: [f64; 3], psnr| DrawCost {
            role,
            children,
            heads: generator[0].into(),
            precision: generator[1].into(),
            quality: quality.into(),
            generate: LevelCost {
                once: 2e6,
                per_voxel: costs[0],
            },
            draw: PictureCost {
                per_gaussian: costs[1],
                per_pixel: costs[2],
                ..PictureCost::default()
            },
            psnr,
        };
        let (best, quick, float) = (["best", "int16"], ["quick", "int16"], ["best", "f16"]);
        Calibration {
            machine: Machine::this(),
            isa: "scalar".into(),
            threads: 2,
            model: String::new(),
            gg: Shape::tiny().gg,
            start: 0.0,
            exact: vec![
                LevelCost {
                    once: 0.0,
                    per_voxel: 1000.0
                };
                3
            ],
            draws: vec![
                draw(1, 8, quick, "fast", [1000.0, 20.0, 5.0], 28.0),
                draw(1, 8, best, "fast", [4000.0, 20.0, 5.0], 30.0),
                draw(2, 1, best, "fast", [1000.0, 20.0, 5.0], 45.0),
                draw(2, 1, best, "exact", [1000.0, 40.0, 9.0], 60.0),
                draw(2, 1, float, "exact", [3000.0, 40.0, 9.0], 70.0),
            ],
        }
    }

    fn choose(time: Option<u64>, min_psnr: Option<f64>, task: Task) -> Choice {
        let time = time.map(Duration::from_millis);
        Budget { time, min_psnr }
            .choose(&calibration(), &header(), &[8, 9], task)
            .unwrap()
    }

    #[test]
    fn the_most_accurate_setting_that_fits_the_budget_is_taken() {
        // Level 8: 62 + 200 ms, with quick heads 62 + 50; level 9: 262 + 200 ms, and 262 + 600 ms in f16.
        let with = |time| choose(Some(time), None, Task::Decode);
        let named = |c: Choice| (c.level, c.heads, c.precision, c.in_time);
        let (best, quick) = (Heads::Best, Heads::Quick);
        assert_eq!(named(with(10_000)), (9, best, Precision::F16, true));
        assert_eq!(named(with(600)), (9, best, Precision::Int16, true));
        assert_eq!(named(with(300)), (8, best, Precision::Int16, true));
        assert_eq!(named(with(200)), (8, quick, Precision::Int16, true));
        assert_eq!(with(600).expected, Duration::from_millis(462));
    }

    #[test]
    fn a_time_that_nothing_keeps_gives_the_fastest_and_says_so() {
        let choice = choose(Some(5), Some(50.0), Task::Decode);
        assert_eq!((choice.level, choice.in_time, choice.accurate), (8, false, false));
    }

    #[test]
    fn an_accuracy_alone_gives_the_fastest_that_has_it() {
        let picture = Task::Picture { pixels: 1_000_000 };
        assert_eq!(choose(None, Some(40.0), picture).quality, Quality::Fast);
        let fine = choose(None, Some(50.0), picture);
        assert_eq!((fine.quality, fine.precision), (Quality::Exact, Precision::Int16));
        let beyond = choose(None, Some(90.0), picture);
        assert_eq!((beyond.precision, beyond.accurate), (Precision::F16, false));
    }

    #[test]
    fn more_time_is_never_used_for_less_accuracy() {
        let picture = Task::Picture { pixels: 500_000 };
        for task in [Task::Decode, picture] {
            let mut before = 0.0;
            for time in 1..1000 {
                let choice = choose(Some(time), None, task);
                if choice.in_time {
                    assert!(choice.psnr >= before, "{time} ms: {choice:?}");
                    before = choice.psnr;
                }
            }
            assert!(before > 0.0);
        }
    }

    #[test]
    fn levels_that_nothing_is_known_of_are_an_error() {
        let budget = Budget::default();
        for levels in [&[][..], &[7], &[3]] {
            let chosen = budget.choose(&calibration(), &header(), levels, Task::Decode);
            assert!(matches!(chosen, Err(Error::Usage(_))), "{levels:?}");
        }
    }
}
