//! Time against accuracy, as SVG.

use super::report::{Report, Row};
use super::setting::Knob;

const WIDTH: f64 = 440.0;
const HEIGHT: f64 = 330.0;
const LEFT: f64 = 56.0;
const TOP: f64 = 44.0;
const GAP: f64 = 72.0;
const FOOT: f64 = 84.0;
/// How wide a letter is, about.
const LETTER: f64 = 6.4;

/// A colour for each knob of the ladder, and what it stands for.
const COLOURS: [(Knob, &str); 8] = [
    (Knob::Default, "#111827"),
    (Knob::Level, "#1d4ed8"),
    (Knob::Heads, "#a16207"),
    (Knob::Precision, "#7c3aed"),
    (Knob::Quality, "#c2410c"),
    (Knob::Size, "#15803d"),
    (Knob::Isa, "#0e7490"),
    (Knob::Threads, "#be185d"),
];

/// One of the two plots: a title, the accuracy of a row, infinite for equal pictures, and whether the row is on a
/// front.
struct Panel {
    title: &'static str,
    accuracy: fn(&Row) -> Option<f64>,
    has_front: bool,
}

const PANELS: [Panel; 2] = [
    Panel {
        title: "Against the truth",
        accuracy: |row| row.truth.map(|truth| truth.psnr),
        has_front: true,
    },
    Panel {
        title: "Against the most accurate computation",
        accuracy: |row| Some(row.decibel()),
        has_front: false,
    },
];

/// Both plots side by side: milliseconds from stream to picture on a logarithmic scale, and PSNR in either sense.
/// Without a truth the first is empty.
pub fn plot(report: &Report) -> String {
    let (width, height) = (LEFT + 2.0 * WIDTH + GAP + 16.0, TOP + HEIGHT + FOOT);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" \
         font-family=\"sans-serif\" font-size=\"12\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n"
    );
    for (i, panel) in PANELS.iter().enumerate() {
        svg += &draw(panel, report, LEFT + i as f64 * (WIDTH + GAP));
    }
    let mut x = LEFT;
    let y = TOP + HEIGHT + 54.0;
    let used = |knob: Knob| report.ladder.iter().any(|row| row.knob == knob);
    for (knob, colour) in COLOURS.into_iter().filter(|(knob, _)| used(*knob)) {
        svg += &format!(
            "<circle cx=\"{x}\" cy=\"{:.1}\" r=\"5\" fill=\"{colour}\"/><text x=\"{}\" y=\"{y}\">{}</text>\n",
            y - 4.0,
            x + 9.0,
            knob.name()
        );
        x += 84.0;
    }
    svg += &format!(
        "<text x=\"{LEFT}\" y=\"{:.1}\" fill=\"#4b5563\">One knob at a time in colour, combinations in grey, joined where no other is \
         as good in less time. {}, {} cores.</text>\n</svg>\n",
        y + 20.0,
        escaped(&report.machine.processor),
        report.machine.cores
    );
    svg
}

fn draw(panel: &Panel, report: &Report, left: f64) -> String {
    let time = |row: &Row| row.total.median;
    let all = || {
        let all = report.ladder.iter().chain(&report.combinations);
        all.filter(|row| (panel.accuracy)(row).is_some())
    };
    let times = || all().map(|row| time(row).max(1e-3));
    let finite = || all().filter_map(|row| (panel.accuracy)(row).filter(|db| db.is_finite()));
    let bounds = |values: &mut dyn Iterator<Item = f64>| {
        values.fold((f64::INFINITY, 0.0f64), |(low, high), v| (low.min(v), high.max(v)))
    };
    if all().next().is_none() {
        return String::new();
    }
    let (fastest, slowest) = bounds(&mut times());
    let (worst, best) = bounds(&mut finite());
    let (low, high) = (worst.min(best) - 3.0, best.max(1.0) + 4.0);
    let (first, last) = (fastest.ln() - 0.1, slowest.ln() + 0.25);
    let x = |ms: f64| left + (ms.max(1e-3).ln() - first) / (last - first) * WIDTH;
    // Equal pictures lie at the upper edge.
    let y = |db: f64| TOP + HEIGHT - (db.min(high) - low) / (high - low) * HEIGHT;

    let mut svg = format!(
        "<text x=\"{left}\" y=\"{:.1}\" font-weight=\"bold\">{}: ms, PSNR in dB</text>\n\
         <rect x=\"{left}\" y=\"{TOP}\" width=\"{WIDTH}\" height=\"{HEIGHT}\" fill=\"none\" stroke=\"#d1d5db\"/>\n",
        TOP - 14.0,
        panel.title
    );
    for ms in ticks(first.exp(), last.exp()) {
        svg += &format!(
            "<path d=\"M{0:.1} {TOP}v{HEIGHT}\" stroke=\"#eef0f3\"/><text x=\"{0:.1}\" y=\"{1:.1}\" text-anchor=\"middle\">{ms}</text>\n",
            x(ms),
            TOP + HEIGHT + 16.0
        );
    }
    let step = if high - low > 40.0 {
        10
    } else if high - low > 15.0 {
        5
    } else {
        2
    };
    let from = (low / f64::from(step)).ceil() as i32 * step;
    for db in (from..=high as i32).step_by(step as usize) {
        svg += &format!(
            "<path d=\"M{left} {0:.1}h{WIDTH}\" stroke=\"#eef0f3\"/><text x=\"{1:.1}\" y=\"{2:.1}\" text-anchor=\"end\">{db}</text>\n",
            y(db.into()),
            left - 6.0,
            y(db.into()) + 4.0
        );
    }
    let accuracy = |row: &Row| (panel.accuracy)(row).unwrap_or_default();
    let at = |row: &Row| (x(time(row)), y(accuracy(row)));
    let point = |row: &Row, radius: f64, colour: &str| {
        let (x, y) = at(row);
        format!(
            "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\" fill=\"{colour}\"><title>{}: {:.2} ms, {} dB</title></circle>\n",
            escaped(&row.name()),
            time(row),
            decibel(Some(accuracy(row)).filter(|db| db.is_finite()))
        )
    };
    let on_front = |row: &&Row| panel.has_front && row.on_front;
    let mut front: Vec<&Row> = report.combinations.iter().filter(on_front).collect();
    front.sort_by(|a, b| time(a).total_cmp(&time(b)));
    let path: Vec<String> = front
        .iter()
        .map(|row| format!("{:.1} {:.1}", at(row).0, at(row).1))
        .collect();
    if !path.is_empty() {
        svg += &format!(
            "<path d=\"M{}\" fill=\"none\" stroke=\"#9ca3af\" stroke-width=\"1.5\"/>\n",
            path.join("L")
        );
    }
    for row in &report.combinations {
        svg += &point(row, if on_front(&row) { 3.5 } else { 2.5 }, "#9ca3af");
    }
    // The default last, on top of what it coincides with; names keep out of each other's way.
    let mut taken: Vec<[f64; 3]> = Vec::new();
    for row in report.ladder.iter().rev() {
        let colour = COLOURS.iter().find(|(knob, _)| *knob == row.knob);
        let colour = colour.map_or("#111827", |(_, colour)| colour);
        svg += &point(row, 5.0, colour);
        let (x, y) = at(row);
        let name = match row.knob {
            Knob::Default => "default".to_owned(),
            _ => row.name(),
        };
        let width = LETTER * name.chars().count() as f64;
        // What would reach out of the plot is named on its left.
        let start = match x + 8.0 + width > left + WIDTH {
            true => x - 8.0 - width,
            false => x + 8.0,
        };
        let free = |y: &f64| {
            let meets = |[from, to, other]: &[f64; 3]| start < *to && start + width > *from && (y - other).abs() < 11.0;
            !taken.iter().any(meets)
        };
        let places = (0..40).map(|i| {
            let step = 6.0 * f64::from((i + 1) / 2);
            y + 4.0 + if i % 2 == 0 { step } else { -step }
        });
        let y = places.into_iter().find(free).unwrap_or(y + 4.0);
        taken.push([start, start + width, y]);
        svg += &format!(
            "<text x=\"{start:.1}\" y=\"{y:.1}\" fill=\"{colour}\">{}</text>\n",
            escaped(&name)
        );
    }
    svg
}

/// 1, 2 and 5 times powers of ten.
fn ticks(low: f64, high: f64) -> Vec<f64> {
    let decades = (low.log10().floor() as i32)..=(high.log10().ceil() as i32);
    let all = decades.flat_map(|d| [1.0, 2.0, 5.0].map(|m| m * 10f64.powi(d)));
    all.filter(|t| (low..=high).contains(t)).collect()
}

/// A PSNR with one decimal; ∞ of equal pictures.
pub(super) fn decibel(psnr: Option<f64>) -> String {
    psnr.map_or("∞".into(), |db| format!("{db:.1}"))
}

/// Text as HTML and SVG take it.
pub(super) fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out += "&amp;",
            '<' => out += "&lt;",
            '>' => out += "&gt;",
            '"' => out += "&quot;",
            _ => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        let ticks = ticks(0.8, 25.0);
        assert_eq!(ticks, [1.0, 2.0, 5.0, 10.0, 20.0]);
    }

    #[test]
    fn markup_in_names_is_text() {
        assert_eq!(escaped("a<b & \"c\">"), "a&lt;b &amp; &quot;c&quot;&gt;");
    }
}
