//! Repeated measurements, and whether two of them can be told apart.

use serde::{Deserialize, Serialize};

/// Median and quartiles of what was measured several times, in milliseconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// The first quartile.
    pub low: f64,
    /// The median.
    pub median: f64,
    /// The third quartile.
    pub high: f64,
}

/// How one measurement compares with another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// Takes less time.
    Faster,
    /// Takes more.
    Slower,
    /// Cannot be told apart: the quartiles overlap.
    Same,
}

impl Spread {
    /// Of samples in any order; quartiles between two samples are interpolated. All zero of none.
    pub fn of(samples: impl IntoIterator<Item = f64>) -> Spread {
        let mut sorted: Vec<f64> = samples.into_iter().collect();
        sorted.sort_by(f64::total_cmp);
        let Some(last) = sorted.len().checked_sub(1) else {
            return Spread::default();
        };
        let at = |share: f64| {
            let place = share * last as f64;
            let (below, above) = (place.floor() as usize, place.ceil() as usize);
            sorted[below] + (place - place.floor()) * (sorted[above] - sorted[below])
        };
        Spread {
            low: at(0.25),
            median: at(0.5),
            high: at(0.75),
        }
    }

    /// Whether this takes more or less than `other`, or that cannot be told.
    pub fn against(&self, other: &Spread) -> Verdict {
        if self.high < other.low {
            Verdict::Faster
        } else if self.low > other.high {
            Verdict::Slower
        } else {
            Verdict::Same
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quartiles_are_those_of_the_sorted_samples() {
        let spread = Spread::of([5.0, 1.0, 4.0, 2.0, 3.0]);
        assert_eq!((spread.low, spread.median, spread.high), (2.0, 3.0, 4.0));
        let two = Spread::of([2.0, 1.0]);
        assert_eq!((two.low, two.median, two.high), (1.25, 1.5, 1.75));
        assert_eq!(Spread::of([]), Spread::default());
    }

    #[test]
    fn overlapping_spreads_are_not_distinguished() {
        let spread = |low, high| Spread {
            low,
            median: (low + high) / 2.0,
            high,
        };
        let middle = spread(2.0, 4.0);
        assert_eq!(spread(1.0, 1.9).against(&middle), Verdict::Faster);
        assert_eq!(spread(1.0, 2.0).against(&middle), Verdict::Same);
        assert_eq!(spread(4.1, 5.0).against(&middle), Verdict::Slower);
    }
}
