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
