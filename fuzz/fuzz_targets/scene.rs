//! Scenes of blocks: see [`b2p_fuzz::scene`].
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: b2p_fuzz::alone(), |bytes: &[u8]| b2p_fuzz::scene(bytes));
