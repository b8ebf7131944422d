//! What the `b2p` program does: arguments in, one stage after the other, files out.
#![forbid(unsafe_code)]

mod args;
mod bench;
mod bench_render;
mod budget;
mod check;
mod cloud;
mod convert;
mod cut;
mod data;
mod decodable;
mod decode;
mod demo;
mod encode;
mod font;
mod info;
mod kinds;
mod load;
mod manners;
mod many;
mod paperwork;
mod parts;
mod picture;
mod pipe;
mod plan;
mod points;
mod progress;
mod render;
mod scene;
mod sequence;
mod serve;
mod sheet;
mod sidecar;
mod table;
mod upgrade;
mod values;
mod video;
#[cfg(feature = "view")]
mod view;
mod views;

use std::io::ErrorKind;
use std::path::Path;
use std::process::ExitCode;
use std::sync::mpsc::sync_channel;

use args::{Cli, Command};
use clap::{ColorChoice, CommandFactory, FromArgMatches};
use manners::Said;
use many::{Files, Work};

use b2p::{Error, output};

/// What went wrong, with the file it went wrong in.
type Result<T> = std::result::Result<T, Failure>;

/// An error with its context, in the words that the user reads.
#[derive(Debug)]
struct Failure(String);

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        let error = match error {
            Error::Io { path, source } if manners::is_pipe(&path) => return Failure::writing(&path, source),
            error => error,
        };
        let text = error.to_string();
        // What the library calls a field is an argument here.
        Failure(match error {
            Error::LimitExceeded { option, .. } => match option {
                "max_bytes" => text.replace(option, "--max-memory"),
                "max_points" => text.replace(option, "--max-points"),
                "max_pixels" => text.replace(option, "--max-pixels"),
                "max_frames" => text.replace(option, "--limits unlimited"),
                "max_pairs" => text.replace(option, "--max-pairs"),
                _ => text,
            },
            Error::TooFewBits { .. } => format!("{text}; code coarser levels (--levels)"),
            Error::ModelMissing { .. } => format!("{text}; --model FILE loads it"),
            _ => text,
        })
    }
}

impl Failure {
    /// The reader of standard output has gone: there is nothing to say.
    const READER_GONE: &str = "";

    /// What the system said when `path` was written.
    fn writing(path: &Path, source: std::io::Error) -> Failure {
        if source.kind() == ErrorKind::BrokenPipe {
            return Failure(Failure::READER_GONE.into());
        }
        let name = match manners::is_pipe(path) {
            true => "standard input or output".into(),
            false => path.display().to_string(),
        };
        Failure(format!("{name}: {source}"))
    }

    /// An error that concerns the contents of a file.
    fn in_file(path: &Path) -> impl Fn(Error) -> Failure + '_ {
        move |error| match error {
            Error::Io { .. } => Failure::from(error),
            _ => Failure(format!("{}: {}", path.display(), Failure::from(error).0)),
        }
    }
}

/// The most threads that are started.
const MOST_THREADS: usize = 1024;
/// What a shell gives for a program that SIGPIPE ended.
const BROKEN_PIPE: u8 = 128 + 13;

/// Runs the program; the exit code is 0 for success, 1 for failure, 2 (from the argument parser) for misuse, 130 after
/// Ctrl-C, 141 if the reader of standard output has gone.
pub fn main() -> ExitCode {
    let mut cli = parse();
    manners::set(&cli);
    // Ctrl-C is awaited by a thread, too.
    if plays(&cli.command) {
        b2p_kernels::keep_freed();
    }
    let usual = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        // Readers of other crates may panic on damaged files, which becomes an error.
        if !b2p_formats::clouds::is_guarded() {
            usual(panic);
        }
    }));
    let interrupted = ctrlc::set_handler(|| {
        many::stop();
        output::remove_unfinished();
        std::process::exit(130);
    });
    if let Err(error) = interrupted {
        manners::warn(&format!("Ctrl-C may leave a temporary file behind: {error}"));
    }
    match run(&mut cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure(message)) if message == Failure::READER_GONE => ExitCode::from(BROKEN_PIPE),
        Err(Failure(message)) if message.ends_with(many::UP_TO_DATE) => {
            manners::note_report(&message);
            ExitCode::SUCCESS
        }
        Err(Failure(message)) => {
            manners::complain(&message);
            ExitCode::FAILURE
        }
    }
}

/// The arguments; help and usage errors are coloured as they say.
fn parse() -> Cli {
    let arguments: Vec<_> = std::env::args_os().collect();
    let given = arguments.iter().zip(arguments.iter().skip(1).map(Some).chain([None]));
    let chosen = given.filter_map(|(argument, next)| match argument.to_str()?.strip_prefix("--color")? {
        "" => next?.to_str(),
        value => value.strip_prefix('='),
    });
    let colour = match chosen.last() {
        Some("always") => ColorChoice::Always,
        Some("never") => ColorChoice::Never,
        _ => ColorChoice::Auto,
    };
    let matches = Cli::command().color(colour).get_matches_from(&arguments);
    Cli::from_arg_matches(&matches).unwrap_or_else(|error| error.exit())
}

fn run(cli: &mut Cli) -> Result<()> {
    start_threads(cli.threads)?;
    let progress = progress::Progress::new(cli.quiet);
    let limits = cli.limits.limits();
    let threads = cli.threads;
    let many = |files: &Files, units, output| many::run(files, units, output, threads, &progress);
    let said: Said = match &mut cli.command {
        Command::Encode(args) => match args.files.work(encode::KIND)? {
            Work::One { input, output } => {
                (args.cloud, args.output) = (input, output);
                encode::run(args, &limits, &progress)?
            }
            Work::Sequence { inputs, output } => {
                (args.clouds, args.output) = (inputs, output);
                encode::run(args, &limits, &progress)?
            }
            Work::Many(units) => many(&args.files, units, "--output")?,
        },
        Command::Decode(args) => match args.files.work(decode::kind(args))? {
            Work::One { input, output } => {
                (args.input, args.output) = (input, output);
                decode::run(args, &limits, &progress)?
            }
            Work::Sequence { .. } => unreachable!("only `encode` gathers files"),
            Work::Many(units) => many(&args.files, units, "--output")?,
        },
        Command::Convert(args) => convert::run(args, &limits, &progress)?,
        Command::Render(args) => match args.files.work(render::kind(args))? {
            Work::One { input, output } => {
                (args.input, args.output) = (input, output);
                render::run(args, &limits, &progress)?
            }
            Work::Sequence { .. } => unreachable!("only `encode` gathers files"),
            Work::Many(units) => {
                let output = args.turntable.as_ref().map_or("--output", |_| "--turntable");
                many(&args.files, units, output)?
            }
        },
        Command::Info(args) => info::run(args, &limits)?,
        Command::Check(args) => check::run(args, &limits)?,
        Command::Upgrade(args) => upgrade::run(args, &limits, &progress)?,
        Command::Cut(args) => cut::run(args, &limits)?,
        Command::Plan(args) => plan::run(args)?,
        #[cfg(feature = "view")]
        Command::View(args) | Command::Play(args) => {
            // A window or a terminal of its own says how it goes.
            drop(progress);
            return view::run(args, &limits)?.say();
        }
        Command::Join(args) => sequence::join(args, &limits)?,
        Command::Serve(args) => serve::run(args)?,
        Command::Demo(args) => demo::run(args, &progress)?,
        Command::Bench(args) => bench::run(args, &limits, &progress)?,
        Command::Completions(args) => paperwork::completions(args)?,
        Command::Man(args) => paperwork::manual(args)?,
    };
    drop(progress);
    said.say()?;
    manners::remember()
}

/// Whether the command draws a sequence, whose frames take the same memory one after the other.
fn plays(command: &Command) -> bool {
    match command {
        Command::Render(args) => args
            .files
            .is_any(|path| !manners::is_pipe(path) && sequence::is_sequence(path)),
        #[cfg(feature = "view")]
        Command::Play(_) => true,
        _ => false,
    }
}

/// Starts the threads at once, so that none that the system refuses is missed later. Unless a number was asked for,
/// fewer will do.
fn start_threads(asked: Option<u16>) -> Result<()> {
    let usual = || {
        let named = std::env::var("RAYON_NUM_THREADS").ok().and_then(|n| n.parse().ok());
        let cores = || std::thread::available_parallelism().map_or(1, usize::from);
        named.filter(|n| *n > 0).unwrap_or_else(cores).min(MOST_THREADS)
    };
    let wanted = asked.map_or_else(usual, usize::from);
    let mut waiting = Vec::new();
    for _ in 0..wanted {
        let (sender, receiver) = sync_channel::<rayon::ThreadBuilder>(1);
        let work = move || {
            if let Ok(worker) = receiver.recv() {
                worker.run();
            }
        };
        match std::thread::Builder::new().spawn(work) {
            Ok(_) => waiting.push(sender),
            Err(error) if asked.is_some() => return Err(Failure(format!("cannot start {wanted} threads: {error}"))),
            Err(error) => {
                let count = table::counted(waiting.len().max(1) as u64, "thread");
                manners::warn(&format!("works in {count} of {wanted}: {error}"));
                break;
            }
        }
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(waiting.len().max(1));
    let built = match waiting.is_empty() {
        true => pool.use_current_thread().build_global(),
        false => {
            let begin = |worker| match waiting.pop() {
                Some(thread) => thread.send(worker).map_err(|e| std::io::Error::other(e.to_string())),
                None => Err(std::io::Error::other("there are too few threads")),
            };
            pool.spawn_handler(begin).build_global()
        }
    };
    built.map_err(|error| Failure(format!("cannot start threads: {error}")))
}
