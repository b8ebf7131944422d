//! Rows of numbers: XYZ, CSV and PTS files.

use b2p::cloud::{Note, RawColours, RawPoints, Stored};
use b2p::{Limits, Result};

use super::{malformed, shown};

/// Columns of a row that are looked at.
const MOST_COLUMNS: usize = 64;

/// What a column holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    Axis(usize),
    Channel(usize),
    Grey,
    Normal(usize),
    Other,
}

/// Numbers of a row, if all of its words are numbers.
pub(crate) fn row_of_numbers(line: &[u8]) -> Option<usize> {
    let mut count = 0;
    for word in words(line) {
        number(word)?;
        count += 1;
    }
    (count > 0).then_some(count)
}

/// Reads a file of rows `x y z`, with colours, intensities or normals after them.
///
/// Numbers are separated by white space, commas, semicolons or tabs. A row of names may come first; then columns are
/// found by name. Without names, the columns after `x y z` are: one: intensity; two: intensity and something else;
/// three: red, green, blue, or a normal if values are negative; four: intensity, red, green, blue (as in PTS files), or
/// red, green, blue, alpha; six: red, green, blue and a normal, or the normal first. Lines that start with `#`, `//` or
/// `;` are comments. A first row of one or two numbers is the number of points.
///
/// # Errors
/// [`b2p::Error::Malformed`] naming the line; [`b2p::Error::LimitExceeded`].
pub(super) fn read(bytes: &[u8], limits: &Limits, notes: &mut Vec<Note>) -> Result<RawPoints> {
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    let mut rows = Rows { bytes, at: 0, line: 0 };
    let mut names: Option<Vec<String>> = None;
    let mut first = None;
    for (line, row) in rows.by_ref() {
        match row_of_numbers(row) {
            Some(0..=2) => {} // The number of points.
            Some(_) => {
                first = Some((line, row));
                break;
            }
            None if names.is_none() && first.is_none() => {
                let name = |word| String::from_utf8_lossy(word).trim_matches('"').to_ascii_lowercase();
                names = Some(words(row).map(name).collect());
            }
            None => return Err(malformed(format!("line {line}"), "row", shown(row), "numbers")),
        }
    }
    let Some((line, row)) = first else {
        return Err(malformed(
            "the file",
            "number of points",
            0,
            "at least one row of numbers",
        ));
    };
    let columns = words(row).take(MOST_COLUMNS).count();
    let roles = names.as_deref().and_then(|names| roles_of(names, columns));
    let mut table = Table::new(columns, roles.as_deref());
    for (line, row) in std::iter::once((line, row)).chain(rows) {
        table.push(line, row)?;
        let count = table.positions.len() as u64;
        limits.check_points("number of points", count)?;
        limits.check_bytes("bytes of the point cloud", count * (24 + 4 * (columns as u64 - 3)))?;
    }
    Ok(table.finish(roles, notes))
}

/// Lines with something in them.
struct Rows<'a> {
    bytes: &'a [u8],
    at: usize,
    line: usize,
}

impl<'a> Iterator for Rows<'a> {
    type Item = (usize, &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        while self.at < self.bytes.len() {
            let rest = &self.bytes[self.at..];
            let length = rest
                .iter()
                .position(|b| matches!(b, b'\n' | b'\r'))
                .unwrap_or(rest.len());
            let crlf = rest[length..].starts_with(b"\r\n");
            self.at += length + if crlf { 2 } else { 1 };
            self.line += 1;
            let row = rest[..length].trim_ascii();
            let comment = [&b"#"[..], b"//", b";"].iter().any(|start| row.starts_with(start));
            if !row.is_empty() && !comment {
                return Some((self.line, row));
            }
        }
        None
    }
}

fn words(row: &[u8]) -> impl Iterator<Item = &[u8]> {
    row.split(|b| b.is_ascii_whitespace() || matches!(b, b',' | b';'))
        .filter(|word| !word.is_empty())
}

fn number(word: &[u8]) -> Option<f64> {
    std::str::from_utf8(word).ok()?.parse().ok()
}

/// All numbers, and the ranges of the columns that are not coordinates.
struct Table {
    /// Columns of the coordinates.
    axes: [usize; 3],
    positions: Vec<[f64; 3]>,
    /// The other columns, row by row.
    rest: Vec<f32>,
    /// Their number.
    extra: usize,
    negative: Vec<bool>,
    fractional: Vec<bool>,
    maximum: Vec<f32>,
}

impl Table {
    fn new(columns: usize, roles: Option<&[Role]>) -> Table {
        let extra = columns - 3;
        let column = |axis| roles.and_then(|roles| roles.iter().position(|role| *role == Role::Axis(axis)));
        Table {
            axes: [0, 1, 2].map(|axis| column(axis).unwrap_or(axis)),
            positions: Vec::new(),
            rest: Vec::new(),
            extra,
            negative: vec![false; extra],
            fractional: vec![false; extra],
            maximum: vec![0.0; extra],
        }
    }

    fn push(&mut self, line: usize, row: &[u8]) -> Result<()> {
        let columns = self.extra + 3;
        let mut words = words(row);
        let mut position = [0.0; 3];
        let mut other = 0;
        for column in 0..columns {
            let word = words.next();
            let value = word.and_then(number).ok_or_else(|| {
                let expected = format!("a number: rows have {columns} columns");
                let field = format!("column {}", column + 1);
                malformed(format!("line {line}"), field, shown(word.unwrap_or_default()), expected)
            })?;
            match self.axes.iter().position(|axis| *axis == column) {
                Some(axis) => position[axis] = value,
                None => {
                    self.negative[other] |= value < 0.0;
                    self.fractional[other] |= value.fract() != 0.0;
                    self.maximum[other] = self.maximum[other].max(value as f32);
                    self.rest.push(value as f32);
                    other += 1;
                }
            }
        }
        if columns < MOST_COLUMNS
            && let Some(word) = words.next()
        {
            let expected = format!("the end of a row of {columns} columns");
            return Err(malformed(format!("line {line}"), "row", shown(word), expected));
        }
        self.positions.push(position);
        Ok(())
    }

    fn finish(self, roles: Option<Vec<Role>>, notes: &mut Vec<Note>) -> RawPoints {
        let roles = roles.unwrap_or_else(|| {
            let roles = self.guessed();
            if self.extra > 0 {
                notes.push(Note::Other(format!("columns are taken as {}", described(&roles))));
            }
            roles
        });
        // The place of a role among the columns that are not coordinates.
        let others: Vec<Role> = (0..roles.len())
            .filter(|column| !self.axes.contains(column))
            .map(|column| roles[column])
            .collect();
        let find = |role: Role| others.iter().position(|r| *r == role);
        let stored = |columns: &[usize]| match columns.iter().any(|c| self.fractional[*c]) {
            true => Stored::Float,
            false => Stored::Integer,
        };
        let colours = match ([0, 1, 2].map(|i| find(Role::Channel(i))), find(Role::Grey)) {
            ([Some(r), Some(g), Some(b)], _) => RawColours::Rgb(self.three([r, g, b]), stored(&[r, g, b])),
            (_, Some(grey)) => {
                let values = self.rest.chunks_exact(self.extra).map(|row| row[grey]);
                RawColours::Grey(values.collect(), stored(&[grey]), "intensity".into())
            }
            _ => RawColours::None,
        };
        let normals = match [0, 1, 2].map(|i| find(Role::Normal(i))) {
            [Some(x), Some(y), Some(z)] => self.three([x, y, z]),
            _ => Vec::new(),
        };
        RawPoints {
            positions: self.positions,
            colours,
            normals,
            ..RawPoints::default()
        }
    }

    fn three(&self, columns: [usize; 3]) -> Vec<[f32; 3]> {
        let values = |row: &[f32]| columns.map(|column| row[column]);
        self.rest.chunks_exact(self.extra).map(values).collect()
    }

    /// Roles of columns without names, by their number and their ranges.
    fn guessed(&self) -> Vec<Role> {
        use Role::{Axis, Channel, Grey, Normal, Other};
        let xyz = [Axis(0), Axis(1), Axis(2)];
        let rgb = [Channel(0), Channel(1), Channel(2)];
        let normal = [Normal(0), Normal(1), Normal(2)];
        let is_normal = |first: usize| {
            let range = first..first + 3;
            range.clone().any(|i| self.negative[i]) && range.clone().all(|i| self.maximum[i] <= 1.0)
        };
        let wide = |i: usize| self.negative[i] || self.maximum[i] > 255.0;
        let rest: Vec<Role> = match self.extra {
            0 => vec![],
            1 | 2 => vec![Grey],
            3 if is_normal(0) => normal.to_vec(),
            3 => rgb.to_vec(),
            4 if wide(0) || !wide(3) && self.maximum[3] < 255.0 && self.maximum[0] != 255.0 => {
                [&[Grey][..], &rgb].concat()
            }
            4 => rgb.to_vec(),
            _ if is_normal(0) && self.extra >= 6 => [normal, rgb].concat(),
            6 if is_normal(3) => [rgb, normal].concat(),
            _ if wide(0) => [&[Grey][..], &rgb].concat(),
            _ => rgb.to_vec(),
        };
        let mut roles = [&xyz[..], &rest].concat();
        roles.resize(3 + self.extra, Other);
        roles
    }
}

/// Roles by names, if they name coordinates.
fn roles_of(names: &[String], columns: usize) -> Option<Vec<Role>> {
    let role = |name: &String| {
        let bare = name
            .trim_start_matches("//")
            .trim_matches(|c: char| !c.is_ascii_alphanumeric());
        match bare {
            "x" | "px" | "easting" => Role::Axis(0),
            "y" | "py" | "northing" => Role::Axis(1),
            "z" | "pz" | "height" | "elevation" => Role::Axis(2),
            "r" | "red" | "rf" => Role::Channel(0),
            "g" | "green" | "gf" => Role::Channel(1),
            "b" | "blue" | "bf" => Role::Channel(2),
            "i" | "intensity" | "grey" | "gray" | "reflectance" | "scalar_intensity" => Role::Grey,
            "nx" => Role::Normal(0),
            "ny" => Role::Normal(1),
            "nz" => Role::Normal(2),
            _ => Role::Other,
        }
    };
    let mut roles: Vec<Role> = names.iter().map(role).collect();
    roles.resize(columns, Role::Other);
    let has = |role| roles.contains(&role);
    (has(Role::Axis(0)) && has(Role::Axis(1)) && has(Role::Axis(2))).then_some(roles)
}

fn described(roles: &[Role]) -> String {
    let name = |role: &Role| match role {
        Role::Axis(i) => ["x", "y", "z"][*i],
        Role::Channel(i) => ["red", "green", "blue"][*i],
        Role::Grey => "intensity",
        Role::Normal(i) => ["nx", "ny", "nz"][*i],
        Role::Other => "unused",
    };
    roles.iter().map(name).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use b2p::cloud::ReadOptions;

    fn cloud(text: &str) -> b2p::cloud::PointCloud {
        let raw = read(text.as_bytes(), &Limits::default(), &mut Vec::new()).unwrap();
        raw.finish(&ReadOptions::default()).unwrap().0
    }

    #[test]
    fn delimiters_comments_and_line_ends_of_any_kind_are_read_alike() {
        let expected = cloud("1 2 3 10 20 30\n4 5 6 40 50 255\n");
        assert_eq!(expected.colours, [[10, 20, 30], [40, 50, 255]]);
        for text in [
            "\u{feff}1,2,3,10,20,30\r\n4,5,6,40,50,255\r\n",
            "# made by hand\n1; 2; 3; 10; 20; 30\n\n4;5;6;40;50;255",
            "1\t2\t3\t10\t20\t30\r4\t5\t6\t40\t50\t255\r",
            "2\n1 2 3 10 20 30\n4 5 6 40 50 255\n",
            "\"X\",\"Y\",\"Z\",\"R\",\"G\",\"B\"\n1,2,3,10,20,30\n4,5,6,40,50,255\n",
            "//X Y Z Rf Gf Bf\n1 2 3 10 20 30\n4 5 6 40 50 255\n",
        ] {
            assert_eq!(cloud(text), expected, "{text:?}");
        }
    }

    #[test]
    fn named_columns_are_found_wherever_they_are() {
        let points = cloud("id,blue,z,green,x,red,y\n7,3,500000.125,2,4000000.0625,1,0.5\n8,0,1,0,1,255,1\n");
        assert_eq!(points.positions[0], [4_000_000.062_5, 0.5, 500_000.125]);
        assert_eq!(points.colours, [[1, 2, 3], [255, 0, 0]]);
    }

    #[test]
    fn columns_without_names_are_judged_by_number_and_range() {
        let first = |text: &str| cloud(text).colours[0];
        assert_eq!(first("1 2 3 128\n0 0 0 255\n"), [128; 3]);
        assert_eq!(first("1 2 3 -1000 10 20 30\n0 0 0 5 255 0 0\n"), [10, 20, 30]);
        assert_eq!(first("1 2 3 10 20 30 255\n0 0 0 5 6 7 255\n"), [10, 20, 30]);
        assert_eq!(first("1 2 3 0 0 -1 10 20 30\n0 0 0 0 0 1 5 6 7\n"), [10, 20, 30]);
        assert_eq!(first("1 2 3 10 20 30 0 0 -1\n0 0 0 5 6 7 0 0 1\n"), [10, 20, 30]);
        assert_eq!(first("1 2 3 0.2 0.4 1.0\n0 0 0 0 0 0.5\n"), [51, 102, 255]);
    }

    #[test]
    fn errors_name_the_line_and_the_column() {
        let error = |text: &str| {
            let read = read(text.as_bytes(), &Limits::default(), &mut Vec::new());
            read.unwrap_err().to_string()
        };
        let text = error("# a\n1 2 3 4\n5 6 seven 8\n");
        assert!(text.contains("line 3") && text.contains("column 3"), "{text}");
        assert!(error("1 2 3\n4 5\n").contains("line 2"));
        assert!(error("1 2 3\n4 5 6 7\n").contains("end of a row"));
        assert!(error("x y z\n").contains("at least one"));
    }
}
