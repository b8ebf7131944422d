//! Streams: see [`b2p_fuzz::stream`]. Three of four inputs have their checksums put right.
#![no_main]

use libfuzzer_sys::{fuzz_mutator, fuzz_target, fuzzer_mutate};

fuzz_target!(|bytes: &[u8]| b2p_fuzz::stream(bytes));

fuzz_mutator!(|data: &mut [u8], size: usize, max_size: usize, seed: u32| {
    let size = fuzzer_mutate(data, size, max_size);
    b2p_fuzz::sealed(&mut data[..size], seed);
    size
});
