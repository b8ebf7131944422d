//! What the fuzzer does, on stable Rust: every input that is kept, and the seeds changed at random for a few seconds.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use b2p_fuzz::{STREAMS, TARGETS, seeds::seeds};

/// Targets count what memory they take: one test at a time, and on one thread, for each keeps what it has prepared for
/// itself.
fn alone(test: impl FnOnce() + Send) {
    static ALONE: Mutex<()> = Mutex::new(());
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build();
    pool.expect("a pool").install(test);
}

fn corpus(target: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(target)
}

fn inputs(target: &str) -> Vec<Vec<u8>> {
    let mut paths: Vec<_> = std::fs::read_dir(corpus(target))
        .expect("a corpus for every target")
        .map(|entry| entry.expect("a readable entry").path())
        .collect();
    paths.sort();
    let read = |path| std::fs::read(path).expect("a readable input");
    paths.into_iter().map(read).collect()
}

#[test]
fn every_input_that_is_kept_passes() {
    alone(|| {
        for (name, run) in TARGETS {
            let inputs = inputs(name);
            assert!(!inputs.is_empty(), "{name} has no corpus");
            inputs.iter().for_each(|input| run(input));
            println!("{name}: {} inputs", inputs.len());
        }
    });
}

/// Streams of an earlier format or model would all be refused alike, and nothing behind that be tried.
#[test]
fn the_streams_that_are_kept_as_seeds_are_as_whole_as_new_ones() {
    alone(|| {
        for name in STREAMS {
            for (i, seed) in seeds(name).iter().enumerate() {
                let kept = std::fs::read(corpus(name).join(format!("seed-{i}"))).expect("a seed");
                let reached = |bytes| b2p_fuzz::deepest(bytes).map_err(|error| error.to_string());
                assert_eq!(reached(&kept), reached(seed), "{name}, seed {i}");
            }
        }
    });
}

/// A change that a fuzzer might make.
fn mutate(bytes: &mut Vec<u8>, others: &[Vec<u8>], random: &mut impl FnMut(usize) -> usize) {
    for _ in 0..=random(3) {
        let at = random(bytes.len() + 1);
        match random(6) {
            0 | 1 if at < bytes.len() => bytes[at] ^= 1 << random(8),
            2 if at < bytes.len() => bytes[at] = [0, 1, 127, 128, 255][random(5)],
            3 => bytes.insert(at, random(256) as u8),
            4 => {
                let end = (at + 1 + random(8)).min(bytes.len());
                bytes.drain(at..end);
            }
            _ => {
                let other = &others[random(others.len())];
                let from = random(other.len() + 1);
                bytes.truncate(at);
                bytes.extend(&other[from..]);
            }
        }
    }
}

/// `B2P_FUZZ_ROUNDS` asks for more than the usual few seconds: so many times as many inputs, and others than the usual
/// ones.
#[test]
fn every_target_holds_on_changed_seeds() {
    alone(|| {
        let rounds = std::env::var("B2P_FUZZ_ROUNDS").map_or(1, |n| n.parse().expect("a number"));
        for (name, run) in TARGETS {
            let mut others = seeds(name);
            others.extend(inputs(name));
            let mut state = u64::from(rounds);
            let mut random = |below: usize| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(3);
                (state >> 33) as usize % below.max(1)
            };
            let runs = match name {
                "model" => 100,
                "backends" | "render" | "scene" | "sequence" | "stream" | "transform" => 1_000,
                _ => 5_000,
            } * rounds;
            for seed in 0..runs {
                let mut bytes = others[random(others.len())].clone();
                if STREAMS.contains(&name) {
                    let (size, most) = (bytes.len(), bytes.len() + 1000);
                    bytes.resize(most, 0);
                    let mut change = |data: &mut [u8], size: usize, most: usize| {
                        let mut some = data[..size].to_vec();
                        mutate(&mut some, &others, &mut random);
                        some.truncate(most);
                        data[..some.len()].copy_from_slice(&some);
                        some.len()
                    };
                    let size = b2p_fuzz::mutate(&mut bytes, size, most, seed, &mut change);
                    bytes.truncate(size);
                } else {
                    mutate(&mut bytes, &others, &mut random);
                }
                run(&bytes);
            }
            println!("{name}: {runs} changed inputs");
        }
    });
}
