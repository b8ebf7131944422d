//! The report as one HTML page that needs nothing else.

use super::TruthKind;
use super::effects::EffectCost;
use super::hard_cases::{BOUND, HardCase};
use super::plot::{decibel, escaped, plot};
use super::report::{Report, Row, STAGES};
use super::setting::Knob;
use b2p::Result;
use b2p::metrics::{Spread, Verdict};
use b2p::renderer::Image;

/// How many times larger differences are shown.
const GAIN: f32 = 8.0;

const STYLE: &str = "body{font:15px/1.45 system-ui,sans-serif;max-width:1080px;margin:2em auto;padding:0 1em;color:#111827}\
h1{font-size:1.5em}h2{font-size:1.15em;margin-top:2em}table{border-collapse:collapse;font-size:13px;font-variant-numeric:tabular-nums}\
th,td{padding:3px 8px;text-align:right;border-bottom:1px solid #e5e7eb;white-space:nowrap}th:first-child,td:first-child{text-align:left}\
td small,p small{color:#6b7280}svg{max-width:100%;height:auto}.crops td{text-align:center}\
.crops img{width:168px;image-rendering:pixelated;border:1px solid #d1d5db}.wide{overflow-x:auto}";

/// The page: plot, tables, and cut-outs of the worst differences.
///
/// # Errors
/// Those of [`Image::to_png`](b2p::renderer::Image::to_png).
pub fn page(report: &Report) -> Result<String> {
    let machine = &report.machine;
    let [width, height] = report.size;
    let mut html = format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>What accuracy costs in time</title>\
         <style>{STYLE}</style></head><body>\n<h1>What accuracy costs in time</h1>\n\
         <p>{}, {} cores, {}; b2p {}. {} of {width}×{height} pixels, medians of {} repeats in turns.</p>\n",
        escaped(&machine.processor),
        machine.cores,
        escaped(&machine.isa),
        escaped(&machine.version),
        if report.views == 1 {
            "One view".into()
        } else {
            format!("{} views", report.views)
        },
        report.repeats,
    );
    html += &format!(
        "<p>Accuracy has two senses. <b>Computation</b>: against the same stream, its finest level made by the best heads in \
         double precision ({:.1} s) and drawn in double precision without any cut-off ({:.1} s a picture): PSNR over all pixels, \
         MS-SSIM, the worst pixel in steps of eight bits. <b>Truth</b>: {}. ≈ marks times that cannot be told from the \
         default's: their quartiles overlap. Smaller pictures are enlarged before they are compared.</p>\n{}",
        report.double_ms[0] / 1e3,
        report.double_ms[1] / 1e3,
        match report.truth {
            Some(TruthKind::Mesh) => "against pictures of the mesh",
            Some(TruthKind::Cloud) => "against pictures of the cloud that was coded, as surfels",
            None => "not at hand, name a mesh or give a cloud",
        },
        plot(report)
    );
    html += "<h2>One knob at a time</h2>\n";
    html += &table(&report.ladder);
    html += "<h2>Combinations that no other beats</h2>\n<p>From stream to picture:</p>\n";
    html += &table(&front(report, |row| row.on_front, |row| row.total.median));
    html += "<p>Each further picture:</p>\n";
    html += &table(&front(report, |row| row.on_picture_front, |row| row.picture.median));
    html += "<h2>By stage</h2>\n";
    html += &stages(&report.ladder);
    html += &format!(
        "<h2>The worst pixels</h2>\n<p>As it should be, as it is, and the difference, {GAIN:.0} times as large, on grey.</p>\n"
    );
    html += &crops(&report.ladder)?;
    html += &format!(
        "<h2>Hard cases</h2>\n<p>The worst pixel in steps of eight bits against double precision; bold above {BOUND:.0}. Of the renderer:</p>\n{}\
         <p>Of the network:</p>\n{}",
        cases(&report.renderer_cases),
        cases(&report.network_cases)
    );
    html += "<h2>Effects</h2>\n<p>Milliseconds of a picture with each forced off and on; the worst pixel of a small picture with it on, against double \
         precision with the same effect.</p>\n";
    html += &effects(&report.effects);
    html += "<h2>The stream</h2>\n<table><tr><th>level</th><th>voxels</th><th>bytes up to here</th></tr>\n";
    for level in &report.levels {
        html += &format!(
            "<tr><td>{}</td><td>{}</td><td>{}</td></tr>\n",
            level.level, level.voxels, level.bytes
        );
    }
    html += "</table>\n</body></html>\n";
    Ok(html)
}

/// The combinations of a front, the fastest first.
fn front(report: &Report, on: fn(&Row) -> bool, time: fn(&Row) -> f64) -> Vec<Row> {
    let mut rows: Vec<Row> = report.combinations.iter().filter(|r| on(r)).cloned().collect();
    rows.sort_by(|a, b| time(a).total_cmp(&time(b)));
    rows
}

fn spread(spread: Spread, verdict: Verdict) -> String {
    let same = if verdict == Verdict::Same { "≈ " } else { "" };
    let digits = if spread.median < 100.0 { 2 } else { 0 };
    format!(
        "{same}{:.digits$} <small>{:.digits$}–{:.digits$}</small>",
        spread.median, spread.low, spread.high
    )
}

fn named(row: &Row) -> String {
    match row.knob {
        Knob::Default => format!("default: {}", row.name()),
        Knob::Combination => row.name(),
        knob => format!("{}: {}", knob.name(), row.name()),
    }
}

fn table(rows: &[Row]) -> String {
    let has_truth = rows.iter().any(|row| row.truth.is_some());
    let mut html = format!(
        "<div class=\"wide\"><table><tr><th>setting</th><th>decode, ms</th><th>picture, ms</th><th>both, ms</th><th>computation, dB</th>\
         <th>MS-SSIM</th><th>worst</th>{}<th>MB at most</th></tr>\n",
        if has_truth {
            "<th>truth, dB</th><th>SSIMULACRA2</th>"
        } else {
            ""
        }
    );
    for row in rows {
        // The default is the same as itself.
        let [decode, picture] = match row.knob {
            Knob::Default => [Verdict::Faster; 2],
            _ => [row.decode_verdict, row.picture_verdict],
        };
        html += &format!(
            "<tr><td>{}</td><td>{}</td><td>{}</td><td>{:.1}</td><td>{}</td><td>{}</td><td>{:.2}</td>{}<td>{}</td></tr>\n",
            escaped(&named(row)),
            spread(row.decode, decode),
            spread(row.picture, picture),
            row.total.median,
            decibel(row.psnr),
            row.ms_ssim.map_or("–".into(), |s| format!("{s:.5}")),
            row.worst,
            row.truth.map_or(String::new(), |truth| {
                let score = truth.ssimulacra2.map_or("–".into(), |score| format!("{score:.1}"));
                format!("<td>{:.2}</td><td>{score}</td>", truth.psnr)
            }),
            row.most_memory / 1_000_000,
        );
    }
    html + "</table></div>\n"
}

fn stages(rows: &[Row]) -> String {
    let mut html = String::from("<div class=\"wide\"><table><tr><th>setting, ms</th>");
    for stage in STAGES {
        html += &format!("<th>{stage}</th>");
    }
    html += "</tr>\n";
    for row in rows {
        html += &format!("<tr><td>{}</td>", escaped(&named(row)));
        for stage in row.stages {
            html += &format!("<td>{:.2}</td>", stage.median);
        }
        html += "</tr>\n";
    }
    html + "</table></div>\n"
}

fn cases(cases: &[HardCase]) -> String {
    let mut html = String::from("<div class=\"wide\"><table><tr><th>case</th>");
    for error in cases.first().map_or(&[][..], |case| &case.errors) {
        html += &format!("<th>{}</th>", escaped(&error.setting));
    }
    html += "</tr>\n";
    for case in cases {
        html += &format!("<tr><td>{}</td>", escaped(&case.name));
        for error in &case.errors {
            let (open, close) = match error.worst > BOUND {
                true => ("<b>", "</b>"),
                false => ("", ""),
            };
            html += &format!("<td>{open}{:.2}{close}</td>", error.worst);
        }
        html += "</tr>\n";
    }
    html + "</table></div>\n"
}

fn effects(effects: &[EffectCost]) -> String {
    let mut html = String::from(
        "<div class=\"wide\"><table><tr><th>effect</th><th>scene</th><th>called for</th><th>off, ms</th><th>on, ms</th><th>worst</th></tr>\n",
    );
    for cost in effects {
        html += &format!(
            "<tr><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{:.2}</td></tr>\n",
            escaped(&cost.effect),
            escaped(&cost.scene),
            if cost.called_for { "yes" } else { "no" },
            spread(cost.off, Verdict::Faster),
            spread(cost.on, cost.verdict),
            cost.worst
        );
    }
    html + "</table></div>\n"
}

fn crops(rows: &[Row]) -> Result<String> {
    let mut html = String::from("<table class=\"crops\">\n");
    for row in rows {
        let Some(crop) = row.crop.as_ref().filter(|_| row.worst > 0.0) else {
            continue;
        };
        html += &format!(
            "<tr><td>{}<br><small>{:.2} of 255, view {}, pixel {}, {}</small></td>",
            escaped(&named(row)),
            row.worst,
            row.worst_at[0],
            row.worst_at[1],
            row.worst_at[2]
        );
        for image in [&crop.truth, &crop.picture, &crop.difference(GAIN)] {
            html += &format!("<td><img alt=\"\" src=\"{}\"></td>", data_uri(image)?);
        }
        html += "</tr>\n";
    }
    Ok(html + "</table>\n")
}

/// A picture as a PNG within the page.
fn data_uri(image: &Image) -> Result<String> {
    Ok(format!("data:image/png;base64,{}", base64(&image.to_png()?)))
}

/// RFC 4648, with padding.
fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let byte = |i: usize| u32::from(chunk.get(i).copied().unwrap_or_default());
        let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
        for digit in 0..4 {
            let value = (bits >> (18 - 6 * digit)) & 63;
            text.push(match digit <= chunk.len() {
                true => char::from(DIGITS[value as usize]),
                false => '=',
            });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_is_that_of_the_standard_s_examples() {
        let pairs = [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foob", "Zm9vYg=="),
            ("fooba", "Zm9vYmE="),
            ("foobar", "Zm9vYmFy"),
        ];
        for (plain, coded) in pairs {
            assert_eq!(base64(plain.as_bytes()), coded);
        }
    }
}
