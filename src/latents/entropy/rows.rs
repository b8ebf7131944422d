//! Rows of integer probabilities, and how the coder looks things up in them.

use std::borrow::Borrow;
use std::num::NonZeroU16;

use constriction::stream::model::{DecoderModel, EncoderModel, EntropyModel};

use super::tables::RawRows;
use crate::coding::ans::{BITS, Interval, PRECISION};
use crate::error::{Error, Result, Stage};

/// Quantiles are looked up by their highest bits first.
const BUCKET_BITS: u32 = 6;
const BUCKETS: usize = 1 << BUCKET_BITS;

/// Rows of different length.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Rows {
    /// Per row the sums of the entries before each entry, and 2¹⁶, which is stored as 0.
    cumulative: Vec<u16>,
    /// What every look at a row needs, close together.
    heads: Vec<Head>,
    /// Per row the entry that the first quantile of each bucket belongs to, and the last entry.
    buckets: Vec<[u16; BUCKETS + 1]>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Head {
    /// Entries before the row's first; each row before it has one sum more than entries.
    start: u32,
    /// The number of the last entry.
    escape: u16,
    low: i16,
}

/// One row.
#[derive(Clone, Copy)]
pub(super) struct Row<'a> {
    cumulative: &'a [u16],
    low: i16,
    buckets: &'a [u16; BUCKETS + 1],
}

impl Rows {
    pub(super) fn new(raw: RawRows, count: Option<usize>) -> Result<Self> {
        let RawRows {
            name,
            entries,
            offsets,
            low,
        } = raw;
        let fault = |field: &str, value: String, expected: String| {
            Err(Error::malformed(
                Stage::Entropy,
                format!("table {name}"),
                field,
                value,
                expected,
            ))
        };
        let rows = offsets.len().saturating_sub(1);
        if rows == 0 || count.is_some_and(|count| count != rows) {
            let expected = count.map_or("1 or more".into(), |count| count.to_string());
            return fault("number of rows", rows.to_string(), expected);
        }
        if low.len() != rows {
            return fault("length of low", low.len().to_string(), rows.to_string());
        }
        if offsets[0] != 0 || offsets[rows] as usize != entries.len() {
            let value = format!("{} to {}", offsets[0], offsets[rows]);
            return fault("range of offsets", value, format!("0 to {}", entries.len()));
        }
        let mut cumulative = Vec::with_capacity(entries.len() + rows);
        let (mut heads, mut buckets) = (Vec::with_capacity(rows), Vec::with_capacity(rows));
        for (row, ends) in offsets.windows(2).enumerate() {
            let Some(entries) = entries.get(ends[0] as usize..ends[1] as usize) else {
                let value = format!("{} to {}", ends[0], ends[1]);
                return fault(&format!("offsets of row {row}"), value, "ascending".into());
            };
            let sum: u64 = entries.iter().map(|&e| u64::from(e) + 1).sum();
            if entries.len() < 2 || sum != 1 << PRECISION {
                let value = format!("{} entries that sum to {sum}", entries.len());
                let expected = "2 or more that sum to 65536".into();
                return fault(&format!("row {row}"), value, expected);
            }
            if i64::from(low[row]) + entries.len() as i64 - 2 > i64::from(i16::MAX) {
                let value = format!("{} values from {}", entries.len() - 1, low[row]);
                return fault(&format!("row {row}"), value, "values of 16 bits".into());
            }
            let start = cumulative.len();
            let mut sum = 0u16;
            for &entry in entries {
                cumulative.push(sum);
                sum = sum.wrapping_add(entry).wrapping_add(1);
            }
            buckets.push(buckets_of(&cumulative[start..]));
            cumulative.push(sum);
            heads.push(Head {
                start: ends[0],
                escape: (entries.len() - 1) as u16,
                low: low[row],
            });
        }
        Ok(Rows {
            cumulative,
            heads,
            buckets,
        })
    }

    pub(super) fn len(&self) -> usize {
        self.heads.len()
    }

    #[inline]
    pub(super) fn row(&self, index: usize) -> Row<'_> {
        let Head { start, escape, low } = self.heads[index];
        Row {
            cumulative: &self.cumulative[start as usize + index..][..usize::from(escape) + 2],
            low,
            buckets: &self.buckets[index],
        }
    }
}

fn buckets_of(sums: &[u16]) -> [u16; BUCKETS + 1] {
    let mut buckets = [(sums.len() - 1) as u16; BUCKETS + 1];
    let bucket = |sum: u16| usize::from(sum).div_ceil(1 << (PRECISION - BUCKET_BITS));
    for (entry, sums) in sums.windows(2).enumerate() {
        buckets[bucket(sums[0])..bucket(sums[1])].fill(entry as u16);
    }
    buckets
}

impl Row<'_> {
    /// What the first entry stands for.
    pub(super) fn low(&self) -> i32 {
        self.low.into()
    }

    /// The last entry: everything that no other stands for.
    pub(super) fn escape(&self) -> usize {
        self.cumulative.len() - 2
    }

    /// The part of 2¹⁶ that stands for an entry.
    #[inline]
    pub(super) fn interval(&self, entry: usize) -> Interval {
        let start = self.cumulative[entry];
        // Two entries of at least 1 that sum to 2¹⁶ leave neither 0 nor 2¹⁶.
        let size = self.cumulative[entry + 1].wrapping_sub(start);
        Interval { start, size }
    }

    /// What a value has of 2¹⁶, or, if it has no entry of its own, all such values together.
    #[inline]
    pub(super) fn part(&self, value: i32) -> u32 {
        let entry = usize::try_from(value - self.low()).unwrap_or(usize::MAX);
        u32::from(self.interval(entry.min(self.escape())).size)
    }

    /// What the likeliest value has of 2¹⁶.
    pub(super) fn peak(&self) -> u32 {
        let parts = (0..self.escape()).map(|entry| u32::from(self.interval(entry).size));
        parts.max().unwrap_or(0)
    }

    /// The entry that a number lies in.
    #[inline]
    pub(super) fn find(&self, quantile: u16) -> (usize, Interval) {
        let bucket = usize::from(quantile >> (PRECISION - BUCKET_BITS));
        let first = usize::from(self.buckets[bucket]);
        let last = usize::from(self.buckets[bucket + 1]);
        let entry = first + self.cumulative[first + 1..=last].partition_point(|&sum| sum <= quantile);
        (entry, self.interval(entry))
    }
}

/// Symbols are the entries.
impl EntropyModel<BITS> for Row<'_> {
    type Symbol = usize;
    type Probability = u16;
}

impl EncoderModel<BITS> for Row<'_> {
    #[inline(always)]
    fn left_cumulative_and_probability(&self, entry: impl Borrow<usize>) -> Option<(u16, NonZeroU16)> {
        Some(self.interval(*entry.borrow()).parts())
    }
}

impl DecoderModel<BITS> for Row<'_> {
    #[inline(always)]
    fn quantile_function(&self, quantile: u16) -> (usize, u16, NonZeroU16) {
        let (entry, interval) = self.find(quantile);
        let (start, size) = interval.parts();
        (entry, start, size)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(rows: &[&[u16]], low: &[i16]) -> Result<Rows> {
        let mut offsets = vec![0];
        for row in rows {
            offsets.push(offsets[offsets.len() - 1] + row.len() as u32);
        }
        let raw = RawRows {
            name: "cdf.test",
            entries: &rows.concat(),
            offsets: &offsets,
            low,
        };
        Rows::new(raw, None)
    }

    #[test]
    fn every_quantile_finds_the_entry_it_lies_in() {
        let flat = [63u16; 1024];
        let steep: Vec<u16> = std::iter::repeat_n(0, 300).chain([65_535 - 301, 0]).collect();
        let rows = rows(&[&[0, 65_533, 0], &[32_767, 32_767], &flat, &steep], &[0; 4]).unwrap();
        for index in 0..rows.len() {
            let row = rows.row(index);
            for quantile in 0..=u16::MAX {
                let (entry, interval) = row.find(quantile);
                let Interval { start, size } = interval;
                assert!(start <= quantile && quantile - start < size);
                assert_eq!(row.interval(entry), interval);
            }
        }
    }

    #[test]
    fn unsound_tables_are_refused_by_name_and_row() {
        let good: &[u16] = &[32_767, 32_767];
        let text = |result: Result<Rows>| result.unwrap_err().to_string();
        let error = text(rows(&[good, &[1, 2, 3]], &[0, 0]));
        assert!(
            error.contains("table cdf.test: row 1 is 3 entries that sum to 9"),
            "{error}"
        );
        assert!(text(rows(&[good, &[65_535]], &[0, 0])).contains("row 1"));
        assert!(text(rows(&[good, &[]], &[0, 0])).contains("row 1"));
        assert!(text(rows(&[good, good], &[0])).contains("length of low"));
        assert!(rows(&[good, good], &[0, i16::MAX]).is_ok());
        assert!(text(rows(&[good, &[65_532, 0, 1]], &[0, i16::MAX])).contains("values of 16 bits"));
        assert!(text(rows(&[], &[])).contains("number of rows"));
    }

    #[test]
    fn offsets_that_do_not_ascend_are_refused() {
        let entries = [32_767; 4];
        for offsets in [&[0, 4, 2, 4][..], &[0, 5, 4], &[1, 4], &[0, 3], &[0], &[]] {
            let raw = RawRows {
                name: "cdf.test",
                entries: &entries,
                offsets,
                low: &[0; 3][..offsets.len().saturating_sub(1)],
            };
            assert!(Rows::new(raw, None).is_err(), "{offsets:?}");
        }
    }
}
