//! The suite of version 3, in `tests/data/conformance/version-3`.
//!
//! `suite.txt` has a line for each stream: its name, then for every level `level=` and the SHA-256 of its geometry
//! (Morton keys, u64), of its colours (red, green, blue, u8) and of its surfels (positions, scales, rotations,
//! opacities, colours, f32), all little-endian. `best.txt` and `quick.txt` have the Gaussians of learned heads instead.

use std::path::PathBuf;

use crate::digest_transform::{in_pieces, whole};
use crate::heads::drawn;
use crate::{folder, pools, pools_for};

fn own_folder() -> PathBuf {
    folder().join("version-3")
}

fn stream(name: &str) -> Vec<u8> {
    std::fs::read(own_folder().join(format!("{name}.b2p"))).expect("every line has a stream")
}

#[test]
fn every_stream_of_version_3_decodes_to_its_digests_with_every_instruction_set_and_number_of_threads() {
    let pools = pools();
    let ways = |isa| drawn(&folder(), isa).map(|(file, decoder)| (isa, file, decoder));
    for (isa, file, decoder) in super::instruction_sets().into_iter().flat_map(ways) {
        let text = std::fs::read_to_string(own_folder().join(file)).expect("the suite is there");
        assert!(text.lines().count() >= 8);
        for line in text.lines() {
            let mut words = line.split(' ').map(str::to_owned);
            let name = words.next().expect("a name");
            let levels: Vec<String> = words.collect();
            let bytes = stream(&name);
            for (threads, pool) in pools_for(file, &pools) {
                let decode = || [whole(&decoder, &bytes), in_pieces(&decoder, &bytes)];
                let found = match pool {
                    Some(pool) => pool.install(decode),
                    None => decode(),
                };
                for (found, how) in found.into_iter().zip(["whole", "in pieces"]) {
                    let of = format!("{name} of {file} with {isa} and {threads} threads, {how}");
                    assert_eq!(found, Ok(levels.clone()), "{of}");
                }
            }
        }
    }
}

#[cfg(feature = "encoder")]
#[test]
fn the_generator_makes_the_same_streams_of_version_3_again() {
    for (name, bytes, anywhere) in crate::make_transform::cases() {
        assert!(!anywhere || bytes == stream(name), "{name} has changed");
    }
}

#[cfg(feature = "encoder")]
#[test]
fn the_generator_makes_the_same_heads_again() {
    let stored = std::fs::read(folder().join("heads.safetensors")).expect("the heads are there");
    assert!(crate::heads::file() == stored, "the heads have changed");
}
