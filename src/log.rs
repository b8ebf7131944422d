//! What a run does, step by step: how many of what, and how long it took.

use std::time::{Duration, Instant};

use crate::error::Result;

/// One finished step.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Step {
    /// What was done, for example `features of level 9`.
    pub name: String,
    /// How many [`Step::unit`]s it worked on.
    pub count: u64,
    /// What was counted, for example `voxels`.
    pub unit: &'static str,
    /// Wall time; zero on machines without a clock.
    pub time: Duration,
}

/// Collects steps, and tells a listener when each begins.
#[derive(Default)]
pub struct Log<'a> {
    listener: Option<&'a dyn Fn(&str)>,
    steps: Vec<Step>,
}

impl<'a> Log<'a> {
    /// A log whose `listener` hears the name of every step as it begins.
    pub fn with_listener(listener: &'a dyn Fn(&str)) -> Self {
        Log {
            listener: Some(listener),
            steps: Vec::new(),
        }
    }

    /// The finished steps, in order.
    pub fn steps(&self) -> &[Step] {
        &self.steps
    }

    /// Runs a step that works on `count` items.
    ///
    /// # Errors
    /// The [`crate::Error`] of `run`; the step is then not recorded.
    pub fn step<T>(
        &mut self,
        name: impl Into<String>,
        count: usize,
        unit: &'static str,
        run: impl FnOnce() -> Result<T>,
    ) -> Result<T> {
        let name = name.into();
        if let Some(listener) = self.listener {
            listener(&name);
        }
        let start = now();
        let value = run()?;
        self.steps.push(Step {
            name,
            count: count as u64,
            unit,
            time: start.map_or(Duration::ZERO, |start| start.elapsed()),
        });
        Ok(value)
    }
}

/// The time, which WebAssembly without a system cannot be asked for.
fn now() -> Option<Instant> {
    let clock = !cfg!(all(target_family = "wasm", target_os = "unknown"));
    clock.then(Instant::now)
}
