//! Arranging kernel maps: rows of like taps together, and short numbers for the input rows.

use super::microkernel::MIN_GROUP;
use super::plan::{Clamped, PlanTile};
use super::rows::TILE;
use super::taps::Taps;
use super::tile_taps::TileTaps;
use crate::simd::Isa;

impl PlanTile {
    /// Arranges a tile's rows.
    fn arrange(&mut self, group: usize, taps: &TileTaps, numbers: &mut Numbers) {
        let (masks, volume) = (taps.masks(), taps.volume());
        self.group = group;
        self.volume = volume;
        self.end = taps.end();
        self.masks.clear();
        self.masks.extend_from_slice(masks);
        self.sort();
        self.positions.clear();
        self.positions.resize(masks.len(), 0);
        for (at, &row) in (0..).zip(&self.order) {
            self.positions[usize::from(row)] = at;
        }
        self.unions.clear();
        self.starts.clear();
        self.taps.clear();
        for group in self.order.chunks(group) {
            let rows = group.iter().map(|&row| masks[usize::from(row)]);
            let mut union = rows.fold(0, |union, mask| union | mask);
            self.unions.push(union);
            self.starts.push(self.taps.len() as u32);
            while union != 0 {
                self.taps.push(union.trailing_zeros() as u8);
                union &= union - 1;
            }
        }

        let near = (0..volume).find_map(|k| taps.of(k).inputs.first());
        numbers.clear(near.copied().unwrap_or(0), &mut self.inputs);
        let mut places = self.places.take();
        places.clear();
        places.resize((self.taps.len() + 1) * group, u16::MAX);
        for k in 0..volume {
            let mut homes = [0; TILE / MIN_GROUP];
            for (group, home) in homes.iter_mut().take(self.unions.len()).enumerate() {
                *home = self.step(group, k);
            }
            let pairs = taps.of(k);
            for (&input, &row) in pairs.inputs.iter().zip(pairs.rows) {
                let at = usize::from(self.positions[row as usize]);
                let place = numbers.of(input, &mut self.inputs);
                places[homes[at / group] * group + at % group] = place;
            }
        }
        self.places = Clamped::new(places, self.inputs.len() as u16);
    }

    /// Arranges `count` rows from `first` on, of which each reads the input row of its own number, through the only
    /// tap.
    fn arrange_same(&mut self, group: usize, first: usize, count: usize) {
        if (self.group, self.masks.len()) != (group, count) {
            let groups = count.div_ceil(group);
            let rows = (groups + 1) * group;
            *self = PlanTile {
                group,
                volume: 1,
                inputs: Vec::new(),
                end: 0,
                masks: vec![1; count],
                order: (0..count as u16).collect(),
                positions: (0..count as u16).collect(),
                unions: vec![1; groups],
                starts: (0..groups as u32).collect(),
                taps: vec![0; groups],
                places: Clamped::new((0..rows as u16).collect(), count as u16),
            };
        }
        self.end = first + count;
        self.inputs.clear();
        self.inputs.extend(first as u32..self.end as u32);
    }

    /// Orders rows by their masks in reflected binary, the taps that half of the rows use first: neighbours then differ
    /// in few taps.
    fn sort(&mut self) {
        let rows = self.masks.len() as i32;
        let mut uses = [0i32; 64];
        for &mask in &self.masks {
            let mut rest = mask;
            while rest != 0 {
                uses[rest.trailing_zeros() as usize] += 1;
                rest &= rest - 1;
            }
        }
        let mut taps: Vec<u32> = (0..self.volume as u32).collect();
        taps.sort_by_key(|&k| (2 * uses[k as usize] - rows).abs());
        let keys = Keys::new(&taps);
        let keys = (0..)
            .zip(&self.masks)
            .map(|(row, &mask)| keys.of(mask) << ROW_BITS | row);
        let mut keys: Vec<u64> = keys.collect();
        keys.sort_unstable();
        self.order.clear();
        let row = |&key: &u64| (key % (1 << ROW_BITS)) as u16;
        self.order.extend(keys.iter().map(row));
    }
}

/// Bits of the number of a tile's row.
const ROW_BITS: u32 = TILE.trailing_zeros();

/// What places a mask has when masks are ordered in reflected binary, their taps in another order.
///
/// The bits of a place are sums, modulo 2, of those of the mask: so it is the sum of what the mask's bytes contribute.
struct Keys(Vec<[u64; 256]>);

impl Keys {
    /// For these taps, of which the first weighs most.
    fn new(taps: &[u32]) -> Self {
        let mut bytes = vec![[0; 256]; taps.len().div_ceil(8)];
        for (weight, &tap) in taps.iter().rev().enumerate() {
            // In reflected binary a bit turns all below it.
            let place = (2u64 << weight) - 1;
            bytes[tap as usize / 8][1 << (tap % 8)] = place;
        }
        for places in &mut bytes {
            for byte in 1..256usize {
                let last = 1 << byte.trailing_zeros();
                places[byte] = places[byte - last] ^ places[last];
            }
        }
        Keys(bytes)
    }

    fn of(&self, mask: u64) -> u64 {
        let bytes = self.0.iter().zip(mask.to_le_bytes());
        bytes.fold(0, |key, (places, byte)| key ^ places[usize::from(byte)])
    }
}

/// Finds or makes the plans of tiles.
#[derive(Default)]
pub(crate) struct Planner {
    numbers: Numbers,
    own: PlanTile,
    same: PlanTile,
}

impl Planner {
    /// The plan of `count` output rows from `first` on in groups of so many rows: the map's own, or one made now.
    pub fn plan<'a>(
        &'a mut self,
        isa: Isa,
        group: usize,
        taps: &Taps<'a>,
        [first, count]: [usize; 2],
        scratch: &mut TileTaps,
    ) -> &'a PlanTile {
        let Planner { numbers, own, same } = self;
        if let Taps::Same = taps {
            same.arrange_same(group, first, count);
            return same;
        }
        let mut arrange = |tile: &mut PlanTile| {
            scratch.fill(isa, taps, first, count, usize::MAX);
            tile.arrange(group, scratch, numbers);
        };
        if let Taps::Map { plan: Some(plan), .. } | Taps::Made { plan, .. } | Taps::AllChildren { plan, .. } = taps
            && first.is_multiple_of(TILE)
            && let Some(places) = plan.0.get(first / TILE)
        {
            let place = usize::from(group > MIN_GROUP);
            let tile = places[place].get_or_init(|| {
                let mut tile = PlanTile::default();
                arrange(&mut tile);
                tile
            });
            if tile.masks.len() == count && tile.group == group {
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
    /// The first of the rows of `near`.
    base: u32,
    /// Their numbers, or [`FREE`]: most of a tile's inputs lie close to each other.
    near: Vec<u16>,
    /// Of the others, by hash: an input row and its number, or [`FREE`].
    far: Vec<(u32, u16)>,
}

/// No number: a tile has at most 512 · 54 pairs.
const FREE: u16 = u16::MAX;
/// Rows before the first that is asked for, and half of those after it, whose numbers are found by place.
const NEAR: u32 = 4096;

impl Numbers {
    /// Forgets all numbers; most that will be asked for are near to a row.
    fn clear(&mut self, row: u32, inputs: &mut Vec<u32>) {
        inputs.clear();
        self.base = row.saturating_sub(NEAR);
        self.near.clear();
        self.near.resize(3 * NEAR as usize, FREE);
        self.far.clear();
        self.far.resize(1024, (0, FREE));
    }

    #[inline(always)]
    fn of(&mut self, input: u32, inputs: &mut Vec<u32>) -> u16 {
        let near = input.wrapping_sub(self.base) as usize;
        if let Some(number) = self.near.get_mut(near) {
            if *number == FREE {
                *number = inputs.len() as u16;
                inputs.push(input);
            }
            return *number;
        }
        self.of_far(input, inputs)
    }

    fn of_far(&mut self, input: u32, inputs: &mut Vec<u32>) -> u16 {
        if 2 * inputs.len() >= self.far.len() {
            let size = 2 * self.far.len();
            self.far.clear();
            self.far.resize(size, (0, FREE));
            for (number, &input) in (0..).zip(&*inputs) {
                let slot = self.slot(input);
                self.far[slot] = (input, number);
            }
        }
        let slot = self.slot(input);
        if self.far[slot].1 == FREE {
            self.far[slot] = (input, inputs.len() as u16);
            inputs.push(input);
        }
        self.far[slot].1
    }

    /// Where an input row is, or could be.
    fn slot(&self, input: u32) -> usize {
        let mask = self.far.len() - 1;
        let mut slot = (input.wrapping_mul(0x9e37_79b9) >> 12) as usize & mask;
        while self.far[slot].0 != input && self.far[slot].1 != FREE {
            slot = (slot + 1) & mask;
        }
        slot
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sparse::taps::ABSENT;

    #[test]
    fn places_count_masks_in_reflected_binary() {
        let taps = [4, 0, 3, 1, 2, 5, 8, 7, 6, 9];
        let keys = Keys::new(&taps);
        let mut masks: Vec<u64> = (0..1 << taps.len()).collect();
        masks.sort_by_key(|&mask| keys.of(mask));
        let turned = |masks: &[u64]| masks[0] ^ masks[1];
        assert!(masks.windows(2).all(|m| turned(m).is_power_of_two()));
        let first = masks.iter().position(|mask| mask >> taps[0] & 1 == 1);
        assert_eq!(first, Some(masks.len() / 2));
    }

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
            let plan = planner.plan(Isa::SCALAR, MIN_GROUP, &taps, [0, count], &mut TileTaps::default());
            let mut found = vec![ABSENT; rows.len()];
            for group in 0..plan.groups() {
                let (taps, places) = plan.steps(group, 0..volume);
                assert!(taps.is_sorted_by(|a, b| a < b));
                let places = places.all().chunks_exact(plan.group);
                for (&tap, places) in taps.iter().zip(places) {
                    for (&row, &place) in plan.order[group * plan.group..].iter().zip(places) {
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
