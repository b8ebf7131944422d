use flate2::Compression;
use flate2::write::GzEncoder;

use super::*;
use crate::splats::tests::{read_back, sample, written};
use crate::splats::{Format, Options};

/// The columns of a file of version 4, and its header.
fn columns(bytes: &[u8]) -> File {
    read_zstd(bytes, &Limits::default()).unwrap()
}

/// A file of an earlier version.
fn legacy(version: u32, file: &File, extra: &[u8]) -> Vec<u8> {
    let Header {
        count,
        degree,
        fraction,
        flags,
        ..
    } = file.header;
    let mut all = MAGIC.to_vec();
    all.extend(version.to_le_bytes());
    all.extend((count as u32).to_le_bytes());
    all.extend([
        degree as u8,
        fraction,
        flags | if extra.is_empty() { 0 } else { EXTENSIONS },
        0,
    ]);
    file.columns.iter().for_each(|column| all.extend(column));
    all.extend(extra);
    let mut gzip = GzEncoder::new(Vec::new(), Compression::default());
    gzip.write_all(&all).unwrap();
    gzip.finish().unwrap()
}

#[test]
fn version_3_holds_what_version_4_holds() {
    for harmonics in [0, 3, 8, 15] {
        let bytes = written(&sample(50, harmonics), Format::Spz);
        let old = legacy(3, &columns(&bytes), &[]);
        assert_eq!(Format::of_bytes(&old), Some(Format::Spz));
        assert_eq!(
            read_back(&old, Format::Spz, [0.0; 3]),
            read_back(&bytes, Format::Spz, [0.0; 3])
        );
    }
}

#[test]
fn version_2_has_rotations_of_three_bytes() {
    let mut file = columns(&written(&sample(1, 0), Format::Spz));
    // x = 0.6, y = 0, z = −0.5.
    file.columns[4] = vec![204, 127, 64];
    let g = read_back(&legacy(2, &file, &[]), Format::Spz, [0.0; 3]).gaussians;
    let expected = [0.626, 0.6, -0.004, -0.498];
    assert!(
        (0..4).all(|k| (g.rotation[0][k] - expected[k]).abs() < 2e-3),
        "{:?}",
        g.rotation[0]
    );
}

#[test]
fn version_1_has_positions_of_half_floats() {
    let mut file = columns(&written(&sample(2, 0), Format::Spz));
    let halves: [u16; 6] = [0x3c00, 0xc000, 0x3555, 0x0001, 0x7bff, 0x8000];
    file.columns[0] = halves.iter().flat_map(|h| h.to_le_bytes()).collect();
    file.columns[4] = vec![127; 6];
    let g = read_back(&legacy(1, &file, &[]), Format::Spz, [0.0; 3]).gaussians;
    let place = |i: usize| g.frame.placement.from_cube(g.frame.bits, g.position[i]);
    // Coordinates in a cube of 65504 a side.
    let near = |a: [f64; 3], b: [f64; 3]| (0..3).all(|k| (a[k] - b[k]).abs() < 0.01);
    assert!(near(place(0), [1.0, -2.0, 0.333]), "{:?}", place(0));
    assert!(near(place(1), [0.0, 65504.0, 0.0]), "{:?}", place(1));
    assert_eq!(half(0x3c00), 1.0);
    assert_eq!(half(0x0001), 2f64.powi(-24));
    assert_eq!(half(0xfc00), f64::NEG_INFINITY);
    assert!(half(0x7c01).is_nan());
}

#[test]
fn view_dependent_colour_of_degree_4_keeps_degrees_1_to_3() {
    let mut file = columns(&written(&sample(2, 15), Format::Spz));
    let kept = read_back(&legacy(3, &file, &[]), Format::Spz, [0.0; 3]).gaussians;
    file.header.degree = 4;
    let rest = std::mem::take(&mut file.columns[5]);
    file.columns[5] = rest
        .chunks(45)
        .flat_map(|own| own.iter().copied().chain([9; 27]))
        .collect();
    let splats = read_back(&legacy(3, &file, &[]), Format::Spz, [0.0; 3]);
    assert_eq!(splats.gaussians, kept);
    assert!(splats.warnings[0].contains("degree 4"), "{:?}", splats.warnings);
}

#[test]
fn extensions_are_skipped_with_a_word() {
    let file = columns(&written(&sample(2, 0), Format::Spz));
    let mut extra = Vec::new();
    for (kind, value) in [
        (0xADBE_0002u32, &[0u8; 12][..]),
        (AXES_EXTENSION, &[6, 0, 0, 0]),
        (AXES_EXTENSION, &[4, 0, 0, 0]),
    ] {
        extra.extend(kind.to_le_bytes());
        extra.extend((value.len() as u32).to_le_bytes());
        extra.extend(value);
    }
    let splats = read_back(&legacy(3, &file, &extra), Format::Spz, [0.0; 3]);
    assert_eq!(splats.gaussians.len(), 2);
    let [unknown, axes] = &splats.warnings[..] else {
        panic!("{:?}", splats.warnings)
    };
    assert!(unknown.contains("0xadbe0002"), "{unknown}");
    assert!(axes.contains("RDF"), "{axes}");
}

#[test]
fn counts_and_sizes_that_lie_are_errors() {
    let whole = written(&sample(3, 0), Format::Spz);
    let refused = |at: usize, bytes: &[u8]| {
        let mut changed = whole.clone();
        changed[at..at + bytes.len()].copy_from_slice(bytes);
        crate::splats::read(&changed, Format::Spz, &Options::default(), &Limits::default()).unwrap_err()
    };
    let limit = |error: &Error| matches!(error, Error::LimitExceeded { .. });
    assert!(limit(&refused(8, &u32::MAX.to_le_bytes())));
    assert!(!limit(&refused(8, &2u32.to_le_bytes())));
    // A table of sizes after the end, before its header, and of streams that end elsewhere.
    for table in [u32::MAX, 0, 31, 33] {
        let error = refused(16, &table.to_le_bytes());
        assert!(
            matches!(error, Error::Malformed { .. } | Error::Truncated { .. }),
            "{error}"
        );
    }
    let error = refused(32, &u64::MAX.to_le_bytes());
    assert!(matches!(error, Error::Truncated { .. }), "{error}");
    let error = refused(40, &u64::MAX.to_le_bytes());
    assert!(error.to_string().contains("size of the positions"), "{error}");
    assert!(refused(4, &[5]).to_string().contains("version 5"));
    assert!(refused(4, &[3]).to_string().contains("gzip"));
    assert!(refused(12, &[5]).to_string().contains("degree"));
    assert!(
        refused(15, &[6])
            .to_string()
            .contains("number of streams is 6, expected 5")
    );
}

#[test]
fn a_stream_that_unpacks_to_more_than_its_column_is_refused() {
    let bomb = compress_to_vec(&vec![0u8; 1 << 20][..], CompressionLevel::Fastest);
    let error = decompress(&bomb, 27, "positions", 112).unwrap_err();
    assert!(error.to_string().contains("expected 27 bytes"), "{error}");
}

#[test]
fn coordinates_take_all_bits_and_no_more() {
    let mut far = sample(2, 0);
    far.frame.placement.voxel_size = 20_000.0;
    let mut bytes = Vec::new();
    let error = crate::splats::write(&far, Default::default(), Format::Spz, &mut bytes, "x".as_ref()).unwrap_err();
    assert!(error.to_string().contains("below 2²³"), "{error}");
    let fraction = |scale: f64| {
        let mut g = sample(2, 0);
        g.position = vec![[1.0; 3], [0.999; 3]];
        g.frame.placement = b2p::Placement {
            origin: [0.0; 3],
            voxel_size: scale / 1024.0,
        };
        written(&g, Format::Spz)[13]
    };
    assert_eq!(fraction(4095.0), 11);
    assert_eq!(fraction(4097.0), 10);
    assert_eq!(fraction(1e-6), 24);
}

#[test]
fn coordinates_have_the_bits_that_the_sizes_of_gaussians_need() {
    let fraction = |size: f32| {
        let mut g = sample(1000, 0);
        g.blur = 0.0;
        g.frame.placement = b2p::Placement {
            origin: [-1.0; 3],
            voxel_size: 2.0 / 1024.0,
        };
        // Discs of almost no thickness, and a few that are tiny.
        g.scale = (0..1000)
            .map(|i| [size * if i % 50 == 0 { 1e-4 } else { 1.0 }, size * 2.0, 1e-6])
            .collect();
        let bytes = written(&g, Format::Spz);
        let after = read_back(&bytes, Format::Spz, g.frame.offset()).gaussians;
        let mut rows = Rows::new(&g, None).unwrap();
        rows.sort_in_space();
        let after = Rows::new(&after, None).unwrap();
        let world = |rows: &Rows, row: &Row| -> [f64; 3] {
            let offset = rows.offset();
            std::array::from_fn(|k| row.position[k] + offset[k])
        };
        for (a, b) in rows.iter().zip(after.iter()) {
            let (from, to) = (world(&rows, &a), world(&after, &b));
            let near = from
                .iter()
                .zip(to)
                .all(|(a, b)| (a - b).abs() <= f64::from(size) * MOST_ERROR + 1e-6);
            assert!(near, "{size} {a:?} {b:?}");
        }
        bytes[13]
    };
    assert_eq!(fraction(0.1), 12);
    assert_eq!(fraction(0.001), 12);
    assert_eq!(fraction(0.000_3), 14);
    assert_eq!(fraction(0.000_02), 18);
}
