//! Progress of a run: the steps that were taken, with counts and times.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::cancel::Cancel;
use crate::error::Result;

/// One finished step.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Step {
    /// What was done, for example `features of level 9`.
    pub name: String,
    /// Number of [`Step::unit`]s that it worked on.
    pub count: u64,
    /// What was counted, for example `voxels`.
    pub unit: &'static str,
    /// Wall time; zero on machines without a clock.
    pub time: Duration,
}

/// Called with the name of a step when it begins.
type Listener = dyn Fn(&str) + Send + Sync;

/// An optional observer of decoders and encoders: it collects finished steps, and calls a listener when one begins.
///
/// Clones share what they collect.
///
/// ```
/// # #[cfg(feature = "embedded")]
/// # fn main() -> b2p::Result<()> {
/// let log = b2p::Log::new();
/// b2p::Decoder::new().with_log(&log).decode(b2p::embedded::SCENE)?;
/// for step in log.steps() {
///     println!("{}: {} {} in {:?}", step.name, step.count, step.unit, step.time);
/// }
/// # assert!(!log.steps().is_empty());
/// # Ok(())
/// # }
/// # #[cfg(not(feature = "embedded"))]
/// # fn main() {}
/// ```
#[derive(Clone)]
pub struct Log {
    listener: Option<Arc<Listener>>,
    /// None for a log that collects nothing.
    steps: Option<Arc<Mutex<Vec<Step>>>>,
    /// Stops a run before its next step.
    cancel: Option<Cancel>,
}

impl Default for Log {
    fn default() -> Self {
        Log::new()
    }
}

impl fmt::Debug for Log {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Log")
            .field("steps", &self.steps().len())
            .finish_non_exhaustive()
    }
}

impl Log {
    /// A log without a listener.
    pub fn new() -> Self {
        Log {
            listener: None,
            steps: Some(Arc::default()),
            cancel: None,
        }
    }

    /// A log whose `listener` is called with the name of every step when it begins.
    pub fn with_listener(listener: impl Fn(&str) + Send + Sync + 'static) -> Self {
        Log {
            listener: Some(Arc::new(listener)),
            ..Log::new()
        }
    }

    /// A log that neither collects nor calls.
    pub(crate) const fn off() -> Self {
        Log {
            listener: None,
            steps: None,
            cancel: None,
        }
    }

    /// A log that neither collects nor calls, and is cancelled as this one is.
    #[cfg(feature = "encoder")]
    pub(crate) fn quiet(&self) -> Self {
        Log {
            cancel: self.cancel.clone(),
            ..Log::off()
        }
    }

    /// The same log, whose steps do not begin once `cancel` is thrown.
    #[doc(hidden)]
    pub fn with_cancel(mut self, cancel: Cancel) -> Self {
        self.cancel = Some(cancel);
        self
    }

    /// The finished steps, in order.
    pub fn steps(&self) -> Vec<Step> {
        match &self.steps {
            Some(steps) => steps.lock().unwrap_or_else(PoisonError::into_inner).clone(),
            None => Vec::new(),
        }
    }

    /// Runs a step that works on `count` items.
    ///
    /// # Errors
    /// The [`crate::Error`] of `run`; the step is then not recorded. [`crate::Error::Cancelled`] if it is not to begin.
    #[doc(hidden)]
    pub fn step<T>(
        &self,
        name: impl Into<String>,
        count: usize,
        unit: &'static str,
        run: impl FnOnce() -> Result<T>,
    ) -> Result<T> {
        self.paused_step(name, count, unit, |_| run())
    }

    /// Runs a step whose pauses do not count as its time.
    ///
    /// # Errors
    /// As [`Log::step`].
    pub(crate) fn paused_step<T>(
        &self,
        name: impl Into<String>,
        count: usize,
        unit: &'static str,
        run: impl FnOnce(&mut Pauses) -> Result<T>,
    ) -> Result<T> {
        if let Some(cancel) = &self.cancel {
            cancel.check()?;
        }
        let name = name.into();
        if let Some(listener) = &self.listener {
            listener(&name);
        }
        let (start, mut pauses) = (now(), Pauses(Duration::ZERO));
        let value = run(&mut pauses)?;
        self.add(name, count, unit, since(start).saturating_sub(pauses.0));
        Ok(value)
    }

    /// Adds a finished step.
    #[doc(hidden)]
    pub fn add(&self, name: impl Into<String>, count: usize, unit: &'static str, time: Duration) {
        if let Some(steps) = &self.steps {
            steps.lock().unwrap_or_else(PoisonError::into_inner).push(Step {
                name: name.into(),
                count: count as u64,
                unit,
                time,
            });
        }
    }
}

/// Time within a step that is not its own.
pub(crate) struct Pauses(Duration);

impl Pauses {
    /// Runs what does not belong to the step.
    pub fn pause<T>(&mut self, run: impl FnOnce() -> T) -> T {
        let start = now();
        let value = run();
        self.0 += since(start);
        value
    }
}

fn since(start: Option<Instant>) -> Duration {
    start.map_or(Duration::ZERO, |start| start.elapsed())
}

/// The time, which WebAssembly without a system cannot be asked for.
fn now() -> Option<Instant> {
    let clock = !cfg!(all(target_family = "wasm", target_os = "unknown"));
    clock.then(Instant::now)
}
