//! The `b2p` program.
#![forbid(unsafe_code)]

fn main() {}
