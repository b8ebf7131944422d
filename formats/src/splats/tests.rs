//! What holds for every format. `expected` rows are compared within the quantisation that each format has.

use b2p::Placement;
use b2p::gaussians::{Frame, Harmonics};
use proptest::prelude::*;

use super::rows::Row;
use super::*;

/// Gaussians with every kind of number that formats hold.
pub(super) fn sample(count: usize, harmonics: usize) -> Gaussians {
    let mut state = 1u32;
    let mut random = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32
    };
    let mut g = Gaussians {
        frame: Frame {
            bits: 10,
            placement: Placement {
                origin: [-2.0, 1.0, 30.0],
                voxel_size: 0.004,
            },
        },
        ..Gaussians::default()
    };
    for i in 0..count {
        g.position.push([0; 3].map(|_| 1.8 * random() - 0.9));
        g.scale.push([0; 3].map(|_| (-6.0 * random() - 2.0).exp()));
        g.rotation.push([0; 4].map(|_| random() - 0.5));
        g.opacity.push([0.0, 1.0, random(), 0.5][i % 4]);
        g.colour.push([0; 3].map(|_| random()));
        g.harmonics
            .coefficients
            .extend((0..harmonics).map(|_| [0; 3].map(|_| 1.6 * random() - 0.8)));
    }
    g.harmonics.count = harmonics;
    g
}

pub(super) fn written(gaussians: &Gaussians, format: Format) -> Vec<u8> {
    written_in(gaussians, Axes::of(format), format).0
}

fn written_in(gaussians: &Gaussians, axes: Axes, format: Format) -> (Vec<u8>, Vec<String>) {
    let mut bytes = Vec::new();
    let warnings = write(gaussians, axes, format, &mut bytes, Path::new("x")).unwrap();
    (bytes, warnings)
}

pub(super) fn read_back(bytes: &[u8], format: Format, offset: [f64; 3]) -> Splats {
    let options = Options {
        offset,
        ..Options::default()
    };
    read(bytes, format, &options, &Limits::default()).unwrap()
}

/// The rows in the order of the format's files, in the world, with their harmonics.
fn world(gaussians: &Gaussians, format: Format, sort: bool) -> Vec<(Row, Vec<[f64; 3]>)> {
    let mut rows = Rows::new(gaussians, None).unwrap();
    if sort && matches!(format, Format::CompressedPly | Format::Sog | Format::Spz) {
        rows.sort_in_space();
    }
    let offset = rows.offset();
    let place = |mut row: Row| {
        row.position = std::array::from_fn(|k| row.position[k] + offset[k]);
        row
    };
    (0..rows.len())
        .map(|i| (place(rows.row(i)), rows.coefficients(i)))
        .collect()
}

/// Largest errors.
struct Tolerance {
    position: f64,
    log_scale: f64,
    rotation: f64,
    opacity: f64,
    colour: f64,
    harmonics: f64,
}

/// What the quantisation of the format leaves, for rows within `extent` per axis and `farthest` from the origin (less
/// the offset), whose logarithms of scales span at most 10.
fn tolerance(format: Format, extent: f64, farthest: f64) -> Tolerance {
    let float = Tolerance {
        position: 2e-7 * farthest,
        log_scale: 2e-6,
        rotation: 1e-6,
        opacity: 1.1e-6,
        colour: 1e-6,
        harmonics: 1e-6,
    };
    let byte = 0.5 / 255.0 + 1e-6;
    match format {
        Format::Ply | Format::Glb | Format::Gltf | Format::Csv | Format::Npz => float,
        Format::CompressedPly => Tolerance {
            position: extent / 2046.0 + float.position,
            log_scale: 10.0 / 2046.0,
            rotation: 3e-3,
            opacity: byte,
            colour: byte,
            harmonics: 8.0 / 256.0,
        },
        Format::Spz => Tolerance {
            // 23 bits for the farthest, of which one is lost to the power of two, or 12 after the point.
            position: farthest / 8_388_608.0 + 2f64.powi(-13) + float.position,
            log_scale: 1.0 / 32.0 + 1e-6,
            rotation: 3e-3,
            opacity: byte,
            colour: 0.5 / 255.0 / 0.15 * 0.2821,
            harmonics: 8.5 / 128.0,
        },
        Format::Sog => Tolerance {
            position: (1.0 + farthest) * (2.0 * (1.0 + extent).ln() / 131_070.0) + float.position,
            log_scale: 10.0 / 255.0,
            rotation: 1.2e-2,
            opacity: byte,
            colour: 4e-3,
            harmonics: 0.02,
        },
        Format::Splat => Tolerance {
            rotation: 2e-2,
            opacity: byte,
            colour: byte,
            ..float
        },
    }
}

fn assert_alike(
    before: &Gaussians,
    after: &Gaussians,
    format: Format,
    limits: &Tolerance,
) -> Result<(), TestCaseError> {
    let (before, after) = (world(before, format, true), world(after, format, false));
    prop_assert_eq!(before.len(), after.len());
    let near = |a: &[f64], b: &[f64], tolerance: f64| a.iter().zip(b).all(|(a, b)| (a - b).abs() <= tolerance);
    for ((a, a_rest), (b, b_rest)) in before.iter().zip(&after) {
        prop_assert!(near(&a.position, &b.position, limits.position), "{format} {a:?} {b:?}");
        let log_scale = match format {
            Format::Spz => a.log_scale().map(|s| s.clamp(-10.0, 5.9375)),
            _ => a.log_scale(),
        };
        let scales = near(&log_scale, &b.log_scale(), limits.log_scale);
        prop_assert!(scales, "{format} {a:?} {b:?}");
        let dot: f64 = (0..4).map(|k| a.rotation[k] * b.rotation[k]).sum();
        let turned = b.rotation.map(|q| q * dot.signum());
        prop_assert!(near(&a.rotation, &turned, limits.rotation), "{format} {a:?} {b:?}");
        prop_assert!(near(&[a.opacity], &[b.opacity], limits.opacity), "{format} {a:?} {b:?}");
        prop_assert!(near(&a.colour, &b.colour, limits.colour), "{format} {a:?} {b:?}");
        if format != Format::Splat {
            prop_assert_eq!(a_rest.len(), b_rest.len());
            prop_assert!(
                near(a_rest.as_flattened(), b_rest.as_flattened(), limits.harmonics),
                "{format}"
            );
        }
    }
    Ok(())
}

fn bounds_of(gaussians: &Gaussians) -> (f64, f64) {
    let (low, high) = Rows::new(gaussians, None).unwrap().bounds();
    let extent = (0..3).fold(0.0, |m: f64, k| m.max(high[k] - low[k]));
    (extent, low.iter().chain(&high).fold(0.0, |m: f64, x| m.max(x.abs())))
}

fn any_gaussian() -> impl Strategy<Value = ([f32; 3], [f32; 3], [f32; 4], f32, [f32; 3])> {
    let position = prop_oneof![Just([0.25; 3]), prop::array::uniform3(-1.0f32..1.0)];
    let scale = prop::array::uniform3(-8.0f32..1.0).prop_map(|s| s.map(f32::exp));
    let rotation = prop_oneof![
        Just([1.0, 0.0, 0.0, 0.0]),
        Just([0.0, 0.0, -1.0, 0.0]),
        Just([-0.5, 0.5, 0.5, -0.5]),
        prop::array::uniform4(-1.0f32..1.0).prop_filter("a rotation", |q| q.iter().any(|q| q.abs() > 0.01)),
    ];
    let opacity = prop_oneof![Just(0.0f32), Just(1.0), 0.0f32..1.0];
    (position, scale, rotation, opacity, prop::array::uniform3(0.0f32..1.0))
}

fn any_gaussians() -> impl Strategy<Value = Gaussians> {
    let frame = prop_oneof![
        Just(([-0.5, -0.5, -0.5], 1.0)),
        Just(([-2.0, 1.0, 3.0], 0.004)),
        Just(([500_123.4, 4_649_876.5, 12.0], 0.1)),
    ];
    let all = prop::collection::vec(any_gaussian(), 0..40);
    let blur = prop_oneof![Just(0.0f32), Just(1e-5)];
    let harmonics = prop::sample::select(vec![0usize, 3, 8, 15]);
    let rest = prop::collection::vec(prop::array::uniform3(-0.98f32..0.98), 40 * 15);
    (all, frame, blur, harmonics, rest, any::<bool>()).prop_map(
        |(all, frame, blur, harmonics, mut rest, compensated)| {
            rest.truncate(all.len() * harmonics);
            let (origin, voxel_size) = frame;
            Gaussians {
                position: all.iter().map(|g| g.0).collect(),
                scale: all.iter().map(|g| g.1).collect(),
                rotation: all.iter().map(|g| g.2).collect(),
                opacity: all.iter().map(|g| g.3).collect(),
                colour: all.iter().map(|g| g.4).collect(),
                harmonics: Harmonics {
                    count: harmonics,
                    coefficients: rest,
                },
                compensated,
                blur,
                frame: Frame {
                    bits: 10,
                    placement: Placement { origin, voxel_size },
                },
            }
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn gaussians_come_back_within_the_quantisation_of_the_format(before in any_gaussians()) {
        let (extent, farthest) = bounds_of(&before);
        for format in Format::all() {
            let bytes = written(&before, format);
            let Splats { gaussians: after, warnings, .. } = read_back(&bytes, format, before.frame.offset());
            prop_assert!(warnings.iter().all(|w| w.contains("names no cube")), "{:?}", warnings);
            let states = !matches!(format, Format::Splat | Format::Csv);
            prop_assert_eq!(after.compensated, before.compensated && states);
            assert_alike(&before, &after, format, &tolerance(format, extent, farthest))?;
        }
    }

    #[test]
    fn any_bytes_are_an_error_or_gaussians(bytes in prop::collection::vec(any::<u8>(), 0..300), format in 0..9usize) {
        let format = Format::all().nth(format).unwrap();
        let _ = read(&bytes, format, &Options::default(), &Limits::embedded());
    }
}

#[test]
fn many_blocks_come_back() {
    for harmonics in [0, 3] {
        let before = sample(1500, harmonics);
        let (extent, farthest) = bounds_of(&before);
        for format in Format::all() {
            let after = read_back(&written(&before, format), format, [0.0; 3]).gaussians;
            assert_alike(&before, &after, format, &tolerance(format, extent, farthest)).unwrap();
        }
    }
}

#[test]
fn formats_that_state_the_cube_restore_it() {
    let before = sample(9, 0);
    for format in Format::all() {
        let after = read_back(&written(&before, format), format, [0.0; 3]).gaussians;
        let states = !matches!(format, Format::Spz | Format::Splat | Format::Csv);
        assert_eq!(after.frame == before.frame, states, "{format}");
    }
}

#[test]
fn an_opacity_of_one_is_finite_everywhere() {
    let mut before = sample(700, 0);
    before.opacity.fill(1.0);
    for format in [Format::Ply, Format::Csv] {
        let bytes = written(&before, format);
        let text = String::from_utf8_lossy(&bytes);
        assert!(!text.contains("inf") && !text.contains("NaN"));
        let after = read_back(&bytes, format, [0.0; 3]).gaussians;
        assert!(after.opacity.iter().all(|&o| o > 0.999_998 && o < 1.0), "{format}");
    }
    for format in Format::all() {
        let after = read_back(&written(&before, format), format, [0.0; 3]).gaussians;
        assert!(after.opacity.iter().all(|&o| o > 0.999_998 && o <= 1.0), "{format}");
    }
}

#[test]
fn extremes_are_clamped_to_what_the_format_holds() {
    let mut before = sample(8, 0);
    before.opacity = vec![-1.0, 2.0, 0.0, 1.0, 0.5, 0.5, 0.5, 0.5];
    before.scale[4] = [0.0; 3];
    before.scale[5] = [1e30, 1e-30, 1.0];
    before.colour[6] = [-9.0, 9.0, 0.5];
    before.rotation[7] = [1e-30, 0.0, 0.0, 0.0];
    for format in Format::all() {
        let after = read_back(&written(&before, format), format, [0.0; 3]).gaussians;
        assert_eq!(after.len(), before.len(), "{format}");
        assert!(after.opacity.iter().all(|o| (0.0..=1.0).contains(o)), "{format}");
        let all = after.scale.as_flattened().iter().chain(after.colour.as_flattened());
        assert!(
            all.chain(after.rotation.as_flattened()).all(|x| x.is_finite()),
            "{format}"
        );
    }
    let (_, warnings) = written_in(&before, Axes::Ply, Format::Spz);
    assert!(
        warnings[0].starts_with("2 Gaussians have scales outside"),
        "{warnings:?}"
    );
}

#[test]
fn numbers_that_are_not_finite_are_left_out_and_counted() {
    let mut before = sample(9, 3);
    before.position[0][1] = f32::NAN;
    before.scale[1][0] = f32::INFINITY;
    before.rotation[2] = [0.0; 4];
    before.opacity[3] = f32::NAN;
    before.colour[4][2] = f32::NEG_INFINITY;
    before.harmonics.coefficients[15][0] = f32::NAN;
    for format in Format::all().filter(|&format| format != Format::Ply) {
        let (bytes, warnings) = written_in(&before, Axes::of(format), format);
        assert!(
            warnings.iter().any(|w| w.starts_with("6 of 9 Gaussians")),
            "{format}: {warnings:?}"
        );
        assert_eq!(read_back(&bytes, format, [0.0; 3]).gaussians.len(), 3, "{format}");
    }
}

#[test]
fn the_blur_that_only_ply_states_widens_the_scales_of_all_others() {
    let mut before = sample(5, 0);
    before.scale.fill([0.03, 0.04, 0.0]);
    before.blur = 9e-4;
    for format in Format::all() {
        let after = read_back(&written(&before, format), format, [0.0; 3]).gaussians;
        if format == Format::Ply {
            assert_eq!(after.blur, before.blur);
            continue;
        }
        assert_eq!(after.blur, 0.0, "{format}");
        let unit = after.frame.unit() / before.frame.unit();
        let expected = [0.0018f64.sqrt(), 0.05, 0.03];
        for scale in &after.scale {
            for k in 0..3 {
                let ratio = f64::from(scale[k]) * unit / expected[k];
                assert!((ratio.ln()).abs() < 0.04, "{format}: {scale:?}");
            }
        }
    }
}

#[test]
fn gltf_is_turned_by_180_degrees_about_z_and_back() {
    let before = sample(20, 15);
    let (bytes, _) = written_in(&before, Axes::Ply, Format::Glb);
    let turned = read_back(&bytes, Format::Glb, [0.0; 3]);
    assert_eq!(turned.axes, Axes::Gltf);
    let (a, b) = (
        world(&before, Format::Glb, true),
        world(&turned.gaussians, Format::Glb, true),
    );
    for ((a, _), (b, _)) in a.iter().zip(&b) {
        let [x, y, z] = a.position;
        for (expected, found) in [-x, -y, z].iter().zip(b.position) {
            assert!((expected - found).abs() < 1e-5, "{a:?} {b:?}");
        }
    }
    // So does its cube, and all of it back.
    let back = turned.clone().into_cloud();
    let near = |a: [f64; 3], b: [f64; 3]| (0..3).all(|k| (a[k] - b[k]).abs() < 1e-9);
    assert!(near(back.frame.placement.origin, before.frame.placement.origin));
    assert!(
        back.position
            .as_flattened()
            .iter()
            .zip(before.position.as_flattened())
            .all(|(a, b)| (a - b).abs() < 1e-5)
    );
    // Each format of PLY's axes takes it back.
    let (extent, farthest) = bounds_of(&before);
    for format in [Format::Ply, Format::Spz, Format::Csv, Format::Npz, Format::Splat] {
        let (bytes, _) = written_in(&turned.gaussians, turned.axes, format);
        let after = read_back(&bytes, format, [0.0; 3]).gaussians;
        let limits = tolerance(format, extent, farthest);
        let looser = Tolerance {
            position: 4.0 * limits.position,
            harmonics: 4.0 * limits.harmonics,
            colour: 2.0 * limits.colour,
            ..limits
        };
        assert_alike(&before, &after, format, &looser).unwrap();
    }
}

#[test]
fn a_cloud_stands_upright_in_every_format_and_comes_back_as_it_was() {
    let before = sample(40, 15);
    let (extent, farthest) = bounds_of(&before);
    for up in [Up::X, Up::MinusX, Up::Y, Up::MinusY, Up::Z, Up::MinusZ] {
        let (axis, negative) = up.axis();
        for format in Format::all() {
            let (bytes, _) = written_in(&before, Axes::Cloud(up), format);
            let options = Options {
                turned_from: Some(up),
                ..Options::default()
            };
            let back = read(&bytes, format, &options, &Limits::default()).unwrap();
            assert_eq!(back.axes, Axes::Cloud(up), "{format} {up}");
            let limits = tolerance(format, extent, farthest);
            let looser = Tolerance {
                position: 4.0 * limits.position,
                harmonics: 4.0 * limits.harmonics,
                colour: 2.0 * limits.colour,
                rotation: limits.rotation + 1e-6,
                ..limits
            };
            // Some files are in the order of a curve, which depends on the axes.
            let turned = |g: &Gaussians| {
                let mut turned = g.clone();
                turn(&mut turned, Axes::Cloud(up), Axes::of(format));
                turned
            };
            assert_alike(&turned(&before), &turned(&back.gaussians), format, &looser).unwrap();
            if format != Format::Csv {
                continue;
            }
            // Other readers see the file's own axes: what was up is −y.
            let file = read_back(&bytes, format, [0.0; 3]).gaussians;
            let places = |g: &Gaussians, i: usize| g.frame.placement.from_cube(g.frame.bits, g.position[i]);
            for i in 0..before.len() {
                let height = places(&before, i)[axis] * if negative { -1.0 } else { 1.0 };
                assert!((places(&file, i)[1] + height).abs() < 1e-5, "{up}");
            }
        }
    }
}

#[test]
fn names_and_extensions_name_all_formats() {
    for format in Format::all() {
        assert_eq!(format.name().parse::<Format>().unwrap(), format);
        let path = format!("some.thing{}", format.extension().to_ascii_uppercase());
        assert_eq!(Format::of_path(Path::new(&path)), Some(format));
        assert_eq!(format.entry().0, format);
    }
    assert_eq!(Format::of_path(Path::new("x.png")), None);
    assert!(
        "obj"
            .parse::<Format>()
            .unwrap_err()
            .to_string()
            .contains("compressed-ply, ply, spz")
    );
}

#[test]
fn contents_tell_the_format() {
    for format in Format::all() {
        let expected = (format != Format::Splat).then_some(format);
        assert_eq!(Format::of_bytes(&written(&sample(3, 0), format)), expected);
    }
    for other in [&b""[..], b"PK\x03\x04", b"\x1f\x8b", b"{}", b"x,y,z\n1,2,3\n"] {
        assert_eq!(Format::of_bytes(other), None, "{other:?}");
    }
}

#[test]
fn files_that_are_cut_anywhere_are_errors() {
    for format in Format::all() {
        let bytes = written(&sample(5, 3), format);
        for length in 0..bytes.len() {
            let result = read(&bytes[..length], format, &Options::default(), &Limits::default());
            let whole = match format {
                Format::Splat => length % 32 == 0,
                // A shorter number is a number, and fewer lines are fewer Gaussians.
                Format::Csv => result.is_ok(),
                _ => false,
            };
            assert_eq!(result.is_ok(), whole, "{format}, {length} of {} bytes", bytes.len());
        }
    }
}

#[test]
fn files_with_a_changed_byte_are_errors_or_gaussians() {
    for format in Format::all() {
        let bytes = written(&sample(2, 3), format);
        for place in 0..bytes.len() {
            for value in [0, 1, 0x7f, 0x80, 0xff, bytes[place] ^ 1, bytes[place].wrapping_add(1)] {
                let mut changed = bytes.clone();
                changed[place] = value;
                let result = read(&changed, format, &Options::default(), &Limits::embedded());
                if let Ok(splats) = result {
                    splats.gaussians.check_lengths().unwrap();
                }
            }
        }
    }
}

#[test]
fn more_gaussians_than_allowed_are_refused_before_memory_is_reserved() {
    let few = Limits::default().with_max_points(4);
    let little = Limits::default().with_max_bytes(300);
    for format in Format::all() {
        let bytes = written(&sample(5, 0), format);
        for limits in [&few, &little] {
            let error = read(&bytes, format, &Options::default(), limits).unwrap_err();
            assert!(matches!(error, Error::LimitExceeded { .. }), "{format}: {error}");
        }
    }
}

#[test]
fn an_output_that_fails_is_an_error() {
    struct Full(usize);
    impl Write for Full {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0 = self.0.checked_sub(bytes.len()).ok_or(std::io::ErrorKind::StorageFull)?;
            Ok(bytes.len())
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }
    for format in Format::all() {
        let before = sample(5, 3);
        let length = written(&before, format).len();
        for room in [0, length / 2, length - 1] {
            let error = write(&before, Axes::of(format), format, &mut Full(room), Path::new("full")).unwrap_err();
            assert!(matches!(error, Error::Io { .. }), "{format}: {error}");
            assert!(error.to_string().starts_with("full: "), "{error}");
        }
    }
}
