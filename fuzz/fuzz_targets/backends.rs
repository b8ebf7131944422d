//! Instruction sets against each other: see [`b2p_fuzz::backends`].
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: b2p_fuzz::alone(), |bytes: &[u8]| b2p_fuzz::backends(bytes));
