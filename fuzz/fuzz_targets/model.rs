//! Model files: see [`b2p_fuzz::model`].
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| b2p_fuzz::model(bytes));
