//! Sequences that are played: one thread decodes ahead, another tells each frame when it is due.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use b2p::sequence::play::clock::{Clock, Timeline};
use b2p::sequence::play::player::LATEST;
use b2p::sequence::play::schedule::{Ladder, Task, next_task};
use b2p::{Cancel, Decoder, Extent, HeadSet, Log, SequenceDecoder, SequenceReader, Up};

use super::files::{Files, Loading};
use super::source::{Arrived, Choices, Scene, Shown, Source, Tell, Wish};
use crate::{Failure, Result, cloud, load, manners, sequence};

/// Frames that wait to be shown, at most.
const AHEAD: usize = 3;

/// Files of one frame and sequences alike.
pub struct Sources {
    files: Files,
    player: Option<Player>,
    loading: Loading,
    tell: Arc<Tell>,
}

impl Sources {
    /// Starts the thread for files; a sequence has threads of its own.
    pub fn start(loading: Loading, tell: Arc<Tell>) -> Result<Sources> {
        Ok(Sources {
            files: Files::start(loading.clone(), tell.clone())?,
            player: None,
            loading,
            tell,
        })
    }
}

impl Source for Sources {
    fn want(&mut self, wanted: Wish) {
        if let Some(player) = self.player.as_ref().filter(|player| player.path == wanted.path) {
            let number = wanted.number;
            player.shared.change(|state| state.wish_again(wanted));
            let choices = player.shared.lock().choices.clone();
            if let Some(choices) = choices {
                (self.tell)(number, Arrived::Choices(choices));
            }
            return;
        }
        self.player = None;
        // A pipe is read once, by the decoder of streams that arrive.
        if manners::is_pipe(&wanted.path) || !sequence::is_sequence(&wanted.path) {
            return self.files.want(wanted);
        }
        self.files.stop();
        let number = wanted.number;
        match Player::start(wanted, self.loading.clone(), self.tell.clone()) {
            Ok(player) => self.player = Some(player),
            Err(Failure(message)) => (self.tell)(number, Arrived::Failed(message)),
        }
    }

    fn play(&mut self, clock: &Clock) {
        if let Some(player) = &self.player {
            player.shared.change(|state| state.set_clock(clock.clone()));
        }
    }
}

/// A sequence that is played, until this is dropped.
struct Player {
    path: PathBuf,
    shared: Arc<Shared>,
    cancel: Cancel,
}

impl Player {
    fn start(wanted: Wish, loading: Loading, tell: Arc<Tell>) -> Result<Player> {
        let (path, cancel) = (wanted.path.clone(), Cancel::default());
        let shared = Arc::new(Shared {
            state: Mutex::new(State::new(wanted)),
            changed: Condvar::new(),
        });
        let cannot = |e: std::io::Error| Failure(format!("cannot start a thread to play: {e}"));
        let presenter = Presenter {
            shared: shared.clone(),
            tell: tell.clone(),
        };
        let decoding = (shared.clone(), cancel.clone());
        let started = std::thread::Builder::new().spawn(move || {
            let (shared, cancel) = decoding;
            let number = shared.lock().wish.number;
            let played = Worker::open(shared, &loading, &cancel, &*tell).and_then(Worker::run);
            if let Err(Failure(message)) = played {
                tell(number, Arrived::Failed(message));
            }
        });
        started.map_err(cannot)?;
        let player = Player { path, shared, cancel };
        let started = std::thread::Builder::new().spawn(move || presenter.run());
        started.map_err(cannot)?;
        Ok(player)
    }
}

impl Drop for Player {
    fn drop(&mut self) {
        self.cancel.cancel();
        self.shared.change(|state| state.ended = true);
    }
}

/// What the threads share.
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

struct State {
    wish: Wish,
    /// None until the sequence is open.
    choices: Option<Choices>,
    /// None until the sequence is open.
    clock: Option<Clock>,
    /// What was decoded, in the order of slots.
    ready: VecDeque<Ready>,
    /// The slot after what was decoded last, or is being decoded.
    next: u64,
    /// Grows when `next` is no longer what follows.
    turn: u64,
    /// Whether the next clock may be another one than that at hand.
    renewed: bool,
    /// Frames that were due and not shown.
    dropped: u64,
    /// When the last frame was shown.
    shown: Option<Instant>,
    /// The last wish of which a frame was shown.
    served: Option<u64>,
    ended: bool,
}

/// A frame, or why there is none.
struct Ready {
    slot: u64,
    number: u64,
    what: std::result::Result<Box<Scene>, String>,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        // What a thread that panicked left is consistent after each statement.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn change(&self, how: impl FnOnce(&mut State)) {
        how(&mut self.lock());
        self.changed.notify_all();
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State>, at_most: Option<Duration>) -> MutexGuard<'a, State> {
        match at_most {
            None => self.changed.wait(state).unwrap_or_else(PoisonError::into_inner),
            Some(time) => match self.changed.wait_timeout(state, time) {
                Ok((state, _)) => state,
                Err(poisoned) => poisoned.into_inner().0,
            },
        }
    }
}

impl State {
    fn new(wish: Wish) -> Self {
        State {
            wish,
            choices: None,
            clock: None,
            ready: VecDeque::new(),
            next: 0,
            turn: 0,
            renewed: false,
            dropped: 0,
            shown: None,
            served: None,
            ended: false,
        }
    }

    /// The same sequence with another level or other heads, from the frame at hand on.
    fn wish_again(&mut self, wish: Wish) {
        self.wish = wish;
        self.renewed = true;
        self.go_on_from(self.clock.as_ref().map_or(0, |clock| clock.slot(Instant::now())));
    }

    fn go_on_from(&mut self, slot: u64) {
        self.ready.clear();
        self.next = slot;
        self.turn += 1;
    }

    /// Goes by this clock. What is ready stays if the clock has jumped to it.
    fn set_clock(&mut self, clock: Clock) {
        let jumped = self.clock.as_ref().is_none_or(|before| before.jumps() != clock.jumps());
        let slot = clock.slot(Instant::now());
        self.clock = Some(clock);
        if !std::mem::take(&mut self.renewed) && !jumped {
            return;
        }
        self.ready.retain(|ready| ready.slot >= slot);
        if self.ready.front().is_none_or(|first| first.slot != slot) {
            self.go_on_from(slot);
        }
    }

    /// Takes what is due: what is said of frames that are lost, and the last frame.
    fn take_due(&mut self, now: Instant) -> Vec<(u64, Arrived)> {
        let Some(clock) = &self.clock else {
            return Vec::new();
        };
        let (due, mut told, mut last) = (clock.slot(now), Vec::new(), None);
        while let Some(ready) = self.ready.pop_front_if(|ready| ready.slot <= due) {
            match ready.what {
                Err(message) => told.push((ready.number, Arrived::Skipped(message))),
                Ok(scene) => {
                    self.dropped += u64::from(last.is_some());
                    last = Some((ready.number, ready.slot, scene));
                }
            }
        }
        if let Some((number, slot, mut scene)) = last {
            scene.frame = Some(Shown {
                number: clock.timeline().frame(slot),
                dropped: self.dropped,
            });
            told.push((number, Arrived::Scene(scene)));
            self.shown = Some(now);
        }
        if let Some((number, _)) = told.last()
            && self.served.replace(*number) != Some(*number)
        {
            told.push((*number, Arrived::Done));
        }
        told
    }

    /// How long it takes until the first frame that waits is due; `None` if there is none or the clock stands.
    fn patience(&self, now: Instant) -> Option<Duration> {
        self.clock.as_ref()?.until(self.ready.front()?.slot, now)
    }

    /// What to decode now, if anything is.
    fn task(&mut self, now: Instant) -> Option<Task> {
        if self.ready.len() >= AHEAD {
            return None;
        }
        let is_wanted = self.shown.is_none_or(|shown| now - shown > LATEST);
        let task = next_task(self.clock.as_ref()?, self.next, now, is_wanted)?;
        self.dropped += task.slot - self.next + u64::from(!task.shown);
        self.next = task.slot + 1;
        Some(task)
    }
}

/// Tells frames when they are due.
struct Presenter {
    shared: Arc<Shared>,
    tell: Arc<Tell>,
}

impl Presenter {
    fn run(self) {
        let mut state = self.shared.lock();
        while !state.ended {
            let now = Instant::now();
            let told = state.take_due(now);
            if told.is_empty() {
                let patience = state.patience(now);
                state = self.shared.wait(state, patience);
                continue;
            }
            drop(state);
            // There is room for more.
            self.shared.changed.notify_all();
            for (number, arrived) in told {
                (self.tell)(number, arrived);
            }
            state = self.shared.lock();
        }
    }
}

/// Decodes frames ahead of the clock.
struct Worker {
    shared: Arc<Shared>,
    sequence: SequenceReader<'static>,
    timeline: Arc<Timeline>,
    decoder: Decoder,
    frames: SequenceDecoder,
    levels: std::ops::RangeInclusive<u8>,
    up: Option<Up>,
    /// Of the first frame.
    extent: Option<Extent>,
}

/// A task, and for which wish and clock it is done.
struct Job {
    task: Task,
    number: u64,
    level: Option<u8>,
    heads: Option<HeadSet>,
    turn: u64,
    /// Seconds that there are for a frame; none if the clock stands.
    budget: Option<f64>,
}

impl Worker {
    /// Reads the sequence, and says what there is to choose from.
    fn open(shared: Arc<Shared>, loading: &Loading, cancel: &Cancel, tell: &Tell) -> Result<Worker> {
        let path = shared.lock().wish.path.clone();
        let sequence = sequence::read(&path, &loading.limits)?;
        let decoder = load::decoder(&[], &loading.detail(), &loading.model, &loading.limits)?;
        let header = sequence.header();
        // Heads need a level above their own.
        let levels = header.base.max(1).min(header.top)..=header.top;
        let up = cloud::up_of(loading.up, &sequence.axes().unwrap_or_default());
        let timeline = Arc::new(Timeline::of(&sequence));
        let choices = Choices {
            levels: levels.clone().collect(),
            heads: HeadSet::ALL.to_vec(),
            timeline: Some(timeline.clone()),
        };
        let number = {
            let mut state = shared.lock();
            state.choices = Some(choices.clone());
            state.wish.number
        };
        tell(number, Arrived::Choices(choices));
        let decoder = decoder.with_cancel(cancel.clone());
        Ok(Worker {
            shared,
            frames: SequenceDecoder::new(decoder.clone()),
            decoder,
            sequence,
            timeline,
            levels,
            up,
            extent: None,
        })
    }

    fn run(mut self) -> Result<()> {
        let mut ladder: Option<(u64, Ladder)> = None;
        let mut before = None;
        while let Some(job) = self.next_job() {
            let ladder = match &mut ladder {
                Some((number, ladder)) if *number == job.number => ladder,
                other => &mut other.insert((job.number, self.ladder(&job)?)).1,
            };
            let slot = job.task.slot;
            let is_alone = self.timeline.is_whole(slot) || slot.checked_sub(1).is_some_and(|last| before == Some(last));
            // A clock that stands has time to decode a frame with those before it.
            let may_rise = self.timeline.is_whole(slot) || job.budget.is_none();
            ladder.choose(job.budget.unwrap_or(f64::INFINITY), may_rise);
            let start = Instant::now();
            let made = self.make(&job, ladder);
            before = made.is_ok().then_some(slot);
            if made.is_ok() && is_alone && job.task.shown && (job.budget.is_some() || self.timeline.is_whole(slot)) {
                ladder.learn(start.elapsed().as_secs_f64());
            }
            self.hand_over(&job, made);
        }
        Ok(())
    }

    /// The levels and heads to choose from for a wish.
    fn ladder(&self, job: &Job) -> Result<Ladder> {
        match job.level {
            Some(level) if !self.levels.contains(&level) => Err(Failure(format!(
                "{}: level {level} cannot be drawn, but {} to {} can",
                self.shared.lock().wish.path.display(),
                self.levels.start(),
                self.levels.end()
            ))),
            level => Ok(Ladder::new(self.levels.clone(), level, job.heads)),
        }
    }

    /// Waits until there is something to decode. `None` at the end.
    fn next_job(&self) -> Option<Job> {
        let mut state = self.shared.lock();
        loop {
            if state.ended {
                return None;
            }
            let now = Instant::now();
            if let Some(task) = state.task(now) {
                let clock = state.clock.as_ref()?;
                let budget = clock.timeline().mean_duration() / clock.speed();
                return Some(Job {
                    task,
                    number: state.wish.number,
                    level: state.wish.level,
                    heads: state.wish.heads,
                    turn: state.turn,
                    budget: clock.is_running(now).then_some(budget),
                });
            }
            state = self.shared.wait(state, None);
        }
    }

    /// Decodes a frame, and makes its Gaussians if it is to be shown.
    fn make(&mut self, job: &Job, ladder: &Ladder) -> b2p::Result<Option<Box<Scene>>> {
        let (rung, log) = (ladder.rung(), Log::new());
        let decoder = self.decoder.clone().with_level(rung.level).with_heads(rung.heads);
        self.frames.set_decoder(decoder.with_log(&log));
        let frame = self.frames.frame(&self.sequence, self.timeline.frame(job.task.slot))?;
        if !job.task.shown {
            return Ok(None);
        }
        let gaussians = frame.gaussians()?;
        let extent = self.extent.get_or_insert_with(|| Extent::of_gaussians(&gaussians));
        Ok(Some(Box::new(Scene {
            extent: extent.clone(),
            gaussians: Arc::new(gaussians),
            up: self.up,
            made: Some((rung.level, rung.heads)),
            is_part: false,
            steps: log.steps(),
            frame: None,
        })))
    }

    /// Puts a frame with those that wait, unless it is not wanted any more. What is predicted from a frame that cannot
    /// be decoded is skipped.
    fn hand_over(&self, job: &Job, made: b2p::Result<Option<Box<Scene>>>) {
        let (slot, timeline) = (job.task.slot, &self.timeline);
        self.shared.change(|state| {
            // After a jump it is of use if it is what comes next.
            let is_next = job.task.shown && state.next == slot;
            if state.wish.number != job.number || !(state.turn == job.turn || is_next) {
                return;
            }
            state.next = slot + 1;
            let what = match made {
                Ok(None) => return,
                Ok(Some(scene)) => Ok(scene),
                Err(error) => {
                    state.next = timeline.next_whole(slot);
                    Err(skipped(timeline, slot, state.next, &error))
                }
            };
            let number = job.number;
            state.ready.push_back(Ready { slot, number, what });
        });
    }
}

/// What is said of frames that cannot be decoded, up to before slot `next`.
fn skipped(timeline: &Timeline, slot: u64, next: u64, error: &b2p::Error) -> String {
    let (first, last) = (timeline.frame(slot), timeline.frame(next - 1));
    match first == last {
        true => format!("frame {first} is skipped: {error}"),
        false => format!("frames {first} to {last} are skipped: {error}"),
    }
}

#[cfg(test)]
mod tests;
