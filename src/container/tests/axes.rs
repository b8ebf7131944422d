//! The chunk for axes, unit and coordinate system.

use super::*;
use crate::axes::{Axes, Up};

fn known() -> Axes {
    Axes {
        up: Some(Up::Z),
        metres_per_unit: Some(0.001),
        crs: "EPSG:32633".into(),
    }
}

fn root() -> Vec<u8> {
    let header = Header {
        bits: 1,
        base: 0,
        top: 0,
        points: 8,
        voxels: vec![1],
        format: Format::Transform { colour_slice: 3 },
        ..header()
    };
    let mut writer = Writer::new(header).unwrap();
    writer.colour_trunk(0, 1, 7, b"root").unwrap();
    writer.finish().unwrap()
}

#[test]
fn axes_are_kept_in_streams_of_both_versions_and_change_nothing_else() {
    for stream in [sample(), super::transform::sample(), root()] {
        assert_eq!(axes(&stream).unwrap(), Axes::default());
        assert_eq!(with_axes(&stream, &Axes::default()).unwrap(), stream);
        let bytes = with_axes(&stream, &known()).unwrap();
        assert_eq!(axes(&bytes).unwrap(), known());
        let more = bytes.len() - stream.len();
        assert!(more <= axes_bytes(&known()), "{more}");
        let (old, new) = (parse(&stream).unwrap(), parse(&bytes).unwrap());
        assert_eq!(new.deepest(), old.deepest());
        assert!(new.damage().is_none());
        for (new, old) in new.levels().iter().zip(old.levels()) {
            let codes = |level: &Level| -> Vec<Vec<u8>> {
                let slices = level.geometry.iter().flat_map(|geometry| &geometry.slices);
                slices.map(|slice| slice.bytes.to_vec()).collect()
            };
            assert_eq!(codes(new), codes(old));
        }
        // The chunk comes first: the rest of the stream may be missing.
        let start = new.header().bytes() + more;
        assert_eq!(axes(&bytes[..start]).unwrap(), known());
        assert_eq!(axes(&bytes[..start - 1]).unwrap(), Axes::default());
    }
}

#[test]
fn a_coordinate_system_has_an_upper_bound() {
    let long = |length: usize| Axes {
        crs: "x".repeat(length),
        ..Axes::default()
    };
    let stream = root();
    let bytes = with_axes(&stream, &long(Axes::MAX_CRS)).unwrap();
    assert_eq!(axes(&bytes).unwrap(), long(Axes::MAX_CRS));
    assert!(matches!(
        with_axes(&stream, &long(Axes::MAX_CRS + 1)),
        Err(Error::Usage(_))
    ));
}

#[test]
fn the_newest_chunk_counts_and_damage_behind_the_header_is_no_error() {
    let turned = Axes {
        up: Some(Up::MinusX),
        ..Axes::default()
    };
    let twice = with_axes(&with_axes(&root(), &known()).unwrap(), &turned).unwrap();
    assert_eq!(axes(&twice).unwrap(), turned);
    let mut damaged = with_axes(&root(), &known()).unwrap();
    let at = parse(&root()).unwrap().header().bytes() + 12;
    damaged[at] ^= 1;
    assert_eq!(axes(&damaged).unwrap(), Axes::default());
}

#[test]
fn the_number_of_points_is_kept_with_and_without_axes_and_is_no_matter_to_older_readers() {
    for stream in [sample(), super::transform::sample(), root()] {
        assert_eq!(source_points(&stream).unwrap(), None);
        for (said, points) in [(Axes::default(), 1u64), (known(), u64::from(u32::MAX))] {
            let bytes = with_source(&stream, &said, Some(points)).unwrap();
            assert!(bytes.len() - stream.len() <= source_bytes(&said, Some(points)));
            assert_eq!(source_points(&bytes).unwrap().map(u64::from), Some(points));
            // Readers of axes alone find them as before.
            assert_eq!(axes(&bytes).unwrap(), said);
            assert!(parse(&bytes).unwrap().damage().is_none());
        }
        assert_eq!(with_source(&stream, &Axes::default(), Some(1 << 32)).unwrap(), stream);
        assert_eq!(source_points(&with_axes(&stream, &known()).unwrap()).unwrap(), None);
    }
}
