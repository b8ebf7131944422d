//! The `b2p` program. What it does is a crate of its own, so that it can be compiled for size: link-time optimisation of
//! all crates goes by the level of this one.
#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    b2p_commands::main()
}
