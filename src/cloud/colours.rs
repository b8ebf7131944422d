//! Colours of points: from the ranges that files store to bytes of sRGB.

use super::raw::{Note, ReadOptions, retain};
use super::{PointCloud, malformed, select};
use crate::error::Result;

/// Values of colours that are taken as white.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ColourRange {
    /// 0 to 1.
    Unit,
    /// 0 to 255.
    Bytes,
    /// 0 to 65,535.
    Shorts,
}

/// The type of numbers in a file, as far as it says what white is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stored {
    /// 8 bits: white is 255.
    Byte,
    /// 16 bits: white is 65,535, or 255 if no value is greater.
    Short,
    /// Other integers: white is 255, or 65,535 if a value is greater.
    Integer,
    /// Floats: white is 1, or 255 or 65,535 if values are greater.
    Float,
}

/// Colours as a file has them.
#[derive(Debug, Clone, Default, PartialEq)]
pub enum RawColours {
    /// None.
    #[default]
    None,
    /// Bytes of sRGB.
    Bytes(Vec<[u8; 3]>),
    /// Red, green and blue of another type.
    Rgb(Vec<[f32; 3]>, Stored),
    /// Grey values, intensities or reflectances, with their name.
    Grey(Vec<f32>, Stored, String),
}

/// The darkest and the brightest shade of points without colours.
const SHADES: [f32; 2] = [56.0, 232.0];
/// Share of the points below the darkest and above the brightest height.
const TAIL: f64 = 0.02;

impl ColourRange {
    /// The value that is white.
    pub fn white(self) -> f64 {
        match self {
            ColourRange::Unit => 1.0,
            ColourRange::Bytes => 255.0,
            ColourRange::Shorts => 65_535.0,
        }
    }
}

impl std::str::FromStr for ColourRange {
    type Err = crate::Error;

    fn from_str(text: &str) -> Result<Self> {
        match text {
            "1" => Ok(ColourRange::Unit),
            "255" => Ok(ColourRange::Bytes),
            "65535" => Ok(ColourRange::Shorts),
            _ => Err(crate::Error::Usage(format!(
                "{text:?} is no range of colours, expected 1, 255 or 65535"
            ))),
        }
    }
}

impl Stored {
    /// Its name in messages.
    pub fn name(self) -> &'static str {
        match self {
            Stored::Byte => "8-bit integers",
            Stored::Short => "16-bit integers",
            Stored::Integer => "integers",
            Stored::Float => "floats",
        }
    }

    /// The value that is white if `maximum` is the greatest, and whether that was guessed. `None` if none is sure
    /// enough.
    pub(super) fn white(self, maximum: f64) -> Option<(f64, bool)> {
        match self {
            Stored::Byte => Some((255.0, false)),
            Stored::Short if maximum > 255.0 => Some((65_535.0, false)),
            Stored::Short => Some((255.0, true)),
            Stored::Integer if maximum <= 255.0 => Some((255.0, false)),
            // Rounding may take colours a little over 1.
            Stored::Float if maximum <= 1.001 => Some((1.0, false)),
            Stored::Float if (2.0..=255.0).contains(&maximum) => Some((255.0, true)),
            Stored::Integer | Stored::Float if (256.0..=65_535.0).contains(&maximum) => Some((65_535.0, true)),
            _ => None,
        }
    }
}

impl RawColours {
    /// Their number, or `None` if there are none.
    pub fn len(&self) -> Option<usize> {
        match self {
            RawColours::None => None,
            RawColours::Bytes(values) => Some(values.len()),
            RawColours::Rgb(values, _) => Some(values.len()),
            RawColours::Grey(values, ..) => Some(values.len()),
        }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len().unwrap_or(0) == 0
    }

    pub(super) fn retain(&mut self, keep: &[bool]) {
        match self {
            RawColours::None => {}
            RawColours::Bytes(values) => retain(values, keep),
            RawColours::Rgb(values, _) => retain(values, keep),
            RawColours::Grey(values, ..) => retain(values, keep),
        }
    }
}

/// Converts the colours of `cloud`'s points to bytes.
pub(super) fn convert(
    colours: RawColours,
    normals: &[[f32; 3]],
    cloud: &PointCloud,
    options: &ReadOptions,
    notes: &mut Vec<Note>,
) -> Result<Vec<[u8; 3]>> {
    let first_note = notes.len();
    let converted = match colours {
        RawColours::Bytes(bytes) => bytes,
        RawColours::Rgb(values, stored) => {
            let white = rgb_white(&values, stored, options, notes)?;
            let bytes = |v: &[f32; 3]| v.map(|v| byte(v, white));
            values.iter().map(bytes).collect()
        }
        RawColours::Grey(values, stored, name) => {
            let white = grey_white(&values, stored, &name, options)?;
            notes.push(Note::Grey { name, white });
            values.iter().map(|v| [byte(*v, white); 3]).collect()
        }
        RawColours::None => {
            let by = if normals.is_empty() { "height" } else { "normals" };
            notes.push(Note::Shaded { by });
            match by {
                "normals" => by_normals(normals, cloud),
                _ => by_height(cloud),
            }
        }
    };
    match notes.get(first_note) {
        Some(note) if options.strict => {
            let expected = "colours of a range that is not in doubt";
            Err(malformed("the file", "what its colours are", note, expected))
        }
        _ => Ok(converted),
    }
}

/// The greatest value. Fails at values below 0 and at NaN.
fn maximum(values: impl Iterator<Item = (usize, f32)>, name: &str) -> Result<f64> {
    let mut maximum = 0f32;
    for (point, value) in values {
        if !(value >= 0.0 && value.is_finite()) {
            return Err(malformed(
                format!("point {point}"),
                name,
                value,
                "a number of 0 or more",
            ));
        }
        maximum = maximum.max(value);
    }
    Ok(maximum.into())
}

fn rgb_white(values: &[[f32; 3]], stored: Stored, options: &ReadOptions, notes: &mut Vec<Note>) -> Result<f64> {
    let all = values.as_flattened().iter().enumerate();
    let maximum = maximum(all.map(|(i, v)| (i / 3, *v)), "colour")?;
    let (white, guessed) = match options.colour_range {
        Some(range) => (range.white(), false),
        None => stored
            .white(maximum)
            .ok_or_else(|| out_of_range(values, maximum, stored))?,
    };
    // Bytes cannot hold what is brighter than white.
    if maximum > 1.001 * white {
        let expected = format!("at most {white}");
        return Err(malformed("the file", "greatest colour", maximum, expected));
    }
    if guessed {
        let stored = stored.name();
        notes.push(Note::ColourRange { stored, maximum, white });
    }
    Ok(white)
}

fn out_of_range(values: &[[f32; 3]], maximum: f64, stored: Stored) -> crate::Error {
    let is_greatest = |v: &f32| f64::from(*v) == maximum;
    let index = values.as_flattened().iter().position(is_greatest).unwrap_or(0);
    let channel = ["red", "green", "blue"][index % 3];
    let expected = match stored {
        Stored::Float => "a number from 0 to 1, to 255 or to 65535",
        _ => "a number from 0 to 255 or to 65535",
    };
    malformed(format!("point {}", index / 3), channel, maximum, expected)
}

/// White of grey values. Instruments have ranges of their own: what fits none of the usual is scaled to its maximum.
fn grey_white(values: &[f32], stored: Stored, name: &str, options: &ReadOptions) -> Result<f64> {
    let maximum = maximum(values.iter().copied().enumerate(), name)?;
    if let Some(range) = options.colour_range {
        return Ok(range.white());
    }
    Ok(match stored {
        Stored::Byte => 255.0,
        _ if maximum == 0.0 => 1.0,
        Stored::Float if maximum <= 1.001 => 1.0,
        _ if (2.0..=255.0).contains(&maximum) => 255.0,
        _ => maximum,
    })
}

fn byte(value: f32, white: f64) -> u8 {
    (f64::from(value) * 255.0 / white).round().clamp(0.0, 255.0) as u8
}

/// Grey from the angle between normals and a light above. Both sides of a surface are lit alike.
fn by_normals(normals: &[[f32; 3]], cloud: &PointCloud) -> Vec<[u8; 3]> {
    let (axis, _) = up_axis(cloud);
    let mut light = [0.4f32, 0.4, 0.4];
    light[axis] = 0.82;
    let shade = |n: &[f32; 3]| {
        let length = n.iter().map(|x| x * x).sum::<f32>().sqrt();
        let cosine = (0..3).map(|i| n[i] * light[i]).sum::<f32>().abs() / length;
        // Points whose normal is not known have a medium shade.
        let cosine = if cosine.is_finite() { cosine.min(1.0) } else { 0.5 };
        [(SHADES[0] + (SHADES[1] - SHADES[0]) * cosine).round() as u8; 3]
    };
    normals.iter().map(shade).collect()
}

/// Grey from the height, the highest points the brightest.
fn by_height(cloud: &PointCloud) -> Vec<[u8; 3]> {
    let (axis, down) = up_axis(cloud);
    let sign = if down { -1.0 } else { 1.0 };
    let height = |p: &[f64; 3]| sign * p[axis];
    let [low, high] = select::quantiles(&cloud.positions, height, [TAIL, 1.0 - TAIL]);
    let shade = |p: &[f64; 3]| {
        let share = ((height(p) - low) / (high - low)).clamp(0.0, 1.0);
        let share = if share.is_nan() { 0.5 } else { share as f32 };
        [(SHADES[0] + (SHADES[1] - SHADES[0]) * share).round() as u8; 3]
    };
    cloud.positions.iter().map(shade).collect()
}

/// The axis along which heights are measured, and whether they are negative: z if nothing is known.
fn up_axis(cloud: &PointCloud) -> (usize, bool) {
    cloud.axes.up.map_or((2, false), crate::axes::Up::axis)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::RawPoints;

    fn bytes(colours: RawColours, options: &ReadOptions) -> Result<(Vec<[u8; 3]>, Vec<Note>)> {
        let points = RawPoints {
            positions: vec![[0.0; 3]; colours.len().unwrap_or(3)],
            colours,
            ..RawPoints::default()
        };
        points.finish(options).map(|(cloud, notes)| (cloud.colours, notes))
    }

    fn rgb(values: &[f32], stored: Stored) -> RawColours {
        RawColours::Rgb(values.iter().map(|v| [*v, 0.0, 0.0]).collect(), stored)
    }

    #[test]
    fn the_greatest_value_says_what_white_is() {
        use Stored::{Byte, Float, Integer, Short};
        let cases: [(&[f32], Stored, u8, bool); 8] = [
            (&[10.0], Byte, 10, false),
            (&[200.0, 7.0], Short, 200, true),
            (&[257.0 * 200.0], Short, 200, false),
            (&[200.0], Integer, 200, false),
            (&[51_400.0], Integer, 200, true),
            (&[0.2, 1.0], Float, 51, false),
            (&[200.0], Float, 200, true),
            (&[51_400.0], Float, 200, true),
        ];
        for (values, stored, expected, guessed) in cases {
            let (colours, notes) = bytes(rgb(values, stored), &ReadOptions::default()).unwrap();
            assert_eq!(colours[0], [expected, 0, 0], "{values:?} {stored:?}");
            assert_eq!(!notes.is_empty(), guessed, "{values:?} {stored:?}: {notes:?}");
        }
    }

    #[test]
    fn a_range_that_is_given_is_used_and_not_mentioned() {
        for (range, value, expected) in [("65535", 200.0, 1), ("255", 0.9, 1), ("1", 1.0, 255)] {
            let options = ReadOptions {
                colour_range: Some(range.parse().unwrap()),
                ..ReadOptions::default()
            };
            let (colours, notes) = bytes(rgb(&[value], Stored::Float), &options).unwrap();
            assert_eq!((colours[0][0], notes.len()), (expected, 0));
        }
        let options = ReadOptions {
            colour_range: Some(ColourRange::Bytes),
            ..ReadOptions::default()
        };
        let error = bytes(rgb(&[300.0], Stored::Short), &options).unwrap_err();
        assert!(error.to_string().contains("greatest colour is 300"), "{error}");
    }

    #[test]
    fn colours_out_of_every_range_are_refused() {
        for value in [-0.5, 1.5, 7e4, f32::NAN, f32::INFINITY] {
            let error = bytes(rgb(&[0.5, value], Stored::Float), &ReadOptions::default());
            assert!(error.unwrap_err().to_string().contains("point 1"), "{value}");
        }
    }

    #[test]
    fn grey_of_any_range_is_drawn_as_grey() {
        for (values, stored, expected) in [
            ([0.0, 0.5], Stored::Float, 128),
            ([0.0, 200.0], Stored::Short, 200),
            ([1000.0, 4000.0], Stored::Short, 255),
            ([0.0, 0.0], Stored::Float, 0),
        ] {
            let grey = RawColours::Grey(values.to_vec(), stored, "intensity".into());
            let (colours, notes) = bytes(grey, &ReadOptions::default()).unwrap();
            assert_eq!(colours[1], [expected; 3]);
            assert!(notes[0].to_string().contains("intensity"));
        }
    }

    #[test]
    fn points_without_colours_are_shaded_by_normals_else_by_height() {
        let points = |normals: &[[f32; 3]]| RawPoints {
            positions: vec![[5.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.5]],
            normals: normals.to_vec(),
            ..RawPoints::default()
        };
        let (cloud, notes) = points(&[]).finish(&ReadOptions::default()).unwrap();
        let greys: Vec<u8> = cloud.colours.iter().map(|c| c[0]).collect();
        assert!(greys[0] < greys[2] && greys[2] < greys[1], "{greys:?}");
        assert_eq!(notes, [Note::Shaded { by: "height" }]);
        let normals = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0; 3]];
        let (cloud, notes) = points(&normals).finish(&ReadOptions::default()).unwrap();
        assert!(cloud.colours[0][0] > cloud.colours[1][0]);
        assert_eq!(notes, [Note::Shaded { by: "normals" }]);
    }

    #[test]
    fn strict_reading_guesses_nothing() {
        let options = ReadOptions {
            strict: true,
            ..ReadOptions::default()
        };
        assert!(bytes(rgb(&[200.0], Stored::Short), &options).is_err());
        assert!(bytes(RawColours::None, &options).is_err());
        assert!(bytes(rgb(&[0.5], Stored::Float), &options).is_ok());
    }
}
