//! `b2p-lab`: mesh to cloud, training sets, evaluation.
#![forbid(unsafe_code)]

fn main() {}
