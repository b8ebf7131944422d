//! Sequences of frames: see [`b2p_fuzz::sequence`].
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: b2p_fuzz::alone(), |bytes: &[u8]| b2p_fuzz::sequence(bytes));
