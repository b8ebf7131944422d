//! Latent codes: see [`b2p_fuzz::entropy`].
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: b2p_fuzz::alone(), |bytes: &[u8]| b2p_fuzz::entropy(bytes));
