//! The dialects of PLY point clouds: names and types of properties, and the comments that our writer adds.

use super::ply::{Column, Ply, Scalar, Values};
use super::raw::{RawPoints, ReadOptions};
use super::{Coordinates, Hints, RawColours, Stored, is_a_mesh, malformed};
use crate::axes::Axes;
use crate::error::Result;
use crate::limits::Limits;

/// Names of colours, the most usual first.
const COLOURS: [[&str; 3]; 4] = [
    ["red", "green", "blue"],
    ["r", "g", "b"],
    ["diffuse_red", "diffuse_green", "diffuse_blue"],
    ["scalar_red", "scalar_green", "scalar_blue"],
];
/// Names of grey values, the most usual first.
const GREYS: [&str; 8] = [
    "intensity",
    "grey",
    "gray",
    "scalar_intensity",
    "reflectance",
    "refc",
    "scalar_grey",
    "scalar_gray",
];
const NORMALS: [[&str; 3]; 2] = [["nx", "ny", "nz"], ["normal_x", "normal_y", "normal_z"]];

/// Properties to read, by their names in the file.
struct Names {
    axes: Vec<String>,
    /// Three, one or none.
    colours: Vec<String>,
    /// Three or none.
    normals: Vec<String>,
}

/// Reads the points of a PLY file.
pub(super) fn read(bytes: &[u8], limits: &Limits, options: &ReadOptions) -> Result<RawPoints> {
    let ply = Ply::open(bytes)?;
    let faces = ["face", "tristrips"].iter().find_map(|name| ply.element(name));
    if let Some(faces) = faces.filter(|faces| faces.count > 0 && !options.vertices) {
        let (count, name) = (super::grouped(faces.count), &faces.name);
        let plural = if faces.count == 1 { "" } else { "s" };
        return Err(is_a_mesh(&format!(" of {count} {name}{plural}")));
    }
    let names = Names::of(&ply);
    let all: Vec<&str> = [&names.axes, &names.colours, &names.normals]
        .into_iter()
        .flatten()
        .map(String::as_str)
        .collect();
    let mut columns = ply.vertex_columns(&all, limits)?;
    let count = columns[0].len();
    if count == 0 {
        let field = "count of element vertex";
        return Err(malformed("header", field, 0, "at least one point"));
    }
    let memory = std::mem::size_of::<([f64; 3], [f32; 3], [f32; 3])>() as u64;
    limits.check_bytes("bytes of the point cloud", count as u64 * memory)?;

    let normals = columns.split_off(3 + names.colours.len());
    let colours = columns.split_off(3);
    let positions: Vec<[f64; 3]> = (0..count)
        .map(|row| std::array::from_fn(|axis| columns[axis].get(row)))
        .collect();
    drop(columns);
    if options.strict {
        check_finite(&positions, &names.axes, &ply)?;
    }
    let normals = match normals.len() {
        3 => (0..count)
            .map(|row| std::array::from_fn(|axis| normals[axis].get(row) as f32))
            .collect(),
        _ => Vec::new(),
    };
    let comments = &ply.header.comments;
    let mut raw = RawPoints {
        positions,
        colours: colours_of(colours, &names)?,
        normals,
        hints: Hints::from_comments(comments),
        axes: axes_in(comments),
        has_offset: false,
    };
    add_offset(&mut raw, comments);
    Ok(raw)
}

impl Names {
    fn of(ply: &Ply) -> Names {
        let properties = ply.element("vertex").map_or(&[][..], |vertex| &vertex.properties);
        let named = |wanted: &str| {
            let exact = properties.iter().find(|p| p.name == wanted);
            let found = exact.or_else(|| properties.iter().find(|p| p.name.eq_ignore_ascii_case(wanted)));
            found.map(|p| p.name.clone())
        };
        // If some of three are there, reading fails at the missing ones.
        let three = |names: &[&str; 3]| {
            names.iter().any(|name| named(name).is_some()).then(|| {
                let or_missing = |name: &&str| named(name).unwrap_or_else(|| (*name).to_owned());
                names.iter().map(or_missing).collect::<Vec<_>>()
            })
        };
        let axes = ["x", "y", "z"].map(|name| named(name).unwrap_or_else(|| name.to_owned()));
        let grey = || GREYS.iter().find_map(|name| named(name)).map(|name| vec![name]);
        let colours = COLOURS.iter().find_map(three).or_else(grey).unwrap_or_default();
        // Normals serve points without colours only.
        let normals = match colours.is_empty() {
            true => NORMALS
                .iter()
                .find(|names| names.iter().all(|name| named(name).is_some())),
            false => None,
        };
        Names {
            axes: axes.to_vec(),
            colours,
            normals: normals.and_then(three).unwrap_or_default(),
        }
    }
}

fn stored(scalar: Scalar) -> Stored {
    match scalar {
        Scalar::U8 => Stored::Byte,
        Scalar::U16 => Stored::Short,
        Scalar::F32 | Scalar::F64 => Stored::Float,
        Scalar::I8 | Scalar::I16 | Scalar::I32 | Scalar::U32 => Stored::Integer,
    }
}

fn colours_of(columns: Vec<Column>, names: &Names) -> Result<RawColours> {
    let types: Vec<Stored> = columns.iter().map(|column| stored(column.scalar)).collect();
    match &columns[..] {
        [] => Ok(RawColours::None),
        [r, g, b] => {
            if let (Values::U8(r), Values::U8(g), Values::U8(b)) = (&r.values, &g.values, &b.values) {
                let bytes = r.iter().zip(g).zip(b).map(|((r, g), b)| [*r, *g, *b]);
                return Ok(RawColours::Bytes(bytes.collect()));
            }
            let rows = 0..r.len();
            if types.iter().all(|stored| *stored == types[0]) {
                let value = |row| [r, g, b].map(|column| column.get(row) as f32);
                return Ok(RawColours::Rgb(rows.map(value).collect(), types[0]));
            }
            // Columns of different types have ranges of their own.
            let mut whites = [1.0; 3];
            for (i, column) in columns.iter().enumerate() {
                let maximum = rows.clone().map(|row| column.get(row)).fold(0.0, f64::max);
                whites[i] = types[i].white(maximum).map(|white| white.0).ok_or_else(|| {
                    let field = format!("greatest value of property {:.40}", names.colours[i]);
                    malformed("vertices", field, maximum, "at most 65535")
                })?;
            }
            let value = |row| std::array::from_fn(|i| (columns[i].get(row) / whites[i]) as f32);
            Ok(RawColours::Rgb(rows.map(value).collect(), Stored::Float))
        }
        [grey, ..] => {
            let values = (0..grey.len()).map(|row| grey.get(row) as f32).collect();
            Ok(RawColours::Grey(values, types[0], names.colours[0].clone()))
        }
    }
}

/// Fails at the first coordinate that is not finite, and names its location.
fn check_finite(positions: &[[f64; 3]], names: &[String], ply: &Ply) -> Result<()> {
    for (row, position) in positions.iter().enumerate() {
        if let Some(axis) = position.iter().position(|x| !x.is_finite()) {
            let field = format!("property {:.40}", names[axis]);
            return Err(malformed(
                ply.vertex_place(row),
                field,
                position[axis],
                "a finite number",
            ));
        }
    }
    Ok(())
}

/// The comments `up AXIS`, `metres_per_unit M` and `crs TEXT`. Others are free text.
fn axes_in(comments: &[String]) -> Axes {
    let value = |key: &str| comments.iter().find_map(|comment| comment.strip_prefix(key));
    let crs = value("crs ").unwrap_or_default();
    Axes {
        up: value("up ").and_then(|up| up.parse().ok()),
        metres_per_unit: value("metres_per_unit ").and_then(|unit| Axes::parse_unit(unit).ok()),
        crs: if crs.len() <= Axes::MAX_CRS {
            crs.to_owned()
        } else {
            String::new()
        },
    }
}

/// Adds the offset of the comments `coordinates local` and `offset X Y Z`.
fn add_offset(raw: &mut RawPoints, comments: &[String]) {
    if !comments.iter().any(|comment| comment == "coordinates local") {
        return;
    }
    let offset = comments.iter().find_map(|comment| {
        let words = comment.strip_prefix("offset ")?.split_ascii_whitespace();
        let numbers: Option<Vec<f64>> = words.map(|word| word.parse().ok()).collect();
        let numbers = <[f64; 3]>::try_from(numbers?).ok()?;
        numbers.iter().all(|x| x.is_finite()).then_some(numbers)
    });
    let Some(offset) = offset else { return };
    for position in &mut raw.positions {
        *position = std::array::from_fn(|axis| position[axis] + offset[axis]);
    }
    raw.hints.coordinates = Coordinates::World;
    raw.has_offset = true;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::{Note, PointCloud};

    /// A cloud of properties `type name`, and its rows.
    fn file(properties: &[&str], rows: &str) -> String {
        let mut text = format!("ply\nformat ascii 1.0\nelement vertex {}\n", rows.lines().count());
        for property in properties {
            text += &format!("property {property}\n");
        }
        text + "end_header\n" + rows
    }

    fn open(text: &str) -> (PointCloud, Vec<Note>) {
        PointCloud::read_ply(text.as_bytes(), &Limits::default(), &ReadOptions::default()).unwrap()
    }

    #[test]
    fn colours_have_many_names() {
        for names in [
            ["red", "green", "blue"],
            ["Red", "Green", "Blue"],
            ["r", "g", "b"],
            ["R", "G", "B"],
            ["diffuse_red", "diffuse_green", "diffuse_blue"],
        ] {
            for axes in [["x", "y", "z"], ["X", "Y", "Z"]] {
                let axes = axes.map(|axis| format!("float {axis}"));
                let colours = names.map(|name| format!("uchar {name}"));
                let all: Vec<&str> = axes.iter().chain(&colours).map(String::as_str).collect();
                let (cloud, notes) = open(&file(&all, "1 2 3 10 20 30\n"));
                assert_eq!((cloud.positions[0], cloud.colours[0]), ([1.0, 2.0, 3.0], [10, 20, 30]));
                assert_eq!(notes, [], "{names:?}");
            }
        }
    }

    #[test]
    fn colours_have_many_types_and_what_is_guessed_is_reported() {
        let read = |scalar: &str, row: &str| {
            let colours = ["red", "green", "blue"].map(|name| format!("{scalar} {name}"));
            let all = [
                "float x",
                "float y",
                "float z",
                colours[0].as_str(),
                colours[1].as_str(),
                colours[2].as_str(),
            ];
            let (cloud, notes) = open(&file(&all, &format!("0 0 0 {row}\n")));
            (cloud.colours[0], notes.len())
        };
        assert_eq!(read("uchar", "10 20 30"), ([10, 20, 30], 0));
        assert_eq!(read("ushort", "65535 257 0"), ([255, 1, 0], 0));
        // Eight bits in fields of sixteen: black, if taken as sixteen.
        assert_eq!(read("ushort", "255 128 1"), ([255, 128, 1], 1));
        assert_eq!(read("float", "1 0.5 0"), ([255, 128, 0], 0));
        assert_eq!(read("double", "255 128 0"), ([255, 128, 0], 1));
        assert_eq!(read("int", "255 128 0"), ([255, 128, 0], 0));
    }

    #[test]
    fn without_colours_grey_values_serve_then_normals_then_heights() {
        let (cloud, notes) = open(&file(
            &["float x", "float y", "float z", "uchar Intensity"],
            "0 0 0 77\n",
        ));
        assert_eq!(cloud.colours, [[77; 3]]);
        assert!(notes[0].to_string().contains("Intensity"), "{notes:?}");
        let normals = ["float x", "float y", "float z", "float nx", "float ny", "float nz"];
        let (_, notes) = open(&file(&normals, "0 0 0 0 0 1\n"));
        assert_eq!(notes, [Note::Shaded { by: "normals" }]);
        let (cloud, notes) = open(&file(&["float x", "float y", "float z"], "0 0 0\n0 0 1\n"));
        assert_eq!(notes, [Note::Shaded { by: "height" }]);
        assert!(cloud.colours[0][0] < cloud.colours[1][0]);
    }

    #[test]
    fn points_that_are_not_finite_are_left_out_and_counted() {
        let all = [
            "float x",
            "float y",
            "float z",
            "uchar red",
            "uchar green",
            "uchar blue",
        ];
        let (cloud, notes) = open(&file(&all, "nan nan nan 0 0 0\n1 2 3 4 5 6\n0 inf 0 1 1 1\n"));
        assert_eq!(
            (cloud.positions, cloud.colours),
            (vec![[1.0, 2.0, 3.0]], vec![[4, 5, 6]])
        );
        assert_eq!(notes, [Note::NotFinite { left_out: 2, of: 3 }]);
    }

    #[test]
    fn comments_of_our_writer_are_understood() {
        let text = file(
            &["float x", "float y", "float z", "uchar r", "uchar g", "uchar b"],
            "1 2 3 4 5 6\n",
        );
        let comments = "comment coordinates local\ncomment offset 500000 4000000 0.5\ncomment up -z\n\
                        comment metres_per_unit 0.3048\ncomment crs EPSG:32633\n";
        let (cloud, _) = open(&text.replace("element", &format!("{comments}element")));
        assert_eq!(cloud.positions, [[500_001.0, 4_000_002.0, 3.5]]);
        assert_eq!(cloud.axes.up, Some(crate::axes::Up::MinusZ));
        assert_eq!(cloud.axes.metres_per_unit, Some(0.3048));
        assert_eq!(cloud.axes.crs, "EPSG:32633");
        // Free text is none of them.
        let (cloud, _) = open(&text.replace("element", "comment up to date\ncomment offset print\nelement"));
        assert!(cloud.axes.is_empty());
    }
}
