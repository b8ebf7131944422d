//! The suite of sequences, in `tests/data/conformance/sequences`.
//!
//! `suite.txt` has for each sequence a line with its timescale and the tick of each frame, and for each frame a line as in
//! the suite of version 3: `name/frame`; `best.txt` and `quick.txt` have those of learned heads.

use std::collections::BTreeSet;

use b2p::container::sequence::{FrameKind, FrameLevel, parse_table};
use b2p::motion::{Head, Modes};
use b2p::{Decoder, Limits, SequenceDecoder, SequenceReader};

use crate::digest_sequence::{broken_clause, lines};
use crate::heads::drawn;
use crate::{folder, pools, pools_for, stream};

fn text(file: &str) -> String {
    std::fs::read_to_string(folder().join("sequences").join(file)).expect("the suite is there")
}

/// Names of the sequences.
fn names() -> Vec<String> {
    let text = text("suite.txt");
    let first = text.lines().filter_map(|line| line.split(' ').next());
    let sequences = first.filter(|name| !name.contains('/'));
    sequences.map(|name| format!("sequences/{name}")).collect()
}

#[test]
fn every_frame_of_every_sequence_decodes_to_its_digests_forwards_and_backwards() {
    let names = names();
    let pools = pools();
    let ways = |isa| drawn(&folder(), isa).map(|(file, decoder)| (isa, file, decoder));
    for (isa, file, decoder) in super::instruction_sets().into_iter().flat_map(ways) {
        let text = text(file);
        for (threads, pool) in pools_for(file, &pools) {
            for backwards in [false, true] {
                let decoded = |name: &String| {
                    let own = name.trim_start_matches("sequences/");
                    lines(&decoder, own, &stream(name), backwards).unwrap_or_else(|error| panic!("{name}: {error}"))
                };
                let decode = || names.iter().map(decoded).collect::<String>();
                let found = match pool {
                    Some(pool) => pool.install(decode),
                    None => decode(),
                };
                assert!(
                    found == text,
                    "{file} with {isa} and {threads} threads, backwards: {backwards}:\n{found}"
                );
            }
        }
    }
}

#[test]
fn the_suite_of_sequences_is_valid_and_has_frames_and_groups_of_all_kinds() {
    let mut predicted_before_whole = 0;
    let mut lengths = BTreeSet::new();
    for name in names() {
        let bytes = stream(&name);
        assert!(bytes.len() < 10_000, "{name} has {} bytes", bytes.len());
        assert_eq!(broken_clause(&bytes), None, "{name}");
        let sequence = SequenceReader::new(bytes, &Limits::default()).expect("a sequence");
        for number in 0..sequence.groups() {
            let group = sequence.group(number).expect("a group");
            lengths.insert(group.len());
            let predicted = (1..group.len()).filter(|at| !group.is_whole(*at)).count();
            assert!(group.len() < 3 || predicted > 0, "{name}, group {number}");
            predicted_before_whole += (2..group.len()).filter(|at| group.is_whole(*at)).count();
        }
    }
    assert!(predicted_before_whole > 0, "a whole frame after predicted ones");
    assert!(lengths.len() >= 3, "groups of {lengths:?} frames");
}

#[test]
fn the_suite_of_sequences_has_all_modes_of_prediction_and_vectors_of_every_kind() {
    let (mut modes, mut vectors, mut reach) = (BTreeSet::new(), BTreeSet::new(), BTreeSet::new());
    let mut of_parts = BTreeSet::new();
    let (mut coarse, mut smooth) = ([0; 2], [0; 2]);
    let mut lattices = BTreeSet::new();
    let limits = Limits::default();
    for name in names() {
        let bytes = stream(&name);
        let sequence = SequenceReader::new(&bytes[..], &limits).expect("a sequence");
        let header = sequence.header();
        let mut decoder = SequenceDecoder::new(Decoder::new().with_level(header.base));
        for entry in &sequence.index().groups {
            let group = entry.take(&bytes).expect("a group");
            let table = parse_table(group, entry, header, &limits).expect("a frame table");
            for (number, frame) in (entry.first..).zip(&table) {
                if frame.kind == FrameKind::Whole {
                    continue;
                }
                let part = |(level, own): (usize, &FrameLevel)| {
                    let before = level.checked_sub(1).map_or(0, |before| frame.prefix_bytes(before));
                    &group[(frame.offset + before) as usize..][..own.motion as usize]
                };
                let mut parts: Vec<&[u8]> = frame.levels.iter().enumerate().map(part).collect();
                let (head, first) = Head::parse(parts[0], header.base, header.top).expect("motion");
                parts[0] = first;
                if head.warped {
                    smooth[usize::from(head.smooth)] += 1;
                    lattices.insert(head.lattice(header.base, first).expect("a lattice").0);
                    parts[0] = head.lattice(header.base, first).expect("a lattice").2;
                }
                let decoded = decoder.frame(&sequence, number).expect("a frame");
                let keys = decoded.points().expect("a level").voxels.keys();
                let nodes = |level: u8| {
                    let down = 3 * (header.base - level);
                    let mut keys: Vec<u64> = keys.iter().map(|key| key >> down).collect();
                    keys.dedup();
                    keys
                };
                if head.divided {
                    coarse[usize::from(head.moves_coarse)] += 1;
                }
                let keys = nodes(head.block_level);
                let mut found = vec![head.blocks(header.base, &keys, &parts).expect("motion")];
                if head.divided && header.top > head.block_level + 1 {
                    let part_keys = nodes(head.block_level + 1);
                    let divided = head
                        .parts(header.base, [&keys, &part_keys], &parts)
                        .expect("motion of parts");
                    of_parts.extend(divided.vectors.clone());
                    found.push(divided);
                }
                for blocks in found {
                    vectors.extend(blocks.vectors);
                    for Modes { geometry, colours } in blocks.modes.into_iter().flatten() {
                        modes.extend([(0, geometry as u8), (1, colours as u8)]);
                    }
                }
                let above = head.unit_level - header.top;
                reach.insert((above, head.reference_level.saturating_sub(head.block_level + 1)));
            }
        }
    }
    assert_eq!(modes.len(), 6, "modes {modes:?}");
    let far = vectors.iter().flatten().map(|x| x.unsigned_abs()).max();
    assert!(vectors.len() >= 10 && far >= Some(16), "{vectors:?}");
    assert!(of_parts.len() >= 10, "vectors of parts: {of_parts:?}");
    assert!(
        lattices.len() >= 5,
        "levels of lattices and least weights: {lattices:?}"
    );
    assert!(coarse.iter().all(|frames| *frames >= 3), "coarse colours: {coarse:?}");
    // The encoder makes smooth ones alone.
    assert!(smooth.iter().all(|frames| *frames >= 5), "warped frames: {smooth:?}");
    assert!(reach.iter().any(|(above, _)| *above > 0), "{reach:?}");
    assert!(
        reach.iter().any(|(_, levels)| *levels == 0) && reach.iter().any(|(_, levels)| *levels >= 3),
        "{reach:?}"
    );
}

#[cfg(feature = "encoder")]
#[test]
fn the_generator_makes_the_same_sequences_again() {
    let cases = crate::make_sequence::cases();
    assert_eq!(cases.len(), names().len());
    for (name, bytes, anywhere) in cases {
        assert!(
            !anywhere || bytes == stream(&format!("sequences/{name}")),
            "{name} has changed"
        );
    }
}
