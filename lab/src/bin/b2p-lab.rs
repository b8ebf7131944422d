//! `b2p-lab`: mesh to cloud, training sets, evaluation.
#![forbid(unsafe_code)]

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    match b2p_lab::cli::Cli::parse().run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("b2p-lab: {error}");
            ExitCode::FAILURE
        }
    }
}
