//! PLY files: a header that declares columns, then rows.
//!
//! The reader supports ASCII and both binary formats, with elements and properties in any order. It skips list
//! properties. Columns are selected by name once per file. Allocations are bounded by the [`Limits`] and by the length
//! of the file.

mod ascii;
mod binary;
mod header;

pub use header::{Element, Format, Header, Kind, Property, Scalar};

use crate::error::{Error, Result, Stage};
use crate::limits::Limits;

/// A PLY file in memory with a parsed header.
#[derive(Debug, Clone)]
pub struct Ply<'a> {
    /// The parsed header.
    pub header: Header,
    bytes: &'a [u8],
}

/// One property of every row of an element.
#[derive(Debug, Clone, PartialEq)]
pub struct Column {
    /// The type in the file.
    pub scalar: Scalar,
    /// The values in the narrowest of three types that represents the file's type exactly.
    pub values: Values,
}

/// The values of a [`Column`].
#[derive(Debug, Clone, PartialEq)]
pub enum Values {
    /// `uchar`.
    U8(Vec<u8>),
    /// `char`, `short`, `ushort`, `float`.
    F32(Vec<f32>),
    /// `int`, `uint`, `double`.
    F64(Vec<f64>),
}

impl<'a> Ply<'a> {
    /// Parses the header of a file.
    ///
    /// # Errors
    /// Those of [`Header::parse`].
    pub fn open(bytes: &'a [u8]) -> Result<Self> {
        let header = Header::parse(bytes)?;
        Ok(Ply { header, bytes })
    }

    /// The element `name`.
    pub fn element(&self, name: &str) -> Option<&Element> {
        self.header.elements.iter().find(|e| e.name == name)
    }

    /// Reads the scalar properties `names`, which must be distinct, of the element `vertex`, in that order.
    ///
    /// # Errors
    /// [`Error::Malformed`] if one is absent, a list, or has a value outside its type; [`Error::Truncated`] if the
    /// file ends early; [`Error::LimitExceeded`] if there are more rows, or more bytes in them, than `limits` allow.
    pub fn vertex_columns(&self, names: &[&str], limits: &Limits) -> Result<Vec<Column>> {
        self.columns("vertex", names, limits)
    }

    /// Location of row `row` of the element `vertex` for messages: the line of an ASCII file or the byte offset of a
    /// binary one; the row's number if earlier rows vary in size.
    pub(super) fn vertex_place(&self, row: usize) -> String {
        let before = self.header.elements.iter().take_while(|e| e.name != "vertex");
        let place = match self.header.format {
            Format::Ascii => {
                let rows = before
                    .filter(|e| !e.properties.is_empty())
                    .map(|e| e.count as usize)
                    .sum::<usize>()
                    + row;
                ascii::line_of(&self.header, self.bytes, rows).map(|line| format!("line {line}"))
            }
            _ => before
                .chain(self.element("vertex"))
                .map(|e| Some((e, e.stride()?)))
                .collect::<Option<Vec<_>>>()
                .and_then(|strides| {
                    let ((_, own), before) = strides.split_last()?;
                    let skipped: usize = before.iter().map(|(e, stride)| e.count as usize * stride).sum();
                    Some(format!("byte {}", self.header.body + skipped + row * own))
                }),
        };
        place.unwrap_or_else(|| format!("vertex {row}"))
    }

    /// As [`Ply::vertex_columns`], of the element `element`.
    ///
    /// # Errors
    /// As [`Ply::vertex_columns`].
    pub fn columns(&self, element: &str, names: &[&str], limits: &Limits) -> Result<Vec<Column>> {
        let position = self.header.elements.iter().position(|e| e.name == element);
        let Some(position) = position else {
            return Err(header::absent("element", element));
        };
        let (before, rest) = self.header.elements.split_at(position);
        let element = &rest[0];
        limits.check_points("points of the PLY file", element.count)?;

        let mut wanted = Vec::with_capacity(names.len());
        for name in names {
            let property = element.scalar(name)?;
            if wanted.contains(&property) {
                return Err(Error::Usage(format!("property {name} is asked for twice")));
            }
            wanted.push(property);
        }
        let width: u64 = wanted.iter().map(|w| w.1.width()).sum();
        limits.check_bytes("bytes of the PLY file's columns", element.count.saturating_mul(width))?;
        match self.header.format {
            Format::Ascii => ascii::columns(self.bytes, &self.header, before, element, &wanted),
            Format::Binary { big_endian } => {
                binary::columns(self.bytes, self.header.body, big_endian, before, element, &wanted)
            }
        }
    }
}

impl Column {
    fn with_capacity(scalar: Scalar, rows: usize) -> Self {
        let values = match scalar.width() {
            1 => Values::U8(Vec::with_capacity(rows)),
            4 => Values::F32(Vec::with_capacity(rows)),
            _ => Values::F64(Vec::with_capacity(rows)),
        };
        Column { scalar, values }
    }

    /// `value` is in the range of `self.scalar`, so that the conversion is exact.
    fn push(&mut self, value: f64) {
        match &mut self.values {
            Values::U8(v) => v.push(value as u8),
            Values::F32(v) => v.push(value as f32),
            Values::F64(v) => v.push(value),
        }
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        match &self.values {
            Values::U8(v) => v.len(),
            Values::F32(v) => v.len(),
            Values::F64(v) => v.len(),
        }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The exact value of row `i`.
    pub fn get(&self, i: usize) -> f64 {
        match &self.values {
            Values::U8(v) => v[i].into(),
            Values::F32(v) => v[i].into(),
            Values::F64(v) => v[i],
        }
    }

    /// All values as `f32`. Values of `int`, `uint` and `double` are rounded.
    pub fn into_f32(self) -> Vec<f32> {
        match self.values {
            Values::U8(v) => v.into_iter().map(f32::from).collect(),
            Values::F32(v) => v,
            Values::F64(v) => v.into_iter().map(|x| x as f32).collect(),
        }
    }
}

/// The file ends early.
fn truncated(offset: usize, field: &'static str, needed: u64) -> Error {
    Error::Truncated {
        stage: Stage::Cloud,
        offset: offset as u64,
        field,
        needed,
    }
}

#[cfg(test)]
mod tests;
