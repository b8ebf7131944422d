//! What a previous frame tells of a level's occupancies (`docs/format.md`, clauses 17.6 and 17.10.8).
//!
//! Every parent has a *mode* and a *window*: the 4³ cells around its children that are occupied in the moved previous
//! frame, numbered as in `contexts`. In the mode [`Mode::Skip`] a parent has the children that the window has, unless
//! it has none. Else the window refines the probability of each child: a table by what the window has around the child
//! and by the logit that was predicted without it. So a wrong window costs bits and nothing else. A warped frame has a
//! second window, of the cells that its voxels come near.

use super::coder::Coder;
use crate::coding::probability::{LIMIT, squash};

/// How a block of a level is predicted from the previous frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Mode {
    /// It is not.
    #[default]
    Intra,
    /// Probabilities, or predicted values, depend on it.
    Inter,
    /// It is the same as there.
    Skip,
}

/// What a previous frame tells of the occupancies of a level.
#[derive(Debug, Clone, Copy)]
pub struct Guide<'a> {
    /// The mode of every parent.
    pub modes: &'a [Mode],
    /// The window of every parent; of no meaning in [`Mode::Intra`].
    pub windows: &'a [u64],
    /// Of a warped frame: the window of near cells of every parent.
    pub near: Option<&'a [u64]>,
}

/// What the previous frame has around a parent's children.
#[derive(Debug, Clone, Copy)]
pub(super) struct Window {
    voxels: u64,
    /// Near cells; of no meaning if the frame is not warped.
    near: u64,
}

/// The cells of the children in octants 0 to 7.
const OWN: [u32; 8] = [21, 22, 25, 26, 37, 38, 41, 42];
/// The face neighbours of the child in octant 0.
const FACES: u64 = 1 << 5 | 1 << 17 | 1 << 20 | 1 << 22 | 1 << 25 | 1 << 37;

impl Guide<'_> {
    /// The occupancy that the window of this parent has; 0 if the parent is not to be skipped.
    #[inline(always)]
    pub(super) fn skipped(&self, parent: usize) -> u8 {
        match self.modes[parent] {
            Mode::Skip => own(self.windows[parent]),
            _ => 0,
        }
    }

    /// The window of this parent, if it refines probabilities.
    #[inline(always)]
    pub(super) fn window(&self, parent: usize) -> Option<Window> {
        (self.modes[parent] != Mode::Intra).then(|| Window {
            voxels: self.windows[parent],
            near: self.near.map_or(0, |near| near[parent]),
        })
    }
}

/// The occupancy of a parent in its window.
#[inline(always)]
pub fn own(window: u64) -> u8 {
    let bit = |mask: u8, (octant, cell): (usize, &u32)| mask | ((window >> cell & 1) as u8) << octant;
    OWN.iter().enumerate().fold(0, bit)
}

/// Logits between two entries of the table.
const STEP: i32 = 45;
/// Entries of a context: logits from −720 to 720.
const ENTRIES: usize = (2 * LIMIT / STEP) as usize + 1;
/// Classes of children, and counts of their faces: in the window; of a warped frame, in both.
const CLASSES: [usize; 2] = [2, 3];
const FACES_THERE: [usize; 2] = [7, 13];
/// How many times as many contexts wrong siblings and errors before make.
const HISTORIES: usize = 3 * 3;
/// Bits of a probability in the table.
const BITS: u32 = 22;
/// How often an entry is seen at first, and at most.
const SEEN: [u32; 2] = [4, 250];
/// Logits by which the class of a child moves the initial probability.
const INITIAL: [&[i32]; 2] = [&[-96, 96], &[-96, -32, 96]];

/// Refines probabilities by the windows of a slice.
#[derive(Debug)]
pub(super) struct Refiner {
    /// Probabilities of a 1 in the upper bits, from bit 8 on; how often they were seen below.
    table: Vec<u32>,
    warped: bool,
    /// A running mean of wrong children, in units of 2⁻¹⁶.
    wrong: u32,
}

/// A refined probability, and what [`Refiner::adapt`] needs.
#[derive(Debug, Clone, Copy)]
pub(super) struct Refined {
    at: usize,
    there: bool,
    pub one: u32,
}

impl Refiner {
    pub fn new(warped: bool) -> Self {
        let kind = usize::from(warped);
        let contexts = CLASSES[kind] * FACES_THERE[kind] * HISTORIES;
        let mut table = Vec::with_capacity(contexts * ENTRIES);
        for context in 0..contexts {
            let shift = INITIAL[kind][context % CLASSES[kind]];
            for entry in 0..ENTRIES as i32 {
                let one = squash(entry * STEP - LIMIT + shift) << (BITS - 16);
                table.push(one << 8 | SEEN[0]);
            }
        }
        Refiner {
            table,
            warped,
            wrong: 1 << 13,
        }
    }

    /// The probability of the child in `octant`, whose lower siblings are `coded`, where `logit` was predicted without
    /// the window.
    #[inline(always)]
    fn predict(&self, window: Window, octant: usize, coded: u8, logit: i32) -> Refined {
        let shift = OWN[octant] - OWN[0];
        let around = window.voxels >> shift;
        let there = around >> OWN[0] & 1;
        let faces = (around & FACES).count_ones() as usize;
        let lower = (1u8 << octant).wrapping_sub(1);
        let siblings = (((coded ^ own(window.voxels)) & lower).count_ones() as usize).min(2);
        let errors = usize::from(self.wrong > 1 << 11) + usize::from(self.wrong > 1 << 13);
        let history = siblings + 3 * errors;
        let context = match self.warped {
            true => {
                let near = window.near >> shift;
                let class = (there + (near >> OWN[0] & 1)) as usize;
                class + 3 * (faces + (near & FACES).count_ones() as usize + 13 * history)
            }
            false => there as usize + 2 * (faces + 7 * history),
        };
        let place = (logit + LIMIT).clamp(0, 2 * LIMIT - 1);
        let (low, part) = (place / STEP, (place % STEP) as u32);
        let at = context * ENTRIES + low as usize;
        let [a, b] = [self.table[at] >> 8, self.table[at + 1] >> 8];
        let mean = (a * (STEP as u32 - part) + b * part) / STEP as u32;
        Refined {
            at,
            there: there == 1,
            one: (mean >> (BITS - 16)).clamp(16, 65_520),
        }
    }

    /// The refined probability alone, in units of 2⁻¹⁶.
    #[cfg(feature = "encoder")]
    #[inline(always)]
    pub fn probability(&self, window: Window, octant: usize, coded: u8, logit: i32) -> u32 {
        self.predict(window, octant, coded, logit).one
    }

    /// Codes a child with the refined probability, and adapts.
    #[inline(always)]
    pub fn code(
        &mut self,
        coder: &mut impl Coder,
        window: Window,
        octant: usize,
        coded: u8,
        logit: i32,
        target: bool,
    ) -> bool {
        let refined = self.predict(window, octant, coded, logit);
        let bit = coder.code(target, refined.one);
        self.adapt(&refined, bit);
        bit
    }

    #[inline(always)]
    fn adapt(&mut self, refined: &Refined, bit: bool) {
        let target = if bit { (1i64 << BITS) - 1 } else { 0 };
        for entry in &mut self.table[refined.at..refined.at + 2] {
            let (one, seen) = (i64::from(*entry >> 8), *entry & 255);
            let one = one + (target - one) * 2 / (2 * i64::from(seen) + 3);
            *entry = (one as u32) << 8 | (seen + 1).min(SEEN[1]);
        }
        let wrong = if bit == refined.there { 0 } else { 1 << 16 };
        self.wrong = self.wrong - (self.wrong >> 5) + (wrong >> 5);
    }
}

#[cfg(test)]
mod tests {
    use super::super::{decode_masks, encode_guided, encode_level};
    use super::*;
    use crate::cancel::Cancel;
    use crate::container::Slice;
    use crate::geometry::{Octree, Voxels};
    use b2p_kernels::Isa;
    use proptest::prelude::*;

    /// Windows whose own children are those of the octree, each wrong where `wrong` has a bit.
    fn windows(octree: &Octree, level: u8, wrong: impl Fn(usize) -> u8) -> Vec<u64> {
        let masks = octree.occupancy(level - 1).iter().enumerate();
        let cells = |mask: u8| {
            OWN.iter()
                .enumerate()
                .map(move |(o, cell)| u64::from(mask >> o & 1) << cell)
                .sum()
        };
        masks.map(|(i, mask)| cells(mask ^ wrong(i))).collect()
    }

    fn slices(coded: &[(u32, Vec<u8>)]) -> Vec<Slice<'_>> {
        coded
            .iter()
            .map(|(voxels, bytes)| Slice {
                voxels: *voxels,
                bytes,
                offset: 0,
            })
            .collect()
    }

    proptest! {
        #[test]
        fn occupancies_are_decoded_as_they_were_coded_however_wrong_the_windows_are(
            keys in prop::collection::vec(0u64..1 << 15, 1..600),
            wrong in prop::collection::vec(any::<u8>(), 600),
            modes in prop::collection::vec(0usize..3, 600),
            warped: bool,
        ) {
            let octree = Octree::new(Voxels::new(5, keys)).unwrap();
            let (map, parents) = (octree.kernel_map(4), octree.occupancy(4).len());
            let mode = |i: usize| [Mode::Intra, Mode::Inter, Mode::Skip][modes[i % 600]];
            let modes: Vec<Mode> = (0..parents).map(mode).collect();
            let windows = windows(&octree, 5, |i| match modes[i] {
                Mode::Skip => 0,
                _ => wrong[i % 600],
            });
            let near: Option<Vec<u64>> = warped.then(|| windows.iter().map(|window| window | window << 1).collect());
            let guide = Some(Guide { modes: &modes, windows: &windows, near: near.as_deref() });
            let isa = Isa::detect();
            let coded = encode_guided(isa, &octree, &map, 5, 90, guide);
            let masks = decode_masks(isa, 5, &map, &slices(&coded), 90, guide, &Cancel::default()).unwrap();
            prop_assert_eq!(&masks[..], octree.occupancy(4));
            let scalar = encode_guided("scalar".parse().unwrap(), &octree, &map, 5, 90, guide);
            prop_assert_eq!(scalar, coded);
        }
    }

    #[test]
    fn right_windows_save_most_bits_and_skipped_parents_take_none() {
        let sphere = |key: &u64| {
            let at = crate::geometry::morton::decode(*key).map(|x| f64::from(x) - 31.5);
            (at.iter().map(|x| x * x).sum::<f64>().sqrt() - 25.0).abs() < 0.6
        };
        let octree = Octree::new(Voxels::new(6, (0..1 << 18).filter(sphere).collect())).unwrap();
        let (map, parents) = (octree.kernel_map(5), octree.occupancy(5).len());
        let bytes = |mode, wrong: fn(usize) -> u8| {
            let (modes, windows) = (vec![mode; parents], windows(&octree, 6, wrong));
            let guide = Guide {
                modes: &modes,
                windows: &windows,
                near: None,
            };
            encode_guided(Isa::detect(), &octree, &map, 6, 1 << 14, Some(guide))
        };
        let size = |coded: &[(u32, Vec<u8>)]| coded.iter().map(|slice| slice.1.len()).sum::<usize>();
        let alone = encode_level(Isa::detect(), &octree, &map, 6, 1 << 14);
        assert_eq!(bytes(Mode::Intra, |_| 0), alone);
        assert!(4 * size(&bytes(Mode::Inter, |_| 0)) < size(&alone));
        assert_eq!(size(&bytes(Mode::Skip, |_| 0)), 4);
        // Windows that know nothing cost little.
        let useless = size(&bytes(Mode::Inter, |i| (i * 0x9e37) as u8));
        assert!(20 * useless < 23 * size(&alone), "{useless} of {}", size(&alone));
    }
}
