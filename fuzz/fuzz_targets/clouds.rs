//! Files of points: see [`b2p_fuzz::clouds`].
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: b2p_fuzz::alone(), |bytes: &[u8]| b2p_fuzz::clouds(bytes));
