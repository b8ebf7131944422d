//! The clock of a sequence that is played. Its caller says what time it is, so that tests need not wait.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::sequence::SequenceReader;

/// How many times faster or slower than it was recorded a sequence can be played.
pub const SPEEDS: [f64; 7] = [0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0];
/// What times may differ by from their sums, in seconds.
const ROUNDING: f64 = 1e-9;
/// The least length of a sequence in seconds.
const LEAST: f64 = 1e-3;

/// When the frames of a sequence are shown, in seconds.
///
/// A frame of a lap is a *slot*: those of the first lap have the numbers of their frames, those of the second follow.
#[derive(Debug, Clone, PartialEq)]
pub struct Timeline {
    /// Of at least one frame: its time, and whether it is coded by itself.
    frames: Vec<(f64, bool)>,
    seconds: f64,
}

impl Timeline {
    /// Frames with their times and whether they are coded by themselves, as the first one is, and the length in seconds.
    pub fn new(mut frames: Vec<(f64, bool)>, seconds: f64) -> Self {
        match frames.first_mut() {
            Some((_, whole)) => *whole = true,
            None => frames.push((0.0, true)),
        }
        Timeline {
            frames,
            seconds: seconds.max(LEAST),
        }
    }

    /// That of a sequence. Frames of a damaged group are spread over its time.
    pub fn of(sequence: &SequenceReader) -> Self {
        let index = sequence.index();
        let mut frames = Vec::new();
        for (number, entry) in index.groups.iter().enumerate() {
            let seconds = |ticks: f64| ticks / f64::from(index.timescale);
            let start = entry.start as f64;
            match sequence.group(number) {
                Ok(group) => frames.extend(
                    (0..group.len()).map(|at| (seconds(start + f64::from(group.ticks(at))), group.is_whole(at))),
                ),
                Err(_) => frames.extend((0..entry.frames).map(|at| {
                    let share = f64::from(at) / f64::from(entry.frames);
                    (seconds(start + share * f64::from(entry.ticks)), at == 0)
                })),
            }
        }
        Timeline::new(frames, sequence.seconds())
    }

    /// Number of frames.
    pub fn count(&self) -> u64 {
        self.frames.len() as u64
    }

    /// Seconds that a frame is shown for, on average.
    pub fn mean_duration(&self) -> f64 {
        self.seconds / self.frames.len() as f64
    }

    /// The frame of a slot.
    pub fn frame(&self, slot: u64) -> u64 {
        slot % self.count()
    }

    /// Whether the frame of a slot is coded by itself.
    pub fn is_whole(&self, slot: u64) -> bool {
        self.frames[self.frame(slot) as usize].1
    }

    /// The first slot after this one whose frame is coded by itself.
    pub fn next_whole(&self, slot: u64) -> u64 {
        let mut next = slot + 1;
        while !self.is_whole(next) {
            next += 1;
        }
        next
    }

    /// The last slot up to this one whose frame is coded by itself.
    pub fn last_whole(&self, slot: u64) -> u64 {
        let mut last = slot;
        while !self.is_whole(last) {
            last -= 1;
        }
        last
    }

    /// The time of a slot, from the start of the first lap.
    pub fn start(&self, slot: u64) -> f64 {
        (slot / self.count()) as f64 * self.seconds + self.frames[self.frame(slot) as usize].0
    }

    /// The slot that is shown at a time from the start of the first lap.
    pub fn slot(&self, time: f64) -> u64 {
        let lap = ((time + ROUNDING) / self.seconds).floor().max(0.0);
        let within = time - lap * self.seconds + ROUNDING;
        let after = self.frames.partition_point(|(start, _)| *start <= within);
        (lap as u64) * self.count() + after.saturating_sub(1) as u64
    }
}

/// Where a sequence is at what time.
#[derive(Debug, Clone, PartialEq)]
pub struct Clock {
    timeline: Arc<Timeline>,
    /// Seconds from the start of the first lap at `since`, or as long as it is paused.
    at: f64,
    since: Option<Instant>,
    speed: f64,
    /// The last slot to be shown; none in a loop.
    last: Option<u64>,
    /// Grows with each jump.
    jumps: u64,
}

impl Clock {
    /// A clock that stands at the start.
    pub fn new(timeline: Arc<Timeline>, speed: f64, looped: bool) -> Self {
        let last = (!looped).then(|| timeline.count() - 1);
        Clock {
            timeline,
            at: 0.0,
            since: None,
            speed,
            last,
            jumps: 0,
        }
    }

    /// When frames are shown.
    pub fn timeline(&self) -> &Timeline {
        &self.timeline
    }

    /// How many times as fast as it was recorded the sequence is played.
    pub fn speed(&self) -> f64 {
        self.speed
    }

    /// Whether it begins again at the end.
    pub fn is_looped(&self) -> bool {
        self.last.is_none()
    }

    /// Whether time passes: it neither stands nor is at the end.
    pub fn is_running(&self, now: Instant) -> bool {
        self.since.is_some() && !self.is_at_end(now)
    }

    /// Tells the clock after a jump from what it was before.
    pub fn jumps(&self) -> u64 {
        self.jumps
    }

    /// The last slot to be shown; none in a loop.
    pub fn last(&self) -> Option<u64> {
        self.last
    }

    fn is_at_end(&self, now: Instant) -> bool {
        self.last.is_some_and(|last| self.slot(now) >= last)
    }

    /// Seconds from the start of the first lap. It stays at the last slot.
    fn position(&self, now: Instant) -> f64 {
        let passed = self
            .since
            .map_or(Duration::ZERO, |since| now.saturating_duration_since(since));
        let position = self.at + passed.as_secs_f64() * self.speed;
        match self.last {
            Some(last) => position.min(self.timeline.start(last)),
            None => position,
        }
    }

    /// The slot that is to be shown.
    pub fn slot(&self, now: Instant) -> u64 {
        self.timeline.slot(self.position(now))
    }

    /// The number of the frame that is to be shown.
    pub fn frame(&self, now: Instant) -> u64 {
        self.timeline.frame(self.slot(now))
    }

    /// The share of the sequence that has passed.
    pub fn share(&self, now: Instant) -> f64 {
        (self.position(now) / self.timeline.seconds).fract().clamp(0.0, 1.0)
    }

    /// How long it takes until a slot is due; `None` if the clock stands.
    pub fn until(&self, slot: u64, now: Instant) -> Option<Duration> {
        let since = self.since?;
        let seconds = (self.timeline.start(slot) - self.at) / self.speed;
        let due = since + Duration::try_from_secs_f64(seconds.max(0.0)).ok()?;
        Some(due.saturating_duration_since(now))
    }

    /// Runs from now on; from the start if it was at the end.
    pub fn play(&mut self, now: Instant) {
        if self.is_at_end(now) {
            self.jump(0.0, now);
        }
        self.at = self.position(now);
        self.since = Some(now);
    }

    /// Stands from now on.
    pub fn pause(&mut self, now: Instant) {
        self.at = self.position(now);
        self.since = None;
    }

    /// Pauses if it runs, else plays.
    pub fn toggle(&mut self, now: Instant) {
        match self.is_running(now) {
            true => self.pause(now),
            false => self.play(now),
        }
    }

    /// The next of the speeds that there are, up or down.
    pub fn change_speed(&mut self, faster: bool, now: Instant) {
        let next = match faster {
            true => SPEEDS.iter().find(|speed| **speed > self.speed),
            false => SPEEDS.iter().rev().find(|speed| **speed < self.speed),
        };
        if let Some(speed) = next {
            self.set_speed(*speed, now);
        }
    }

    /// Runs so many times as fast from now on.
    pub fn set_speed(&mut self, speed: f64, now: Instant) {
        self.at = self.position(now);
        self.since = self.since.map(|_| now);
        self.speed = speed;
    }

    /// Begins again at the end, or stays at the end of this lap.
    pub fn toggle_loop(&mut self, now: Instant) {
        self.at = self.position(now);
        self.since = self.since.map(|_| now);
        self.last = match self.last {
            Some(_) => None,
            None => {
                let frames = self.timeline.count();
                Some((self.slot(now) / frames + 1) * frames - 1)
            }
        };
    }

    /// Goes to the frame at a share of the sequence.
    pub fn seek(&mut self, share: f64, now: Instant) {
        self.jump(share.clamp(0.0, 1.0) * self.timeline.seconds, now);
    }

    /// Pauses a frame further on or back, within the sequence unless it is looped.
    pub fn step(&mut self, by: i64, now: Instant) {
        let frames = self.timeline.count() as i64;
        let frame = self.frame(now) as i64 + by;
        let frame = match self.last {
            None => frame.rem_euclid(frames),
            Some(_) => frame.clamp(0, frames - 1),
        };
        self.since = None;
        self.jump(self.timeline.start(frame as u64), now);
    }

    /// Goes to a time of the first lap.
    pub fn jump(&mut self, time: f64, now: Instant) {
        let last = self.timeline.count() - 1;
        self.last = self.last.map(|_| last);
        // The end belongs to the next lap.
        self.at = self.timeline.start(self.timeline.slot(time).min(last));
        self.since = self.since.map(|_| now);
        self.jumps += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ten frames, one each 0.1 s, of which every fifth is whole.
    fn timeline() -> Arc<Timeline> {
        let frames = (0..10).map(|i| (f64::from(i) / 10.0, i % 5 == 0)).collect();
        Arc::new(Timeline::new(frames, 1.0))
    }

    fn after(start: Instant, ms: u64) -> Instant {
        start + Duration::from_millis(ms)
    }

    #[test]
    fn every_time_has_its_frame_and_laps_follow_each_other() {
        let timeline = timeline();
        for slot in 0..25 {
            assert_eq!(timeline.slot(timeline.start(slot)), slot);
            assert_eq!(timeline.slot(timeline.start(slot) + 0.05), slot);
        }
        assert_eq!(timeline.slot(-1.0), 0);
        assert_eq!((timeline.next_whole(0), timeline.next_whole(7)), (5, 10));
        assert_eq!(
            (timeline.last_whole(4), timeline.last_whole(5), timeline.last_whole(19)),
            (0, 5, 15)
        );
        let empty = Timeline::new(Vec::new(), 0.0);
        assert_eq!((empty.count(), empty.next_whole(0), empty.slot(0.0)), (1, 1, 0));
    }

    #[test]
    fn it_stands_until_it_is_played_and_when_it_is_paused() {
        let start = Instant::now();
        let mut clock = Clock::new(timeline(), 1.0, true);
        assert_eq!(clock.slot(after(start, 500)), 0);
        clock.play(start);
        assert_eq!(clock.slot(after(start, 250)), 2);
        assert_eq!(clock.until(4, after(start, 250)), Some(Duration::from_millis(150)));
        clock.toggle(after(start, 250));
        assert_eq!(clock.slot(after(start, 900)), 2);
        assert_eq!(clock.until(4, start), None);
        clock.toggle(after(start, 1000));
        assert_eq!(clock.slot(after(start, 1100)), 3);
        assert_eq!(clock.jumps(), 0);
    }

    #[test]
    fn speed_changes_how_fast_it_goes_from_now_on() {
        let start = Instant::now();
        let mut clock = Clock::new(timeline(), 1.0, true);
        clock.play(start);
        clock.change_speed(true, after(start, 200));
        assert_eq!(clock.slot(after(start, 350)), 5);
        for _ in 0..20 {
            clock.change_speed(false, after(start, 350));
        }
        assert_eq!(clock.speed(), SPEEDS[0]);
        assert_eq!(clock.slot(after(start, 360)), 5);
    }

    #[test]
    fn a_loop_begins_again_and_one_that_ends_stays_at_the_last_frame() {
        let start = Instant::now();
        let mut clock = Clock::new(timeline(), 1.0, true);
        clock.play(start);
        assert_eq!(clock.frame(after(start, 2350)), 3);
        clock.toggle_loop(after(start, 2350));
        assert_eq!(clock.slot(after(start, 9000)), 29);
        assert!(!clock.is_running(after(start, 9000)));
        clock.toggle(after(start, 9000));
        assert_eq!((clock.slot(after(start, 9150)), clock.jumps()), (1, 1));
        clock.toggle_loop(after(start, 9150));
        assert_eq!(clock.slot(after(start, 10_250)), 12);
    }

    #[test]
    fn steps_pause_and_a_seek_does_not() {
        let start = Instant::now();
        let mut clock = Clock::new(timeline(), 1.0, false);
        clock.play(start);
        clock.seek(0.55, start);
        assert_eq!(clock.slot(after(start, 100)), 6);
        clock.step(1, after(start, 100));
        assert_eq!(clock.frame(after(start, 5000)), 7);
        for _ in 0..9 {
            clock.step(1, start);
        }
        assert_eq!(clock.frame(start), 9);
        clock.seek(1.0, start);
        assert_eq!(clock.slot(start), 9);
        clock.seek(0.0, start);
        clock.step(-1, start);
        assert_eq!(clock.frame(start), 0);
        clock.toggle_loop(start);
        clock.step(-1, start);
        assert_eq!(clock.frame(start), 9);
    }
}
