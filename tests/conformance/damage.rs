//! Damaged streams: `tests/data/conformance/damage.txt` has a line for each, with its name, the stream of the suite
//! that it is made from, the clause of `docs/format.md` that it breaks, and the changes `offset:bytes removed:bytes
//! inserted`. `cargo xtask damage` makes the list.

use std::collections::BTreeSet;

use b2p::decoder::Checked;
use b2p::{Decoder, Error, Limits, SceneReader, SequenceDecoder, SequenceReader};

use crate::models::model;
use crate::{digest_scene, digest_sequence, folder, root, scene, suite};

struct Damage {
    name: String,
    clause: String,
    bytes: Vec<u8>,
    decoder: Decoder,
    kind: Kind,
}

/// What it was before it was damaged.
#[derive(Clone, Copy)]
enum Kind {
    Frame,
    Scene,
    Sequence,
}

impl Kind {
    fn of(stream: &str) -> Self {
        match stream.split('/').next() {
            Some("scenes") => Kind::Scene,
            Some("sequences") => Kind::Sequence,
            _ => Kind::Frame,
        }
    }
}

fn changed(mut bytes: Vec<u8>, changes: &[&str]) -> Vec<u8> {
    for change in changes.iter().rev() {
        let parts: Vec<&str> = change.split(':').collect();
        let (at, removed): (usize, usize) = (parts[0].parse().unwrap(), parts[1].parse().unwrap());
        let digits = parts[2].as_bytes().chunks(2);
        let inserted = digits.map(|hex| u8::from_str_radix(std::str::from_utf8(hex).unwrap(), 16).unwrap());
        bytes.splice(at..at + removed, inserted);
    }
    bytes
}

/// What decodes a stream of either suite.
fn decoder(stream: &str) -> Decoder {
    match suite().iter().find(|line| line.name == stream) {
        Some(line) => Decoder::new().with_model(model(&line.model)),
        None => Decoder::new(),
    }
}

fn damaged() -> Vec<Damage> {
    let text = std::fs::read_to_string(folder().join("damage.txt")).expect("the list is there");
    let damage = |line: &str| {
        let words: Vec<&str> = line.split(' ').collect();
        Damage {
            name: words[0].into(),
            clause: words[2].into(),
            bytes: changed(crate::stream(words[1]), &words[3..]),
            decoder: decoder(words[1]),
            kind: Kind::of(words[1]),
        }
    };
    text.lines().map(damage).collect()
}

/// The numbers of all clauses, and those of the sections that they are in.
fn clauses() -> BTreeSet<String> {
    let text = std::fs::read_to_string(root().join("docs/format.md")).expect("the format is there");
    let number = |line: &str| {
        let word = line
            .trim_start_matches('#')
            .trim_start()
            .split(' ')
            .next()
            .unwrap_or_default();
        let is = !word.is_empty() && word.split('.').all(|n| n.parse::<u8>().is_ok());
        is.then(|| word.to_owned())
    };
    text.lines().filter_map(number).collect()
}

fn first_clause(checked: &Checked) -> Option<&'static str> {
    checked.faults.first()?.error.clause()
}

/// What is wrong with a frame has a place in the file, in that frame, unless what was decoded has another hash.
fn faults_of_frames_are_in_them(name: &str, bytes: &[u8]) {
    let Ok(sequence) = SequenceReader::new(bytes, &Limits::unlimited()) else {
        return;
    };
    for fault in SequenceDecoder::new(Decoder::new()).faults(&sequence) {
        let Error::Frame { frame, source } = &fault else {
            continue;
        };
        if !matches!(**source, Error::DeterminismMismatch { .. }) {
            // What is cut ends there.
            let at = fault.offset().unwrap_or_else(|| panic!("{name}: {fault} has no place"));
            let part = [at, at - 1].into_iter().find_map(|byte| sequence.part_at(byte));
            assert!(
                part.is_some_and(|part| part.frame == *frame),
                "{name}: {fault}: {part:?}"
            );
        }
    }
}

fn faults_of_blocks_are_in_them(name: &str, bytes: &[u8]) {
    let Ok(scene) = SceneReader::new(bytes, &Limits::unlimited()) else {
        return;
    };
    let checks = scene.check(&Decoder::new());
    for (entry, checked) in scene.blocks().iter().zip(&checks.blocks) {
        let faults = checked.iter().flat_map(|checked| &checked.faults);
        for at in faults.filter_map(|fault| fault.offset) {
            let own = entry.offset..=entry.offset + u64::from(entry.bytes);
            assert!(own.contains(&at), "{name}: byte {at} in {own:?}");
        }
    }
}

#[test]
fn every_damaged_stream_is_refused_for_the_clause_that_it_breaks() {
    let (damaged, clauses) = (damaged(), clauses());
    let names: BTreeSet<_> = damaged.iter().map(|damage| &damage.name).collect();
    assert!(
        names.len() >= 300 && names.len() == damaged.len(),
        "{} kinds of damage",
        names.len()
    );
    for Damage {
        name,
        clause,
        bytes,
        decoder,
        kind,
    } in &damaged
    {
        assert!(
            clauses.contains(clause),
            "{name}: docs/format.md has no clause {clause}"
        );
        match kind {
            Kind::Frame => {}
            Kind::Scene => {
                assert_eq!(digest_scene::broken_clause(bytes), Some(&**clause), "{name}");
                assert!(scene::is_refused(bytes), "{name}");
                faults_of_blocks_are_in_them(name, bytes);
                continue;
            }
            Kind::Sequence => {
                assert_eq!(digest_sequence::broken_clause(bytes), Some(&**clause), "{name}");
                faults_of_frames_are_in_them(name, bytes);
                continue;
            }
        }
        let checked = decoder.check(bytes);
        assert_eq!(first_clause(&checked), Some(&**clause), "{name}: {:?}", checked.faults);
        assert!(!checked.is_valid() && checked.unchecked.is_none(), "{name}");
        // Lengths that the limits do not allow are wrong in another way first.
        let unlimited = decoder.clone().with_limits(Limits::unlimited());
        let refused = unlimited.whole(bytes).map(drop).expect_err(name);
        // Nor does a processor allow more than it has addresses for.
        if usize::BITS == 32 && matches!(refused, Error::LimitExceeded { .. }) {
            continue;
        }
        assert_eq!(refused.clause(), Some(&**clause), "{name}: {refused}");
    }
    println!("{} kinds of damage", damaged.len());
}

#[test]
fn every_stream_of_the_suites_is_valid_as_is_a_prefix_that_ends_after_a_level() {
    let suite = suite();
    let learned = suite.iter().map(|line| line.name.clone());
    let text = std::fs::read_to_string(folder().join("version-3/suite.txt")).expect("the suite is there");
    let transform = text
        .lines()
        .filter_map(|line| Some(format!("version-3/{}", line.split(' ').next()?)));
    for name in learned.chain(transform) {
        let (bytes, decoder) = (crate::stream(&name), decoder(&name));
        let checked = decoder.check(&bytes);
        assert!(checked.is_valid(), "{name}: {checked:?}");
        assert_eq!(
            checked.notes.is_empty(),
            !name.contains("notes-between-chunks"),
            "{name}: {checked:?}"
        );
        let header = checked.header.expect("a valid stream has a header");
        assert_eq!(checked.valid_to, Some(header.top), "{name}");
        for level in header.base..header.top {
            let end = header.prefix_bytes(level).expect("the header has the level") as usize;
            let prefix = decoder.check(&bytes[..end]);
            assert!(
                prefix.is_valid() && prefix.valid_to == Some(level),
                "{name}: {prefix:?}"
            );
            assert!(!prefix.is_cut, "{name}");
            let cut = decoder.check(&bytes[..end + 1]);
            assert!(
                !cut.is_valid() && cut.is_cut && cut.valid_to == Some(level),
                "{name}: {cut:?}"
            );
        }
    }
}

#[test]
fn a_stream_of_another_model_is_neither_valid_nor_at_fault() {
    let line = &suite()[0];
    let bytes = crate::stream(&line.name);
    for decoder in [Decoder::new(), Decoder::new().with_model(model("lite"))] {
        let checked = decoder.check(&bytes);
        assert!(checked.faults.is_empty() && checked.unchecked.is_some(), "{checked:?}");
        assert!(!checked.is_valid() && checked.valid_to.is_none());
    }
}

#[cfg(feature = "encoder")]
mod sealed {
    use super::*;
    use crate::seal::{places, seal};
    use b2p::container::with_axes;
    use b2p::{Axes, Up};

    /// A stream of levels 2 to 4 with a chunk of axes in front.
    fn with_ancillary() -> Vec<u8> {
        let axes = Axes {
            up: Some(Up::Z),
            ..Axes::default()
        };
        with_axes(&crate::stream("version-3/fine-steps"), &axes).expect("the stream is valid")
    }

    /// With another type in the ancillary chunk.
    fn with_type(code: u8) -> Vec<u8> {
        let mut bytes = with_ancillary();
        let at = places(&bytes)[0].start;
        assert_eq!(bytes[at], 128);
        bytes[at] = code;
        seal(&mut bytes);
        bytes
    }

    #[test]
    fn every_change_that_decoding_refuses_is_invalid_and_its_error_names_a_clause_of_the_format() {
        let clauses = clauses();
        let mut seen = BTreeSet::new();
        for name in [
            "version-3/coarse-steps",
            "version-3/slices-of-1",
            "bare-residual",
            "tiny-levels-0-2",
        ] {
            let (bytes, decoder) = (crate::stream(name), decoder(name));
            for bit in (0..8 * bytes.len()).step_by(3) {
                let mut changed = bytes.clone();
                changed[bit / 8] ^= 1 << (bit % 8);
                seal(&mut changed);
                let (decoded, checked) = (decoder.whole(&changed), decoder.check(&changed));
                let refused = decoded.is_err() || (checked.valid_to < checked.header.as_ref().map(|header| header.top));
                assert_eq!(!checked.is_valid(), refused, "{name}, bit {bit}: {checked:?}");
                let Err(error) = decoded else { continue };
                if matches!(error, Error::LimitExceeded { .. } | Error::ModelMismatch { .. }) {
                    continue;
                }
                let clause = error
                    .clause()
                    .unwrap_or_else(|| panic!("{name}, bit {bit}: {error} has no clause"));
                assert!(clauses.contains(clause), "docs/format.md has no clause {clause}");
                seen.insert(clause);
            }
        }
        assert!(seen.len() > 12, "{seen:?}");
    }

    #[test]
    fn a_damaged_chunk_that_decoders_skip_hides_no_damaged_level() {
        let mut bytes = with_ancillary();
        let last = bytes.len() - 1;
        let ancillary = places(&bytes)[0];
        bytes[ancillary.payload] ^= 1;
        bytes[last] ^= 1;
        let checked = Decoder::new().check(&bytes);
        let found: Vec<_> = checked
            .faults
            .iter()
            .map(|fault| (fault.level, fault.error.clause()))
            .collect();
        assert_eq!(found, [(Some(2), Some("3.1.1")), (Some(4), Some("3.1.1"))]);
        assert_eq!(checked.faults[0].offset, Some(ancillary.start as u64));
        assert_eq!(checked.valid_to, Some(3));
    }

    #[test]
    fn damaged_colours_hide_no_damaged_geometry_of_a_finer_level() {
        let mut bytes = crate::stream("version-3/fine-steps");
        let places = places(&bytes);
        let of = |kind: u8, level: u8| {
            let is = |place: &&crate::seal::Place| bytes[place.start] == kind && bytes[place.start + 1] == level;
            *places.iter().find(is).expect("the stream has the chunk")
        };
        let (colours, geometry, filter) = (of(7, 3), of(1, 4), of(8, 4));
        bytes[colours.payload] ^= 1;
        bytes[geometry.end - 1] ^= 1;
        bytes[filter.payload] = 7;
        seal(&mut bytes);
        let checked = Decoder::new().check(&bytes);
        let found: Vec<_> = checked
            .faults
            .iter()
            .map(|fault| (fault.level, fault.error.clause()))
            .collect();
        let expected = [
            (Some(3), Some("5.10.1")),
            (Some(4), Some("4.2.3")),
            (Some(4), Some("5.11.1")),
        ];
        assert_eq!(found, expected);
    }

    #[test]
    fn a_chunk_of_a_later_version_that_may_be_skipped_is_skipped_and_noted() {
        let (plain, newer) = (with_ancillary(), with_type(200));
        let decoder = Decoder::new();
        assert_eq!(decoder.decode(&plain).unwrap(), decoder.decode(&newer).unwrap());
        let checked = decoder.check(&newer);
        assert!(checked.is_valid(), "{checked:?}");
        assert_eq!(checked.notes.len(), 1);
        assert_eq!(checked.notes[0].clause, "1.6.2");
        assert!(checked.notes[0].text.contains("200"), "{checked:?}");
    }

    #[test]
    fn a_critical_chunk_of_a_later_version_is_refused_by_its_number() {
        let bytes = with_type(40);
        let error = Decoder::new().decode(&bytes).unwrap_err();
        assert!(matches!(error, Error::Unsupported { .. }), "{error}");
        assert!(error.to_string().contains("type 40"), "{error}");
        assert_eq!(error.clause(), Some("3.1.2"));
    }

    #[test]
    fn levels_before_a_feature_that_a_decoder_lacks_decode() {
        let mut bytes = crate::stream("version-3/fine-steps");
        let places = places(&bytes);
        let filter = places
            .iter()
            .find(|place| bytes[place.start] == 8)
            .expect("level 4 has a filter")
            .start;
        bytes[filter] = 41;
        seal(&mut bytes);
        assert!(Decoder::new().with_level(3).decode(&bytes).is_ok());
        let error = Decoder::new().with_level(4).decode(&bytes).unwrap_err();
        assert!(error.to_string().contains("type 41"), "{error}");
    }

    #[test]
    fn minor_versions_and_optional_flags_of_later_versions_are_noted_and_change_nothing() {
        let plain = crate::stream("version-3/fine-steps");
        let mut newer = plain.clone();
        newer[10] = 7;
        newer[17] = 1;
        seal(&mut newer);
        let decoder = Decoder::new();
        assert_eq!(decoder.decode(&plain).unwrap(), decoder.decode(&newer).unwrap());
        let checked = decoder.check(&newer);
        assert!(checked.is_valid() && checked.notes.len() == 2, "{checked:?}");
    }

    #[test]
    fn axes_and_head_maps_of_another_form_are_noted() {
        let mut bytes = with_ancillary();
        let payload = places(&bytes)[0].payload;
        bytes[payload] = 99;
        seal(&mut bytes);
        let checked = Decoder::new().check(&bytes);
        assert!(checked.is_valid());
        let clauses: Vec<_> = checked.notes.iter().map(|note| note.clause).collect();
        assert_eq!(clauses, ["3.4.2"]);
        let checked = Decoder::new().check(&with_type(129));
        assert_eq!(checked.notes[0].clause, "7.5.1", "{checked:?}");
    }

    #[test]
    fn a_check_obeys_limits() {
        let bytes = crate::stream("version-3/fine-steps");
        let checked = Decoder::new()
            .with_limits(Limits::default().with_max_points(20))
            .check(&bytes);
        assert!(checked.faults.is_empty() && !checked.is_valid());
        assert!(matches!(checked.unchecked, Some(Error::LimitExceeded { .. })));
    }
}
