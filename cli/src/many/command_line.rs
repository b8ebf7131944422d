//! The command line of one input: that of all of them without their names.

use std::ffi::{OsStr, OsString};

use clap::CommandFactory;

use super::super::args::Cli;
use super::files::{OPTIONS, Unit};

/// The arguments of a command over many files: its options, and how an input and an output are put beside them.
#[derive(Debug)]
pub struct CommandLine {
    /// What comes before inputs: the command and its options, and global options.
    common: Vec<OsString>,
    /// The option that names the output.
    output: &'static str,
}

impl CommandLine {
    /// Of the arguments that the program was called with, its own name left out. `output` is the option that names
    /// outputs.
    pub fn new(arguments: impl IntoIterator<Item = OsString>, output: &'static str) -> Self {
        CommandLine {
            common: Self::without(arguments, &[output]),
            output,
        }
    }

    /// The command and its options, less those of [`OPTIONS`] and the ones that `left_out` names.
    pub fn without(arguments: impl IntoIterator<Item = OsString>, left_out: &[&str]) -> Vec<OsString> {
        let program = Cli::command();
        let mut with_value = options_with_value(&program);
        let mut command = None;
        let mut common = Vec::new();
        let mut arguments = arguments.into_iter();
        while let Some(argument) = arguments.next() {
            let text = argument.to_string_lossy().into_owned();
            if text == "--" {
                break;
            }
            if text == "-" || !text.starts_with('-') {
                if command.is_none() {
                    command = program.find_subcommand(&argument);
                    with_value.extend(command.into_iter().flat_map(options_with_value));
                    common.push(argument);
                }
                continue;
            }
            let (name, joined) = named(&text);
            let takes_next = !joined && with_value.iter().any(|known| known == name);
            let value = if takes_next { arguments.next() } else { None };
            if !OPTIONS.contains(&name) && !left_out.contains(&name) {
                common.push(argument.clone());
                common.extend(value);
            }
        }
        common
    }

    /// The arguments for one input, with so many threads.
    pub fn of(&self, unit: &Unit, threads: usize) -> Vec<OsString> {
        let mut arguments = self.common.clone();
        arguments.extend(["--color", "never", "--threads"].map(OsString::from));
        arguments.push(threads.to_string().into());
        arguments.extend([OsStr::new(self.output).into(), unit.output.clone().into()]);
        arguments.extend(["--".into(), unit.input.clone().into()]);
        arguments
    }
}

/// The options of a command that take a value, as they are written.
fn options_with_value(command: &clap::Command) -> Vec<String> {
    let options = command
        .get_arguments()
        .filter(|option| option.get_action().takes_values());
    let names = options.flat_map(|option| {
        let long = option.get_long().into_iter();
        let long = long.chain(option.get_all_aliases().into_iter().flatten());
        let long = long.map(|name| format!("--{name}"));
        long.chain(option.get_short().map(|short| format!("-{short}")))
    });
    names.collect()
}

/// The name of an option, and whether its value is in the same argument.
fn named(text: &str) -> (&str, bool) {
    match text.split_once('=') {
        Some((name, _)) if text.starts_with("--") => (name, true),
        _ if !text.starts_with("--") && text.is_char_boundary(2) && text.len() > 2 => (&text[..2], true),
        _ => (text, false),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(arguments: &str, output: &'static str) -> String {
        let line = CommandLine::new(arguments.split(' ').map(OsString::from), output);
        let unit = Unit {
            input: "x.b2p".into(),
            output: "y.png".into(),
        };
        let all: Vec<_> = line
            .of(&unit, 2)
            .iter()
            .map(|a| a.to_string_lossy().into_owned())
            .collect();
        all.join(" ")
    }

    #[test]
    fn options_stay_and_files_are_replaced() {
        assert_eq!(
            of(
                "-v render a.b2p --size 9x9 b.b2p --orbit=1,2 -o d/ --jobs 3",
                "--output"
            ),
            "-v render --size 9x9 --orbit=1,2 --color never --threads 2 --output y.png -- x.b2p"
        );
        assert_eq!(
            of("encode --resume -b0.2 -Q 3 --name {n}.b2p -od -- -a -b", "--output"),
            "encode --resume -b0.2 -Q 3 --color never --threads 2 --output y.png -- x.b2p"
        );
    }

    #[test]
    fn a_turntable_stays_one() {
        assert_eq!(
            of("render a b --turntable d --views 9", "--turntable"),
            "render --views 9 --color never --threads 2 --turntable y.png -- x.b2p"
        );
    }
}
