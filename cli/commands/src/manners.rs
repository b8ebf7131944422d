//! What holds for every command: where results and reports go, in which colours, and what may be overwritten.

use std::io::{ErrorKind, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, OnceLock, PoisonError};

use b2p::output;
use serde_json::Value;

use super::args::{Cli, Colour};
use super::many::UP_TO_DATE;
use super::many::record::{self, Record};
use super::pipe::PIPE;
use super::{Failure, Result};

static MANNERS: OnceLock<Manners> = OnceLock::new();

/// The global options.
#[derive(Debug, Clone, Copy, Default)]
struct Manners {
    quiet: bool,
    verbose: bool,
    force: bool,
    json: bool,
    coloured: bool,
    resume: bool,
}

/// What `--resume` will know of this run: its inputs and its outputs.
static FILES: Mutex<[Vec<PathBuf>; 2]> = Mutex::new([Vec::new(), Vec::new()]);

/// Takes the global options, once.
pub fn set(cli: &Cli) {
    let coloured = match cli.color {
        Colour::Always => true,
        Colour::Never => false,
        Colour::Auto => std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none(),
    };
    // Set twice only if the program ran twice.
    let _ = MANNERS.set(Manners {
        quiet: cli.quiet,
        verbose: cli.verbose,
        force: cli.force,
        json: cli.json,
        coloured,
        resume: cli.command.files().is_some_and(|files| files.resume),
    });
}

fn manners() -> Manners {
    MANNERS.get().copied().unwrap_or_default()
}

/// Whether more is to be said than usual.
pub fn verbose() -> bool {
    manners().verbose
}

/// Whether programs read what is said.
pub fn json() -> bool {
    manners().json
}

/// What a command has to say.
#[derive(Debug, Default)]
pub struct Said {
    /// Goes to standard output: what was asked for.
    pub result: String,
    /// Goes to standard error unless `-q` is given: how it went.
    pub report: String,
}

impl Said {
    /// A report, and with `--json` the same for programs as the result.
    pub fn report(report: String, json: impl FnOnce() -> Value) -> Self {
        match self::json() {
            true => Said::result(format!("{:#}\n", json())),
            false => Said {
                report,
                result: String::new(),
            },
        }
    }

    /// A result alone.
    pub fn result(result: String) -> Self {
        Said {
            result,
            report: String::new(),
        }
    }

    /// The same for an output that takes standard output: everything goes to standard error.
    pub fn beside(mut self, to: &Path) -> Self {
        if is_pipe(to) {
            self.report += &std::mem::take(&mut self.result);
        }
        self
    }

    /// Says it. What fails when a result is written is an error; what fails when a report is, is not.
    pub fn say(self) -> Result<()> {
        if !manners().quiet {
            let _ = std::io::stderr().lock().write_all(self.report.as_bytes());
        }
        if self.result.is_empty() {
            return Ok(());
        }
        check_open()?;
        let mut out = std::io::stdout().lock();
        let written = out.write_all(self.result.as_bytes()).and_then(|()| out.flush());
        written.map_err(|source| Failure::writing(Path::new(PIPE), source))
    }
}

/// Fails if what is written to standard output would be lost.
fn check_open() -> Result<()> {
    match b2p_kernels::stdout_was_closed() {
        true => Err(Failure("standard output is closed".into())),
        false => Ok(()),
    }
}

/// Warns on standard error, whatever is asked for.
pub fn warn(text: &str) {
    note("33", text);
}

/// Says on standard error what was done, unless `-q` is given.
pub fn note_report(text: &str) {
    if !manners().quiet {
        warn(text);
    }
}

/// Says on standard error why the program fails.
pub fn complain(text: &str) {
    note("31", text);
}

/// Passes on what a command said on standard error.
pub fn note_text(text: &str) {
    let _ = std::io::stderr().lock().write_all(text.as_bytes());
}

fn note(colour: &str, text: &str) {
    let name = match manners().coloured {
        true => format!("\x1b[1;{colour}mb2p:\x1b[0m"),
        false => "b2p:".into(),
    };
    // There is nobody else to tell.
    let _ = writeln!(std::io::stderr(), "{name} {text}");
}

/// Whether `--resume` was given.
pub fn resumes() -> bool {
    manners().resume
}

/// Whether a path stands for standard input or output.
pub fn is_pipe(path: &Path) -> bool {
    path == Path::new(PIPE)
}

/// Whether these outputs may be written: none is one of the inputs, and those that exist may be replaced. On a terminal
/// the user is asked; elsewhere `--force` is needed.
///
/// With `--resume`, what is up to date ends the command, and what is not may be replaced.
pub fn permit(outputs: &[&Path], inputs: &[&Path]) -> Result<()> {
    for output in outputs.iter().filter(|output| !is_pipe(output)) {
        if let Some(input) = inputs.iter().find(|input| is_same(input, output)) {
            let (output, input) = (output.display(), input.display());
            return Err(Failure(format!("{output} is the input {input}: write to another file")));
        }
    }
    if manners().resume {
        return resume(outputs, inputs);
    }
    let existing = outputs.iter().filter(|output| !is_pipe(output));
    let existing: Vec<PathBuf> = existing.filter_map(|output| output::replaced(output)).collect();
    let Some(first) = existing.first() else {
        return Ok(());
    };
    let what = match existing.len() {
        1 => format!("{} exists already", first.display()),
        n => format!("{} and {} of the other outputs exist already", first.display(), n - 1),
    };
    if manners().force || agreed(&what) {
        return Ok(());
    }
    Err(Failure(format!("{what}; --force overwrites")))
}

/// Ends the command if it did before what it is to do; remembers its files otherwise.
fn resume(outputs: &[&Path], inputs: &[&Path]) -> Result<()> {
    let owned = |paths: &[&Path]| paths.iter().map(|&path| path.to_path_buf()).collect::<Vec<_>>();
    let (inputs, outputs) = (owned(inputs), owned(outputs));
    if let Some(first) = outputs.first()
        && let Some(before) = Record::read(first)
        && Record::of(&record::options(), &inputs, &outputs).is_some_and(|now| now == before)
    {
        return Err(Failure(format!("{} {UP_TO_DATE}", first.display())));
    }
    *FILES.lock().unwrap_or_else(PoisonError::into_inner) = [inputs, outputs];
    Ok(())
}

/// With `--resume`, keeps a record of what this run has done.
pub fn remember() -> Result<()> {
    let [inputs, outputs] = &*FILES.lock().unwrap_or_else(PoisonError::into_inner);
    match Record::of(&record::options(), inputs, outputs) {
        Some(record) if manners().resume => record.write(),
        _ => Ok(()),
    }
}

/// Asks on a terminal, if there is one at both ends.
fn agreed(what: &str) -> bool {
    let (input, errors) = (std::io::stdin(), std::io::stderr());
    if !(input.is_terminal() && errors.is_terminal()) {
        return false;
    }
    let mut answer = String::new();
    let asked = write!(errors.lock(), "b2p: {what}; overwrite? [y/N] ").and_then(|()| errors.lock().flush());
    asked.is_ok() && input.read_line(&mut answer).is_ok() && matches!(answer.trim(), "y" | "Y" | "yes")
}

/// Whether both paths lead to the same regular file.
fn is_same(a: &Path, b: &Path) -> bool {
    let file = |path: &Path| {
        let found = std::fs::metadata(path).ok()?;
        found.is_file().then_some(found)
    };
    let (Some(found_a), Some(found_b)) = (file(a), file(b)) else {
        return false;
    };
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        (found_a.dev(), found_a.ino()) == (found_b.dev(), found_b.ino())
    }
    #[cfg(not(unix))]
    {
        let _ = (found_a, found_b);
        std::fs::canonicalize(a).is_ok_and(|a| std::fs::canonicalize(b).is_ok_and(|b| a == b))
    }
}

/// Writes a file, or standard output.
pub fn write(to: &Path, fill: impl FnOnce(&mut dyn Write) -> b2p::Result<()>) -> Result<()> {
    if !is_pipe(to) {
        return Ok(output::write_file(to, fill)?);
    }
    check_open()?;
    let mut reader = Reader { gone: false };
    let mut out = std::io::BufWriter::with_capacity(1 << 16, &mut reader);
    let filled = fill(&mut out).map_err(Failure::from);
    // What could not be written is not tried once more.
    let flushed = match &filled {
        Ok(()) => out.flush().map_err(|source| Failure::writing(to, source)),
        Err(_) => Ok(()),
    };
    drop(out.into_parts());
    match reader.gone {
        true => Err(Failure(Failure::READER_GONE.into())),
        false => filled.and(flushed),
    }
}

/// Standard output. It remembers that its reader has gone, which encoders may say in words of their own.
struct Reader {
    gone: bool,
}

impl Write for Reader {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let written = std::io::stdout().write(bytes);
        self.gone |= written.as_ref().is_err_and(|e| e.kind() == ErrorKind::BrokenPipe);
        written
    }

    fn flush(&mut self) -> std::io::Result<()> {
        let flushed = std::io::stdout().flush();
        self.gone |= flushed.as_ref().is_err_and(|e| e.kind() == ErrorKind::BrokenPipe);
        flushed
    }
}
