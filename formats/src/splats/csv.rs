//! Comma-separated values: a line of names, then a line per Gaussian.
//!
//! Names and numbers are those of PLY files, and coordinates those of the world, to the last digit.

use std::io::{self, Write};

use b2p::gaussians::Gaussians;
use b2p::{Limits, Result};

use super::builder::{self, Builder};
use super::bytes::malformed;
use super::rows::{HARMONIC, Row, Rows};

const NAMES: [&str; 14] = [
    "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2",
    "rot_3",
];

/// Whether the first line has the names.
pub(super) fn is_csv(bytes: &[u8]) -> bool {
    let line = bytes.split(|&byte| byte == b'\n').next().unwrap_or_default();
    let names = std::str::from_utf8(&line[..line.len().min(4096)]).unwrap_or_default();
    let names: Vec<&str> = names.split(',').map(clean).collect();
    NAMES.iter().all(|name| names.contains(name))
}

/// A field without spaces and quotes.
fn clean(field: &str) -> &str {
    field.trim().trim_matches('"')
}

pub(super) fn read(bytes: &[u8], limits: &Limits) -> Result<(Gaussians, Vec<String>)> {
    let text = std::str::from_utf8(bytes);
    let text = text.map_err(|e| malformed(format!("byte {}", e.valid_up_to()), "text", "not UTF-8", "UTF-8"))?;
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let mut lines = text
        .lines()
        .enumerate()
        .map(|(i, line)| (i + 1, line))
        .filter(|(_, line)| !line.trim().is_empty());
    let names: Vec<&str> = lines
        .next()
        .map_or(Vec::new(), |(_, line)| line.split(',').map(clean).collect());
    let place = |name: &str| {
        let place = names.iter().position(|known| *known == name);
        place.ok_or_else(|| malformed("line 1", format!("column {name}"), "absent", "a column of this name"))
    };
    let mut places = [0; NAMES.len()];
    for (to, name) in places.iter_mut().zip(NAMES) {
        *to = place(name)?;
    }
    let rest = (0..45)
        .take_while(|k| names.contains(&format!("f_rest_{k}").as_str()))
        .count();
    let harmonics = if [9, 24, 45].contains(&rest) { rest / 3 } else { 0 };
    let rest: Vec<usize> = (0..3 * harmonics)
        .map(|k| place(&format!("f_rest_{k}")))
        .collect::<Result<_>>()?;

    let count = lines.clone().count() as u64;
    builder::check(count, harmonics, limits)?;
    let mut builder = Builder::new(count, harmonics, limits)?;
    let mut numbers = vec![0.0; names.len()];
    for (line, text) in lines {
        let at = || format!("line {line}");
        let mut fields = text.split(',');
        for (number, name) in numbers.iter_mut().zip(&names) {
            let field = fields.next();
            let field = field.ok_or_else(|| malformed(at(), format!("column {name}"), "absent", "a number"))?;
            let parsed = clean(field).parse();
            *number = parsed.map_err(|_| malformed(at(), format!("column {name}"), clean(field), "a number"))?;
        }
        if fields.next().is_some() {
            return Err(malformed(
                at(),
                "number of fields",
                text.split(',').count(),
                names.len(),
            ));
        }
        let of = |k: usize| numbers[places[k]];
        builder.push(Row {
            position: [of(0), of(1), of(2)],
            colour: [of(3), of(4), of(5)].map(|c| 0.5 + HARMONIC * c),
            opacity: 1.0 / (1.0 + (-of(6)).exp()),
            scale: [of(7), of(8), of(9)].map(f64::exp),
            rotation: [of(10), of(11), of(12), of(13)],
        });
        builder.push_coefficients(
            (0..harmonics).map(|k| std::array::from_fn(|channel| numbers[rest[channel * harmonics + k]])),
        );
    }
    Ok((builder.finish(None), Vec::new()))
}

/// The line of names, where each Gaussian has so many harmonics.
pub(super) fn header(harmonics: usize) -> String {
    let mut line = NAMES.join(",");
    (0..3 * harmonics).for_each(|k| line += &format!(",f_rest_{k}"));
    line + "\n"
}

pub(super) fn write_rows(rows: &Rows, to: &mut dyn Write) -> io::Result<()> {
    let offset = rows.offset();
    for (i, row) in rows.iter().enumerate() {
        let [x, y, z]: [f64; 3] = std::array::from_fn(|k| row.position[k] + offset[k]);
        let mut line = match offset == [0.0; 3] {
            true => format!("{},{},{}", x as f32, y as f32, z as f32),
            // Single precision does not resolve these.
            false => format!("{x},{y},{z}"),
        };
        let numbers = row
            .dc()
            .into_iter()
            .chain([row.logit()])
            .chain(row.log_scale())
            .chain(row.rotation);
        numbers.for_each(|x| line += &format!(",{}", x as f32));
        let coefficients = rows.coefficients(i);
        for channel in 0..3 {
            coefficients
                .iter()
                .for_each(|c| line += &format!(",{}", c[channel] as f32));
        }
        writeln!(to, "{line}")?;
    }
    Ok(())
}
