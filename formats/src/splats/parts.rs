//! Files of Gaussians that come in parts: of formats with a row for each in the order of the Gaussians.

use std::io::Write;
use std::path::Path;

use b2p::gaussians::Gaussians;
use b2p::{Error, Result};

use super::rows::{self, Rows};
use super::turn::Turn;
use super::{Axes, Format, csv, splat, turned, up_comment};

/// Writes Gaussians part by part: what stands before the rows, and the rows of each part.
#[derive(Debug)]
pub struct PartWriter {
    format: Format,
    axes: Axes,
    turn: Option<Turn>,
    /// How many Gaussians were left out, of how many.
    lost: [usize; 2],
    unsaid: Vec<String>,
}

impl PartWriter {
    /// A writer of Gaussians whose coordinates have the axes `axes`, turned to those of the format. `None` if the format
    /// takes all Gaussians at once.
    pub fn new(axes: Axes, format: Format) -> Option<Self> {
        matches!(format, Format::Ply | Format::Splat | Format::Csv).then(|| PartWriter {
            format,
            axes,
            turn: Turn::between(axes, Axes::of(format)),
            lost: [0; 2],
            unsaid: Vec::new(),
        })
    }

    /// Whether the start of a file says how many Gaussians it has.
    pub fn has_count(&self) -> bool {
        self.format == Format::Ply
    }

    /// The start of a file of `count` Gaussians, of which `part` has some or none.
    ///
    /// # Errors
    /// [`Error::Usage`] if the frame is invalid.
    pub fn head(&self, part: &Gaussians, count: usize) -> Result<Vec<u8>> {
        let frame = part.frame;
        let like = Gaussians {
            frame: self.turn.as_ref().map_or(frame, |turn| turn.frame(frame)),
            blur: part.blur,
            compensated: part.compensated,
            harmonics: b2p::gaussians::Harmonics {
                count: part.harmonics.count,
                ..Default::default()
            },
            ..Gaussians::default()
        };
        let mut head = match self.format {
            Format::Ply => like.ply_header(count)?,
            Format::Csv => csv::header(like.harmonics.count),
            _ => String::new(),
        };
        if self.format == Format::Ply {
            // Comments come after the second line.
            let ends = head.match_indices('\n').nth(1);
            let place = ends.map_or(head.len(), |(end, _)| end + 1);
            head.insert_str(place, &up_comment(self.axes.turned_from()));
        }
        Ok(head.into_bytes())
    }

    /// Writes the rows of a part. `path` appears in error messages only.
    ///
    /// # Errors
    /// Those of [`write()`](super::write()).
    pub fn write_rows(&mut self, part: &Gaussians, to: &mut dyn Write, path: &Path) -> Result<()> {
        let part = turned(part, self.turn.as_ref());
        if self.format == Format::Ply {
            return part.write_ply_rows(to, path);
        }
        let mut rows = Rows::new(&part, self.axes.turned_from())?;
        let written = match self.format {
            Format::Csv => csv::write_rows(&rows, to),
            _ => splat::write_rows(&mut rows, to),
        };
        written.map_err(|source| Error::Io {
            path: path.to_owned(),
            source,
        })?;
        for (sum, count) in self.lost.iter_mut().zip(rows.lost()) {
            *sum += count;
        }
        self.unsaid = rows.unsaid();
        Ok(())
    }

    /// What the format could not keep, a sentence each.
    pub fn warnings(self) -> Vec<String> {
        rows::loss(self.lost).into_iter().chain(self.unsaid).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::sample;
    use super::super::write;
    use super::*;
    use b2p::Up;

    /// Gaussians from `first` on, at most so many.
    fn some(of: &Gaussians, first: usize, count: usize) -> Gaussians {
        let range = first..(first + count).min(of.len());
        let mut part = of.clone();
        part.position = of.position[range.clone()].to_vec();
        part.scale = of.scale[range.clone()].to_vec();
        part.rotation = of.rotation[range.clone()].to_vec();
        part.opacity = of.opacity[range.clone()].to_vec();
        part.colour = of.colour[range.clone()].to_vec();
        let each = of.harmonics.count;
        part.harmonics.coefficients = of.harmonics.coefficients[range.start * each..range.end * each].to_vec();
        part
    }

    #[test]
    fn parts_of_any_size_give_the_file_and_the_warnings_that_all_give_at_once() {
        for harmonics in [0, 3] {
            let mut all = sample(300, harmonics);
            all.compensated = true;
            all.opacity[7] = f32::NAN;
            all.position[290][1] = f32::INFINITY;
            for format in [Format::Ply, Format::Splat, Format::Csv] {
                for (axes, size) in [(Axes::Ply, 1), (Axes::Cloud(Up::Z), 77), (Axes::Gltf, 1000)] {
                    let (mut expected, mut bytes, path) = (Vec::new(), Vec::new(), Path::new("x"));
                    let warnings = write(&all, axes, format, &mut expected, path).unwrap();
                    let mut writer = PartWriter::new(axes, format).unwrap();
                    for first in (0..all.len()).step_by(size) {
                        let part = some(&all, first, size);
                        if first == 0 {
                            bytes = writer.head(&part, all.len()).unwrap();
                        }
                        writer.write_rows(&part, &mut bytes, path).unwrap();
                    }
                    assert!(bytes == expected, "{format}, {size} at a time");
                    assert_eq!(writer.warnings(), warnings);
                }
            }
        }
    }

    #[test]
    fn formats_that_sort_gaussians_or_have_columns_take_no_parts() {
        let takes = |format: &Format| PartWriter::new(Axes::Ply, *format).is_some();
        let formats: Vec<_> = Format::all().filter(takes).collect();
        assert_eq!(formats, [Format::Ply, Format::Splat, Format::Csv]);
        let counts = formats
            .iter()
            .map(|format| PartWriter::new(Axes::Ply, *format).unwrap().has_count());
        assert!(counts.eq([true, false, false]));
    }
}
