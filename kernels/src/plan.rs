//! Kernel maps as matrix tiles want them: few input rows, each known by a short number, and output rows of like neighbours together.

use crate::isa::Isa;
use crate::rows::{TILE, with_scratch};
use crate::taps::{Taps, TileTaps};

/// Output rows of a group: those of one matrix tile.
pub(crate) const GROUP: usize = 16;

/// A kernel map arranged for matrix tiles. It pays where a map serves several layers and the [`Isa`] has such tiles; results
/// are the same without.
///
/// Made of a [`PlanTile`] for every [`PlanTile::ROWS`] rows of the map, in their order.
#[derive(Debug, Clone, Default)]
pub struct Plan(Vec<PlanTile>);

impl FromIterator<PlanTile> for Plan {
    fn from_iter<I: IntoIterator<Item = PlanTile>>(tiles: I) -> Self {
        Plan(tiles.into_iter().collect())
    }
}

impl From<Vec<PlanTile>> for Plan {
    fn from(tiles: Vec<PlanTile>) -> Self {
        Plan(tiles)
    }
}

impl Plan {
    /// The plan of `count` rows from `first` on, if there is one for just these.
    pub(crate) fn tile(&self, first: usize, count: usize) -> Option<&PlanTile> {
        let tile = self.0.get(first / TILE)?;
        (first.is_multiple_of(TILE) && tile.masks.len() == count).then_some(tile)
    }
}

/// Up to [`PlanTile::ROWS`] rows of a kernel map, arranged.
///
/// Rows are sorted by which taps they use, and cut into groups of sixteen: what a group multiplies is the taps that any of its rows uses.
/// Two groups at a time share the weights.
#[derive(Debug, Clone, Default)]
pub struct PlanTile {
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
    /// What two groups multiply, for every two.
    pairs: Vec<Pair>,
    /// Of all pairs.
    taps: Vec<u8>,
    /// Likewise.
    places: Vec<[u16; GROUP]>,
}

/// What two groups multiply.
#[derive(Debug, Clone)]
struct Pair {
    /// Taps that both use, that the first uses alone, that the second uses alone.
    counts: [usize; 3],
    /// Where the pair's taps begin.
    taps: usize,
    /// Where its places begin: for each tap those of the first group, if it uses it, then those of the second.
    places: usize,
}

/// What two groups multiply, in this order.
pub(crate) struct Steps<'a> {
    /// Taps that both use, that the first uses alone, that the second uses alone.
    pub counts: [usize; 3],
    /// The taps.
    pub taps: &'a [u8],
    /// For each tap which of the inputs the rows of each group that uses it read; the inputs' number for nothing.
    pub places: &'a [[u16; GROUP]],
}

impl PlanTile {
    /// Rows that a tile has, unless it is a map's last.
    pub const ROWS: usize = TILE;

    /// Arranges at most [`PlanTile::ROWS`] rows of a kernel map of `volume` taps, laid out as in [`Taps::Map`].
    ///
    /// # Panics
    /// If there are more rows, or more than 63 taps.
    pub fn new(isa: Isa, volume: usize, rows: &[u32]) -> Self {
        assert!(volume < 64, "a kernel has more than 63 taps");
        let mut plan = PlanTile::default();
        let map = Taps::Map {
            volume,
            rows,
            plan: None,
        };
        with_scratch(|scratch| {
            let (taps, numbers) = (&mut scratch.taps, &mut scratch.planner.numbers);
            taps.fill(isa, &map, 0, rows.len() / volume, usize::MAX);
            plan.arrange(taps, numbers);
        });
        plan
    }

    /// Arranges a tile's rows.
    pub(crate) fn arrange(&mut self, taps: &TileTaps, numbers: &mut Numbers) {
        let (masks, volume) = (taps.masks(), taps.volume());
        self.volume = volume;
        self.end = taps.end();
        self.masks.clear();
        self.masks.extend_from_slice(masks);
        self.sort();
        let mut position = [0u16; TILE];
        for (at, &row) in (0..).zip(&self.order) {
            position[usize::from(row)] = at;
        }
        let homes = self.pair();
        numbers.clear(&mut self.inputs);
        for (k, homes) in homes.iter().enumerate().take(volume) {
            let pairs = taps.of(k);
            for (&input, &row) in pairs.inputs.iter().zip(pairs.rows) {
                let at = usize::from(position[row as usize]);
                let home = usize::from(homes[at / GROUP]);
                self.places[home][at % GROUP] = numbers.of(input, &mut self.inputs);
            }
        }
        let none = self.inputs.len() as u16;
        for place in self.places.as_flattened_mut() {
            *place = (*place).min(none);
        }
    }

    /// Lists the taps of every two groups, and makes room for their places; tells which places are those of a tap's group.
    fn pair(&mut self) -> [[u16; TILE / GROUP]; 64] {
        let mut homes = [[0; TILE / GROUP]; 64];
        self.pairs.clear();
        self.taps.clear();
        let mut places = 0;
        for (pair, rows) in self.order.chunks(2 * GROUP).enumerate() {
            let mut unions = [0; 2];
            for (union, rows) in unions.iter_mut().zip(rows.chunks(GROUP)) {
                let masks = rows.iter().map(|&row| self.masks[usize::from(row)]);
                *union = masks.fold(0, |union, mask| union | mask);
            }
            let [mine, others] = unions;
            let kinds = [mine & others, mine & !others, others & !mine];
            self.pairs.push(Pair {
                counts: kinds.map(|taps| taps.count_ones() as usize),
                taps: self.taps.len(),
                places: usize::from(places),
            });
            for mut rest in kinds {
                while rest != 0 {
                    let k = rest.trailing_zeros() as usize;
                    rest &= rest - 1;
                    self.taps.push(k as u8);
                    for (group, union) in unions.iter().enumerate() {
                        if union >> k & 1 == 1 {
                            homes[k][2 * pair + group] = places;
                            places += 1;
                        }
                    }
                }
            }
        }
        self.places.clear();
        self.places.resize(places.into(), [u16::MAX; GROUP]);
        homes
    }

    /// Orders rows by their masks in reflected binary, the taps that half of the rows use first: neighbours then differ in few taps.
    fn sort(&mut self) {
        let volume = self.volume;
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

    /// Pairs of groups.
    pub(crate) fn pairs(&self) -> usize {
        self.pairs.len()
    }

    /// The tile's rows of a pair's two groups, at most [`GROUP`] each.
    pub(crate) fn rows(&self, pair: usize) -> impl Iterator<Item = &[u16]> {
        self.order.chunks(GROUP).skip(2 * pair).take(2)
    }

    /// What a pair of groups multiplies.
    pub(crate) fn steps(&self, pair: usize) -> Steps<'_> {
        let Pair {
            counts,
            taps,
            places,
        } = self.pairs[pair];
        Steps {
            counts,
            taps: &self.taps[taps..][..counts.iter().sum()],
            places: &self.places[places..][..2 * counts[0] + counts[1] + counts[2]],
        }
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
        if let Taps::Map { plan, .. } = taps
            && let Some(tile) = plan.and_then(|plan| plan.tile(first, count))
        {
            return tile;
        }
        scratch.fill(isa, taps, first, count, usize::MAX);
        self.own.arrange(scratch, &mut self.numbers);
        &self.own
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
            let plan = PlanTile::new(Isa::SCALAR, volume, &rows);
            let mut found = vec![ABSENT; rows.len()];
            for pair in 0..plan.pairs() {
                let Steps {
                    counts,
                    taps,
                    places,
                } = plan.steps(pair);
                let groups: Vec<&[u16]> = plan.rows(pair).collect();
                let mut places = places.iter();
                for (step, &tap) in taps.iter().enumerate() {
                    let of = match step {
                        step if step < counts[0] => 0..2,
                        step if step < counts[0] + counts[1] => 0..1,
                        _ => 1..2,
                    };
                    for group in of {
                        for (&row, &place) in groups[group].iter().zip(places.next().unwrap()) {
                            if let Some(&input) = plan.inputs().get(usize::from(place)) {
                                found[usize::from(row) * volume + usize::from(tap)] = input;
                            }
                        }
                    }
                }
                assert!(places.next().is_none());
            }
            assert_eq!(found, rows);
            let mut inputs = plan.inputs().to_vec();
            inputs.sort_unstable();
            inputs.dedup();
            assert_eq!(inputs.len(), plan.inputs().len(), "each input row once");
        }
    }
}
