//! A line on the terminal while something takes long; nothing when nobody watches.

use std::io::IsTerminal;
use std::time::Duration;

use b2p::Log;
use indicatif::{ProgressBar, ProgressStyle};

/// Shows the step at hand on standard error if that is a terminal.
pub struct Progress {
    bar: ProgressBar,
}

impl Progress {
    /// Stays silent if `quiet` or if standard error is no terminal.
    pub fn new(quiet: bool) -> Self {
        if quiet || !std::io::stderr().is_terminal() {
            return Progress {
                bar: ProgressBar::hidden(),
            };
        }
        let bar = ProgressBar::new_spinner();
        if let Ok(style) = ProgressStyle::with_template("{spinner} {msg} ({elapsed})") {
            bar.set_style(style);
        }
        Progress { bar }
    }

    /// A log that shows each step as it begins.
    pub fn log(&self) -> Log {
        let bar = self.bar.clone();
        Log::with_listener(move |step| show(&bar, step))
    }

    /// Says what is being done.
    pub fn say(&self, step: &str) {
        show(&self.bar, step);
    }
}

fn show(bar: &ProgressBar, step: &str) {
    // From the first step on: before, the user may be asked something.
    if !bar.is_hidden() && bar.message().is_empty() {
        bar.enable_steady_tick(Duration::from_millis(100));
    }
    bar.set_message(step.to_owned());
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}
