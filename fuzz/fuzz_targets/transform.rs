//! Streams of version 3: see [`b2p_fuzz::transform`]. Changed by [`b2p_fuzz::mutate`].
#![no_main]

use libfuzzer_sys::{fuzz_mutator, fuzz_target, fuzzer_mutate};

fuzz_target!(init: b2p_fuzz::alone(), |bytes: &[u8]| b2p_fuzz::transform(bytes));

fuzz_mutator!(|data: &mut [u8], size: usize, max_size: usize, seed: u32| {
    b2p_fuzz::mutate(data, size, max_size, seed, &mut fuzzer_mutate)
});
