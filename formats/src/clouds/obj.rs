//! Wavefront OBJ files of vertices, with colours after the coordinates.

use b2p::cloud::{RawColours, RawPoints, ReadOptions, Stored, is_a_mesh};
use b2p::{Limits, Result};

use super::{malformed, shown};

/// Numbers of a vertex at most: coordinates, a weight, and colours.
const MOST: usize = 7;

/// Reads the vertices of an OBJ file: `v x y z`, `v x y z r g b` or `v x y z w r g b`.
///
/// # Errors
/// [`b2p::Error::Unsupported`] if it has faces and `options` do not ask for vertices; [`b2p::Error::Malformed`] naming
/// the line; [`b2p::Error::LimitExceeded`].
pub(super) fn read(bytes: &[u8], limits: &Limits, options: &ReadOptions) -> Result<RawPoints> {
    let mut points = RawPoints::default();
    let mut colours: Vec<[f32; 3]> = Vec::new();
    let (mut faces, mut fractional) = (0, false);
    for (i, line) in bytes.split(|b| *b == b'\n').enumerate() {
        let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        match words.next() {
            Some(b"v") => {}
            Some(b"f") => {
                faces += 1;
                continue;
            }
            _ => continue,
        }
        let mut values = [0.0f64; MOST];
        let mut count = 0;
        for word in words {
            let value = std::str::from_utf8(word).ok().and_then(|word| word.parse().ok());
            let at = || format!("line {}", i + 1);
            let slot = values
                .get_mut(count)
                .ok_or_else(|| malformed(at(), "vertex", shown(line), "3 to 7 numbers"))?;
            *slot = value.ok_or_else(|| malformed(at(), "vertex", shown(word), "a number"))?;
            count += 1;
        }
        let colour = match count {
            3 | 4 => None,
            6 => Some([values[3], values[4], values[5]]),
            7 => Some([values[4], values[5], values[6]]),
            _ => {
                let expected = "3, 4, 6 or 7 numbers";
                return Err(malformed(format!("line {}", i + 1), "vertex", shown(line), expected));
            }
        };
        // All vertices before have colours, or none has.
        let before = points.positions.len();
        if before > 0 && colour.is_some() == colours.is_empty() {
            let expected = "colours at all vertices or at none";
            return Err(malformed(format!("line {}", i + 1), "vertex", shown(line), expected));
        }
        if let Some(colour) = colour {
            fractional |= colour.iter().any(|c| c.fract() != 0.0);
            colours.push(colour.map(|c| c as f32));
        }
        points.positions.push([values[0], values[1], values[2]]);
        let count = points.positions.len() as u64;
        limits.check_points("number of points", count)?;
        limits.check_bytes("bytes of the point cloud", 36 * count)?;
    }
    if faces > 0 && !options.vertices {
        let plural = if faces == 1 { "" } else { "s" };
        return Err(is_a_mesh(&format!(" of {faces} face{plural}")));
    }
    if !colours.is_empty() {
        // Floats of 0 and 1 alone are more usual than bytes of 0 and 1.
        let greatest = colours.as_flattened().iter().copied().fold(0.0, f32::max);
        let stored = if fractional || greatest <= 1.0 {
            Stored::Float
        } else {
            Stored::Integer
        };
        points.colours = RawColours::Rgb(colours, stored);
    }
    Ok(points)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str, options: &ReadOptions) -> Result<b2p::cloud::PointCloud> {
        Ok(read(text.as_bytes(), &Limits::default(), options)?.finish(options)?.0)
    }

    #[test]
    fn vertices_with_colours_are_points() {
        let options = ReadOptions::default();
        let cloud = parse(
            "# a\r\no thing\r\nv 1 2 3 0.2 0 1\r\nvn 0 0 1\r\nv 4 5 6 1 0 0\r\n",
            &options,
        )
        .unwrap();
        assert_eq!(cloud.positions, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
        assert_eq!(cloud.colours, [[51, 0, 255], [255, 0, 0]]);
        let cloud = parse("v 1 2 3 1.0 51 0 255\nv 0 0 0 1.0 1 2 3\n", &options).unwrap();
        assert_eq!(cloud.colours, [[51, 0, 255], [1, 2, 3]]);
    }

    #[test]
    fn meshes_are_refused_unless_their_vertices_are_asked_for() {
        let text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
        let error = parse(text, &ReadOptions::default()).unwrap_err().to_string();
        assert!(
            error.contains("mesh of 1 face:") && error.contains("voxelize"),
            "{error}"
        );
        let vertices = ReadOptions {
            vertices: true,
            ..ReadOptions::default()
        };
        assert_eq!(parse(text, &vertices).unwrap().positions.len(), 3);
    }

    #[test]
    fn vertices_of_mixed_kinds_are_refused_by_line() {
        for text in [
            "v 0 0 0\nv 1 2 3 1 1 1\n",
            "v 1 2 3 1 1 1\nv 0 0 0\n",
            "v 0 0\nv 1\n",
            "v 0 0 zero\n",
        ] {
            let error = parse(text, &ReadOptions::default()).unwrap_err().to_string();
            assert!(error.contains("line "), "{error}");
        }
    }
}
