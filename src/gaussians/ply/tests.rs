use super::*;

fn gaussians() -> Gaussians {
    Gaussians {
        position: vec![[0.0, 0.25, -0.999], [1.0, -1.0, 0.5], [1.3, 0.1, 0.2]],
        scale: vec![[0.001, 0.002, 0.5], [1e-6, 0.0, 3.0], [0.1; 3]],
        rotation: vec![[1.0, 0.0, 0.0, 0.0], [0.5, -0.5, 0.5, 0.5], [0.6, 0.8, 0.0, 0.0]],
        opacity: vec![0.25, 1.0, 0.0],
        colour: vec![[0.0, 0.5, 1.0], [0.2, 0.4, 0.6], [1.5, -0.5, 0.25]],
        frame: Frame {
            bits: 9,
            placement: Placement {
                origin: [-1.7, 0.1 + 0.2, 40.0],
                voxel_size: 0.003,
            },
        },
        blur: 1.2345678e-6,
        ..Gaussians::default()
    }
}

fn written(gaussians: &Gaussians) -> Vec<u8> {
    let mut bytes = Vec::new();
    gaussians.write_ply(&mut bytes, Path::new("x")).unwrap();
    bytes
}

fn read_back(bytes: &[u8]) -> (Gaussians, Notes) {
    read(bytes, &Limits::default()).unwrap()
}

/// One Gaussian whose numbers the formulas below decide, after the header lines `extra`.
fn ascii(extra: &str, properties: &[&str], rows: &[&str]) -> Vec<u8> {
    let mut text = format!("ply\nformat ascii 1.0\n{extra}element vertex {}\n", rows.len());
    for property in properties {
        text += &format!("property {property}\n");
    }
    text += "end_header\n";
    for row in rows {
        text += &format!("{row}\n");
    }
    text.into_bytes()
}

const FLOATS: [&str; 14] = [
    "float x",
    "float y",
    "float z",
    "float f_dc_0",
    "float f_dc_1",
    "float f_dc_2",
    "float opacity",
    "float scale_0",
    "float scale_1",
    "float scale_2",
    "float rot_0",
    "float rot_1",
    "float rot_2",
    "float rot_3",
];
const CUBE: &str = "comment b2p bits 1\ncomment b2p origin -1 -1 -1\ncomment b2p voxel_size 1\n";

fn assert_near(a: f32, b: f32, tolerance: f32) {
    assert!((a - b).abs() <= tolerance, "{a} {b}");
}

#[test]
fn written_gaussians_are_read_back() {
    let before = gaussians();
    let (after, notes) = read_back(&written(&before));
    assert_eq!(notes, Notes::default());
    assert_eq!(after.frame, before.frame);
    assert_eq!(after.rotation, before.rotation);
    for i in 0..before.len() {
        for k in 0..3 {
            // World coordinates up to 40 at 0.77 world units per cube unit, in single precision.
            assert_near(after.position[i][k], before.position[i][k], 3e-6);
            assert_near(after.colour[i][k], before.colour[i][k], 2e-7);
            let scale = before.scale[i][k];
            assert_near(after.scale[i][k], scale, 1e-6 * scale + 1e-37);
        }
        assert_near(after.opacity[i], before.opacity[i], 1.1e-6);
    }
}

#[test]
fn rows_of_several_blocks_are_read_back() {
    let mut many = Gaussians::default();
    for i in 0..2 * BLOCK + 1 {
        many.position.push([i as f32 / 4096.0, 0.0, 0.0]);
        many.scale.push([0.01; 3]);
        many.rotation.push([1.0, 0.0, 0.0, i as f32]);
        many.opacity.push(0.5);
        many.colour.push([0.5; 3]);
    }
    let (after, _) = read_back(&written(&many));
    assert_eq!(after.rotation, many.rotation);
    assert_eq!(after.position, many.position);
}

#[test]
fn an_empty_file_is_valid() {
    let none = Gaussians::default();
    let (after, notes) = read_back(&written(&none));
    assert_eq!((after, notes), (none, Notes::default()));
}

#[test]
fn the_numbers_follow_the_convention_of_viewers() {
    let bytes = ascii(CUBE, &FLOATS, &["0.5 0 -1 1 0 -1 0 -1 0 1 2 0 0 0"]);
    let (g, _) = read_back(&bytes);
    // The cube [−1, 1]³ of the world: world and cube units are the same.
    assert_eq!(g.position[0], [0.5, 0.0, -1.0]);
    assert_eq!(g.colour[0], [0.782_094_8, 0.5, 0.217_905_21]);
    assert_eq!(g.opacity[0], 0.5);
    let e = std::f32::consts::E;
    for (scale, expected) in g.scale[0].into_iter().zip([1.0 / e, 1.0, e]) {
        assert_near(scale, expected, 1e-6);
    }
    assert_eq!(g.rotation[0], [2.0, 0.0, 0.0, 0.0]);
}

#[test]
fn properties_are_found_by_name_whatever_their_order_and_type() {
    let mut properties = FLOATS.map(|p| p.replace("float x", "int x").replace("float r", "double r"));
    let mut row: Vec<&str> = "1 0.25 -0.5 0.5 0 -0.5 2 -3 -2 -1 1 0.5 0.25 0".split(' ').collect();
    let straight = ascii(CUBE, &FLOATS, &[&row.join(" ")]);
    properties.reverse();
    row.reverse();
    let names: Vec<&str> = properties.iter().map(String::as_str).collect();
    let shuffled = ascii(CUBE, &names, &[&row.join(" ")]);
    assert_eq!(read_back(&straight), read_back(&shuffled));
}

#[test]
fn properties_that_are_ignored_are_noted() {
    let mut properties = FLOATS.to_vec();
    properties.retain(|p| !p.ends_with("scale_2"));
    properties.extend(["float f_rest_0", "float f_rest_1", "float nx"]);
    let row = "0 0 0 0 0 0 0 -1 -2 1 0 0 0 9 9 9";
    let bytes = ascii("comment SplatRenderMode: deep\n", &properties, &[row]);
    let (g, notes) = read_back(&bytes);
    assert_eq!(g.scale[0][2], 0.0);
    assert_eq!(
        notes,
        Notes {
            ignored_harmonics: 2,
            ignored_mode: Some("deep".into()),
            flat: true,
            fitted: true,
        }
    );
    assert_eq!(notes.warnings().len(), 4);
    assert!(Notes::default().warnings().is_empty());
}

#[test]
fn a_file_without_a_cube_gets_one_around_all_but_outliers() {
    let rows: Vec<String> = (0..1000)
        .map(|i| {
            let x = match i {
                0 => 1e6,
                1 => -1e6,
                2 => f64::NAN,
                _ => 10.0 + 4.0 * f64::from(i) / 1000.0,
            };
            format!("{x} 2 3 0 0 0 9 -3 -3 -3 1 0 0 0")
        })
        .collect();
    let rows: Vec<&str> = rows.iter().map(String::as_str).collect();
    let (g, notes) = read_back(&ascii("", &FLOATS, &rows));
    assert!(notes.fitted && g.frame.is_valid());
    let side = 1024.0 * g.frame.placement.voxel_size;
    assert!((3.9..4.0).contains(&side), "{side}");
    let inside = g.position.iter().filter(|p| p.iter().all(|x| x.abs() <= 1.0));
    assert!(inside.count() >= 985);
    assert!(g.position[2][0].is_nan());
    let middle = g.frame.placement.from_cube(10, [0.0; 3]);
    assert!((middle[0] - 12.0).abs() < 0.02 && middle[1] == 2.0 && middle[2] == 3.0);
}

#[test]
fn centres_in_one_place_or_none_still_get_a_cube() {
    let one = "5 5 5 0 0 0 0 0 0 0 1 0 0 0";
    let nowhere = "nan inf 5 0 0 0 0 0 0 0 1 0 0 0";
    for rows in [&[one][..], &[one, one], &[nowhere], &[]] {
        let (g, _) = read_back(&ascii("", &FLOATS, rows));
        assert!(g.frame.is_valid());
        assert_eq!(g.len(), rows.len());
    }
}

#[test]
fn centres_as_near_or_as_far_as_single_precision_allows_get_a_cube_that_can_be_written() {
    for far in [1e-45, 1e-40, 1e-36, 1.0, 1e35, 1e38, 3.4e38] {
        let rows = [-far, far].map(|x| format!("{x} 0 {x} 0 0 0 0 0 0 0 1 0 0 0"));
        let (g, notes) = read_back(&ascii("", &FLOATS, &rows.each_ref().map(String::as_str)));
        assert!(notes.fitted && g.frame.is_valid(), "{far}: {:?}", g.frame);
        let (again, _) = read_back(&written(&g));
        assert!(again.position.iter().flatten().all(|x| x.is_finite()), "{far}");
        assert_eq!(again.frame, g.frame, "{far}");
    }
}

#[test]
fn offsets_that_take_centres_beyond_single_precision_leave_a_cube_that_can_be_written() {
    let rows = [
        "1e38 -3e38 0 0 0 0 0 0 0 0 1 0 0 0",
        "3e38 -3e38 0 0 0 0 0 0 0 0 1 0 0 0",
    ];
    for offset in ["4e53 0 0", "0 -3e38 1e107", "3e38 -3.4e38 0", "1e308 1e308 1e308"] {
        let comment = format!("comment b2p offset {offset}\n");
        let (g, notes) = read_back(&ascii(&comment, &FLOATS, &rows));
        assert!(notes.fitted && g.frame.is_valid(), "{offset}: {:?}", g.frame);
        assert_eq!(read_back(&written(&g)).0.len(), g.len(), "{offset}");
    }
}

#[test]
fn extreme_values_are_kept() {
    let rows = [
        "0 0 0 0 0 0 inf 20 1000 -1000 1 0 0 0",
        "0 0 0 0 0 0 -inf inf nan -inf 1 0 0 0",
        "0 0 0 nan 0 0 nan 0 0 0 1 0 0 0",
    ];
    let (g, _) = read_back(&ascii(CUBE, &FLOATS, &rows));
    assert_eq!(g.opacity[..2], [1.0, 0.0]);
    assert!(g.opacity[2].is_nan() && g.colour[2][0].is_nan());
    assert_near(g.scale[0][0], 4.851_652e8, 1e3);
    assert_eq!(g.scale[0][1..], [f32::MAX, 0.0]);
    assert!(g.scale[1][0] == f32::INFINITY && g.scale[1][1].is_nan() && g.scale[1][2] == 0.0);
    // And so they are written again.
    let (again, _) = read_back(&written(&g));
    assert!(again.opacity[2].is_nan() && again.scale[1][1].is_nan());
    assert_eq!(again.scale[1][0], f32::INFINITY);
}

#[test]
fn an_invalid_cube_is_ignored() {
    for bad in [
        CUBE.replace("bits 1", "bits 0"),
        CUBE.replace("bits 1", "bits 22"),
        CUBE.replace("voxel_size 1", "voxel_size -1"),
        CUBE.replace("voxel_size 1", "voxel_size nan"),
        CUBE.replace("-1 -1 -1", "-1 -1"),
        CUBE.replace("-1 -1 -1", "-1 inf -1"),
    ] {
        let (g, notes) = read_back(&ascii(&bad, &FLOATS, &["0 0 0 0 0 0 0 0 0 0 1 0 0 0"]));
        assert!(notes.fitted && g.frame.is_valid(), "{bad}");
    }
}

#[test]
fn a_file_without_gaussians_is_an_error() {
    let limits = Limits::default();
    let without = |name: &str| {
        let mut properties = FLOATS.to_vec();
        properties.retain(|p| !p.ends_with(name));
        read(&ascii(CUBE, &properties, &[]), &limits)
    };
    for name in ["z", "f_dc_1", "opacity", "scale_1", "rot_3"] {
        assert!(matches!(without(name), Err(Error::Malformed { .. })), "{name}");
    }
    let whole = written(&gaussians());
    assert!(matches!(
        read(&whole[..whole.len() - 1], &limits),
        Err(Error::Truncated { .. })
    ));
    let few = Limits {
        max_points: 2,
        ..limits
    };
    assert!(matches!(read(&whole, &few), Err(Error::LimitExceeded { .. })));
}

#[test]
fn gaussians_that_cannot_be_written_are_an_error() {
    let write = |gaussians: &Gaussians| gaussians.write_ply(&mut Vec::new(), Path::new("x"));
    let mut uneven = gaussians();
    uneven.opacity.pop();
    assert!(matches!(write(&uneven), Err(Error::Usage(_))));
    let mut nowhere = gaussians();
    nowhere.frame.bits = 0;
    assert!(matches!(write(&nowhere), Err(Error::Usage(_))));
    // Single precision has neither such places nor such voxels.
    for (origin, voxel_size) in [
        ([1e300, 0.0, 0.0], 1.0),
        ([0.0, -1e39, 0.0], 1.0),
        ([0.0; 3], 1e38),
        ([0.0; 3], 1e-60),
    ] {
        let mut far = gaussians();
        far.frame.placement = Placement { origin, voxel_size };
        assert!(matches!(write(&far), Err(Error::Usage(_))), "{origin:?} {voxel_size}");
    }

    struct Full;
    impl Write for Full {
        fn write(&mut self, _: &[u8]) -> std::io::Result<usize> {
            Err(std::io::ErrorKind::StorageFull.into())
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }
    let error = gaussians().write_ply(&mut Full, Path::new("full.ply")).unwrap_err();
    assert!(error.to_string().contains("full.ply"));
}

#[test]
fn view_dependent_colour_is_read_channel_by_channel() {
    let mut properties: Vec<String> = FLOATS.iter().map(|p| p.to_string()).collect();
    properties.extend((0..9).map(|i| format!("float f_rest_{i}")));
    let names: Vec<&str> = properties.iter().map(String::as_str).collect();
    let row = "0 0 0 0 0 0 0 -1 -2 -3 1 0 0 0 1 2 3 4 5 6 7 8 9";
    let (g, notes) = read_back(&ascii("comment SplatRenderMode: mip\n", &names, &[row, row]));
    assert_eq!((notes.ignored_harmonics, notes.ignored_mode), (0, None));
    assert!(g.compensated);
    assert_eq!(g.harmonics.count, 3);
    let one = [[1.0, 4.0, 7.0], [2.0, 5.0, 8.0], [3.0, 6.0, 9.0]];
    assert_eq!(g.harmonics.coefficients, [one, one].concat());
}

#[test]
fn view_dependent_colour_is_assigned_to_its_gaussian() {
    let count = 2 * BLOCK + 7;
    let mut bytes = format!("ply\nformat binary_little_endian 1.0\nelement vertex {count}\n").into_bytes();
    let rest: Vec<String> = (0..9).map(|i| format!("f_rest_{i}")).collect();
    for name in PROPERTIES.into_iter().chain(rest.iter().map(String::as_str)) {
        bytes.extend(format!("property float {name}\n").bytes());
    }
    bytes.extend(b"end_header\n");
    let value = |i: usize, k: usize| (10 * i + k) as f32;
    for i in 0..count {
        bytes.extend([0.5f32; 14].into_iter().flat_map(f32::to_le_bytes));
        bytes.extend((0..9).flat_map(|k| value(i, k).to_le_bytes()));
    }
    let (g, _) = read_back(&bytes);
    let of = |i| (0..3).map(move |k| [0, 3, 6].map(|channel| value(i, channel + k)));
    assert_eq!(g.harmonics.coefficients, (0..count).flat_map(of).collect::<Vec<_>>());
}

#[test]
fn view_dependent_colour_and_its_render_mode_are_written() {
    let mut before = gaussians();
    before.compensated = true;
    before.harmonics = Harmonics {
        count: 3,
        coefficients: (0..9).map(|i| [i as f32, 0.5 * i as f32, -0.25 * i as f32]).collect(),
    };
    let (after, notes) = read_back(&written(&before));
    assert_eq!(notes, Notes::default());
    assert!(after.compensated);
    assert_eq!(after.harmonics, before.harmonics);
}

#[test]
fn a_cube_far_from_the_origin_is_written_without_stripes() {
    // A cube of 100 m with voxels of 10 cm at UTM coordinates, where single precision resolves half a metre.
    let frame = Frame {
        bits: 10,
        placement: Placement {
            origin: [500_123.4, 4_649_876.5, 12.0],
            voxel_size: 0.1,
        },
    };
    assert_eq!(frame.offset(), [500_200.0, 4_649_900.0, 0.0]);
    let before = Gaussians { frame, ..gaussians() };
    let file = written(&before);
    let ply = Ply::open(&file).unwrap();
    assert!(ply.header.comments.contains(&"b2p offset 500200 4649900 0".to_owned()));
    let columns = ply.vertex_columns(&["x", "y"], &Limits::default()).unwrap();
    assert!((0..3).all(|i| columns[0].get(i).abs() < 200.0 && columns[1].get(i).abs() < 200.0));
    let (after, _) = read_back(&file);
    assert_eq!(after.frame, frame);
    for (after, before) in after.position.as_flattened().iter().zip(before.position.as_flattened()) {
        assert_near(*after, *before, 1e-6);
    }
}

#[test]
fn a_cube_near_the_origin_keeps_its_coordinates() {
    for (origin, voxel_size) in [([-0.5; 3], 1.0), ([-3.0, 2.0, 900.0], 1.0), ([0.0, 0.0, 60.0], 0.001)] {
        let placement = Placement { origin, voxel_size };
        assert_eq!(Frame { bits: 10, placement }.offset(), [0.0; 3]);
    }
    let placement = Placement {
        origin: [11.576_123, 48.137_1, 0.0],
        voxel_size: 1e-7,
    };
    assert_eq!(Frame { bits: 10, placement }.offset(), [11.576_2, 48.137_2, 0.0]);
}

#[test]
fn opacities_of_nothing_and_of_all_are_written_as_finite_numbers() {
    let mut extremes = gaussians();
    let values = [0.0, 1.0, -0.5, 1.5];
    for (opacity, value) in extremes.opacity.iter_mut().zip(values.into_iter().cycle()) {
        *opacity = value;
    }
    let mut file = Vec::new();
    extremes.write_ply(&mut file, Path::new("x")).unwrap();
    let ply = Ply::open(&file).unwrap();
    let column = &ply.vertex_columns(&["opacity"], &Limits::default()).unwrap()[0];
    for i in 0..extremes.len() {
        let logit: f64 = column.get(i);
        assert!(logit.is_finite() && (13.0..14.0).contains(&logit.abs()), "{logit}");
    }
}
