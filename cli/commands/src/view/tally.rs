//! How many pictures a viewer showed, and how fast while the camera moved.

use std::time::{Duration, Instant};

use serde_json::json;

use super::painter::Picture;
use super::source::Arrived;
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
    played: Played,
}

/// Frames of sequences.
#[derive(Debug, Default)]
struct Played {
    frames: u64,
    /// When the first and the last one were shown.
    first: Option<Instant>,
    last: Option<Instant>,
    dropped: u64,
    /// Times that frames were skipped because they are damaged.
    skips: u64,
    /// Frames of each level and heads.
    made: std::collections::BTreeMap<String, u64>,
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

    /// Counts frames of sequences.
    pub fn arrived(&mut self, arrived: &Arrived, now: Instant) {
        let played = &mut self.played;
        match arrived {
            Arrived::Skipped(_) => played.skips += 1,
            Arrived::Scene(scene) => {
                let Some(frame) = scene.frame else { return };
                played.frames += 1;
                played.first.get_or_insert(now);
                played.last = Some(now);
                played.dropped = frame.dropped;
                if let Some((level, heads)) = scene.made {
                    *played.made.entry(format!("level {level}, {heads}")).or_default() += 1;
                }
            }
            _ => {}
        }
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
        let played = self.played.json();
        let mut report = match crate::manners::verbose() && count > 0 {
            true => format!(
                "{} pictures shown; while the camera or a sequence moved {a_second:.1} a second, each in {:.1} ms (median) or less \
                 than {:.1} ms (95 %), at {:.0} % of the width\n",
                self.pictures,
                median.as_secs_f64() * 1e3,
                slow.as_secs_f64() * 1e3,
                scale * 1e2,
            ),
            false => String::new(),
        };
        if crate::manners::verbose() {
            report += &self.played.report();
        }
        let json = || {
            json!({
                "pictures": self.pictures,
                "sequence": played,
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

impl Played {
    fn a_second(&self) -> f64 {
        match self.last.zip(self.first) {
            Some((last, first)) if last > first => (self.frames - 1) as f64 / (last - first).as_secs_f64(),
            _ => 0.0,
        }
    }

    fn json(&self) -> serde_json::Value {
        json!({
            "frames": self.frames,
            "a_second": self.a_second(),
            "dropped": self.dropped,
            "skips": self.skips,
            "made": self.made,
        })
    }

    /// A line, if a sequence was played.
    fn report(&self) -> String {
        if self.frames + self.skips == 0 {
            return String::new();
        }
        let made = self.made.iter().map(|(how, count)| format!("{count} at {how}"));
        format!(
            "{} frames of a sequence shown, {:.1} a second ({}); {} dropped; skipped {} times\n",
            self.frames,
            self.a_second(),
            made.collect::<Vec<_>>().join("; "),
            self.dropped,
            self.skips
        )
    }
}
