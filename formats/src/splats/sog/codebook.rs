//! 256 numbers for many.

use rayon::prelude::*;

/// Entries of a codebook.
const ENTRIES: usize = 256;
/// Passes that move entries to the means of what they stand for.
const PASSES: usize = 12;

/// Ascending numbers, each of which stands for those nearest to it.
pub(super) struct Codebook(Vec<f32>);

impl Codebook {
    /// Exact for at most 256 different numbers; else entries start evenly spaced and move to where the numbers are.
    pub fn of(values: impl Iterator<Item = f64>) -> Self {
        // Numbers beyond single precision become the outermost that it has.
        let single = |x: f64| x.clamp(f32::MIN.into(), f32::MAX.into()) as f32;
        let mut values: Vec<f32> = values.map(single).collect();
        values.par_sort_unstable_by(f32::total_cmp);
        let mut distinct: Vec<f32> = Vec::new();
        for &value in &values {
            if distinct.last() != Some(&value) {
                distinct.push(value);
            }
            if distinct.len() > ENTRIES {
                return Codebook(fitted(&values));
            }
        }
        let last = distinct.last().copied().unwrap_or(0.0);
        distinct.resize(ENTRIES, last);
        Codebook(distinct)
    }

    /// The 256 entries.
    pub fn numbers(&self) -> &[f32] {
        &self.0
    }

    /// The index of the entry nearest to `value`.
    pub fn index(&self, value: f64) -> u8 {
        let above = self
            .0
            .partition_point(|&entry| f64::from(entry) < value)
            .min(ENTRIES - 1);
        let below = above.saturating_sub(1);
        let distance = |i: usize| (f64::from(self.0[i]) - value).abs();
        (if distance(below) <= distance(above) {
            below
        } else {
            above
        }) as u8
    }

    /// Three indices and one more byte.
    pub fn pixel(&self, values: [f64; 3], fourth: u8) -> [u8; 4] {
        let [a, b, c] = values.map(|x| self.index(x));
        [a, b, c, fourth]
    }
}

/// Lloyd's method over sorted numbers.
fn fitted(values: &[f32]) -> Vec<f32> {
    let (low, high) = (f64::from(values[0]), f64::from(values[values.len() - 1]));
    let mut entries: Vec<f64> = (0..ENTRIES)
        .map(|i| low + (high - low) * i as f64 / (ENTRIES - 1) as f64)
        .collect();
    let mut sums = vec![0.0; values.len() + 1];
    for (i, &value) in values.iter().enumerate() {
        sums[i + 1] = sums[i] + f64::from(value);
    }
    for _ in 0..PASSES {
        let mut first = 0;
        for i in 0..ENTRIES {
            let border = entries
                .get(i + 1)
                .map_or(f64::INFINITY, |next| 0.5 * (entries[i] + next));
            let end = first + values[first..].partition_point(|&x| f64::from(x) < border);
            if end > first {
                entries[i] = (sums[end] - sums[first]) / (end - first) as f64;
            }
            first = end;
        }
    }
    entries.into_iter().map(|x| x as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_numbers_are_exact() {
        let values: Vec<f64> = (0..256).map(|i| f64::from(i * i % 257) * 0.25).collect();
        let book = Codebook::of(values.iter().copied().chain(values.iter().copied()));
        for value in values {
            assert_eq!(f64::from(book.numbers()[usize::from(book.index(value))]), value);
        }
        assert_eq!(Codebook::of(std::iter::empty()).numbers().len(), 256);
    }

    #[test]
    fn numbers_beyond_single_precision_give_finite_entries() {
        let book = Codebook::of([-1e39, 0.0, 1e300].into_iter());
        assert!(book.numbers().iter().all(|x| x.is_finite()));
        assert_eq!(book.index(0.0), 1);
    }

    #[test]
    fn many_numbers_are_nearer_than_with_even_steps() {
        let values: Vec<f64> = (0..10_000).map(|i| (f64::from(i) * 0.001).exp()).collect();
        let book = Codebook::of(values.iter().copied());
        let range = values[9999] - values[0];
        let error = |x: f64| (f64::from(book.numbers()[usize::from(book.index(x))]) - x).abs();
        let mean = values.iter().map(|&x| error(x)).sum::<f64>() / 1e4;
        assert!(mean < range / 255.0 / 4.0, "{mean}");
        assert!(book.numbers().is_sorted());
    }
}
