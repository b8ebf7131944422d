//! Which frame of a sequence is decoded next, and how accurately, so that the clock is kept.

use std::time::Instant;

use super::clock::Clock;
use crate::gaussians::HeadSet;

/// A frame to decode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Task {
    /// The slot of the frame.
    pub slot: u64,
    /// Whether it is shown, or only decoded because the next ones are predicted from it.
    pub shown: bool,
}

/// What to decode at this time, if `next` follows what was decoded last. `None`: nothing before the clock jumps.
///
/// A frame that is late is dropped with those after it up to one that is coded by itself, if that is due. Else it is
/// decoded without being drawn, unless no frame was shown for so long that one is wanted though it is late.
pub fn next_task(clock: &Clock, next: u64, now: Instant, is_wanted: bool) -> Option<Task> {
    if clock.last().is_some_and(|last| next > last) {
        return None;
    }
    let (timeline, due) = (clock.timeline(), clock.slot(now));
    if next >= due {
        return Some(Task {
            slot: next,
            shown: true,
        });
    }
    // The first frame of each lap is coded by itself.
    let nearest = due.saturating_sub(timeline.count()).max(next + 1);
    match (nearest..=due).rev().find(|slot| timeline.is_whole(*slot)) {
        Some(slot) => Some(Task { slot, shown: true }),
        None => Some(Task {
            slot: next,
            shown: is_wanted,
        }),
    }
}

/// A level, and heads to draw it with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rung {
    /// The level.
    pub level: u8,
    /// The heads.
    pub heads: HeadSet,
}

/// Levels and heads from the most accurate to the fastest, with the time that a frame of each takes.
#[derive(Debug, Clone)]
pub struct Ladder {
    rungs: Vec<Rung>,
    /// Seconds, as far as they were measured.
    times: Vec<Option<f64>>,
    at: usize,
}

/// The weight of the last frame in the time of its rung.
const NEW: f64 = 0.3;
/// The share of the time there is that a more accurate rung may take.
const RISE: f64 = 0.8;
/// The time of a level, of the time of the next finer one, until it is measured.
const COARSER: f64 = 0.4;

impl Ladder {
    /// All of these levels, of which there is at least one, with quick heads and surfels; or one level, or some heads.
    pub fn new(levels: std::ops::RangeInclusive<u8>, level: Option<u8>, heads: Option<HeadSet>) -> Self {
        let levels = match level {
            Some(level) => level..=level,
            None => levels,
        };
        let heads = match heads {
            Some(heads) => vec![heads],
            None => vec![HeadSet::Quick, HeadSet::Surfels],
        };
        let rungs: Vec<Rung> = levels
            .rev()
            .flat_map(|level| heads.iter().map(move |heads| Rung { level, heads: *heads }))
            .collect();
        Ladder {
            times: vec![None; rungs.len()],
            rungs,
            at: 0,
        }
    }

    /// The rung at hand.
    pub fn rung(&self) -> Rung {
        self.rungs[self.at]
    }

    /// The most accurate rung.
    pub fn finest(&self) -> Rung {
        self.rungs[0]
    }

    /// Forgets all times, and begins with the most accurate rung again.
    pub fn forget(&mut self) {
        self.times.fill(None);
        self.at = 0;
    }

    /// Learns how many seconds a frame took. If a machine is slower than before, it is so on every rung.
    pub fn learn(&mut self, seconds: f64) {
        let seconds = seconds.max(1e-6);
        let Some(before) = self.times[self.at] else {
            self.times[self.at] = Some(seconds);
            return;
        };
        let factor = (before + NEW * (seconds - before)) / before;
        for time in self.times.iter_mut().flatten() {
            *time *= factor;
        }
    }

    /// Goes to the most accurate rung for which this many seconds are enough, else to the fastest. Only if it may rise
    /// to a more accurate one than that at hand.
    pub fn choose(&mut self, seconds: f64, may_rise: bool) {
        let first = if may_rise { 0 } else { self.at };
        let fits = |rung: &usize| {
            let share = if *rung < self.at { RISE } else { 1.0 };
            self.time(*rung).is_none_or(|time| time <= share * seconds)
        };
        let found = (first..self.rungs.len()).find(fits);
        self.at = found.unwrap_or(self.rungs.len() - 1);
    }

    /// Seconds of a rung, measured or guessed. `None` if there was no measurement at all.
    fn time(&self, rung: usize) -> Option<f64> {
        if self.times[rung].is_some() {
            return self.times[rung];
        }
        let known = (0..self.rungs.len()).filter(|other| self.times[*other].is_some());
        let near = known.min_by_key(|other| other.abs_diff(rung))?;
        Some(self.times[near]? * self.guess(rung) / self.guess(near))
    }

    /// A rung's time relative to the first one's, before anything is measured.
    fn guess(&self, rung: usize) -> f64 {
        let Rung { level, heads } = self.rungs[rung];
        let of_heads = match heads {
            HeadSet::Surfels => 0.7,
            HeadSet::Quick => 1.0,
            _ => 1.7,
        };
        of_heads * COARSER.powi(i32::from(self.rungs[0].level) - i32::from(level))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::time::Duration;

    use super::super::clock::Timeline;
    use super::*;

    /// A clock that began to run at `start`, of frames each 0.1 s of which every fifth is whole.
    fn clock(start: Instant, looped: bool) -> Clock {
        let frames = (0..10).map(|i| (f64::from(i) / 10.0, i % 5 == 0)).collect();
        let mut clock = Clock::new(Arc::new(Timeline::new(frames, 1.0)), 1.0, looped);
        clock.play(start);
        clock
    }

    fn task(slot: u64, shown: bool) -> Option<Task> {
        Some(Task { slot, shown })
    }

    #[test]
    fn frames_that_are_in_time_are_decoded_one_after_the_other() {
        let start = Instant::now();
        let clock = clock(start, false);
        for slot in 0..10 {
            assert_eq!(next_task(&clock, slot, start, false), task(slot, true));
        }
        assert_eq!(next_task(&clock, 10, start, false), None);
    }

    #[test]
    fn late_frames_are_not_drawn_and_are_dropped_up_to_a_whole_one_that_is_due() {
        let start = Instant::now();
        let clock = clock(start, true);
        let at = |ms| start + Duration::from_millis(ms);
        assert_eq!(next_task(&clock, 1, at(350), false), task(1, false));
        assert_eq!(next_task(&clock, 1, at(350), true), task(1, true));
        assert_eq!(next_task(&clock, 3, at(350), false), task(3, true));
        assert_eq!(next_task(&clock, 1, at(650), false), task(5, true));
        assert_eq!(next_task(&clock, 6, at(1950), false), task(15, true));
        assert_eq!(next_task(&clock, 6, at(3_600_250), false), task(36_000, true));
    }

    #[test]
    fn a_clock_that_stands_drops_nothing() {
        let start = Instant::now();
        let mut clock = clock(start, true);
        clock.seek(0.35, start);
        clock.pause(start);
        let later = start + Duration::from_secs(9);
        assert_eq!(next_task(&clock, 3, later, false), task(3, true));
        assert_eq!(next_task(&clock, 4, later, false), task(4, true));
    }

    fn ladder() -> Ladder {
        Ladder::new(7..=9, None, None)
    }

    /// Plays on a machine where a frame of each rung takes these seconds.
    fn settled(ladder: &mut Ladder, times: [f64; 6], budget: f64) -> Rung {
        for _ in 0..200 {
            ladder.choose(budget, true);
            ladder.learn(times[ladder.at]);
        }
        ladder.rung()
    }

    #[test]
    fn a_fast_machine_stays_at_the_finest_level_with_learned_heads() {
        let finest = Rung {
            level: 9,
            heads: HeadSet::Quick,
        };
        assert_eq!(ladder().rung(), finest);
        assert_eq!(
            settled(&mut ladder(), [0.03, 0.02, 0.01, 0.01, 0.01, 0.01], 0.033),
            finest
        );
    }

    #[test]
    fn a_slow_machine_settles_at_what_it_has_time_for_and_rises_when_there_is_more() {
        let times = [0.09, 0.06, 0.03, 0.02, 0.01, 0.005];
        let mut ladder = ladder();
        let (coarser, heads) = (8, HeadSet::Quick);
        assert_eq!(settled(&mut ladder, times, 0.04), Rung { level: coarser, heads });
        assert_eq!(settled(&mut ladder, times.map(|t| t * 3.0), 0.04).level, 7);
        assert_eq!(settled(&mut ladder, times, 0.04), Rung { level: coarser, heads });
        assert_eq!(settled(&mut ladder, times, 0.2), Rung { level: 9, heads });
        assert_eq!(settled(&mut ladder, times, 1e-4), *ladder.clone().rungs.last().unwrap());
    }

    #[test]
    fn it_rises_only_where_it_may() {
        let mut ladder = ladder();
        ladder.learn(1.0);
        ladder.choose(0.2, false);
        let low = ladder.rung();
        assert!(low.level < 9);
        ladder.choose(10.0, false);
        assert_eq!(ladder.rung(), low);
        ladder.choose(10.0, true);
        assert_eq!(ladder.rung().level, 9);
    }

    #[test]
    fn what_was_asked_for_is_kept() {
        let mut ladder = Ladder::new(7..=9, Some(8), Some(HeadSet::Best));
        ladder.learn(5.0);
        ladder.choose(0.01, true);
        let asked = Rung {
            level: 8,
            heads: HeadSet::Best,
        };
        assert_eq!(ladder.rung(), asked);
    }
}
