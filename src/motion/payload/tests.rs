//! Motion as bytes: read as it was written, or refused.

use super::*;
use proptest::prelude::*;

fn head(block_level: u8) -> Head {
    Head {
        block_level,
        divided: false,
        moves_coarse: false,
        warped: false,
        smooth: false,
        unit_level: 12,
        reference_level: block_level + 1,
        root: Modes {
            geometry: Mode::Skip,
            colours: Mode::Inter,
        },
        vector: [0, -3, 4096],
    }
}

fn modes() -> impl Strategy<Value = Modes> {
    (0u8..3, 0u8..3).prop_map(|(geometry, colours)| Modes {
        geometry: mode_of(geometry).unwrap_or_default(),
        colours: mode_of(colours).unwrap_or_default(),
    })
}

/// Vectors of which many are alike.
fn vector() -> impl Strategy<Value = [i16; 3]> {
    prop_oneof![
        3 => prop::array::uniform3(0i16..2),
        1 => prop::array::uniform3(-4096i16..=4096),
    ]
}

/// The bytes behind the head, and those of the levels after the first.
fn sections(written: &[Vec<u8>], base: u8, top: u8, head: Head) -> Vec<&[u8]> {
    let (read, first) = Head::parse(&written[0], base, top).unwrap();
    assert_eq!(read, head);
    let mut behind: Vec<&[u8]> = written.iter().map(Vec::as_slice).collect();
    behind[0] = first;
    behind
}

proptest! {
    #[test]
    fn motion_is_read_as_it_was_written(
        vectors in prop::collection::vec(vector(), 1..40),
        all in prop::collection::vec(prop::collection::vec(modes(), 40), 2..6),
    ) {
        let (base, top) = (6, 6 + all.len() as u8 - 2);
        let count = vectors.len();
        let modes = all.iter().map(|modes| modes[..count].to_vec()).collect();
        let blocks = Blocks { vectors, modes };
        let keys: Vec<u64> = (0..count as u64).map(|i| i * i / 2 + i).collect();
        let written = head(4).write(base, [&keys, &[]], [&blocks, &Blocks::default()]).unwrap();
        prop_assert_eq!(written.len(), usize::from(top - base) + 1);
        let sections = sections(&written, base, top, head(4));
        prop_assert_eq!(head(4).blocks(base, &keys, &sections).unwrap(), blocks);
    }

    #[test]
    fn parts_are_read_as_they_were_written(
        block_level in 3u8..6,
        vectors in prop::collection::vec(vector(), 1..20),
        part_vectors in prop::collection::vec(vector(), 160),
        octants in prop::collection::vec(1u8.., 20),
        all in prop::collection::vec(prop::collection::vec(modes(), 160), 5),
    ) {
        // Level L is 6: parts are coded with it, or with the level after it.
        let (base, top) = (6, block_level + 5);
        let head = Head { divided: true, ..head(block_level) };
        let keys: Vec<u64> = (0..vectors.len() as u64).map(|i| i * i / 3 + i).collect();
        let part_keys: Vec<u64> = { keys.iter().zip(&octants) }
            .flat_map(|(key, mask)| (0..8u64).filter_map(move |octant| {
                (mask >> octant & 1 == 1).then_some(*key << 3 | octant)
            }))
            .collect();
        let modes = |levels: std::ops::Range<usize>, count: usize| {
            all[levels].iter().map(|modes| modes[..count].to_vec()).collect()
        };
        let blocks = Blocks { modes: modes(0..1, keys.len()), vectors };
        let parts = Blocks {
            vectors: part_vectors[..part_keys.len()].to_vec(),
            modes: modes(1..5, part_keys.len()),
        };
        let written = head.write(base, [&keys, &part_keys], [&blocks, &parts]).unwrap();
        prop_assert_eq!(written.len(), usize::from(top - base) + 1);
        let sections = sections(&written, base, top, head);
        prop_assert_eq!(head.blocks(base, &keys, &sections).unwrap(), blocks);
        prop_assert_eq!(head.parts(base, [&keys, &part_keys], &sections).unwrap(), parts);
    }

    #[test]
    fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..80), count in 1usize..50) {
        if let Ok((head, rest)) = Head::parse(&bytes, 6, 9) {
            let keys: Vec<u64> = (0..count as u64).collect();
            let part_keys: Vec<u64> = (0..8 * count as u64).filter(|key| key % 3 > 0).collect();
            if let Ok(blocks) = head.blocks(6, &keys, &[rest]) {
                prop_assert_eq!(blocks.vectors.len(), count);
            }
            if head.divided && let Ok(parts) = head.parts(6, [&keys, &part_keys], &[rest, rest]) {
                prop_assert_eq!(parts.vectors.len(), part_keys.len());
            }
        }
    }
}

#[test]
fn vectors_longer_than_the_cube_and_levels_out_of_range_are_refused() {
    let clause = |head: Head| {
        let parsed = Head::parse(&head.to_bytes(), 6, 9).map(|(head, _)| head);
        parsed.map_err(|error| error.clause())
    };
    assert!(clause(head(6)).is_ok());
    assert_eq!(clause(head(7)).err(), Some(Some("17.5.1")));
    let divided = |block_level| Head {
        divided: true,
        ..head(block_level)
    };
    assert!(clause(divided(5)).is_ok());
    assert_eq!(clause(divided(6)).err(), Some(Some("17.5.1")));
    let coarse = |block_level| Head {
        moves_coarse: true,
        reference_level: block_level + 2,
        ..divided(block_level)
    };
    assert_eq!(
        Head::parse(&coarse(4).to_bytes(), 6, 9).ok().map(|(head, _)| head),
        Some(coarse(4))
    );
    for head in [
        coarse(5),
        Head {
            divided: false,
            ..coarse(4)
        },
        Head {
            reference_level: 5,
            ..coarse(4)
        },
    ] {
        assert_eq!(clause(head).err(), Some(Some("17.5.1")), "{head:?}");
    }
    let warped = |smooth| Head {
        warped: true,
        smooth,
        reference_level: 9,
        vector: [0; 3],
        ..head(5)
    };
    for smooth in [false, true] {
        let read = Head::parse(&warped(smooth).to_bytes(), 6, 9).map(|(head, _)| head);
        assert_eq!(read.ok(), Some(warped(smooth)));
        let moves_coarse = Head {
            moves_coarse: true,
            ..warped(smooth)
        };
        assert_eq!(clause(moves_coarse).err(), Some(Some("17.5.1")));
    }
    let far = Head {
        vector: [0, 0, 4097],
        ..head(5)
    };
    assert_eq!(clause(far).err(), Some(Some("17.5.3")));
    for unit_level in [8, 22] {
        let other = Head { unit_level, ..head(5) };
        assert_eq!(clause(other).err(), Some(Some("17.5.1")));
    }
    for reference_level in [4, 10] {
        let other = Head {
            reference_level,
            ..head(5)
        };
        assert_eq!(clause(other).err(), Some(Some("17.5.1")));
    }
    let short = Head::parse(&[0; 9], 6, 9).expect_err("too short");
    assert_eq!(short.clause(), Some("17.5.1"));
}
