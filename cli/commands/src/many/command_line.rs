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
            for (name, written, joined) in options_in(&argument, &text, &with_value) {
                let takes_next = !joined && with_value.contains(&name);
                let value = if takes_next { arguments.next() } else { None };
                if !OPTIONS.contains(&name.as_str()) && !left_out.contains(&name.as_str()) {
                    common.push(written);
                    common.extend(value);
                }
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

/// The options of an argument: one, or several short ones such as `-fo`. Of each its name, how it is written by itself,
/// and whether its value is there, too.
fn options_in(argument: &OsStr, text: &str, with_value: &[String]) -> Vec<(String, OsString, bool)> {
    if let Some(long) = text.strip_prefix("--") {
        let name = long.split('=').next().unwrap_or(long);
        return vec![(format!("--{name}"), argument.to_owned(), long.contains('='))];
    }
    let mut options = Vec::new();
    for (at, short) in text.char_indices().skip(1) {
        let name = format!("-{short}");
        let rest = &text[at + short.len_utf8()..];
        if with_value.contains(&name) {
            options.push((name, format!("-{short}{rest}").into(), !rest.is_empty()));
            break;
        }
        options.push((name.clone(), name.into(), false));
    }
    options
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
    fn short_options_may_be_written_together() {
        assert_eq!(
            of("encode -vfo d/ a b -fb0.2 -qv", "--output"),
            "encode -v -f -f -b0.2 -v --color never --threads 2 --output y.png -- x.b2p"
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
