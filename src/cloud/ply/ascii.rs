//! Rows of an ASCII file: one per line; blank lines are skipped.

use super::header::{Element, Header, Kind, Scalar, shown};
use super::{Column, truncated};
use crate::cloud::malformed;
use crate::error::Result;

struct Lines<'a> {
    bytes: &'a [u8],
    at: usize,
    line: usize,
    line_end: u8,
}

/// Reads the properties `wanted` (index, type) of `element`, which follows the elements `before`.
pub(super) fn columns(
    bytes: &[u8],
    header: &Header,
    before: &[Element],
    element: &Element,
    wanted: &[(usize, Scalar)],
) -> Result<Vec<Column>> {
    let mut lines = Lines {
        bytes,
        at: header.body,
        line: header.lines,
        line_end: header.line_end,
    };
    for element in before {
        lines.check_rows(element)?;
        if !element.properties.is_empty() {
            for _ in 0..element.count {
                lines.next_row()?;
            }
        }
    }
    lines.check_rows(element)?;
    let rows = element.count as usize;
    let mut columns: Vec<Column> = wanted
        .iter()
        .map(|&(_, scalar)| Column::with_capacity(scalar, rows))
        .collect();
    if wanted.is_empty() {
        return Ok(columns);
    }
    let mut slots = vec![None; element.properties.len()];
    for (slot, &(property, _)) in wanted.iter().enumerate() {
        slots[property] = Some(slot);
    }
    for _ in 0..rows {
        let row = lines.next_row()?;
        let line = lines.line;
        let mut words = row.split(|b| b.is_ascii_whitespace()).filter(|w| !w.is_empty());
        for (property, &slot) in element.properties.iter().zip(&slots) {
            let at = |word: Option<&[u8]>, expected: String| {
                let field = format!("property {:.40}", property.name);
                malformed(format!("line {line}"), field, shown(word.unwrap_or_default()), expected)
            };
            let mut next = |scalar: Scalar| {
                let word = words.next();
                word.and_then(|word| number(scalar, word))
                    .ok_or_else(|| at(word, format!("a number of type {scalar}")))
            };
            match (property.kind, slot) {
                (Kind::Scalar(scalar), Some(slot)) => columns[slot].push(next(scalar)?),
                (Kind::Scalar(scalar), None) => {
                    next(scalar)?;
                }
                (Kind::List { count, item }, _) => {
                    let length = next(count)?;
                    if length < 0.0 {
                        return Err(at(None, format!("0 or more items, not {length}")));
                    }
                    // Bounded by the words of the line, whatever the declared length of the list.
                    for _ in 0..length as u64 {
                        next(item)?;
                    }
                }
            }
        }
        if let Some(word) = words.next() {
            let expected = format!("the end of a row of {}", element.name);
            return Err(malformed(format!("line {line}"), "row", shown(word), expected));
        }
    }
    Ok(columns)
}

/// Line number of row `row`, counted over all elements.
pub(super) fn line_of(header: &Header, bytes: &[u8], row: usize) -> Option<usize> {
    let mut lines = Lines {
        bytes,
        at: header.body,
        line: header.lines,
        line_end: header.line_end,
    };
    for _ in 0..=row {
        lines.next_row().ok()?;
    }
    Some(lines.line)
}

impl<'a> Lines<'a> {
    /// The next line that is not blank.
    fn next_row(&mut self) -> Result<&'a [u8]> {
        while self.at < self.bytes.len() {
            let rest = &self.bytes[self.at..];
            let length = rest.iter().position(|&b| b == self.line_end).unwrap_or(rest.len());
            self.at = (self.at + length + 1).min(self.bytes.len());
            self.line += 1;
            let row = rest[..length].trim_ascii();
            if !row.is_empty() {
                return Ok(row);
            }
        }
        Err(truncated(self.at, "rows of a PLY element", 1))
    }

    /// Fails unless the remaining bytes can hold the rows: each number takes a digit and a separator, except at the end
    /// of the file.
    fn check_rows(&self, element: &Element) -> Result<()> {
        let width = 2 * element.properties.len() as u64;
        let needed = element.count.saturating_mul(width).saturating_sub(1);
        let left = (self.bytes.len() - self.at) as u64;
        if needed > left {
            let missing = needed - left;
            return Err(truncated(self.bytes.len(), "rows of a PLY element", missing));
        }
        Ok(())
    }
}

/// Parses a word as a value of `scalar`.
fn number(scalar: Scalar, word: &[u8]) -> Option<f64> {
    let value = match small_integer(word) {
        Some(value) => value,
        None => {
            let word = std::str::from_utf8(word).ok()?;
            match scalar {
                Scalar::F32 => word.parse::<f32>().ok()?.into(),
                _ => word.parse().ok()?,
            }
        }
    };
    match scalar.range() {
        Some((low, high)) => (value.fract() == 0.0 && low <= value && value <= high).then_some(value),
        // Values of type f32 are rounded to f32.
        None if scalar == Scalar::F32 => Some((value as f32).into()),
        None => Some(value),
    }
}

/// Fast path: most words of a voxelised cloud are short integers. Without the general parser, reading is several times
/// faster.
fn small_integer(word: &[u8]) -> Option<f64> {
    if word.is_empty() || word.len() > 9 {
        return None;
    }
    let mut value = 0u32;
    for &digit in word {
        if !digit.is_ascii_digit() {
            return None;
        }
        value = value * 10 + u32::from(digit - b'0');
    }
    Some(value.into())
}
