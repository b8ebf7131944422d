//! LAS and LAZ files, written here and changed.

use super::*;
use b2p::cloud::ReadOptions;

const UTM: [f64; 3] = [500_000.0, 4_000_000.0, 120.0];

fn cloud() -> (PointCloud, Placement) {
    let grid = Placement {
        origin: UTM,
        voxel_size: 0.003,
    };
    let at = |v: f64, axis: usize| UTM[axis] + 0.003 * (v + 0.5);
    let cloud = PointCloud {
        positions: (0..300)
            .map(|i| [at(f64::from(i), 0), at(f64::from(i * 7), 1), at(f64::from(i % 9), 2)])
            .collect(),
        colours: (0..300).map(|i| [i as u8, 255, (i / 2) as u8]).collect(),
        axes: Axes {
            up: Some(Up::Z),
            metres_per_unit: Some(1.0),
            crs: "PROJCS[\"WGS 84 / UTM zone 33N\",UNIT[\"metre\",1]]".into(),
        },
        ..PointCloud::default()
    };
    (cloud, grid)
}

fn parse(bytes: Vec<u8>) -> Result<(PointCloud, Vec<Note>)> {
    let mut notes = Vec::new();
    read(bytes, &Limits::default(), &mut notes)?.finish(&ReadOptions::default())
}

#[test]
fn points_far_from_the_origin_come_back_exactly_from_las_and_laz() {
    let (cloud, grid) = cloud();
    for compressed in [false, true] {
        let bytes = write(&cloud, &Steps::of_grid(&grid), compressed).unwrap();
        assert_eq!(describe(&bytes), if compressed { "LAZ 1.4" } else { "LAS 1.4" });
        let (read, notes) = parse(bytes).unwrap();
        assert_eq!(notes, []);
        assert_eq!(read.colours, cloud.colours);
        assert_eq!(read.axes, cloud.axes);
        for (a, b) in read.positions.iter().zip(&cloud.positions) {
            assert!((0..3).all(|i| (a[i] - b[i]).abs() < 1e-6), "{a:?} {b:?}");
        }
    }
}

#[test]
fn a_file_cut_anywhere_is_an_error_and_nothing_panics() {
    let (cloud, grid) = cloud();
    for compressed in [false, true] {
        let bytes = write(&cloud, &Steps::of_grid(&grid), compressed).unwrap();
        for length in (0..bytes.len()).step_by(7) {
            assert!(
                parse(bytes[..length].to_vec()).is_err(),
                "{compressed}, cut at {length}"
            );
        }
    }
}

#[test]
fn counts_beyond_the_file_are_refused_before_memory_is_taken() {
    let (cloud, grid) = cloud();
    for compressed in [false, true] {
        let bytes = write(&cloud, &Steps::of_grid(&grid), compressed).unwrap();
        for (at, value) in [
            (247, 1u64 << 25),
            (247, u64::MAX),
            (96, 0xffff_ffff),
            (235, u64::MAX - 3),
        ] {
            let mut bytes = bytes.clone();
            let size = if at == 96 { 4 } else { 8 };
            bytes[at..at + size].copy_from_slice(&value.to_le_bytes()[..size]);
            bytes[243] = u8::from(at == 235);
            if at == 247 && value < 1 << 32 {
                // The number for older readers, which the crate prefers.
                bytes[107..111].copy_from_slice(&(value as u32).to_le_bytes());
            }
            assert!(parse(bytes).is_err(), "{compressed} {at} {value}");
        }
    }
}

#[test]
fn eight_bit_colours_in_sixteen_bits_are_recognised() {
    let (cloud, grid) = cloud();
    let mut bytes = write(&cloud, &Steps::of_grid(&grid), false).unwrap();
    let start = Start::parse(&bytes).unwrap();
    for record in bytes[start.offset..].chunks_exact_mut(start.record) {
        for channel in record[30..36].chunks_exact_mut(2) {
            channel[1] = 0;
        }
    }
    let (read, notes) = parse(bytes).unwrap();
    assert_eq!(read.colours, cloud.colours);
    assert!(
        notes[0].to_string().contains("16-bit integers of at most 255"),
        "{notes:?}"
    );
}

#[test]
fn intensities_serve_where_colours_were_never_set() {
    let (mut cloud, grid) = cloud();
    cloud.colours.fill([0; 3]);
    let mut bytes = write(&cloud, &Steps::of_grid(&grid), false).unwrap();
    let start = Start::parse(&bytes).unwrap();
    for record in bytes[start.offset..].chunks_exact_mut(start.record) {
        record[12] = 200;
    }
    let (read, notes) = parse(bytes).unwrap();
    assert_eq!(read.colours[0], [200; 3]);
    assert!(notes[0].to_string().contains("intensity"));
}

#[test]
fn units_follow_from_the_coordinate_system() {
    assert_eq!(
        unit_of("PROJCS[\"a\",GEOGCS[UNIT[\"degree\",0.017]],UNIT[\"US survey foot\",0.3048006096]]"),
        Some(0.304_800_609_6)
    );
    assert_eq!(unit_of("GEOGCS[\"a\",UNIT[\"degree\",0.017]]"), None);
    assert_eq!(
        unit_of("PROJCS[\"a\",UNIT[\"metre\",1,AUTHORITY[\"EPSG\",\"9001\"]]]"),
        Some(1.0)
    );
    assert_eq!(unit_of("EPSG:32633"), None);
}
