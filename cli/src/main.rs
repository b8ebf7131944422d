//! The `b2p` program: arguments in, one stage after the other, files out.
#![forbid(unsafe_code)]

mod args;
mod bench;
mod bench_render;
mod budget;
mod cloud;
mod decode;
mod demo;
mod encode;
mod info;
mod keep;
mod load;
mod picture;
mod pipe;
mod progress;
mod render;
mod table;
mod values;

use std::path::Path;
use std::process::ExitCode;

use args::{Cli, Command};
use clap::Parser;

use b2p::{Error, output};

/// What went wrong, with the file it went wrong in.
type Result<T> = std::result::Result<T, Failure>;

/// An error with its context, in the words that the user reads.
#[derive(Debug)]
struct Failure(String);

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        let text = error.to_string();
        // What the library calls a field is an argument here.
        Failure(match error {
            Error::LimitExceeded { option, .. } => match option {
                "max_bytes" => text.replace(option, "--max-memory"),
                "max_points" => text.replace(option, "--max-points"),
                "max_pixels" => text.replace(option, "--max-pixels"),
                _ => text,
            },
            Error::TooFewBits { .. } => format!("{text}; code coarser levels (--levels)"),
            Error::ModelMissing { .. } => format!("{text}; --model FILE loads it"),
            _ => text,
        })
    }
}

impl Failure {
    /// An error that concerns the contents of a file.
    fn in_file(path: &Path) -> impl Fn(Error) -> Failure + '_ {
        move |error| match error {
            Error::Io { .. } => Failure(error.to_string()),
            _ => Failure(format!("{}: {}", path.display(), Failure::from(error).0)),
        }
    }
}

/// Runs the program; the exit code is 0 for success, 1 for failure, 2 (from the argument parser) for misuse, 130 after Ctrl-C.
fn main() -> ExitCode {
    let cli = Cli::parse();
    let interrupted = ctrlc::set_handler(|| {
        output::remove_unfinished();
        std::process::exit(130);
    });
    let done = interrupted
        .map_err(|e| Failure(format!("no handler for Ctrl-C: {e}")))
        .and_then(|()| run(&cli));
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure(message)) => {
            eprintln!("b2p: {message}");
            ExitCode::FAILURE
        }
    }
}

fn run(cli: &Cli) -> Result<()> {
    if let Some(threads) = cli.threads {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads.into())
            .build_global()
            .map_err(|e| Failure(format!("cannot start {threads} threads: {e}")))?;
    }
    let progress = progress::Progress::new(cli.quiet);
    let limits = cli.limits.limits();
    let text = match &cli.command {
        Command::Encode(args) => encode::run(args, &limits, &progress)?,
        Command::Decode(args) => decode::run(args, &limits, &progress)?,
        Command::Render(args) => render::run(args, &limits, &progress)?,
        Command::Info(args) => info::run(args, &limits)?,
        Command::Demo(args) => demo::run(args, &progress)?,
        Command::Bench(args) => bench::run(args, &limits, &progress)?,
    };
    drop(progress);
    if !cli.quiet {
        print(&text);
    }
    Ok(())
}

/// Prints without failing when the reader of a pipe has gone.
fn print(text: &str) {
    use std::io::Write;
    let _ = std::io::stdout().write_all(text.as_bytes());
}
