//! Many files: a command for each, run by this program as a process of its own, so that one that fails harms no other
//! and can be repeated by hand.

mod command_line;
mod files;
pub mod record;

use std::ffi::OsString;
use std::num::NonZeroUsize;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::manners::{self, Said};
use super::progress::Progress;
use super::table::counted;
use super::{Failure, Result};
use command_line::CommandLine;
pub use files::{Files, Kind, Unit, Work, expanded};

/// What a command says of an output that `--resume` finds as it was left.
pub const UP_TO_DATE: &str = "is up to date";

/// Commands that are running.
static RUNNING: Mutex<Vec<u32>> = Mutex::new(Vec::new());

/// How a command ended.
struct Ended {
    unit: Unit,
    status: Status,
    time: Duration,
    /// Its result in JSON, if it was asked for.
    result: Value,
}

/// Whether it did what it was to do.
enum Status {
    Done,
    /// It was done before.
    Skipped,
    Failed(String),
}

/// Runs the command that this program was called with for each of `units`, and goes on after those that fail.
///
/// # Errors
/// If one failed, after all have ended.
pub fn run(
    files: &Files,
    units: Vec<Unit>,
    output: &'static str,
    threads: Option<u16>,
    progress: &Progress,
) -> Result<Said> {
    let start = Instant::now();
    for folder in units.iter().filter_map(|unit| unit.output.parent()) {
        let made = std::fs::create_dir_all(folder);
        made.map_err(|error| Failure(format!("{}: {error}", folder.display())))?;
    }
    let all = units.len();
    let threads = threads.map_or_else(cores, usize::from);
    let jobs = files.jobs.map_or(threads, usize::from).clamp(1, all.max(1));
    let runner = Runner {
        line: CommandLine::new(std::env::args_os().skip(1), output),
        threads: (threads / jobs).max(1),
        tells_json: files.progress.is_some(),
        next: AtomicUsize::new(0),
        ended: Mutex::new(Vec::with_capacity(all)),
        units,
    };
    std::thread::scope(|scope| {
        for _ in 0..jobs {
            scope.spawn(|| runner.work(progress));
        }
    });
    let mut ended = runner.ended.into_inner().unwrap_or_else(PoisonError::into_inner);
    ended.sort_by(|a, b| a.unit.output.cmp(&b.unit.output));
    said(&ended, start.elapsed())
}

/// Ends the commands that are running, if this program is asked to end.
pub fn stop() {
    #[cfg(unix)]
    for &process in lock(&RUNNING).iter() {
        let process = i32::try_from(process).ok().and_then(rustix::process::Pid::from_raw);
        if let Some(process) = process {
            // It may have ended by itself.
            let _ = rustix::process::kill_process(process, rustix::process::Signal::TERM);
        }
    }
}

struct Runner {
    line: CommandLine,
    units: Vec<Unit>,
    /// Of each command.
    threads: usize,
    tells_json: bool,
    /// The unit that starts next.
    next: AtomicUsize,
    ended: Mutex<Vec<Ended>>,
}

impl Runner {
    /// Runs one command after the other.
    fn work(&self, progress: &Progress) {
        while let Some(unit) = self.units.get(self.next.fetch_add(1, Ordering::Relaxed)) {
            self.tell(|| json!({"event": "start", "input": path(&unit.input), "output": path(&unit.output)}));
            let start = Instant::now();
            let (status, result) = self.command(unit);
            let one = Ended {
                unit: unit.clone(),
                status,
                time: start.elapsed(),
                result,
            };
            let mut ended = lock(&self.ended);
            let (count, of) = (ended.len() + 1, self.units.len());
            self.tell(|| {
                let mut event = one.json();
                event["event"] = "end".into();
                event["count"] = count.into();
                event["of"] = of.into();
                event
            });
            progress.say(&format!("{count} of {of}"));
            ended.push(one);
        }
    }

    fn tell(&self, event: impl FnOnce() -> Value) {
        if self.tells_json {
            // Nobody may be reading: the work goes on.
            let _ = Said::result(format!("{}\n", event())).say();
        }
    }

    /// Runs the command of one input, and waits for it.
    fn command(&self, unit: &Unit) -> (Status, Value) {
        let output = self.spawn(self.line.of(unit, self.threads));
        let output = match output {
            Ok(output) => output,
            Err(error) => return (Status::Failed(format!("cannot start: {error}")), Value::Null),
        };
        let said = String::from_utf8_lossy(&output.stderr);
        if output.status.success() {
            let status = match said.contains(UP_TO_DATE) {
                true => Status::Skipped,
                false => Status::Done,
            };
            if manners::verbose() {
                manners::note_text(&said);
            }
            return (status, serde_json::from_slice(&output.stdout).unwrap_or(Value::Null));
        }
        let why = said.trim().trim_start_matches("b2p: ");
        let why = match output.status.code() {
            Some(_) => why.to_owned(),
            None => format!("{} {why}", output.status).trim().to_owned(),
        };
        (Status::Failed(why), Value::Null)
    }

    fn spawn(&self, arguments: Vec<OsString>) -> std::io::Result<std::process::Output> {
        let child = Command::new(std::env::current_exe()?)
            .args(arguments)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let id = child.id();
        lock(&RUNNING).push(id);
        let output = child.wait_with_output();
        lock(&RUNNING).retain(|&running| running != id);
        output
    }
}

impl Ended {
    fn json(&self) -> Value {
        let (status, error) = match &self.status {
            Status::Done => ("done", None),
            Status::Skipped => ("skipped", None),
            Status::Failed(why) => ("failed", Some(why)),
        };
        json!({
            "input": path(&self.unit.input),
            "output": path(&self.unit.output),
            "status": status,
            "seconds": self.time.as_secs_f64(),
            "error": error,
        })
    }
}

/// What is said at the end, or which commands failed.
fn said(ended: &[Ended], time: Duration) -> Result<Said> {
    let skipped = ended.iter().filter(|one| matches!(one.status, Status::Skipped)).count();
    let failed = ended.iter().filter_map(|one| match &one.status {
        Status::Failed(why) => Some((&one.unit, why)),
        _ => None,
    });
    let failed: Vec<_> = failed.collect();
    let files = counted(ended.len() as u64, "file");
    let report = format!(
        "{files} in {:.1} s: {} done, {skipped} up to date, {} failed\n",
        time.as_secs_f64(),
        ended.len() - skipped - failed.len(),
        failed.len(),
    );
    let json = || {
        let each = ended.iter().map(|one| {
            let mut value = one.json();
            value["result"] = one.result.clone();
            value
        });
        Value::from_iter(each)
    };
    let said = Said::report(report, json);
    if failed.is_empty() {
        return Ok(said);
    }
    said.say()?;
    for (unit, why) in &failed {
        let input = path(&unit.input);
        // Most errors name the file themselves.
        match why.starts_with(&input) {
            true => manners::complain(why),
            false => manners::complain(&format!("{input}: {why}")),
        }
    }
    Err(Failure(format!("{} of {files} failed", failed.len())))
}

fn path(path: &Path) -> String {
    path.display().to_string()
}

fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, NonZeroUsize::get)
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
