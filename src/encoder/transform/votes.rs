//! How well the previous frame predicts blocks, and the modes that follow.

use crate::colour::Ycc;
use crate::motion::{Mode, Modes};

/// Colours of a block are predicted from the previous frame, moved or warped, if what is left is at most this share of the
/// differences.
const INTER_COLOURS: [f32; 2] = [0.9, 1.1];

/// How well the previous frame predicts a block at a level.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Votes {
    /// Parents whose children are there, but not those of the window.
    other: u64,
    /// Children that are there in both frames, and in one of them.
    hits: u64,
    misses: u64,
    /// Children without, or with other colours.
    pub coloured: u64,
    /// Differences of luma to the parent, and those left by the prediction.
    intra: f32,
    pub inter: f32,
    /// Differences of luma to the parent where nothing is predicted.
    pub new: f32,
}

impl Votes {
    pub fn geometry(&mut self, mask: u8, moved: u8) {
        self.other += u64::from(moved != 0 && moved != mask);
        self.hits += u64::from((mask & moved).count_ones());
        self.misses += u64::from((mask ^ moved).count_ones());
    }

    pub fn colours(&mut self, truth: &[Ycc], moved: &[Option<Ycc>], above: Ycc) {
        let there = || {
            truth
                .iter()
                .zip(moved)
                .filter_map(|(truth, moved)| Some((truth, (*moved)?)))
        };
        let mut shift = 0;
        let mut count = 0;
        for (truth, moved) in there() {
            shift += i32::from(truth[0]) - i32::from(moved[0]);
            count += 1;
        }
        let shift = shift as f32 / count.max(1) as f32;
        let new = truth.iter().zip(moved).filter(|(_, moved)| moved.is_none());
        self.new += new
            .map(|(truth, _)| (f32::from(truth[0]) - f32::from(above[0])).abs())
            .sum::<f32>();
        for (truth, moved) in there() {
            self.intra += (f32::from(truth[0]) - f32::from(above[0])).abs();
            self.inter += (f32::from(truth[0]) - f32::from(moved[0]) - shift).abs();
        }
    }

    pub fn add(&mut self, other: Votes) {
        self.other += other.other;
        self.hits += other.hits;
        self.misses += other.misses;
        self.coloured += other.coloured;
        self.intra += other.intra;
        self.inter += other.inter;
        self.new += other.new;
    }

    /// The modes for a block, which is to stay what it was if `keep`.
    pub fn modes(&self, keep: bool, [lossless, warped]: [bool; 2]) -> Modes {
        let geometry = match (self.other, self.hits > 0) {
            (0, true) => Mode::Skip,
            _ if 2 * self.hits >= self.misses => Mode::Inter,
            _ => Mode::Intra,
        };
        let colours = match self.hits {
            0 => Mode::Intra,
            _ if self.coloured == 0 || (keep && !lossless) => Mode::Skip,
            _ if self.inter <= INTER_COLOURS[usize::from(warped)] * self.intra => Mode::Inter,
            _ => Mode::Intra,
        };
        Modes { geometry, colours }
    }
}
