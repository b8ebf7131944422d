//! E57 files, through the crate `e57`: all scans of a file, in the file's coordinates.

use std::io::Cursor;

use b2p::cloud::{Note, PointCloud, RawColours, RawPoints, Stored};
use b2p::{Axes, Error, Limits, Result, Up};
use e57::{CartesianCoordinate, E57Reader, E57Writer, Record, RecordDataType, RecordName, RecordValue};

use super::{guarded, malformed, truncated};

/// Bytes of a file's header.
const HEADER: usize = 48;
/// Bytes of a page at most. The standard has pages of 1024.
const MOST_PAGE: u64 = 1 << 20;

/// Reads all points that are valid. Colours are those of the points, else their intensities.
///
/// # Errors
/// [`Error::Malformed`], [`Error::Truncated`], [`Error::LimitExceeded`].
pub(super) fn read(bytes: &[u8], limits: &Limits, notes: &mut Vec<Note>) -> Result<RawPoints> {
    check_header(bytes)?;
    guarded("E57", || {
        let failed = |e: e57::Error| malformed("the file", "E57 data", e, "a valid file");
        let mut reader = E57Reader::new(Cursor::new(bytes)).map_err(failed)?;
        let scans = reader.pointclouds();
        let count = scans.iter().map(|scan| scan.records).fold(0, u64::saturating_add);
        limits.check_points("number of points", count)?;
        limits.check_bytes("bytes of the point cloud", count.saturating_mul(52))?;
        let crs = reader.coordinate_metadata().unwrap_or_default().to_owned();
        let mut scene = Scene::default();
        for scan in &scans {
            let has_colour = scan.has_color();
            for point in reader.pointcloud_simple(scan).map_err(failed)? {
                scene.push(&point.map_err(failed)?, has_colour);
            }
        }
        if scans.len() > 1 {
            notes.push(Note::Other(format!("joined {} scans", scans.len())));
        }
        Ok(scene.finish(crs, notes))
    })
}

/// Points of all scans.
#[derive(Default)]
struct Scene {
    positions: Vec<[f64; 3]>,
    colours: Vec<[f32; 3]>,
    grey: Vec<f32>,
    /// Points with a colour, and with an intensity.
    coloured: usize,
    measured: usize,
    invalid: u64,
}

impl Scene {
    fn push(&mut self, point: &e57::Point, has_colour: bool) {
        let CartesianCoordinate::Valid { x, y, z } = point.cartesian else {
            self.invalid += 1;
            return;
        };
        self.positions.push([x, y, z]);
        let grey = point.intensity.unwrap_or_default();
        self.measured += usize::from(point.intensity.is_some());
        self.grey.push(grey.clamp(0.0, 1.0));
        // Without colours, the crate gives the intensity as a colour.
        let colour = point.color.as_ref().filter(|_| has_colour);
        self.coloured += usize::from(colour.is_some());
        let colour = colour.map_or([grey; 3], |c| [c.red, c.green, c.blue]);
        self.colours
            .push(colour.map(|c| if c.is_finite() { c.clamp(0.0, 1.0) } else { 0.0 }));
    }

    fn finish(self, crs: String, notes: &mut Vec<Note>) -> RawPoints {
        if self.invalid > 0 {
            let of = self.invalid + self.positions.len() as u64;
            notes.push(Note::NotFinite {
                left_out: self.invalid,
                of,
            });
        }
        let colours = match (self.coloured, self.measured) {
            (1.., _) => RawColours::Rgb(self.colours, Stored::Float),
            (0, 1..) => RawColours::Grey(self.grey, Stored::Float, "intensity".into()),
            _ => RawColours::None,
        };
        RawPoints {
            positions: self.positions,
            colours,
            // The standard has metres, and scanners have z up.
            axes: Axes {
                up: Some(Up::Z),
                metres_per_unit: Some(1.0),
                crs: if crs.len() <= Axes::MAX_CRS { crs } else { String::new() },
            },
            ..RawPoints::default()
        }
    }
}

/// Checks the lengths by which memory is allocated.
fn check_header(bytes: &[u8]) -> Result<()> {
    if bytes.len() < HEADER {
        return Err(truncated(bytes.len(), "E57 header", HEADER - bytes.len()));
    }
    let number = |at: usize| {
        let mut eight = [0; 8];
        eight.copy_from_slice(&bytes[at..at + 8]);
        u64::from_le_bytes(eight)
    };
    let (xml, page) = (number(32), number(40));
    if xml > bytes.len() as u64 {
        let missing = usize::try_from(xml - bytes.len() as u64).unwrap_or(usize::MAX);
        return Err(truncated(bytes.len(), "XML of the E57 file", missing));
    }
    match (5..=MOST_PAGE).contains(&page) {
        true => Ok(()),
        false => Err(malformed(
            "byte 40",
            "size of a page",
            page,
            format!("5 to {MOST_PAGE}"),
        )),
    }
}

/// Encodes a cloud as E57 with coordinates in doubles.
///
/// # Errors
/// [`Error::Usage`] if the crate cannot write it.
pub(super) fn write(cloud: &PointCloud) -> Result<Vec<u8>> {
    let failed = |e: e57::Error| Error::Usage(format!("these points cannot be written as E57: {e}"));
    let mut file = Cursor::new(Vec::new());
    {
        let mut writer = E57Writer::new(&mut file, "b2p file").map_err(failed)?;
        if !cloud.axes.crs.is_empty() {
            writer.set_coordinate_metadata(Some(cloud.axes.crs.clone()));
        }
        let coordinate = |name| Record {
            name,
            data_type: RecordDataType::Double { min: None, max: None },
        };
        let channel = |name| Record {
            name,
            data_type: RecordDataType::Integer { min: 0, max: 255 },
        };
        let prototype = vec![
            coordinate(RecordName::CartesianX),
            coordinate(RecordName::CartesianY),
            coordinate(RecordName::CartesianZ),
            channel(RecordName::ColorRed),
            channel(RecordName::ColorGreen),
            channel(RecordName::ColorBlue),
        ];
        let mut points = writer.add_pointcloud("b2p points", prototype).map_err(failed)?;
        for (position, colour) in cloud.positions.iter().zip(&cloud.colours) {
            let mut values = Vec::with_capacity(6);
            values.extend(position.map(RecordValue::Double));
            values.extend(colour.map(|c| RecordValue::Integer(c.into())));
            points.add_point(values).map_err(failed)?;
        }
        points.finalize().map_err(failed)?;
        writer.finalize().map_err(failed)?;
    }
    Ok(file.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;
    use b2p::cloud::ReadOptions;

    fn cloud() -> PointCloud {
        PointCloud {
            positions: (0..200)
                .map(|i| [500_000.125 + f64::from(i), 0.1, -f64::from(i)])
                .collect(),
            colours: (0..200).map(|i| [i as u8, 0, 255 - i as u8]).collect(),
            axes: Axes {
                up: Some(Up::Z),
                metres_per_unit: Some(1.0),
                crs: "EPSG:32633".into(),
            },
            ..PointCloud::default()
        }
    }

    fn parse(bytes: &[u8]) -> Result<PointCloud> {
        let mut notes = Vec::new();
        Ok(read(bytes, &Limits::default(), &mut notes)?
            .finish(&ReadOptions::default())?
            .0)
    }

    #[test]
    fn written_files_read_back_equal() {
        assert_eq!(parse(&write(&cloud()).unwrap()).unwrap(), cloud());
    }

    #[test]
    fn files_that_are_cut_or_damaged_are_errors_and_nothing_panics() {
        let bytes = write(&cloud()).unwrap();
        for length in (0..bytes.len()).step_by(11) {
            assert!(parse(&bytes[..length]).is_err(), "cut at {length}");
        }
        for at in (0..bytes.len()).step_by(13) {
            let mut damaged = bytes.clone();
            damaged[at] ^= 0xff;
            // Pages have checksums.
            let _ = parse(&damaged);
        }
        let mut huge = bytes;
        huge[40..48].copy_from_slice(&u64::MAX.to_le_bytes());
        assert!(parse(&huge).unwrap_err().to_string().contains("size of a page"));
    }
}
