//! The setting that looks best among those that fit a time.

use std::cmp::Ordering;
use std::time::Duration;

use b2p::container::Header;
use b2p::gaussians::HeadSet;
use b2p::{Error, Result};

use super::calibration::Calibration;
use super::costs::{PictureSize, score};

/// A time is promised only if the longest that is likely, so many times and with so many nanoseconds more, keeps it: in
/// short tasks it shows when a thread wakes late, or a page is long in coming.
const MARGIN: f64 = 1.1;
const SPARE: f64 = 3e6;
/// How many times longer or shorter than expected something takes if the calibration is plainly off.
const OFF: f64 = 1.5;

/// What is to be done in the time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Task {
    /// From a stream in memory to its Gaussians.
    Decode,
    /// From a stream in memory to a picture.
    Picture {
        /// Width times height.
        pixels: f64,
        /// Pixels that a cube-frame unit takes at most.
        per_unit: f64,
    },
}

/// A setting, and what is expected of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Choice {
    /// Octree level.
    pub level: u8,
    /// What makes Gaussians.
    pub heads: HeadSet,
    /// Time of the task.
    pub expected: Duration,
    /// How many times as long it may take on this machine.
    spread: f64,
    /// How good pictures are.
    score: f64,
}

impl Choice {
    /// Whether it fits a time, with something to spare.
    pub fn fits(&self, time: Duration) -> bool {
        self.expected.as_secs_f64() * self.spread * MARGIN + SPARE / 1e9 <= time.as_secs_f64()
    }

    /// Whether what it took tells that the machine is another than it was when it was calibrated.
    pub fn is_off(&self, took: Duration) -> bool {
        let (took, expected) = (took.as_secs_f64(), self.expected.as_secs_f64());
        let (spare, off) = (SPARE / 1e9, OFF * self.spread);
        took > expected * off + spare || expected > took * off + spare
    }
}

/// The choices for the `levels` of a stream with this header, with `heads` alone if they are named.
///
/// # Errors
/// [`Error::Usage`] if there are none: the calibration does not know these heads.
pub fn choices(
    calibration: &Calibration,
    header: &Header,
    levels: &[u8],
    heads: Option<HeadSet>,
    task: Task,
) -> Result<Vec<Choice>> {
    let mut all = Vec::new();
    for &level in levels {
        let voxels = f64::from(header.voxels(level)?);
        let above = header.bits - level;
        for cost in calibration.of_levels_above(above) {
            if heads.is_some_and(|heads| heads != cost.heads) {
                continue;
            }
            let decode = [calibration.exact.of(voxels), cost.generate.of(voxels)];
            let [Some(exact), Some(generate)] = decode else {
                continue;
            };
            let picture = match task {
                Task::Decode => 0.0,
                Task::Picture { pixels, per_unit } => {
                    let size = PictureSize::of_surface(pixels, per_unit, voxels, level);
                    cost.picture.of(voxels * cost.per_voxel, size)
                }
            };
            let expected = Duration::try_from_secs_f64((exact + generate + picture) / 1e9);
            all.extend(expected.ok().map(|expected| Choice {
                level,
                heads: cost.heads,
                expected,
                spread: calibration.spread.max(1.0),
                score: score(above, cost.heads),
            }));
        }
    }
    match all.is_empty() {
        true => Err(Error::Usage(
            "no heads of a budget draw the levels of this stream".into(),
        )),
        false => Ok(all),
    }
}

/// The one that looks best among those that fit the time, the fastest of equals; if none fits, the fastest.
pub fn choose(all: &[Choice], time: Duration) -> Option<Choice> {
    let better = |a: &&Choice, b: &&Choice| -> Ordering {
        let faster = || b.expected.cmp(&a.expected);
        a.score.total_cmp(&b.score).then_with(faster)
    };
    let fitting = all.iter().filter(|choice| choice.fits(time));
    let fastest = || all.iter().min_by_key(|choice| choice.expected);
    fitting.max_by(better).or_else(fastest).copied()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::budget::calibration::HeadsCost;
    use crate::budget::costs::{Curve, PictureCost};
    use b2p::container::{Format, Section};
    use b2p::metrics::Machine;
    use b2p::placement::Placement;

    const MS: f64 = 1e6;
    const PICTURE: Task = Task::Picture {
        pixels: 1e6,
        per_unit: 100.0,
    };

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

    /// Eight Gaussians a voxel above level 9: level 8 has twice as many as level 9.
    fn calibration() -> Calibration {
        let heads = |heads, wide, generate: &[[f64; 2]]| HeadsCost {
            heads,
            wide,
            per_voxel: if wide { 8.0 } else { 1.0 },
            generate: Curve(generate.iter().map(|[n, ms]| [*n, ms * MS]).collect()),
            picture: PictureCost {
                per_gaussian: 100.0,
                ..PictureCost::default()
            },
        };
        Calibration {
            machine: Machine::this(),
            isa: "scalar".into(),
            threads: 2,
            model: String::new(),
            spread: 1.0,
            exact: Curve(
                [[1e4, 10.0], [5e4, 30.0], [2e5, 80.0]]
                    .map(|[n, ms]| [n, ms * MS])
                    .into(),
            ),
            heads: vec![
                heads(HeadSet::Best, true, &[[1e4, 10.0], [5e4, 50.0]]),
                heads(HeadSet::Surfels, true, &[[1e4, 1.0], [5e4, 5.0]]),
                heads(HeadSet::Best, false, &[[2e5, 120.0]]),
                heads(HeadSet::Surfels, false, &[[2e5, 10.0]]),
            ],
        }
    }

    fn chosen(time: u64, heads: Option<HeadSet>, task: Task) -> (u8, HeadSet, u128, bool) {
        let all = choices(&calibration(), &header(), &[7, 8, 9], heads, task).unwrap();
        let time = Duration::from_millis(time);
        let choice = choose(&all, time).unwrap();
        let expected = choice.expected.as_millis();
        (choice.level, choice.heads, expected, choice.fits(time))
    }

    #[test]
    fn the_best_looking_setting_that_fits_the_time_is_taken() {
        let (best, surfels) = (HeadSet::Best, HeadSet::Surfels);
        assert_eq!(chosen(1000, None, Task::Decode), (9, best, 200, true));
        assert_eq!(chosen(150, None, Task::Decode), (9, surfels, 90, true));
        assert_eq!(chosen(100, None, Task::Decode), (8, best, 80, true));
        assert_eq!(chosen(50, None, Task::Decode), (8, surfels, 35, true));
        assert_eq!(chosen(27, None, Task::Decode), (7, best, 20, true));
    }

    #[test]
    fn a_machine_whose_times_differ_is_promised_less() {
        let steady = calibration();
        let shaky = Calibration {
            spread: 1.5,
            ..calibration()
        };
        let level = |calibration: &Calibration| {
            let all = choices(calibration, &header(), &[7, 8, 9], None, Task::Decode).unwrap();
            choose(&all, Duration::from_millis(120)).map(|choice| (choice.level, choice.expected.as_millis()))
        };
        assert_eq!((level(&steady), level(&shaky)), (Some((9, 90)), Some((8, 35))));
    }

    #[test]
    fn a_coarser_level_that_draws_slower_is_not_taken_for_being_coarser() {
        // Level 8 with the best heads: 80 ms and 400,000 Gaussians; level 9 with surfels: 90 ms and half as many.
        assert_eq!(chosen(130, None, PICTURE), (9, HeadSet::Surfels, 110, true));
        assert_eq!(chosen(125, Some(HeadSet::Best), PICTURE), (7, HeadSet::Best, 28, true));
    }

    #[test]
    fn a_time_that_nothing_keeps_gives_the_fastest() {
        assert_eq!(chosen(5, None, Task::Decode), (7, HeadSet::Surfels, 11, false));
        assert_eq!(
            chosen(5, Some(HeadSet::Best), Task::Decode),
            (7, HeadSet::Best, 20, false)
        );
    }

    #[test]
    fn more_time_is_never_used_for_a_worse_picture() {
        for task in [Task::Decode, PICTURE] {
            let all = choices(&calibration(), &header(), &[7, 8, 9], None, task).unwrap();
            let mut before = f64::MIN;
            for time in 1..1000 {
                let time = Duration::from_millis(time);
                let choice = choose(&all, time).unwrap();
                if choice.fits(time) {
                    assert!(choice.score >= before, "{time:?}: {choice:?}");
                    before = choice.score;
                }
            }
            assert!(before > f64::MIN);
        }
    }

    #[test]
    fn heads_that_nothing_is_known_of_are_an_error() {
        for (levels, heads) in [(&[][..], None), (&[9][..], Some(HeadSet::Quick))] {
            let all = choices(&calibration(), &header(), levels, heads, Task::Decode);
            assert!(matches!(all, Err(Error::Usage(_))), "{levels:?}");
        }
    }

    #[test]
    fn a_calibration_is_off_if_something_takes_half_as_long_again_or_two_thirds() {
        let all = choices(&calibration(), &header(), &[9], None, Task::Decode).unwrap();
        let choice = choose(&all, Duration::from_secs(1)).unwrap();
        assert_eq!(choice.expected, Duration::from_millis(200));
        for (took, off) in [(120, true), (140, false), (200, false), (295, false), (310, true)] {
            assert_eq!(choice.is_off(Duration::from_millis(took)), off, "{took} ms");
        }
    }
}
