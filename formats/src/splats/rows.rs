//! Gaussians as rows of numbers in world units, as all writers but that of PLY take them.

use b2p::gaussians::{Frame, Gaussians, Harmonics};
use b2p::{Error, Result, Up};
use rayon::prelude::*;

use super::turn::unit;

/// The spherical harmonic of degree 0: `1/(2√π)`.
pub(super) const HARMONIC: f64 = 0.282_094_791_773_878_14;
/// Minimum opacity of formats that hold logits. The maximum is 1 minus this.
const OPACITY_MARGIN: f64 = 1e-6;
/// Minimum standard deviation of formats that hold logarithms.
const LEAST_SCALE: f64 = f32::MIN_POSITIVE as f64;

/// One Gaussian.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Row {
    /// World coordinates less the offset.
    pub position: [f64; 3],
    /// Standard deviations in world units, with the blur; not negative.
    pub scale: [f64; 3],
    /// A unit quaternion w, x, y, z.
    pub rotation: [f64; 4],
    /// In [0, 1].
    pub opacity: f64,
    /// sRGB; mostly in [0, 1].
    pub colour: [f64; 3],
}

impl Row {
    /// The logarithms of the scales, which are finite.
    pub fn log_scale(&self) -> [f64; 3] {
        self.scale.map(|s| s.max(LEAST_SCALE).ln())
    }

    /// The logit of the opacity, which is finite.
    pub fn logit(&self) -> f64 {
        let opacity = self.opacity.clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
        (opacity / (1.0 - opacity)).ln()
    }

    /// The harmonics of degree 0.
    pub fn dc(&self) -> [f64; 3] {
        self.colour.map(|c| (c - 0.5) / HARMONIC)
    }
}

/// The Gaussians that have finite numbers and a rotation.
pub(super) struct Rows<'a> {
    pub gaussians: &'a Gaussians,
    /// The axis that pointed up before the scene was turned, for formats that can say so.
    pub up: Option<Up>,
    frame: Frame,
    offset: [f64; 3],
    unit: f64,
    order: Vec<u32>,
    /// Sentences about what the format does not keep.
    warnings: Vec<String>,
}

impl<'a> Rows<'a> {
    pub fn new(gaussians: &'a Gaussians, up: Option<Up>) -> Result<Self> {
        gaussians.check_lengths()?;
        if !gaussians.frame.is_valid() {
            return Err(gaussians.frame.not_valid());
        }
        if u32::try_from(gaussians.len()).is_err() {
            return Err(Error::Usage(format!("{} Gaussians are more than 2³²", gaussians.len())));
        }
        let order: Vec<u32> = (0..gaussians.len() as u32)
            .filter(|&i| is_whole(gaussians, i as usize))
            .collect();
        let frame = gaussians.frame;
        Ok(Rows {
            gaussians,
            up,
            offset: frame.offset(),
            frame,
            unit: frame.unit(),
            order,
            warnings: Vec::new(),
        })
    }

    pub fn len(&self) -> usize {
        self.order.len()
    }

    /// What is subtracted from the coordinates.
    pub fn offset(&self) -> [f64; 3] {
        self.offset
    }

    /// The cube, in the axes of the file.
    pub fn frame(&self) -> Frame {
        self.frame
    }

    /// Adds a sentence about what the format does not keep.
    pub fn warn(&mut self, warning: String) {
        self.warnings.push(warning);
    }

    /// How many Gaussians are left out, of how many.
    pub fn lost(&self) -> [usize; 2] {
        let all = self.gaussians.len();
        [all - self.len(), all]
    }

    /// What the format does not keep, beside Gaussians that are left out.
    pub fn unsaid(self) -> Vec<String> {
        self.warnings
    }

    /// Coefficients of view-dependent colour per Gaussian.
    pub fn harmonics(&self) -> usize {
        self.gaussians.harmonics.count
    }

    pub fn row(&self, i: usize) -> Row {
        let g = self.gaussians;
        let i = self.order[i] as usize;
        let blur = f64::from(g.blur.max(0.0)) * self.unit * self.unit;
        let world = g.frame.placement.from_cube(g.frame.bits, g.position[i]);
        let rotation = unit(g.rotation[i].map(f64::from));
        Row {
            position: std::array::from_fn(|k| world[k] - self.offset[k]),
            scale: g.scale[i].map(|s| {
                let s = f64::from(s).abs() * self.unit;
                if blur > 0.0 { (s * s + blur).sqrt() } else { s }
            }),
            rotation,
            opacity: f64::from(g.opacity[i]).clamp(0.0, 1.0),
            colour: g.colour[i].map(f64::from),
        }
    }

    /// All rows, in order.
    pub fn iter(&self) -> impl Iterator<Item = Row> + '_ {
        (0..self.len()).map(|i| self.row(i))
    }

    /// The coefficients of view-dependent colour of row `i`.
    pub fn coefficients(&self, i: usize) -> Vec<[f64; 3]> {
        let Harmonics { count, coefficients } = &self.gaussians.harmonics;
        let own = &coefficients[self.order[i] as usize * count..][..*count];
        own.iter().map(|c| c.map(f64::from)).collect()
    }

    /// The lowest and highest coordinates; zeros if there are no rows.
    pub fn bounds(&self) -> ([f64; 3], [f64; 3]) {
        let mut bounds = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for row in self.iter() {
            for k in 0..3 {
                bounds.0[k] = bounds.0[k].min(row.position[k]);
                bounds.1[k] = bounds.1[k].max(row.position[k]);
            }
        }
        if self.len() == 0 { ([0.0; 3], [0.0; 3]) } else { bounds }
    }

    /// Sorts the rows so that neighbours in the file are neighbours in space: along the Morton curve of the cube.
    pub fn sort_in_space(&mut self) {
        let key = |i: u32| {
            let spread = |x: f32| {
                let cell = ((x + 1.0) * 0.5 * 1_048_576.0).clamp(0.0, 1_048_575.0) as u64;
                (0..20).fold(0, |key, bit| key | (cell >> bit & 1) << (3 * bit))
            };
            let [x, y, z] = self.gaussians.position[i as usize].map(spread);
            x << 2 | y << 1 | z
        };
        let mut order: Vec<(u64, u32)> = self.order.par_iter().map(|&i| (key(i), i)).collect();
        order.par_sort_unstable();
        self.order = order.into_iter().map(|(_, i)| i).collect();
    }
}

/// A sentence about Gaussians that are left out, if there are any.
pub(super) fn loss([lost, all]: [usize; 2]) -> Option<String> {
    let what = "with numbers that are not finite, or without a rotation, are left out";
    (lost > 0).then(|| format!("{lost} of {all} Gaussians {what}"))
}

fn is_whole(g: &Gaussians, i: usize) -> bool {
    let finite = |numbers: &[f32]| numbers.iter().all(|x| x.is_finite());
    let count = g.harmonics.count;
    finite(&g.position[i])
        && finite(&g.scale[i])
        && finite(&g.rotation[i])
        && g.rotation[i] != [0.0; 4]
        && g.opacity[i].is_finite()
        && finite(&g.colour[i])
        && finite(g.harmonics.coefficients[i * count..][..count].as_flattened())
}
