//! How many pictures a viewer showed, and how fast while the camera moved.

use std::time::{Duration, Instant};

use serde_json::json;

use super::painter::Picture;
use crate::manners::Said;

/// Pictures further apart than this belong to different moves.
const PAUSE: Duration = Duration::from_millis(400);

/// Pictures shown.
#[derive(Debug, Default)]
pub struct Tally {
    pictures: usize,
    /// When the last picture of the move at hand was shown.
    last: Option<Instant>,
    /// Times between pictures of the same move, and the share of pixels along each side.
    intervals: Vec<Duration>,
    scales: f64,
}

impl Tally {
    /// Counts a picture that was shown at this time.
    pub fn shown(&mut self, picture: &Picture, now: Instant) {
        self.pictures += 1;
        if !picture.moving {
            self.last = None;
            return;
        }
        if let Some(interval) = self.last.map(|last| now - last).filter(|interval| *interval < PAUSE) {
            self.intervals.push(interval);
            self.scales += f64::from(picture.drawn[0]) / f64::from(picture.size[0].max(1));
        }
        self.last = Some(now);
    }

    /// What there is to say at the end.
    pub fn said(mut self) -> Said {
        self.intervals.sort();
        let count = self.intervals.len();
        let total: Duration = self.intervals.iter().sum();
        let at = |share: f64| {
            self.intervals
                .get((share * count as f64) as usize)
                .copied()
                .unwrap_or_default()
        };
        let (median, slow) = (at(0.5), at(0.95));
        let a_second = count as f64 / total.as_secs_f64().max(1e-9);
        let scale = self.scales / count.max(1) as f64;
        let report = match crate::manners::verbose() && count > 0 {
            true => format!(
                "{} pictures shown; while the camera moved {a_second:.1} a second, each in {:.1} ms (median) or less \
                 than {:.1} ms (95 %), at {:.0} % of the width\n",
                self.pictures,
                median.as_secs_f64() * 1e3,
                slow.as_secs_f64() * 1e3,
                scale * 1e2,
            ),
            false => String::new(),
        };
        let json = || {
            json!({
                "pictures": self.pictures,
                "moving": {
                    "pictures": count,
                    "a_second": if count > 0 { a_second } else { 0.0 },
                    "ms": { "median": median.as_secs_f64() * 1e3, "p95": slow.as_secs_f64() * 1e3 },
                    "scale": scale,
                },
            })
        };
        Said::report(report, json)
    }
}
