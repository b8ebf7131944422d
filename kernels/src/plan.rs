//! Kernel maps as matrix tiles want them: few input rows, each known by a short number, and output rows of like neighbours together.

use std::ops::Range;
use std::sync::OnceLock;

use crate::isa::Isa;
use crate::rows::TILE;
use crate::taps::{Taps, TileTaps};

/// Output rows of a group: those of one matrix tile.
pub(crate) const GROUP: usize = 16;

/// A kernel map arranged for matrix tiles, part by part as layers first read it. It pays where a map serves several layers and the
/// [`Isa`] has such tiles; results are the same without.
#[derive(Debug, Clone)]
pub struct Plan(Vec<OnceLock<PlanTile>>);

impl Plan {
    /// For a map of so many output rows.
    pub fn new(rows: usize) -> Self {
        Plan(vec![OnceLock::new(); rows.div_ceil(TILE)])
    }
}

/// Up to [`TILE`] rows of a kernel map, arranged.
///
/// Rows are sorted by which taps they use, and cut into groups of sixteen: what a group multiplies is the taps that any of its rows uses.
#[derive(Debug, Clone, Default)]
pub(crate) struct PlanTile {
    /// Taps of the kernel.
    volume: usize,
    /// The input rows that are read, each once.
    inputs: Vec<u32>,
    /// One more than the last of them.
    end: usize,
    /// For each row, which taps read something.
    masks: Vec<u64>,
    /// The rows in the order of the groups.
    order: Vec<u16>,
    /// For each group, the taps that any of its rows uses.
    unions: Vec<u64>,
    /// Where each group's steps begin.
    starts: Vec<u32>,
    /// Each step's tap; they ascend within a group.
    taps: Vec<u8>,
    /// For each step, which of `inputs` the group's rows read; their number for nothing. One more, of nothing, comes last.
    places: Vec<[u16; GROUP]>,
}

impl PlanTile {
    /// Arranges a tile's rows.
    fn arrange(&mut self, taps: &TileTaps, numbers: &mut Numbers) {
        let (masks, volume) = (taps.masks(), taps.volume());
        self.volume = volume;
        self.end = taps.end();
        self.masks.clear();
        self.masks.extend_from_slice(masks);
        self.sort(volume);
        let mut position = [0u16; TILE];
        for (at, &row) in (0..).zip(&self.order) {
            position[usize::from(row)] = at;
        }
        self.unions.clear();
        self.starts.clear();
        self.taps.clear();
        for group in self.order.chunks(GROUP) {
            let rows = group.iter().map(|&row| masks[usize::from(row)]);
            let mut union = rows.fold(0, |union, mask| union | mask);
            self.unions.push(union);
            self.starts.push(self.taps.len() as u32);
            while union != 0 {
                self.taps.push(union.trailing_zeros() as u8);
                union &= union - 1;
            }
        }

        numbers.clear(&mut self.inputs);
        self.places.clear();
        self.places.resize(self.taps.len() + 1, [u16::MAX; GROUP]);
        for k in 0..volume {
            let mut homes = [0; TILE / GROUP];
            for (group, home) in homes.iter_mut().take(self.unions.len()).enumerate() {
                *home = self.step(group, k);
            }
            let pairs = taps.of(k);
            for (&input, &row) in pairs.inputs.iter().zip(pairs.rows) {
                let at = usize::from(position[row as usize]);
                let place = numbers.of(input, &mut self.inputs);
                self.places[homes[at / GROUP]][at % GROUP] = place;
            }
        }
        let none = self.inputs.len() as u16;
        for place in self.places.as_flattened_mut() {
            *place = (*place).min(none);
        }
    }

    /// The first step of a group whose tap is `k` or beyond.
    fn step(&self, group: usize, k: usize) -> usize {
        let before = self.unions[group] & ((1 << k) - 1);
        self.starts[group] as usize + before.count_ones() as usize
    }

    /// Orders rows by their masks in reflected binary, the taps that half of the rows use first: neighbours then differ in few taps.
    fn sort(&mut self, volume: usize) {
        self.order.clear();
        self.order.extend(0..self.masks.len() as u16);
        if volume == 1 {
            return;
        }
        let mut uses = [0i32; 64];
        for &mask in &self.masks {
            let mut rest = mask;
            while rest != 0 {
                uses[rest.trailing_zeros() as usize] += 1;
                rest &= rest - 1;
            }
        }
        let rows = self.masks.len() as i32;
        let mut taps: Vec<u32> = (0..volume as u32).collect();
        taps.sort_by_key(|&k| (2 * uses[k as usize] - rows).abs());
        let mut keys: Vec<u64> = Vec::with_capacity(self.masks.len());
        for &mask in &self.masks {
            let mut key = taps.iter().fold(0, |key, k| key << 1 | (mask >> k & 1));
            for shift in [1, 2, 4, 8, 16, 32] {
                key ^= key >> shift;
            }
            keys.push(key);
        }
        self.order.sort_by_key(|&row| keys[usize::from(row)]);
    }

    /// Taps of the kernel.
    pub(crate) fn volume(&self) -> usize {
        self.volume
    }

    /// The input rows that are read, each once. [`PlanTile::places`] counts them.
    pub(crate) fn inputs(&self) -> &[u32] {
        &self.inputs
    }

    /// One more than the last input row.
    pub(crate) fn end(&self) -> usize {
        self.end
    }

    /// For each row, bit k tells whether tap `k` reads something.
    pub(crate) fn masks(&self) -> &[u64] {
        &self.masks
    }

    /// Groups.
    pub(crate) fn groups(&self) -> usize {
        self.unions.len()
    }

    /// The tile's rows of a group.
    pub(crate) fn rows(&self, group: usize) -> &[u16] {
        let rows = &self.order[group * GROUP..];
        &rows[..rows.len().min(GROUP)]
    }

    /// What a group multiplies of some taps, ascending: the taps it uses, and for each of them the places of the input rows, followed by
    /// one more.
    pub(crate) fn steps(&self, group: usize, taps: Range<usize>) -> (&[u8], &[[u16; GROUP]]) {
        let (start, end) = (self.step(group, taps.start), self.step(group, taps.end));
        (&self.taps[start..end], &self.places[start..=end])
    }
}

/// Finds or makes the plans of tiles.
#[derive(Default)]
pub(crate) struct Planner {
    numbers: Numbers,
    own: PlanTile,
}

impl Planner {
    /// The plan of `count` output rows from `first` on: the map's own, or one made now.
    pub fn plan<'a>(
        &'a mut self,
        isa: Isa,
        taps: &Taps<'a>,
        [first, count]: [usize; 2],
        scratch: &mut TileTaps,
    ) -> &'a PlanTile {
        let Planner { numbers, own } = self;
        let mut arrange = |tile: &mut PlanTile| {
            scratch.fill(isa, taps, first, count, usize::MAX);
            tile.arrange(scratch, numbers);
        };
        if let Taps::Map {
            plan: Some(plan), ..
        } = taps
            && first.is_multiple_of(TILE)
            && let Some(place) = plan.0.get(first / TILE)
        {
            let tile = place.get_or_init(|| {
                let mut tile = PlanTile::default();
                arrange(&mut tile);
                tile
            });
            if tile.masks.len() == count {
                return tile;
            }
        }
        arrange(own);
        own
    }
}

/// Numbers for input rows, in the order in which they are first asked for.
#[derive(Default)]
pub(crate) struct Numbers {
    /// By hash: an input row and its number, or [`FREE`].
    slots: Vec<(u32, u16)>,
    /// The last that was asked for.
    last: (u32, u16),
}

const FREE: (u32, u16) = (u32::MAX, 0);

impl Numbers {
    /// Forgets all numbers.
    fn clear(&mut self, inputs: &mut Vec<u32>) {
        inputs.clear();
        self.slots.clear();
        self.slots.resize(4096, FREE);
        self.last = FREE;
    }

    fn of(&mut self, input: u32, inputs: &mut Vec<u32>) -> u16 {
        if self.last.0 == input {
            return self.last.1;
        }
        if 2 * inputs.len() >= self.slots.len() {
            let size = 2 * self.slots.len();
            self.slots.clear();
            self.slots.resize(size, FREE);
            for (number, &input) in (0..).zip(&*inputs) {
                let slot = self.slot(input);
                self.slots[slot] = (input, number);
            }
        }
        let slot = self.slot(input);
        if self.slots[slot].0 != input {
            // A tile has at most 512 · 63 pairs.
            self.slots[slot] = (input, inputs.len() as u16);
            inputs.push(input);
        }
        self.last = self.slots[slot];
        self.last.1
    }

    /// Where an input row is, or could be.
    fn slot(&self, input: u32) -> usize {
        let mask = self.slots.len() - 1;
        let mut slot = (input.wrapping_mul(0x9e37_79b9) >> 12) as usize & mask;
        while self.slots[slot].0 != input && self.slots[slot] != FREE {
            slot = (slot + 1) & mask;
        }
        slot
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ABSENT;

    #[test]
    fn a_plan_says_what_its_map_says() {
        let (volume, count) = (27, 300);
        let mut state = 1u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            state >> 8
        };
        for dense in [0, 40, 100] {
            let rows: Vec<u32> = (0..volume * count)
                .map(|_| match random() % 100 < dense {
                    true => random() % 5000,
                    false => ABSENT,
                })
                .collect();
            let taps = Taps::Map {
                volume,
                rows: &rows,
                plan: None,
            };
            let mut planner = Planner::default();
            let plan = planner.plan(Isa::SCALAR, &taps, [0, count], &mut TileTaps::default());
            let mut found = vec![ABSENT; rows.len()];
            for group in 0..plan.groups() {
                let (taps, places) = plan.steps(group, 0..volume);
                assert!(taps.is_sorted_by(|a, b| a < b));
                for (&tap, places) in taps.iter().zip(places) {
                    for (&row, &place) in plan.rows(group).iter().zip(places) {
                        if let Some(&input) = plan.inputs().get(usize::from(place)) {
                            found[usize::from(row) * volume + usize::from(tap)] = input;
                        }
                    }
                }
            }
            assert_eq!(found, rows);
            let mut inputs = plan.inputs().to_vec();
            inputs.sort_unstable();
            inputs.dedup();
            assert_eq!(inputs.len(), plan.inputs().len(), "each input row once");
        }
    }
}
