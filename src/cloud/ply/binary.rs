//! Rows of a binary file.

use super::header::{Element, Kind, Scalar};
use super::{Column, Values, truncated};
use crate::cloud::malformed;
use crate::error::Result;

struct Cursor<'a> {
    bytes: &'a [u8],
    at: usize,
    big_endian: bool,
}

/// Reads the properties `wanted` (position, type) of `element`, which follows `before` from byte `body` on.
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
    Ok(wanted
        .iter()
        .map(|&(property, scalar)| Column {
            scalar,
            values: gather_scalar(rows, stride, offset(element, property), scalar, big_endian),
        })
        .collect())
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

    /// Visits every scalar property of every row as (row's property, its bytes), passing over lists.
    fn walk(
        &mut self,
        element: &Element,
        mut visit: impl FnMut(usize, Scalar, &[u8]) -> Result<()>,
    ) -> Result<()> {
        // A row holds at least the count of a list, so the loop ends with the bytes.
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
                            return Err(malformed(
                                format!("byte {at}"),
                                field,
                                length,
                                "0 or more",
                            ));
                        }
                        self.take(length as u64 * item.size() as u64, "items of a PLY list")?;
                    }
                }
            }
        }
        Ok(())
    }

    /// Columns of an element whose rows vary in length.
    fn listed_columns(
        mut self,
        element: &Element,
        wanted: &[(usize, Scalar)],
    ) -> Result<Vec<Column>> {
        let least: usize = element
            .properties
            .iter()
            .map(|p| match p.kind {
                Kind::Scalar(scalar) => scalar.size(),
                Kind::List { count, .. } => count.size(),
            })
            .sum();
        // Looked ahead at, not consumed: the rows must at least be there before columns are reserved.
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

/// One number from exactly its bytes.
fn number(bytes: &[u8], scalar: Scalar, big_endian: bool) -> f64 {
    match gather_scalar(bytes, scalar.size(), 0, scalar, big_endian) {
        Values::U8(v) => v[0].into(),
        Values::F32(v) => v[0].into(),
        Values::F64(v) => v[0],
    }
}

fn gather_scalar(
    rows: &[u8],
    stride: usize,
    at: usize,
    scalar: Scalar,
    big_endian: bool,
) -> Values {
    macro_rules! column {
        ($values:ident, $file:ty as $memory:ty) => {
            Values::$values(gather(rows, stride, at, big_endian, |bytes| {
                <$file>::from_le_bytes(bytes) as $memory
            }))
        };
    }
    match scalar {
        Scalar::I8 => column!(F32, i8 as f32),
        Scalar::U8 => column!(U8, u8 as u8),
        Scalar::I16 => column!(F32, i16 as f32),
        Scalar::U16 => column!(F32, u16 as f32),
        Scalar::I32 => column!(F64, i32 as f64),
        Scalar::U32 => column!(F64, u32 as f64),
        Scalar::F32 => column!(F32, f32 as f32),
        Scalar::F64 => column!(F64, f64 as f64),
    }
}

fn gather<const N: usize, T>(
    rows: &[u8],
    stride: usize,
    at: usize,
    big_endian: bool,
    value: impl Fn([u8; N]) -> T,
) -> Vec<T> {
    rows.chunks_exact(stride)
        .map(|row| {
            let mut bytes = [0; N];
            bytes.copy_from_slice(&row[at..at + N]);
            if big_endian {
                bytes.reverse();
            }
            value(bytes)
        })
        .collect()
}
