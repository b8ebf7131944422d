//! PCD files in all three encodings, made here.

use super::*;
use b2p::cloud::ReadOptions;

const HEADER: &str = "# .PCD v.7\nVERSION .7\nFIELDS x y z rgb _ normal_x\nSIZE 4 4 8 4 1 4\nTYPE F F F F U F\n\
                      COUNT 1 1 1 1 4 1\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\n";

fn rows(last: u32) -> Vec<u8> {
    let mut rows = Vec::new();
    for (x, y, z, rgb) in [
        (1.5f32, -2.0f32, 3.0f64, 0x0a_14_1eu32),
        (4.0, 5.0, 4_000_000.062_5, last),
    ] {
        rows.extend(x.to_le_bytes());
        rows.extend(y.to_le_bytes());
        rows.extend(z.to_le_bytes());
        rows.extend(rgb.to_le_bytes());
        rows.extend([9; 4]);
        rows.extend(0f32.to_le_bytes());
    }
    rows
}

fn columns() -> Vec<u8> {
    let rows = rows(0xff_00_01);
    let mut columns = Vec::new();
    for (offset, size) in [(0, 4), (4, 4), (8, 8), (16, 4), (20, 4), (24, 4)] {
        for row in rows.chunks(28) {
            columns.extend(&row[offset..offset + size]);
        }
    }
    columns
}

fn compressed() -> Vec<u8> {
    let columns = columns();
    // Runs of literals only.
    let code: Vec<u8> = columns
        .chunks(32)
        .flat_map(|c| [&[c.len() as u8 - 1][..], c].concat())
        .collect();
    let mut bytes = format!("{HEADER}DATA binary_compressed\n").into_bytes();
    bytes.extend((code.len() as u32).to_le_bytes());
    bytes.extend((columns.len() as u32).to_le_bytes());
    bytes.extend(code);
    bytes
}

fn parse(bytes: &[u8]) -> Result<PointCloud> {
    Ok(read(bytes, &Limits::default())?.finish(&ReadOptions::default())?.0)
}

#[test]
fn all_three_encodings_hold_the_same_points() {
    let float = |bits: u32| f32::from_bits(bits);
    let ascii = format!(
        "{HEADER}DATA ascii\n1.5 -2 3 {:e} 9 9 9 9 0\n4 5 4000000.0625 {:e} 9 9 9 9 0\n",
        float(0x0a_14_1e),
        float(0xff_00_01)
    );
    let binary = [format!("{HEADER}DATA binary\n").as_bytes(), &rows(0xff_00_01)].concat();
    for bytes in [ascii.as_bytes(), &binary, &compressed()] {
        let cloud = parse(bytes).unwrap();
        assert_eq!(cloud.positions, [[1.5, -2.0, 3.0], [4.0, 5.0, 4_000_000.062_5]]);
        assert_eq!(cloud.colours, [[10, 20, 30], [255, 0, 1]]);
    }
}

#[test]
fn packed_colours_survive_where_their_bits_are_those_of_a_nan() {
    let bytes = [format!("{HEADER}DATA binary\n").as_bytes(), &rows(0xff_80_00_01)].concat();
    assert_eq!(parse(&bytes).unwrap().colours[1], [128, 0, 1]);
}

#[test]
fn a_file_cut_anywhere_is_an_error() {
    let binary = [format!("{HEADER}DATA binary\n").as_bytes(), &rows(7)].concat();
    for bytes in [binary, compressed()] {
        for length in 0..bytes.len() {
            assert!(parse(&bytes[..length]).is_err(), "cut at {length}");
        }
    }
}

#[test]
fn packed_data_that_is_damaged_is_refused() {
    let whole = compressed();
    let body = whole.len() - columns().len() - columns().len().div_ceil(32);
    for at in body..whole.len() {
        let mut bytes = whole.clone();
        bytes[at] = 0xff;
        let _ = parse(&bytes);
    }
    let mut bytes = whole;
    bytes[body - 4] ^= 1;
    let error = parse(&bytes).unwrap_err().to_string();
    assert!(error.contains("unpacked size"), "{error}");
}

#[test]
fn points_of_an_organised_cloud_that_are_not_finite_are_counted() {
    let text = "VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 2\n\
                POINTS 4\nDATA ascii\nnan nan nan nan\n1 2 3 0.5\ninf 0 0 0\n4 5 6 1\n";
    let raw = read(text.as_bytes(), &Limits::default()).unwrap();
    let (cloud, notes) = raw.finish(&ReadOptions::default()).unwrap();
    assert_eq!(cloud.colours, [[128; 3], [255; 3]]);
    assert!(notes[0].to_string().contains("2 points of 4"), "{notes:?}");
}

#[test]
fn written_files_read_back_equal() {
    let cloud = PointCloud {
        positions: vec![[0.1, -4e6, 7.0], [1.0, 2.0, 3.0]],
        colours: vec![[1, 2, 3], [255, 254, 253]],
        ..PointCloud::default()
    };
    assert_eq!(parse(&write(&cloud, true)).unwrap(), cloud);
    let single = parse(&write(&cloud, false)).unwrap();
    assert_eq!(single.positions[0][0], f64::from(0.1f32));
    assert_eq!(single.colours, cloud.colours);
}
