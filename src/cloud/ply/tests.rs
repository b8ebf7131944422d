use super::*;
use proptest::prelude::*;

const XYZ: [&str; 3] = ["x", "y", "z"];

fn open(bytes: &[u8]) -> Result<Vec<Column>> {
    Ply::open(bytes)?.vertex_columns(&XYZ, &Limits::default())
}

fn message(bytes: &[u8]) -> String {
    open(bytes).unwrap_err().to_string()
}

/// Two vertices (1.5, −2, 3) and (4, 5, 6) after a face element with a list, in every format; y is a short, z an int,
/// and a property that is not read is between them.
fn sample(format: &str, line_end: &str) -> Vec<u8> {
    let header = format!(
        "ply\nformat {format} 1.0\ncomment made by  hand \nobj_info none\nelement face 2\n\
         property list uint8 int32 vertex_indices\nelement vertex 2\nproperty int z\nproperty double confidence\n\
         property float32 x\nproperty int16 y\nend_header\n"
    );
    let mut bytes = header.replace('\n', line_end).into_bytes();
    if format == "ascii" {
        let rows = "3 0 1 1\n0\n\n3 0.25 1.5 -2\n6 nan 4 5\n";
        bytes.extend(rows.replace('\n', line_end).bytes());
        return bytes;
    }
    let mut put = |value: &[u8]| {
        if format.contains("big") {
            bytes.extend(value.iter().rev());
        } else {
            bytes.extend(value);
        }
    };
    put(&[3]);
    for index in [0i32, 1, 1] {
        put(&index.to_le_bytes());
    }
    put(&[0]);
    for (x, y, z) in [(1.5f32, -2i16, 3i32), (4.0, 5, 6)] {
        put(&z.to_le_bytes());
        put(&0.25f64.to_le_bytes());
        put(&x.to_le_bytes());
        put(&y.to_le_bytes());
    }
    bytes
}

const FORMATS: [&str; 3] = ["ascii", "binary_little_endian", "binary_big_endian"];

#[test]
fn every_format_reads_the_same_columns() {
    for format in FORMATS {
        for (mark, line_end) in [
            ("", "\n"),
            ("", "\r\n"),
            ("", "\r"),
            ("\u{feff}", "\n"),
            ("\u{feff}", "\r"),
        ] {
            let bytes = [mark.as_bytes(), &sample(format, line_end)].concat();
            let ply = Ply::open(&bytes).unwrap();
            assert_eq!(ply.header.comments, ["made by  hand"]);
            assert_eq!(ply.element("vertex").unwrap().count, 2);
            let columns = ply.vertex_columns(&XYZ, &Limits::default()).unwrap();
            assert_eq!(columns[0].values, Values::F32(vec![1.5, 4.0]), "{format}");
            assert_eq!(columns[1].values, Values::F32(vec![-2.0, 5.0]), "{format}");
            assert_eq!(columns[2].values, Values::F64(vec![3.0, 6.0]), "{format}");
            assert_eq!(columns[2].scalar, Scalar::I32);
        }
    }
}

#[test]
fn many_columns_of_many_rows_are_read_as_few_are() {
    let (columns, rows) = (37, 1300);
    let value = |row: usize, column: usize| (row * 100 + column) as f32;
    for big_endian in [false, true] {
        let kind = if big_endian { "big" } else { "little" };
        let mut bytes = format!("ply\nformat binary_{kind}_endian 1.0\nelement vertex {rows}\n").into_bytes();
        let names: Vec<String> = (0..columns).map(|i| format!("p{i}")).collect();
        for name in &names {
            bytes.extend(format!("property float {name}\n").bytes());
        }
        bytes.extend(b"end_header\n");
        for row in 0..rows {
            for column in 0..columns {
                let bits = value(row, column).to_bits();
                bytes.extend(if big_endian {
                    bits.to_be_bytes()
                } else {
                    bits.to_le_bytes()
                });
            }
        }
        let ply = Ply::open(&bytes).unwrap();
        // A subset, in another order than in the file.
        let wanted: Vec<usize> = (1..columns).rev().collect();
        let names: Vec<&str> = wanted.iter().map(|&i| names[i].as_str()).collect();
        let read = ply.vertex_columns(&names, &Limits::default()).unwrap();
        for (column, read) in wanted.into_iter().zip(read) {
            let expected = (0..rows).map(|row| value(row, column)).collect();
            assert_eq!(read.values, Values::F32(expected), "{kind}, {column}");
        }
    }
}

#[test]
fn lists_in_vertices_are_skipped() {
    let header = "element vertex 2\nproperty list uchar ushort tags\nproperty uchar x\n\
                  property uint y\nproperty list ushort double more\nproperty char z\nend_header\n";
    let ascii = format!("ply\nformat ascii 1.0\n{header}2 8 9 1 4000000000 0 -3\n0 4 5 1 0.5 6\n");
    let mut binary = format!("ply\nformat binary_little_endian 1.0\n{header}").into_bytes();
    binary.extend([2, 8, 0, 9, 0, 1]);
    binary.extend(4_000_000_000u32.to_le_bytes());
    binary.extend([0, 0, 0xfd]);
    binary.extend([0, 4, 5, 0, 0, 0, 1, 0]);
    binary.extend(0.5f64.to_le_bytes());
    binary.extend([6]);
    for bytes in [ascii.as_bytes(), &binary] {
        let columns = open(bytes).unwrap();
        assert_eq!(columns[0].values, Values::U8(vec![1, 4]));
        assert_eq!(columns[1].values, Values::F64(vec![4e9, 5.0]));
        assert_eq!(columns[2].values, Values::F32(vec![-3.0, 6.0]));
    }
}

#[test]
fn a_list_of_fewer_than_no_items_is_refused() {
    let header = "element vertex 1\nproperty list char uchar tags\nproperty uchar x\nproperty uchar y\n\
                  property uchar z\nend_header\n";
    let ascii = format!("ply\nformat ascii 1.0\n{header}-1 7 8 9\n").into_bytes();
    let mut binary = format!("ply\nformat binary_little_endian 1.0\n{header}").into_bytes();
    binary.extend([0xff, 7, 8, 9]);
    for bytes in [ascii, binary] {
        let error = open(&bytes).unwrap_err().to_string();
        assert!(
            error.contains("tags") || error.contains("0 or more items, not -1"),
            "{error}"
        );
    }
}

#[test]
fn a_file_cut_anywhere_is_an_error() {
    for format in FORMATS {
        let bytes = sample(format, "\n");
        // Without its line end the last row of an ASCII file is still whole.
        let whole = bytes.len() - usize::from(format == "ascii");
        for length in 0..whole {
            assert!(open(&bytes[..length]).is_err(), "{format} cut at {length}");
        }
    }
}

#[test]
fn errors_name_location_value_and_reason() {
    let header =
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty uchar y\nproperty float z\nend_header\n";
    let error = message(format!("{header}1 2 3\n4 256 6\n").as_bytes());
    assert_eq!(
        error,
        "cloud: at line 9: property y is \"256\", expected a number of type uchar"
    );
    let error = message(format!("{header}1 2 3\n4 5\n7").as_bytes());
    assert!(error.contains("line 9") && error.contains("property z"), "{error}");
    let error = message(format!("{header}1 2 3 4\n4 5 6\n").as_bytes());
    assert!(error.contains("line 8") && error.contains("end of a row"), "{error}");
    let error = message(b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n");
    assert!(error.contains("property of vertex y is absent"), "{error}");
    let error = message(b"ply\nformat ascii 1.0\nend_header\n");
    assert!(error.contains("element vertex is absent"), "{error}");
    let error = message(b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n");
    assert!(error.contains("line 3") && error.contains("many"), "{error}");
    assert!(matches!(
        open(b"ply\nformat ascii 2.0\nend_header\n"),
        Err(Error::Unsupported { .. })
    ));
    let bytes = sample("binary_little_endian", "\n");
    match open(&bytes[..bytes.len() - 5]) {
        Err(Error::Truncated { offset, needed, .. }) => {
            assert_eq!((offset, needed), (bytes.len() as u64 - 5, 5));
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_declared_count_does_not_allocate_beyond_the_file() {
    for format in FORMATS {
        for list in ["", "property list int int l\n"] {
            for count in [1u64 << 25, u64::MAX] {
                let header = format!(
                    "ply\nformat {format} 1.0\nelement pad {count}\nproperty float a\n{list}element vertex {count}\n\
                     property float x\nproperty float y\nproperty float z\n{list}end_header\n1 2 3"
                );
                assert!(open(header.as_bytes()).is_err());
                let header = header.replace(&format!("pad {count}\nproperty float a\n{list}"), "pad 0\n");
                assert!(open(header.as_bytes()).is_err());
            }
        }
    }
    let bytes = sample("ascii", "\n");
    let limits = Limits {
        max_points: 1,
        ..Limits::default()
    };
    let result = Ply::open(&bytes).unwrap().vertex_columns(&XYZ, &limits);
    assert!(matches!(result, Err(Error::LimitExceeded { needed: 2, .. })));
}

#[test]
fn rows_without_properties_take_no_time() {
    for format in FORMATS {
        let header = format!(
            "ply\nformat {format} 1.0\nelement nothing {}\nelement vertex 0\n",
            u64::MAX
        );
        let properties = "property float x\nproperty float y\nproperty float z\nend_header\n";
        let columns = open((header + properties).as_bytes()).unwrap();
        assert!(columns.iter().all(Column::is_empty));
    }
}

proptest! {
    #[test]
    fn arbitrary_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let _ = open(&bytes);
        let _ = open(&[b"ply\nformat ascii 1.0\n", &bytes[..]].concat());
    }

    #[test]
    fn damaged_files_never_panic(
        format in 0..3usize,
        edits in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8),
        cut in any::<prop::sample::Index>(),
    ) {
        let mut bytes = sample(FORMATS[format], "\n");
        for (at, value) in edits {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        let _ = open(&bytes);
        bytes.truncate(cut.index(bytes.len()));
        let _ = open(&bytes);
    }

    #[test]
    fn ascii_and_binary_agree_on_any_numbers(rows in prop::collection::vec((any::<f32>(), any::<i32>(), any::<u16>()), 0..50)) {
        let header = |format| format!(
            "ply\nformat {format} 1.0\nelement vertex {}\nproperty float x\nproperty int y\nproperty ushort z\nend_header\n",
            rows.len()
        );
        let mut ascii = header("ascii");
        let mut binary = header("binary_big_endian").into_bytes();
        for (x, y, z) in &rows {
            ascii += &format!("{x:?} {y} {z}\n");
            binary.extend(x.to_be_bytes());
            binary.extend(y.to_be_bytes());
            binary.extend(z.to_be_bytes());
        }
        prop_assert_eq!(open(ascii.as_bytes()).unwrap(), open(&binary).unwrap());
    }
}

#[test]
fn a_vertex_has_a_location_in_every_format() {
    let bytes = b"ply\nformat ascii 1.0\nelement list 1\nproperty uchar a\nelement vertex 2\nproperty int x\nend_header\n7\n\n1\n2";
    let ply = Ply::open(bytes).unwrap();
    assert_eq!(ply.vertex_place(1), "line 11");
    let bytes =
        b"ply\nformat binary_little_endian 1.0\nelement list 2\nproperty uchar a\nelement vertex 2\nproperty float x\n\
        property double y\nend_header\n..";
    let body = bytes.len() - 2;
    let ply = Ply::open(bytes).unwrap();
    assert_eq!(ply.vertex_place(1), format!("byte {}", body + 2 + 12));
}
