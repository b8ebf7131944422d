//! Scores as a table and as JSON.

use std::fmt::Write;

use serde::Serialize;

use super::protocol::Scores;

/// Bits of a stream per point of the finest cloud.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Rate {
    /// All bits of the stream up to the level: header, geometry, features.
    pub total: f64,
    /// What each level takes, the base level first (its geometry being that of all levels up to it); empty if not
    /// known.
    pub levels: Vec<LevelRate>,
}

/// What a level takes, in bits per point of the finest cloud.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LevelRate {
    /// The octree level.
    pub level: u8,
    /// Bits of the octree.
    pub geometry: f64,
    /// Bits of the latents.
    pub features: f64,
}

/// One way to draw one item.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// The item.
    pub name: String,
    /// How it was drawn.
    pub drawn: String,
    /// The level that was decoded, for streams.
    pub level: Option<u8>,
    /// What it costs, if known.
    pub rate: Option<Rate>,
    /// How many squares or Gaussians were drawn.
    pub primitives: usize,
    /// Means over the views.
    pub scores: Scores,
    /// View by view, from azimuth 0 on.
    pub views: Vec<Scores>,
}

/// Everything that one run found out.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// The mesh that is the truth.
    pub mesh: String,
    /// Bit depth of the grid.
    pub bits: u8,
    /// Points of the cloud at that depth, over which bits are counted, if known.
    pub points: Option<u64>,
    /// What was judged.
    pub rows: Vec<Row>,
}

impl Report {
    /// The scores as a Markdown table, and the rates of streams, level by level, as another.
    pub fn to_markdown(&self) -> String {
        let mut text = String::from(
            "| item | drawn as | bpp | PSNR dB | foreground dB | MS-SSIM | SSIMULACRA2 | primitives |\n\
             |---|---|---:|---:|---:|---:|---:|---:|\n",
        );
        for row in &self.rows {
            let bpp = match &row.rate {
                Some(rate) => format!("{:.4}", rate.total),
                None => "–".into(),
            };
            let s = &row.scores;
            // Writing to a string cannot fail.
            let _ = writeln!(
                text,
                "| {} | {} | {bpp} | {:.2} | {:.2} | {:.4} | {:.2} | {} |",
                row.name, row.drawn, s.psnr, s.foreground_psnr, s.ms_ssim, s.ssimulacra2, row.primitives
            );
        }
        let mut levels = String::new();
        for row in &self.rows {
            // A row of a deeper level tells those above it too.
            let count = |row: &Row| row.rate.as_ref().map_or(0, |rate| rate.levels.len());
            let same = |other: &&Row| other.name == row.name;
            if self.rows.iter().filter(same).any(|other| count(other) > count(row)) {
                continue;
            }
            for level in row.rate.iter().flat_map(|r| &r.levels) {
                let (name, number) = (&row.name, level.level);
                let (geometry, features) = (level.geometry, level.features);
                let _ = writeln!(levels, "| {name} | {number} | {geometry:.4} | {features:.4} |");
            }
        }
        if !levels.is_empty() {
            text += "\n| item | level | geometry bpp | feature bpp |\n|---|---:|---:|---:|\n";
            text += &levels;
        }
        text
    }

    /// The whole report as JSON; an infinite PSNR, of equal pictures, is null.
    ///
    /// # Errors
    /// None for a report; the writer's contract has one.
    pub fn to_json(&self) -> serde_json::Result<String> {
        serde_json::to_string_pretty(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(psnr: f64, levels: Vec<LevelRate>) -> Report {
        let scores = Scores {
            psnr,
            foreground_psnr: 25.0,
            ms_ssim: 0.98,
            ssimulacra2: 61.5,
        };
        let row = Row {
            name: "a".into(),
            drawn: "squares ×1".into(),
            level: None,
            rate: Some(Rate { total: 0.4, levels }),
            primitives: 10,
            scores,
            views: vec![scores],
        };
        Report {
            mesh: "m".into(),
            bits: 10,
            points: Some(100),
            rows: vec![row],
        }
    }

    #[test]
    fn the_table_has_a_line_per_row_and_levels_only_for_streams() {
        let plain = report(26.1, Vec::new()).to_markdown();
        assert_eq!(plain.lines().count(), 3);
        assert!(plain.contains("| a | squares ×1 | 0.4000 | 26.10 | 25.00 | 0.9800 | 61.50 | 10 |"));
        let level = LevelRate {
            level: 8,
            geometry: 0.05,
            features: 0.2,
        };
        let stream = report(26.1, vec![level]).to_markdown();
        assert!(stream.contains("| a | 8 | 0.0500 | 0.2000 |"));
    }

    #[test]
    fn levels_are_reported_once_by_the_deepest_row_of_an_item() {
        let level = |level| LevelRate {
            level,
            geometry: 0.05,
            features: 0.2,
        };
        let mut both = report(26.1, vec![level(8), level(9)]);
        both.rows.extend(report(25.0, vec![level(8)]).rows);
        let text = both.to_markdown();
        assert_eq!(text.matches("| a | 8 |").count(), 1);
        assert_eq!(text.matches("| a | 9 |").count(), 1);
    }

    #[test]
    fn json_holds_the_scores_and_null_for_equal_pictures() {
        let json = report(f64::INFINITY, Vec::new()).to_json().unwrap();
        let value: serde_json::Value = serde_json::from_str(&json).unwrap();
        assert!(value["rows"][0]["scores"]["psnr"].is_null());
        assert_eq!(value["rows"][0]["views"][0]["ms_ssim"], 0.98);
    }
}
