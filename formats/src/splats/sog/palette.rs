//! A palette of view-dependent colours: the harmonics of many Gaussians as those of at most 65,536.

use std::collections::BinaryHeap;

use crate::splats::rows::Rows;

/// Entries that labels of 16 bits can name.
const ENTRIES: usize = 1 << 16;

pub(super) struct Palette {
    /// Of every entry its coefficients.
    pub entries: Vec<[f32; 3]>,
    /// Of every row the entry.
    pub labels: Vec<u16>,
}

/// Rows that share an entry so far.
struct Group {
    /// Squared error along `axis`, which splitting would lessen.
    error: f64,
    axis: usize,
    mean: f64,
    rows: Vec<u32>,
}

impl Palette {
    /// Exact for at most 65,536 rows. Else the group of rows with the largest error along a coefficient is halved at
    /// its mean until there are enough groups.
    pub fn of(rows: &Rows) -> Self {
        let count = rows.harmonics();
        let all: Vec<[f32; 3]> = (0..rows.len())
            .flat_map(|i| rows.coefficients(i))
            .map(|c| c.map(|x| x as f32))
            .collect();
        if rows.len() <= ENTRIES {
            return Palette {
                entries: all,
                labels: (0..rows.len()).map(|i| i as u16).collect(),
            };
        }
        Palette::grouped(all.as_flattened(), 3 * count, ENTRIES)
    }

    fn grouped(vectors: &[f32], width: usize, entries: usize) -> Self {
        let rows: Vec<u32> = (0..(vectors.len() / width) as u32).collect();
        let count = rows.len();
        let mut groups = BinaryHeap::from([Group::of(rows, vectors, width)]);
        while groups.len() < entries {
            let Some(group) = groups.pop() else { break };
            if group.error <= 0.0 {
                groups.push(group);
                break;
            }
            let value = |row: &u32| f64::from(vectors[*row as usize * width + group.axis]);
            let (low, high): (Vec<u32>, Vec<u32>) = group.rows.iter().partition(|row| value(row) < group.mean);
            groups.push(Group::of(low, vectors, width));
            groups.push(Group::of(high, vectors, width));
        }
        let mut palette = Palette {
            entries: Vec::with_capacity(groups.len() * width / 3),
            labels: vec![0; count],
        };
        for (label, group) in groups.iter().enumerate() {
            let mean = |axis: usize| group.mean_along(vectors, width, axis) as f32;
            palette
                .entries
                .extend((0..width / 3).map(|k| [mean(3 * k), mean(3 * k + 1), mean(3 * k + 2)]));
            group
                .rows
                .iter()
                .for_each(|&row| palette.labels[row as usize] = label as u16);
        }
        palette
    }
}

impl Group {
    fn of(rows: Vec<u32>, vectors: &[f32], width: usize) -> Self {
        let mut sums = vec![(0.0, 0.0); width];
        for &row in &rows {
            let vector = &vectors[row as usize * width..][..width];
            for (sum, &x) in sums.iter_mut().zip(vector) {
                let x = f64::from(x);
                *sum = (sum.0 + x, sum.1 + x * x);
            }
        }
        let count = rows.len().max(1) as f64;
        let error = |(sum, squares): &(f64, f64)| squares - sum * sum / count;
        let axis = (0..width)
            .max_by(|&a, &b| error(&sums[a]).total_cmp(&error(&sums[b])))
            .unwrap_or(0);
        let mut group = Group {
            error: error(&sums[axis]),
            axis,
            mean: sums[axis].0 / count,
            rows,
        };
        // Rounding makes errors of equal rows positive: nothing could be split.
        let values = group
            .rows
            .iter()
            .map(|&row| f64::from(vectors[row as usize * width + axis]));
        if values.clone().all(|x| x >= group.mean) || values.clone().all(|x| x < group.mean) {
            group.error = 0.0;
        }
        group
    }

    fn mean_along(&self, vectors: &[f32], width: usize, axis: usize) -> f64 {
        let values = self
            .rows
            .iter()
            .map(|&row| f64::from(vectors[row as usize * width + axis]));
        values.sum::<f64>() / self.rows.len().max(1) as f64
    }
}

impl Ord for Group {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        // The first row makes the order of equal errors certain.
        self.error
            .total_cmp(&other.error)
            .then_with(|| other.rows.first().cmp(&self.rows.first()))
    }
}

impl PartialOrd for Group {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Group {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Group {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_palette_has_the_means_of_the_rows_that_share_an_entry() {
        let vectors: Vec<f32> = (0..300).flat_map(|i| [(i % 5) as f32, (i % 3) as f32, 1.0]).collect();
        let palette = Palette::grouped(&vectors, 3, 64);
        // 15 different vectors: as many entries, each exact.
        assert_eq!(palette.entries.len(), 15);
        for (row, label) in vectors.chunks(3).zip(&palette.labels) {
            assert_eq!(palette.entries[usize::from(*label)], row);
        }
        let coarse = Palette::grouped(&vectors, 3, 4);
        assert_eq!(coarse.entries.len(), 4);
        let error = |row: &[f32], label: u16| (row[0] - coarse.entries[usize::from(label)][0]).abs();
        assert!(
            vectors
                .chunks(3)
                .zip(&coarse.labels)
                .all(|(row, &label)| error(row, label) <= 1.0)
        );
    }
}
