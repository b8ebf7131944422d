//! Which files a command reads, and where it writes.

use std::path::{Path, PathBuf};

use clap::error::ErrorKind;
use clap::{Args, CommandFactory, ValueEnum};

use super::super::args::Cli;
use super::super::manners::is_pipe;
use super::super::{Failure, Result};

/// Inputs, and an output or a folder of outputs.
#[derive(Debug, Clone, Default, Args)]
pub struct Files {
    /// Files, folders or patterns such as 'scans/*.ply', then the output, unless -o names it. `-`: standard input or
    /// output
    #[arg(value_name = "IN", required_unless_present = "files_from", num_args = 1..)]
    paths: Vec<PathBuf>,
    /// File to write, or of several inputs a folder. `-`: standard output
    #[arg(short, long, value_name = "OUT")]
    output: Option<PathBuf>,
    /// Text file with an input on each line
    #[arg(long, help_heading = "Many files", value_name = "FILE")]
    files_from: Option<PathBuf>,
    /// Names of files in the output folder: {stem} is the name of the input without its ending, {name} the whole name,
    /// {n} its number from 0 [default: {stem} and the ending of the format]
    #[arg(long, help_heading = "Many files", value_name = "PATTERN")]
    name: Option<String>,
    /// Inputs that are worked on at the same time. The threads are divided among them [default: one per thread]
    #[arg(long, help_heading = "Many files", value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub jobs: Option<u16>,
    /// Skip what was done before: outputs whose contents, inputs and options have not changed since, by hash
    #[arg(long, help_heading = "Many files")]
    pub resume: bool,
    /// Write one line of JSON to standard output for each input that starts and ends
    #[arg(long, help_heading = "Many files", value_enum, value_name = "FORMAT")]
    pub progress: Option<ProgressFormat>,
}

/// How progress is reported.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ProgressFormat {
    /// JSON, an object a line
    Json,
}

/// Options that are not those of each input.
pub const OPTIONS: [&str; 10] = [
    "--output",
    "-o",
    "--files-from",
    "--name",
    "--jobs",
    "--progress",
    "--threads",
    "--color",
    // What each says is caught, and tells whether it was done before.
    "--quiet",
    "-q",
];

/// What a command works on.
#[derive(Debug)]
pub enum Work {
    One {
        input: PathBuf,
        output: PathBuf,
    },
    /// Inputs that become one output: frames of a sequence.
    Sequence {
        inputs: Vec<PathBuf>,
        output: PathBuf,
    },
    Many(Vec<Unit>),
}

/// An input, and the output that it becomes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unit {
    pub input: PathBuf,
    pub output: PathBuf,
}

/// What a command takes from a folder, and how it names what it makes of it.
#[derive(Debug, Clone, Copy)]
pub struct Kind<'a> {
    /// The command.
    pub command: &'a str,
    /// Endings of files that are taken from folders, in lower case.
    pub takes: &'a [&'a str],
    /// Ending of what is written.
    pub ending: &'a str,
    /// An output that an option names in place of [`Files`].
    pub instead: Option<&'a Path>,
    /// Whether many inputs may become one output.
    pub gathers: bool,
}

impl Files {
    /// Whether `is` holds for a path that was given.
    pub fn is_any(&self, is: impl Fn(&Path) -> bool) -> bool {
        self.paths.iter().any(|path| is(path))
    }

    /// Tells inputs from the output.
    ///
    /// # Errors
    /// If inputs cannot be listed, or two of them would become the same output. The program ends if there is no output.
    pub fn work(&self, kind: Kind<'_>) -> Result<Work> {
        let named = self.output.as_deref().or(kind.instead);
        let (inputs, output) = match (named, self.paths.split_last()) {
            (Some(output), _) => (&self.paths[..], output),
            (None, Some((last, inputs))) if !inputs.is_empty() || self.files_from.is_some() => (inputs, last.as_path()),
            _ => {
                let text = format!("where to? `b2p {0} IN OUT` or `b2p {0} IN -o OUT`", kind.command);
                Cli::command().error(ErrorKind::MissingRequiredArgument, text).exit()
            }
        };
        if let ([input], None, None) = (inputs, &self.files_from, &self.name)
            && !is_many(input)
            && !is_folder(output)
        {
            let (input, output) = (input.clone(), output.to_path_buf());
            return Ok(match self.progress {
                None => Work::One { input, output },
                Some(_) => Work::Many(vec![Unit { input, output }]),
            });
        }
        let mut all = expanded(inputs, kind.takes)?;
        if let Some(list) = &self.files_from {
            let text = std::fs::read_to_string(list);
            let text = text.map_err(|error| Failure(format!("{}: {error}", list.display())))?;
            all.extend(text.lines().filter(|line| !line.trim().is_empty()).map(PathBuf::from));
        }
        if is_pipe(output) || (output.extension().is_some() && !is_folder(output)) {
            if kind.gathers {
                let output = output.to_path_buf();
                return Ok(Work::Sequence { inputs: all, output });
            }
            let what = format!("{} is no folder: outputs of several inputs need one", output.display());
            let folder = output.with_extension("");
            return Err(Failure(format!("{what}, such as -o {}/", folder.display())));
        }
        self.units(&all, output, kind.ending).map(Work::Many)
    }

    fn units(&self, inputs: &[PathBuf], folder: &Path, ending: &str) -> Result<Vec<Unit>> {
        let mut units: Vec<Unit> = Vec::with_capacity(inputs.len());
        for (n, input) in inputs.iter().enumerate() {
            let part = |part: Option<&std::ffi::OsStr>| part.unwrap_or_default().to_string_lossy().into_owned();
            let (stem, name) = (part(input.file_stem()), part(input.file_name()));
            let output = match &self.name {
                None => format!("{stem}.{ending}"),
                Some(pattern) => pattern
                    .replace("{stem}", &stem)
                    .replace("{name}", &name)
                    .replace("{n}", &format!("{n:06}")),
            };
            units.push(Unit {
                input: input.clone(),
                output: folder.join(output),
            });
        }
        let mut by_output: Vec<&Unit> = units.iter().collect();
        by_output.sort_by(|a, b| a.output.cmp(&b.output));
        if let Some([a, b]) = by_output.array_windows().find(|[a, b]| a.output == b.output) {
            let (a, b, output) = (a.input.display(), b.input.display(), a.output.display());
            let what = format!("{a} and {b} would both become {output}");
            return Err(Failure(format!(
                "{what}: --name '{{n}}-{{stem}}.{ending}' tells them apart"
            )));
        }
        Ok(units)
    }
}

/// Whether an output is to be a folder.
fn is_folder(path: &Path) -> bool {
    path.is_dir() || path.as_os_str().to_string_lossy().ends_with('/')
}

/// Whether an input stands for several files.
fn is_many(path: &Path) -> bool {
    path.is_dir() || (is_pattern(path) && !path.exists())
}

fn is_pattern(path: &Path) -> bool {
    path.as_os_str().to_string_lossy().contains(['*', '?', '['])
}

/// The files that inputs stand for. Those of a folder and of a pattern are in the order of their names.
pub fn expanded(inputs: &[PathBuf], takes: &[&str]) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for input in inputs {
        if input.is_dir() {
            let fail = |error: std::io::Error| Failure(format!("{}: {error}", input.display()));
            let entries = std::fs::read_dir(input).map_err(fail)?;
            let entries = entries.collect::<std::io::Result<Vec<_>>>().map_err(fail)?;
            let mut found: Vec<PathBuf> = entries.iter().map(std::fs::DirEntry::path).collect();
            found.retain(|path| path.is_file() && has_ending(path, takes));
            require(&found, input, &format!("no files that end with .{}", takes.join(", .")))?;
            found.sort();
            files.extend(found);
        } else if is_many(input) {
            let name = input.to_string_lossy();
            let paths = glob::glob(&name).map_err(|error| Failure(format!("{name}: {error}")))?;
            let found: Vec<PathBuf> = paths
                .filter_map(std::result::Result::ok)
                .filter(|path| path.is_file())
                .collect();
            require(&found, input, "no file has such a name")?;
            files.extend(found);
        } else {
            files.push(input.clone());
        }
    }
    Ok(files)
}

fn require(found: &[PathBuf], input: &Path, what: &str) -> Result<()> {
    match found.is_empty() {
        true => Err(Failure(format!("{}: {what}", input.display()))),
        false => Ok(()),
    }
}

fn has_ending(path: &Path, takes: &[&str]) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    !name.starts_with('.') && takes.iter().any(|ending| name.ends_with(&format!(".{ending}")))
}
