//! The header, which declares elements and properties.

use crate::cloud::malformed;
use crate::error::{Error, Result};

/// Encoding of the rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// One row per line.
    Ascii,
    /// Rows without padding.
    Binary {
        /// Most significant byte first.
        big_endian: bool,
    },
}

/// A number type of the format.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

/// Kind of a property.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// One number per row.
    Scalar(Scalar),
    /// A count and as many numbers per row.
    List {
        /// The integer type of the count.
        count: Scalar,
        /// The type of the numbers.
        item: Scalar,
    },
}

/// A named value in every row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Property {
    /// Its name.
    pub name: String,
    /// Its kind.
    pub kind: Kind,
}

/// Rows with the same properties.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Element {
    /// Its name.
    pub name: String,
    /// Declared number of rows.
    pub count: u64,
    /// The properties in the order of the file.
    pub properties: Vec<Property>,
}

/// Everything up to `end_header`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Header {
    /// Encoding of the rows.
    pub format: Format,
    /// The comments without the word `comment`, trimmed.
    pub comments: Vec<String>,
    /// The elements in the order of the file.
    pub elements: Vec<Element>,
    /// Byte offset of the first row.
    pub body: usize,
    /// Number of lines of the header.
    pub lines: usize,
    /// The last byte of a line: LF, or CR in a file without LF.
    pub line_end: u8,
}

/// The byte-order mark that some programs put before text.
const MARK: &[u8] = b"\xef\xbb\xbf";

impl Scalar {
    /// Parses a type's name in either spelling (`uchar`, `uint8`).
    fn named(name: &str) -> Option<Scalar> {
        Some(match name {
            "char" | "int8" => Scalar::I8,
            "uchar" | "uint8" => Scalar::U8,
            "short" | "int16" => Scalar::I16,
            "ushort" | "uint16" => Scalar::U16,
            "int" | "int32" => Scalar::I32,
            "uint" | "uint32" => Scalar::U32,
            "float" | "float32" => Scalar::F32,
            "double" | "float64" => Scalar::F64,
            _ => return None,
        })
    }

    /// Size in a binary file, in bytes.
    pub fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }

    /// Minimum and maximum of an integer type.
    pub fn range(self) -> Option<(f64, f64)> {
        Some(match self {
            Scalar::I8 => (i8::MIN.into(), i8::MAX.into()),
            Scalar::U8 => (0.0, u8::MAX.into()),
            Scalar::I16 => (i16::MIN.into(), i16::MAX.into()),
            Scalar::U16 => (0.0, u16::MAX.into()),
            Scalar::I32 => (i32::MIN.into(), i32::MAX.into()),
            Scalar::U32 => (0.0, u32::MAX.into()),
            Scalar::F32 | Scalar::F64 => return None,
        })
    }

    /// Bytes per value of a column in memory.
    pub(super) fn width(self) -> u64 {
        match self {
            Scalar::U8 => 1,
            Scalar::I8 | Scalar::I16 | Scalar::U16 | Scalar::F32 => 4,
            Scalar::I32 | Scalar::U32 | Scalar::F64 => 8,
        }
    }
}

impl std::fmt::Display for Scalar {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Scalar::I8 => "char",
            Scalar::U8 => "uchar",
            Scalar::I16 => "short",
            Scalar::U16 => "ushort",
            Scalar::I32 => "int",
            Scalar::U32 => "uint",
            Scalar::F32 => "float",
            Scalar::F64 => "double",
        })
    }
}

impl Element {
    /// Index and type of the scalar property `name`.
    pub(super) fn scalar(&self, name: &str) -> Result<(usize, Scalar)> {
        let mut found = None;
        for (i, property) in self.properties.iter().enumerate() {
            if property.name != name {
                continue;
            }
            let what = || format!("property {name} of {}", self.name);
            if found.is_some() {
                return Err(malformed("header", what(), "declared twice", "one"));
            }
            match property.kind {
                Kind::Scalar(scalar) => found = Some((i, scalar)),
                Kind::List { .. } => {
                    return Err(malformed("header", what(), "a list", "a number"));
                }
            }
        }
        found.ok_or_else(|| absent(&format!("property of {}", self.name), name))
    }

    /// Whether the element has a property `name`.
    pub fn has(&self, name: &str) -> bool {
        self.properties.iter().any(|p| p.name == name)
    }

    /// Bytes per row of a binary file, or `None` if the element has lists.
    pub(super) fn stride(&self) -> Option<usize> {
        self.properties.iter().try_fold(0, |sum, p| match p.kind {
            Kind::Scalar(scalar) => Some(sum + scalar.size()),
            Kind::List { .. } => None,
        })
    }
}

impl Header {
    /// Reads from `ply` to `end_header`. Lines end with LF, CR LF or CR, as the first does; bytes after the header are
    /// ignored, as is a byte-order mark before it.
    ///
    /// # Errors
    /// [`Error::Malformed`], naming the line, if the header is invalid; [`Error::Truncated`] if it does not end.
    pub fn parse(bytes: &[u8]) -> Result<Header> {
        let text = bytes.strip_prefix(MARK).unwrap_or(bytes);
        if !text.starts_with(b"ply") {
            let start = &bytes[..bytes.len().min(8)];
            return Err(malformed("byte 0", "magic", shown(start), "\"ply\""));
        }
        let line_end = match text {
            [b'p', b'l', b'y', b'\r', next, ..] if *next != b'\n' => b'\r',
            _ => b'\n',
        };
        let mut format = None;
        let mut comments = Vec::new();
        let mut elements: Vec<Element> = Vec::new();
        let (mut body, mut lines) = (bytes.len() - text.len(), 0);
        loop {
            let rest = &bytes[body..];
            let Some(length) = rest.iter().position(|&b| b == line_end) else {
                let needed = "end_header\n".len() as u64;
                return Err(super::truncated(bytes.len(), "header", needed));
            };
            let line = rest[..length].trim_ascii();
            body += length + 1;
            lines += 1;
            let text = String::from_utf8_lossy(line);
            let at = || format!("line {lines}");
            // Only comments have more than five words. The sixth word makes other lines invalid.
            let words: Vec<&str> = text.split_ascii_whitespace().take(6).collect();
            match words[..] {
                ["ply"] if lines == 1 => {}
                _ if lines == 1 => return Err(malformed(at(), "magic", shown(line), "\"ply\"")),
                [] | ["obj_info", ..] => {}
                ["comment", ..] => comments.push(text["comment".len()..].trim().to_owned()),
                ["format", name, "1.0"] if format.is_none() => format = Some(format_named(name, at)?),
                ["format", _, version] if version != "1.0" => {
                    return Err(Error::Unsupported {
                        what: "this PLY version",
                        detail: format!("line {lines}: found {version:.20}, 1.0 would do"),
                    });
                }
                ["element", name, count] => elements.push(Element {
                    name: name.to_owned(),
                    count: count.parse().map_err(|_| {
                        let field = format!("count of element {name:.40}");
                        malformed(at(), field, shown(count.as_bytes()), "a whole number")
                    })?,
                    properties: Vec::new(),
                }),
                ["property", ref kind @ .., name] => {
                    let Some(element) = elements.last_mut() else {
                        return Err(malformed(at(), "property", shown(line), "an element first"));
                    };
                    element.properties.push(property(kind, name, line, at)?);
                }
                ["end_header"] => break,
                _ => {
                    let expected = "format, comment, element, property or end_header";
                    return Err(malformed(at(), "header line", shown(line), expected));
                }
            }
        }
        let Some(format) = format else {
            return Err(absent("header line", "format"));
        };
        Ok(Header {
            format,
            comments,
            elements,
            body,
            lines,
            line_end,
        })
    }
}

fn format_named(name: &str, at: impl Fn() -> String) -> Result<Format> {
    match name {
        "ascii" => Ok(Format::Ascii),
        "binary_little_endian" => Ok(Format::Binary { big_endian: false }),
        "binary_big_endian" => Ok(Format::Binary { big_endian: true }),
        _ => {
            let names = "ascii, binary_little_endian or binary_big_endian";
            Err(malformed(at(), "format", shown(name.as_bytes()), names))
        }
    }
}

/// A property whose type is these words of `line`.
fn property(kind: &[&str], name: &str, line: &[u8], at: impl Fn() -> String) -> Result<Property> {
    let Some(kind) = property_kind(kind) else {
        let field = format!("type of property {name:.40}");
        let expected = "a number type, or list, integer type, number type";
        return Err(malformed(at(), field, shown(line), expected));
    };
    let name = name.to_owned();
    Ok(Property { name, kind })
}

fn property_kind(words: &[&str]) -> Option<Kind> {
    match *words {
        [scalar] => Some(Kind::Scalar(Scalar::named(scalar)?)),
        ["list", count, item] => {
            let (count, item) = (Scalar::named(count)?, Scalar::named(item)?);
            count.range().map(|_| Kind::List { count, item })
        }
        _ => None,
    }
}

/// A declaration that the header lacks.
pub(super) fn absent(what: &str, name: &str) -> Error {
    malformed("header", format!("{what} {name}"), "absent", "to be declared")
}

/// Escaped bytes of a file for an error message.
pub(super) fn shown(bytes: &[u8]) -> String {
    let text = String::from_utf8_lossy(&bytes[..bytes.len().min(40)]);
    format!("{text:?}")
}
