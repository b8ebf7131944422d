//! Rows of a binary file.

use rayon::prelude::*;

use super::header::{Element, Kind, Scalar};
use super::{Column, Values, truncated};
use crate::cloud::malformed;
use crate::error::Result;

/// Rows and columns per task.
const BLOCK: usize = 512;
const TOGETHER: usize = 16;

struct Cursor<'a> {
    bytes: &'a [u8],
    at: usize,
    big_endian: bool,
}

/// Reads the properties `wanted` (index, type) of `element`, which follows the elements `before`; the rows begin at
/// byte `body`.
pub(super) fn columns(
    bytes: &[u8],
    body: usize,
    big_endian: bool,
    before: &[Element],
    element: &Element,
    wanted: &[(usize, Scalar)],
) -> Result<Vec<Column>> {
    let mut cursor = Cursor {
        bytes,
        at: body,
        big_endian,
    };
    for element in before {
        match element.stride() {
            Some(stride) => {
                cursor.take_rows(element.count, stride)?;
            }
            None => cursor.walk(element, |_, _, _| Ok(()))?,
        }
    }
    let Some(stride) = element.stride() else {
        return cursor.listed_columns(element, wanted);
    };
    let rows = cursor.take_rows(element.count, stride)?;
    let with_room = |&(_, scalar)| Column::with_capacity(scalar, element.count as usize);
    let mut columns: Vec<Column> = wanted.iter().map(with_room).collect();
    let offsets: Vec<usize> = wanted.iter().map(|w| offset(element, w.0)).collect();
    let parts = columns.par_chunks_mut(TOGETHER);
    parts.zip(offsets.par_chunks(TOGETHER)).for_each(|(columns, offsets)| {
        // In blocks of rows, which stay in the cache for all columns.
        for rows in rows.chunks(BLOCK * stride) {
            for (column, &at) in columns.iter_mut().zip(offsets) {
                column.extend(rows, stride, at, big_endian);
            }
        }
    });
    Ok(columns)
}

impl<'a> Cursor<'a> {
    /// Takes `size` bytes.
    fn take(&mut self, size: u64, field: &'static str) -> Result<&'a [u8]> {
        let rest = &self.bytes[self.at..];
        if size > rest.len() as u64 {
            return Err(truncated(self.bytes.len(), field, size - rest.len() as u64));
        }
        self.at += size as usize;
        Ok(&rest[..size as usize])
    }

    fn take_rows(&mut self, count: u64, stride: usize) -> Result<&'a [u8]> {
        self.take(count.saturating_mul(stride as u64), "rows of a PLY element")
    }

    /// Visits every scalar property of every row with its index, type and bytes. Lists are skipped.
    fn walk(&mut self, element: &Element, mut visit: impl FnMut(usize, Scalar, &[u8]) -> Result<()>) -> Result<()> {
        // Each row has at least the count of a list, so the bytes bound the loop.
        for _ in 0..element.count {
            for (i, property) in element.properties.iter().enumerate() {
                match property.kind {
                    Kind::Scalar(scalar) => {
                        let bytes = self.take(scalar.size() as u64, "rows of a PLY element")?;
                        visit(i, scalar, bytes)?;
                    }
                    Kind::List { count, item } => {
                        let at = self.at;
                        let bytes = self.take(count.size() as u64, "count of a PLY list")?;
                        let length = number(bytes, count, self.big_endian);
                        if length < 0.0 {
                            let field = format!("length of list {:.40}", property.name);
                            return Err(malformed(format!("byte {at}"), field, length, "0 or more"));
                        }
                        self.take(length as u64 * item.size() as u64, "items of a PLY list")?;
                    }
                }
            }
        }
        Ok(())
    }

    /// Columns of an element whose rows vary in length.
    fn listed_columns(mut self, element: &Element, wanted: &[(usize, Scalar)]) -> Result<Vec<Column>> {
        let least: usize = element
            .properties
            .iter()
            .map(|p| match p.kind {
                Kind::Scalar(scalar) => scalar.size(),
                Kind::List { count, .. } => count.size(),
            })
            .sum();
        // Checked before columns are allocated: the file must be long enough for the rows.
        let start = self.at;
        self.take_rows(element.count, least)?;
        self.at = start;

        let rows = element.count as usize;
        let mut columns: Vec<Column> = wanted
            .iter()
            .map(|&(_, scalar)| Column::with_capacity(scalar, rows))
            .collect();
        let mut slots = vec![None; element.properties.len()];
        for (slot, &(property, _)) in wanted.iter().enumerate() {
            slots[property] = Some(slot);
        }
        let big_endian = self.big_endian;
        self.walk(element, |property, scalar, bytes| {
            if let Some(slot) = slots[property] {
                columns[slot].push(number(bytes, scalar, big_endian));
            }
            Ok(())
        })?;
        Ok(columns)
    }
}

/// Byte offset of a property in a row without lists.
fn offset(element: &Element, property: usize) -> usize {
    element.properties[..property]
        .iter()
        .map(|p| match p.kind {
            Kind::Scalar(scalar) => scalar.size(),
            Kind::List { .. } => 0,
        })
        .sum()
}

/// Decodes one number. `bytes` has the length of `scalar`.
fn number(bytes: &[u8], scalar: Scalar, big_endian: bool) -> f64 {
    let mut column = Column::with_capacity(scalar, 1);
    column.extend(bytes, bytes.len(), 0, big_endian);
    column.get(0)
}

impl Column {
    /// Appends a property of `rows` of `stride` bytes each, at offset `at` in each row.
    fn extend(&mut self, rows: &[u8], stride: usize, at: usize, big_endian: bool) {
        macro_rules! add {
            ($to:ident, $file:ty as $memory:ty) => {
                gather(rows, stride, at, big_endian, $to, |bytes| {
                    <$file>::from_le_bytes(bytes) as $memory
                })
            };
        }
        match (self.scalar, &mut self.values) {
            (Scalar::I8, Values::F32(to)) => add!(to, i8 as f32),
            (Scalar::U8, Values::U8(to)) => add!(to, u8 as u8),
            (Scalar::I16, Values::F32(to)) => add!(to, i16 as f32),
            (Scalar::U16, Values::F32(to)) => add!(to, u16 as f32),
            (Scalar::I32, Values::F64(to)) => add!(to, i32 as f64),
            (Scalar::U32, Values::F64(to)) => add!(to, u32 as f64),
            (Scalar::F32, Values::F32(to)) => add!(to, f32 as f32),
            (Scalar::F64, Values::F64(to)) => add!(to, f64 as f64),
            _ => unreachable!("a column is made for its type"),
        }
    }
}

fn gather<const N: usize, T>(
    rows: &[u8],
    stride: usize,
    at: usize,
    big_endian: bool,
    to: &mut Vec<T>,
    value: impl Fn([u8; N]) -> T,
) {
    to.extend(rows.chunks_exact(stride).map(|row| {
        let mut bytes = [0; N];
        bytes.copy_from_slice(&row[at..at + N]);
        if big_endian {
            bytes.reverse();
        }
        value(bytes)
    }));
}
