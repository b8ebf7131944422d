//! Points as a reader of a file format found them, and what makes a [`PointCloud`] of them.

use super::colours::{ColourRange, RawColours};
use super::{Hints, PointCloud, colours, hidden, malformed, select};
use crate::axes::{Axes, Up};
use crate::error::{Error, Result};

/// Points of a file before their colours are converted and bad points are left out.
#[derive(Debug, Clone, Default)]
pub struct RawPoints {
    /// Coordinates, finite or not.
    pub positions: Vec<[f64; 3]>,
    /// Colours in the file's own range.
    pub colours: RawColours,
    /// Normals, or none. They shade points that have no colours.
    pub normals: Vec<[f32; 3]>,
    /// The voxel grid that the file names.
    pub hints: Hints,
    /// What is known of the coordinates.
    pub axes: Axes,
    /// Whether the file stated an offset, which has been added.
    pub has_offset: bool,
}

/// How points are read.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ReadOptions {
    /// Refuse what else is mended or guessed: points that are not finite, colours whose range must be guessed, points
    /// without colours.
    pub strict: bool,
    /// Range of the colours, where the format leaves it open.
    pub colour_range: Option<ColourRange>,
    /// Keep only points in this box: its lowest and its highest corner, both inclusive.
    pub crop: Option<[[f64; 3]; 2]>,
    /// Leave out points far from all others.
    pub drop_outliers: bool,
    /// Leave out points that cannot be seen from outside: inside of closed surfaces, or far behind openings that are
    /// narrower than three of 512 cells along the longest side. Takes up to 90 MB while it looks.
    pub drop_hidden: bool,
    /// The axis that points up, whatever the file says.
    pub up: Option<Up>,
    /// Metres per unit, whatever the file says.
    pub metres_per_unit: Option<f64>,
    /// Take the vertices of a mesh as points. Otherwise meshes are refused.
    pub vertices: bool,
    /// Added to the coordinates of files that state no offset of their own.
    pub offset: [f64; 3],
}

/// What was done to points when they were read, for the user.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Note {
    /// Points with a coordinate that is not finite were left out.
    NotFinite {
        /// Their number.
        left_out: u64,
        /// Number of points in the file.
        of: u64,
    },
    /// The range of colours was guessed from their maximum.
    ColourRange {
        /// The type of the values in the file.
        stored: &'static str,
        /// The greatest value.
        maximum: f64,
        /// The value that is taken as white.
        white: f64,
    },
    /// There are no colours, but grey values.
    Grey {
        /// The name of the values.
        name: String,
        /// The value that is taken as white.
        white: f64,
    },
    /// There are no colours at all.
    Shaded {
        /// What the shade was made from: `normals` or `height`.
        by: &'static str,
    },
    /// Points outside of the box were left out.
    Cropped {
        /// Their number.
        left_out: u64,
    },
    /// Points far from all others were left out.
    Outliers {
        /// Their number.
        left_out: u64,
    },
    /// Points that cannot be seen from outside were left out.
    Hidden {
        /// Their number.
        left_out: u64,
    },
    /// Something else that a reader has to say.
    Other(String),
}

impl std::fmt::Display for Note {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Note::NotFinite { left_out, of } => {
                write!(
                    f,
                    "left out {} of {}: not finite",
                    points(*left_out),
                    super::grouped(*of)
                )
            }
            Note::ColourRange { stored, maximum, white } => write!(
                f,
                "colours are {stored} of at most {maximum}: taken as 0 to {white}; --colour-range says otherwise"
            ),
            Note::Grey { name, white } => write!(f, "no colours: {name} of 0 to {white} is drawn as grey"),
            Note::Shaded { by } => write!(f, "no colours: points are shaded by their {by}"),
            Note::Cropped { left_out } => write!(f, "left out {}: outside of the box", points(*left_out)),
            Note::Outliers { left_out } => write!(f, "left out {}: far from all others", points(*left_out)),
            Note::Hidden { left_out } => write!(f, "left out {}: not seen from outside", points(*left_out)),
            Note::Other(text) => f.write_str(text),
        }
    }
}

fn points(count: u64) -> String {
    format!("{} point{}", super::grouped(count), if count == 1 { "" } else { "s" })
}

impl RawPoints {
    /// Makes a cloud: leaves out points that are not finite or outside of the box, converts colours, and leaves out
    /// outliers and hidden points. Also returns what was done.
    ///
    /// # Errors
    /// [`Error::Malformed`] if there are no points, none is left, a colour is out of range, or, if strict, something
    /// would have to be left out or guessed; [`Error::Usage`] if arrays differ in length or the box is empty.
    pub fn finish(mut self, options: &ReadOptions) -> Result<(PointCloud, Vec<Note>)> {
        let count = self.positions.len();
        let lengths = [self.colours.len().unwrap_or(count), self.normals.len()];
        if lengths[0] != count || (lengths[1] != count && lengths[1] != 0) {
            return Err(Error::Usage(format!(
                "{count} points have {lengths:?} colours and normals"
            )));
        }
        if count == 0 {
            return Err(malformed("the file", "number of points", 0, "at least one"));
        }
        if !self.has_offset && options.offset != [0.0; 3] {
            for position in &mut self.positions {
                *position = std::array::from_fn(|axis| position[axis] + options.offset[axis]);
            }
        }
        let mut notes = Vec::new();
        self.drop_not_finite(options, &mut notes)?;
        self.crop(options, &mut notes)?;
        if let Some(up) = options.up {
            self.axes.up = Some(up);
        }
        if let Some(metres) = options.metres_per_unit {
            self.axes.metres_per_unit = Some(metres);
        }
        let mut cloud = PointCloud {
            colours: Vec::new(),
            hints: self.hints,
            axes: self.axes,
            positions: self.positions,
        };
        cloud.colours = colours::convert(self.colours, &self.normals, &cloud, options, &mut notes)?;
        if options.drop_outliers {
            let keep = select::not_outliers(&cloud.positions);
            notes.push(Note::Outliers {
                left_out: keep_only(&mut cloud, &keep),
            });
        }
        if options.drop_hidden {
            let keep = hidden::not_hidden(&cloud.positions);
            notes.push(Note::Hidden {
                left_out: keep_only(&mut cloud, &keep),
            });
        }
        Ok((cloud, notes))
    }

    fn drop_not_finite(&mut self, options: &ReadOptions, notes: &mut Vec<Note>) -> Result<()> {
        let is_finite = |p: &[f64; 3]| p.iter().all(|x| x.is_finite());
        let Some(first) = self.positions.iter().position(|p| !is_finite(p)) else {
            return Ok(());
        };
        if options.strict {
            let value = format!("{:?}", self.positions[first]);
            return Err(malformed(format!("point {first}"), "position", value, "finite numbers"));
        }
        let keep: Vec<bool> = self.positions.iter().map(is_finite).collect();
        let (left_out, of) = (count_of(&keep, false), keep.len() as u64);
        self.retain(&keep);
        if self.positions.is_empty() {
            return Err(malformed("the file", "number of finite points", 0, "at least one"));
        }
        notes.push(Note::NotFinite { left_out, of });
        Ok(())
    }

    fn crop(&mut self, options: &ReadOptions, notes: &mut Vec<Note>) -> Result<()> {
        let Some([low, high]) = options.crop else {
            return Ok(());
        };
        if !(0..3).all(|i| low[i] <= high[i]) {
            return Err(Error::Usage(format!("the box from {low:?} to {high:?} is empty")));
        }
        let inside = |p: &[f64; 3]| (0..3).all(|i| (low[i]..=high[i]).contains(&p[i]));
        let keep: Vec<bool> = self.positions.iter().map(inside).collect();
        let left_out = count_of(&keep, false);
        if left_out == keep.len() as u64 {
            let (from, to) = select::bounds(&self.positions);
            return Err(Error::Usage(format!(
                "no point is in the box from {low:?} to {high:?}; the points reach from {from:?} to {to:?}"
            )));
        }
        self.retain(&keep);
        notes.push(Note::Cropped { left_out });
        Ok(())
    }

    fn retain(&mut self, keep: &[bool]) {
        retain(&mut self.positions, keep);
        retain(&mut self.normals, keep);
        self.colours.retain(keep);
    }
}

/// Keeps some points of a cloud, and returns how many others there were.
fn keep_only(cloud: &mut PointCloud, keep: &[bool]) -> u64 {
    retain(&mut cloud.positions, keep);
    retain(&mut cloud.colours, keep);
    count_of(keep, false)
}

fn count_of(keep: &[bool], value: bool) -> u64 {
    keep.iter().filter(|k| **k == value).count() as u64
}

/// Keeps the items that `keep` names. An empty list stays empty.
pub(super) fn retain<T>(items: &mut Vec<T>, keep: &[bool]) {
    let mut keep = keep.iter();
    items.retain(|_| *keep.next().unwrap_or(&false));
}
