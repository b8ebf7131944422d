//! From Gaussians to ellipses on the picture.
//!
//! A Gaussian with axes `R·S` is seen as the image of its centre and the 2×2 covariance `M·Mᵀ + b·I`, where `M =
//! J·W·R·S` and `J` is the derivative of the pinhole projection at the centre (EWA splatting), and `b` the Gaussians'
//! own blur ([`Gaussians::blur`]) at that distance, or the pixel's ([`Gaussians::pixel_blur`]) if that is more. The
//! covariance is never formed and inverted, which loses a long thin ellipse to cancellation in single precision; the
//! kernel has the formulas ([`b2p_kernels::splat`]).
//!
//! [`Ellipses::project`] is the sole gate of visibility: its conditions are phrased so that NaN fails them, and
//! everything after it may assume finite numbers, a depth beyond the near plane, and at least one pixel.

#[cfg(test)]
mod reference;
mod space;

use std::ops::Range;

use b2p_kernels::Isa;
use b2p_kernels::splat::{self, Cloud, Crossing, Tally, View};
use rayon::iter::repeat_n;
use rayon::prelude::*;

pub use b2p_kernels::splat::{Bounds, Ellipse, MAX_SCALE};

use crate::error::{Error, Result};
use crate::gaussians::Gaussians;
use crate::renderer::camera::{Camera, Projection};

/// Gaussians are projected in runs of at least so many, and at most [`RUNS`] runs a thread.
const LEAST_RUN: usize = 2048;
const RUNS: usize = 4;
/// Gaussians that are projected before anybody looks at them: their ellipses take 32 KB. A multiple of all numbers of
/// lanes.
const PIECE: usize = 512;
/// The most runs: what is kept for each of them is kept for every tile.
const MOST_RUNS: usize = 64;

/// The visible Gaussians of a picture, in the order of the input, in runs with gaps between.
#[derive(Debug, Default)]
pub struct Ellipses {
    all: Vec<Ellipse>,
    runs: Vec<Run>,
    visible: usize,
    crossing: Vec<Crossing>,
    slopes: Vec<[f32; 2]>,
}

/// How Gaussians are projected.
#[derive(Debug, Clone, Copy)]
pub struct How<'a> {
    /// With which instructions.
    pub isa: Isa,
    /// Opacity is taken back by as much as the blur widens.
    pub compensated: bool,
    /// The least α that is drawn, in `(0, 1]`.
    pub floor: f32,
    /// Gaussians that reach over the near plane are drawn, whatever side their centres are on.
    pub near_care: bool,
    /// How depths change across ellipses is found out too.
    pub slopes: bool,
    /// In place of the Gaussians' colours, one for each.
    pub colours: Option<&'a [[f32; 3]]>,
}

#[derive(Debug, Default, Clone, Copy)]
struct Run {
    first: usize,
    tally: Tally,
}

impl Ellipses {
    /// Bytes per Gaussian.
    pub const BYTES: u64 = size_of::<Ellipse>() as u64;

    /// How many.
    pub fn len(&self) -> usize {
        self.visible
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.visible == 0
    }

    /// In how many runs as many Gaussians are projected.
    pub fn runs_of(gaussians: usize) -> usize {
        gaussians.div_ceil(run_length(gaussians))
    }

    /// All of them, and what stands in the gaps: only the places in [`Ellipses::runs`] hold what this picture shows.
    pub fn all(&self) -> &[Ellipse] {
        &self.all
    }

    /// The runs without gaps.
    pub fn runs(&self) -> impl IndexedParallelIterator<Item = Range<usize>> {
        self.runs
            .par_iter()
            .map(|run| run.first..run.first + run.tally.visible as usize)
    }

    /// Projects, reusing memory; counts what is not visible. While they are still in the cache, the ellipses of a run
    /// are shown to `look`, some at a time, together with a state of the run's own: `states` is given one for each run,
    /// to which first `start` is told the run's length.
    ///
    /// # Errors
    /// [`Error::Usage`] if the camera is none ([`Camera::check`]) or the arrays of `gaussians` differ in length;
    /// [`Error::Unsupported`] if there are 2³² or more.
    pub fn project<S: Default + Send>(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        how: How,
        states: &mut Vec<S>,
        start: impl Fn(&mut S, usize) + Sync,
        look: impl Fn(&mut S, &[Ellipse]) + Sync,
    ) -> Result<Seen> {
        camera.check()?;
        gaussians.check_lengths()?;
        let colours = how.colours.unwrap_or(&gaussians.colour);
        if colours.len() != gaussians.len() {
            let what = format!("{} colours of {} Gaussians", colours.len(), gaussians.len());
            return Err(Error::Usage(what));
        }
        let count = gaussians.len();
        if u32::try_from(count).is_err() {
            return Err(Error::Unsupported {
                what: "a picture of 2^32 or more Gaussians",
                detail: format!("there are {count}"),
            });
        }
        let view = view(camera, how, gaussians);
        let length = run_length(count);
        if self.all.len() < count {
            if self.all.capacity() < count {
                // What is outgrown goes before its successor comes.
                self.all = Vec::new();
            }
            // New memory comes from the system page by page, as it is touched: by all threads.
            repeat_n(Ellipse::default(), count)
                .with_min_len(LEAST_RUN)
                .collect_into_vec(&mut self.all);
        }
        self.all.truncate(count);
        self.runs.clear();
        self.runs.resize(count.div_ceil(length), Run::default());
        states.resize_with(self.runs.len(), S::default);
        self.runs
            .par_iter_mut()
            .zip(self.all.par_chunks_mut(length))
            .zip(states)
            .enumerate()
            .with_max_len(1)
            .for_each(|(i, ((run, ellipses), state))| {
                let (begin, end) = (i * length, i * length + ellipses.len());
                start(state, ellipses.len());
                let mut tally = Tally::default();
                for first in (begin..end).step_by(PIECE) {
                    let piece = first..end.min(first + PIECE);
                    let cloud = Cloud {
                        position: &gaussians.position[piece.clone()],
                        scale: &gaussians.scale[piece.clone()],
                        rotation: &gaussians.rotation[piece.clone()],
                        opacity: &gaussians.opacity[piece.clone()],
                        colour: &colours[piece],
                    };
                    let room = &mut ellipses[tally.visible as usize..];
                    let seen = splat::project(how.isa, &view, cloud, first as u32, room);
                    look(state, &room[..seen.visible as usize]);
                    tally = tally + seen;
                }
                *run = Run { first: begin, tally };
            });
        self.crossing.clear();
        self.slopes.clear();
        self.visible = self.runs.iter().map(|run| run.tally.visible as usize).sum();
        let mut seen = Seen::default();
        for run in &self.runs {
            seen.dropped.add(run.tally.into());
            seen.crossing += u64::from(run.tally.crossing);
        }
        Ok(seen)
    }
}

fn run_length(gaussians: usize) -> usize {
    let most = (RUNS * rayon::current_num_threads()).min(MOST_RUNS);
    gaussians.div_ceil(most).max(LEAST_RUN).next_multiple_of(16)
}

/// What projecting found out.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Seen {
    /// Gaussians that are not drawn.
    pub dropped: Dropped,
    /// Gaussians that reach over the near plane; with care for it, those that are visible.
    pub crossing: u64,
}

/// How many Gaussians are not drawn, by the first reason that applies.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Dropped {
    /// A parameter is NaN or infinite.
    pub not_finite: u64,
    /// The rotation is the zero quaternion.
    pub no_rotation: u64,
    /// The opacity is below the least that is drawn.
    pub too_faint: u64,
    /// The centre is not beyond the near plane. A Gaussian that only reaches over it is dropped as well, never
    /// mirrored.
    pub behind: u64,
    /// No pixel within reach.
    pub outside: u64,
}

/// Indices are in the order of the input: a run's place in them goes with its place among the runs.
impl Ellipses {
    /// Those that reach over the near plane, by index, if they are drawn.
    pub fn crossing(&self) -> &[Crossing] {
        &self.crossing
    }

    /// For each of [`Ellipses::all`], how its depth changes by pixel to the right and down, if that was asked for.
    pub fn slopes(&self) -> &[[f32; 2]] {
        &self.slopes
    }

    /// Finds out, reusing memory, what effects need to know of those last projected beyond their ellipses.
    /// [`Seen::crossing`] says how many [`Crossing`] that may take.
    pub fn look_closer(&mut self, gaussians: &Gaussians, camera: &Camera, how: How) {
        if how.near_care {
            let crossing = self.runs.iter().map(|run| run.tally.crossing as usize);
            self.crossing.resize(crossing.sum(), Crossing::default());
            fill_crossing(&self.runs, &self.all, &mut self.crossing, &|index| {
                space::crossing(gaussians, camera, index as usize)
            });
        }
        if how.slopes {
            self.slopes.resize(self.all.len(), [0.0; 2]);
            let length = run_length(self.all.len());
            let runs = self.runs.par_iter().zip(self.slopes.par_chunks_mut(length));
            runs.for_each(|(run, slopes)| {
                for (slope, ellipse) in slopes.iter_mut().zip(run.of(&self.all)) {
                    *slope = space::slopes(gaussians, camera, ellipse.index as usize);
                }
            });
        }
    }
}

/// Fills `crossing` with what `see` says of those of the runs' ellipses that cross the near plane, all of which are
/// visible.
fn fill_crossing(runs: &[Run], all: &[Ellipse], crossing: &mut [Crossing], see: &(impl Fn(u32) -> Crossing + Sync)) {
    match runs {
        [] => {}
        [run] => {
            let crosses = run.of(all).iter().filter(|ellipse| ellipse.crosses());
            for (to, ellipse) in crossing.iter_mut().zip(crosses) {
                *to = see(ellipse.index);
            }
        }
        _ => {
            let (left, right) = runs.split_at(runs.len() / 2);
            let some = left.iter().map(|run| run.tally.crossing as usize).sum();
            let (first, rest) = crossing.split_at_mut(some);
            rayon::join(
                || fill_crossing(left, all, first, see),
                || fill_crossing(right, all, rest, see),
            );
        }
    }
}

impl Run {
    /// Its ellipses.
    fn of<'a>(&self, all: &'a [Ellipse]) -> &'a [Ellipse] {
        &all[self.first..][..self.tally.visible as usize]
    }
}

impl Dropped {
    /// All of them.
    pub fn total(&self) -> u64 {
        self.not_finite + self.no_rotation + self.too_faint + self.behind + self.outside
    }

    fn add(&mut self, other: Dropped) {
        self.not_finite += other.not_finite;
        self.no_rotation += other.no_rotation;
        self.too_faint += other.too_faint;
        self.behind += other.behind;
        self.outside += other.outside;
    }
}

impl From<Tally> for Dropped {
    fn from(tally: Tally) -> Self {
        Dropped {
            not_finite: tally.not_finite.into(),
            no_rotation: tally.no_rotation.into(),
            too_faint: tally.too_faint.into(),
            behind: tally.behind.into(),
            outside: tally.outside.into(),
        }
    }
}

/// The camera as the kernel has it.
fn view(camera: &Camera, how: How, gaussians: &Gaussians) -> View {
    let rotation = camera.pose.matrix3;
    View {
        rotation: std::array::from_fn(|i| rotation.row(i).into()),
        translation: camera.pose.translation.into(),
        near: camera.near,
        near_care: how.near_care,
        focal: [camera.fx, camera.fy],
        centre: [camera.cx, camera.cy],
        slopes: camera.slope_ranges(),
        window: camera.tiled_window(),
        floor: how.floor,
        orthographic: camera.projection == Projection::Orthographic,
        compensated: how.compensated,
        blur: gaussians.own_blur().into(),
        pixel_blur: gaussians.pixel_blur(),
    }
}
