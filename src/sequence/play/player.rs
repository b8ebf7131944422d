//! A sequence that one thread decodes and draws by a clock.

use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::clock::{Clock, SPEEDS, Timeline};
use super::schedule::{Ladder, Rung, Task, next_task};
use crate::decoder::Decoder;
use crate::error::{Error, Result};
use crate::gaussians::{Gaussians, HeadSet};
use crate::sequence::{SequenceDecoder, SequenceReader};

/// If no frame was shown for so long, one is shown though it is late.
pub const LATEST: Duration = Duration::from_millis(200);

/// In the first seconds code is compiled and caches are filled: the times of frames are forgotten once after that.
const WARM: Duration = Duration::from_secs(3);

/// Decodes the frames of a sequence, one at each call of [`Player::next`], so that the clock is kept: it drops frames and
/// goes to coarser levels and faster heads. Where the clock stands, the frame is decoded as accurately as it can be.
///
/// Between two calls its user draws what was made, when it is due, and says how long a frame took.
#[derive(Debug)]
pub struct Player {
    sequence: SequenceReader<'static>,
    timeline: Arc<Timeline>,
    decoder: Decoder,
    frames: SequenceDecoder,
    levels: RangeInclusive<u8>,
    ladder: Ladder,
    clock: Clock,
    /// The slot after what was decoded last.
    next: u64,
    /// Frames of slots before this one are only decoded because it is predicted from them.
    target: u64,
    shown: Option<Shown>,
    /// Since when it plays, until it is warm.
    warming: Option<Instant>,
    dropped: u64,
    /// Whether the time of the last frame tells what its rung takes.
    counts: bool,
}

#[derive(Debug)]
struct Shown {
    slot: u64,
    rung: Rung,
    at: Instant,
}

/// A frame that was decoded.
#[derive(Debug)]
pub struct Step {
    /// Its number.
    pub frame: u64,
    /// Its time in the sequence, in seconds.
    pub time: f64,
    /// How long it takes until it is to be shown.
    pub due: Duration,
    /// The level and the heads.
    pub rung: Rung,
    /// Its Gaussians; none if it is not to be shown. An error skips the frames up to the next one that is coded by itself.
    pub made: Result<Option<Gaussians>>,
}

impl Player {
    /// A player that stands at the first frame. It decodes and draws as `decoder` does, at levels and with heads that there
    /// is time for, or at this level, or with these heads. It begins again at the end.
    ///
    /// # Errors
    /// Those of [`SequenceReader::new`]; [`Error::Usage`] if the sequence cannot be drawn at this level.
    pub fn new(bytes: Vec<u8>, decoder: Decoder, level: Option<u8>, heads: Option<HeadSet>) -> Result<Self> {
        let sequence = SequenceReader::new(bytes, decoder.limits())?;
        let header = sequence.header();
        // Heads need a level above their own.
        let levels = header.base.max(1).min(header.top)..=header.top;
        if let Some(level) = level.filter(|level| !levels.contains(level)) {
            let (first, last) = (levels.start(), levels.end());
            let text = format!("level {level} cannot be drawn, but {first} to {last} can");
            return Err(Error::Usage(text));
        }
        let timeline = Arc::new(Timeline::of(&sequence));
        Ok(Player {
            clock: Clock::new(timeline.clone(), 1.0, true),
            timeline,
            frames: SequenceDecoder::new(decoder.clone()),
            decoder,
            sequence,
            ladder: Ladder::new(levels.clone(), level, heads),
            levels,
            next: 0,
            target: 0,
            shown: None,
            warming: None,
            dropped: 0,
            counts: false,
        })
    }

    /// The sequence.
    pub fn sequence(&self) -> &SequenceReader<'static> {
        &self.sequence
    }

    /// The levels that can be drawn.
    pub fn levels(&self) -> RangeInclusive<u8> {
        self.levels.clone()
    }

    /// Frames that were due and not shown.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Seconds that there are for a frame; `None` if the clock stands.
    pub fn budget(&self, now: Instant) -> Option<f64> {
        let budget = self.timeline.mean_duration() / self.clock.speed();
        self.clock.is_running(now).then_some(budget)
    }

    /// Runs from now on.
    pub fn play(&mut self, now: Instant) {
        self.clock.play(now);
        self.warming = Some(now);
    }

    /// Stays at the frame that was shown last, which is then decoded as accurately as it can be.
    pub fn pause(&mut self, now: Instant) {
        self.clock.pause(now);
        let shown = self.shown.as_ref().filter(|shown| shown.slot >= self.target);
        let slot = shown.map_or(self.clock.slot(now), |shown| shown.slot);
        let fine = shown.is_some_and(|shown| shown.rung == self.ladder.finest()) && self.next == slot + 1;
        let frame = self.timeline.frame(slot);
        self.clock.jump(self.timeline.start(frame), now);
        match fine {
            // The same frame in the first lap.
            true => (self.next, self.target) = (frame + 1, frame),
            false => self.go_to(frame),
        }
    }

    /// Goes to the frame at a time in seconds.
    pub fn seek(&mut self, time: f64, now: Instant) {
        let time = if time.is_nan() { 0.0 } else { time };
        let time = time.clamp(0.0, self.sequence.seconds());
        self.clock.jump(time, now);
        self.go_to(self.clock.slot(now));
    }

    /// Pauses a frame further on or back.
    pub fn step(&mut self, by: i64, now: Instant) {
        self.pause(now);
        self.clock.step(by, now);
        self.go_to(self.clock.slot(now));
    }

    /// Plays so many times as fast from now on, within [`SPEEDS`].
    pub fn set_speed(&mut self, speed: f64, now: Instant) {
        let [slowest, .., fastest] = SPEEDS;
        let speed = if speed.is_nan() { 1.0 } else { speed };
        self.clock.set_speed(speed.clamp(slowest, fastest), now);
    }

    /// Shows this slot next, decoded at the finest rung if the clock stands.
    fn go_to(&mut self, slot: u64) {
        self.target = slot;
        if self.next != slot || self.ladder.rung() != self.ladder.finest() {
            self.next = self.timeline.last_whole(slot);
        }
    }

    /// Decodes a frame. `None` if there is nothing to do until the clock is changed.
    pub fn next(&mut self, now: Instant) -> Option<Step> {
        let is_running = self.clock.is_running(now);
        let task = match is_running {
            true => self.due_task(now),
            false => self.standing_task(now),
        }?;
        let is_whole = self.timeline.is_whole(task.slot);
        if is_running && is_whole && self.warming.take_if(|since| now - *since >= WARM).is_some() {
            self.ladder.forget();
        }
        self.ladder.choose(self.budget(now).unwrap_or(f64::INFINITY), is_whole);
        let rung = self.ladder.rung();
        let made = self.make(task, rung);
        self.next = match made {
            Ok(_) => task.slot + 1,
            Err(_) => self.timeline.next_whole(task.slot),
        };
        self.counts = made.is_ok() && task.shown && (is_running || is_whole);
        if made.is_ok() && task.shown {
            let (slot, at) = (task.slot, now);
            self.shown = Some(Shown { slot, rung, at });
        }
        let frame = self.timeline.frame(task.slot);
        Some(Step {
            frame,
            time: self.timeline.start(frame),
            due: self.clock.until(task.slot, now).unwrap_or(Duration::ZERO),
            rung,
            made,
        })
    }

    /// How long the last frame took, decoded and drawn.
    pub fn learn(&mut self, seconds: f64) {
        if std::mem::take(&mut self.counts) {
            self.ladder.learn(seconds);
        }
    }

    fn due_task(&mut self, now: Instant) -> Option<Task> {
        let is_wanted = self.shown.as_ref().is_none_or(|shown| now - shown.at > LATEST);
        let mut task = next_task(&self.clock, self.next, now, is_wanted)?;
        task.shown &= task.slot >= self.target;
        // What is between is dropped, but for what only leads to the target.
        let dropped = task.slot + u64::from(!task.shown);
        self.dropped += dropped.saturating_sub(self.next.max(self.target));
        Some(task)
    }

    fn standing_task(&self, now: Instant) -> Option<Task> {
        let due = self.clock.slot(now);
        (self.next <= due).then_some(Task {
            slot: self.next,
            shown: self.next == due,
        })
    }

    fn make(&mut self, task: Task, rung: Rung) -> Result<Option<Gaussians>> {
        let decoder = self.decoder.clone().with_level(rung.level).with_heads(rung.heads);
        self.frames.set_decoder(decoder);
        let frame = self.frames.frame(&self.sequence, self.timeline.frame(task.slot))?;
        task.shown.then(|| frame.gaussians()).transpose()
    }
}

#[cfg(all(test, feature = "encoder"))]
mod tests;
