//! Numbers in columns.

use std::time::Duration;

use b2p::log::Step;
use serde_json::{Value, json};

/// Lays rows out in columns, the first to the left, the others to the right.
pub fn table(rows: &[Vec<String>]) -> String {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |c: usize| {
        rows.iter()
            .filter_map(|r| r.get(c))
            .map(|s| s.chars().count())
            .max()
            .unwrap_or(0)
    };
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let mut text = String::new();
    for row in rows {
        let mut line = String::new();
        for (c, cell) in row.iter().enumerate() {
            let gap = " ".repeat(widths[c] - cell.chars().count());
            line += &if c == 0 {
                format!("{cell}{gap}")
            } else {
                format!("  {gap}{cell}")
            };
        }
        text += line.trim_end();
        text.push('\n');
    }
    text
}

/// What was done, how many of what, and how long it took.
pub fn steps(steps: &[Step]) -> String {
    let mut rows: Vec<Vec<String>> = steps
        .iter()
        .map(|s| vec![s.name.clone(), count(s.count), s.unit.into(), milliseconds(s.time)])
        .collect();
    let total = steps.iter().map(|s| s.time).sum();
    rows.push(vec!["total".into(), String::new(), String::new(), milliseconds(total)]);
    table(&rows)
}

/// A time in milliseconds.
pub fn milliseconds(time: Duration) -> String {
    format!("{:.1} ms", time.as_secs_f64() * 1e3)
}

/// A whole number with its thousands apart.
pub fn count(n: u64) -> String {
    let digits = n.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(' ');
        }
        text.push(digit);
    }
    text
}

/// A number of things: `1 point`, `2 points`.
pub fn counted(n: u64, thing: &str) -> String {
    let ending = if n == 1 { "" } else { "s" };
    format!("{} {thing}{ending}", count(n))
}

/// What was done, for programs.
pub fn steps_json(steps: &[Step]) -> Value {
    let step = |step: &Step| {
        json!({
            "step": step.name,
            "count": step.count,
            "unit": step.unit,
            "ms": step.time.as_secs_f64() * 1e3,
        })
    };
    steps.iter().map(step).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_line_up() {
        let rows = [vec!["a".to_string(), "1".into()], vec!["bcd".into(), "1000".into()]];
        assert_eq!(table(&rows), "a       1\nbcd  1000\n");
    }

    #[test]
    fn thousands_are_apart() {
        assert_eq!(count(1_234_567), "1 234 567");
        assert_eq!(count(999), "999");
        assert_eq!(counted(1, "point"), "1 point");
        assert_eq!(counted(2000, "point"), "2 000 points");
    }
}
