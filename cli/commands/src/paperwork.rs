//! `b2p completions` and `b2p man`: what shells and readers of manuals know of the program.

use std::path::PathBuf;

use b2p::Error;
use clap::{Args, Command, CommandFactory};
use clap_complete::Shell;
use clap_mangen::Man;

use super::args::Cli;
use super::manners::{self, Said};
use super::{Failure, Result};

/// The program's name in its manual and in completions.
const NAME: &str = "b2p";

#[derive(Debug, Args)]
pub struct Completions {
    /// Shell to write for
    #[arg(value_enum)]
    shell: Shell,
}

#[derive(Debug, Args)]
pub struct Manual {
    /// Folder to write b2p.1 and a page for each command to; it is made if it is not there
    #[arg(value_name = "DIR")]
    folder: PathBuf,
}

/// Prints what a shell is to read to complete command lines.
pub fn completions(args: &Completions) -> Result<Said> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut Cli::command(), NAME, &mut script);
    let text = String::from_utf8(script);
    text.map(Said::result)
        .map_err(|e| Failure(format!("the completions of {}: {e}", args.shell)))
}

/// Writes manual pages.
pub fn manual(args: &Manual) -> Result<Said> {
    let io = |path: &PathBuf| {
        let path = path.clone();
        move |source| Error::Io { path, source }
    };
    std::fs::create_dir_all(&args.folder).map_err(io(&args.folder))?;
    let pages: Vec<(PathBuf, Command)> = pages()
        .into_iter()
        .map(|(name, page)| (args.folder.join(name), page))
        .collect();
    let paths: Vec<_> = pages.iter().map(|(path, _)| path.as_path()).collect();
    manners::permit(&paths, &[])?;
    for (path, page) in &pages {
        let man = Man::new(page.clone());
        manners::write(path, |w| man.render(&mut &mut *w).map_err(io(path)))?;
    }
    let count = super::table::counted(pages.len() as u64, "page");
    let report = format!("{}: {count} of the manual\n", args.folder.display());
    Ok(Said::report(report, || serde_json::json!({ "pages": paths })))
}

/// The names of all pages, and the commands that they are about.
fn pages() -> Vec<(String, Command)> {
    // Options that hold for all commands are on the first page.
    let mut program = Cli::command().disable_help_subcommand(true);
    program.build();
    let commands = program.get_subcommands().filter(|command| !command.is_hide_set());
    let page = |command: &Command| {
        let name = format!("{NAME}-{}.1", command.get_name());
        let local = command.clone().mut_args(|arg| {
            let hidden = arg.is_global_set();
            arg.hide(hidden)
        });
        (name, local.version(env!("CARGO_PKG_VERSION")))
    };
    let mut pages: Vec<_> = commands.map(page).collect();
    pages.insert(0, (format!("{NAME}.1"), program.clone()));
    pages
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_command_has_a_page_with_its_options() {
        let pages = pages();
        let names: Vec<_> = pages.iter().map(|(name, _)| name.as_str()).collect();
        for name in ["b2p.1", "b2p-encode.1", "b2p-render.1", "b2p-completions.1"] {
            assert!(names.contains(&name), "{name}: {names:?}");
        }
        for (name, page) in pages {
            let mut text = Vec::new();
            Man::new(page).render(&mut text).unwrap();
            let text = String::from_utf8(text).unwrap();
            assert!(text.contains(".SH NAME") && text.contains(".SH SYNOPSIS"), "{name}");
            let about_all = text.contains("\\-\\-max\\-memory");
            assert_eq!(about_all, name == "b2p.1", "{name}");
        }
    }

    #[test]
    fn every_shell_completes_the_options() {
        for shell in [Shell::Bash, Shell::Zsh, Shell::Fish, Shell::PowerShell] {
            let said = completions(&Completions { shell }).unwrap();
            assert!(said.result.contains("turntable"), "{shell}");
        }
    }
}
