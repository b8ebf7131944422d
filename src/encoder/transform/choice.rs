//! Rate–distortion choice of what the blocks of a predicted frame show.
//!
//! Two samplings of one surface differ in many voxels, and coding them tells nothing of the surface. Each cell of 4³
//! voxels of the finest level therefore shows what minimises D + λ·R of
//!
//! - *copy*: the voxels of the moved previous frame;
//! - *mend*: the same without those that have no true voxel within one, with the true ones that have no copied one
//!   within one;
//! - *own*: the true voxels.
//!
//! A block whose cells are all copied, colours included, is *kept*, if coding what differs saves less distortion than
//! it costs bits. D is compared with the true frame, never with the previous one, so that errors do not add up.
//! Differences of colours that sampling explains (`noise.rs`) are no distortion, and are left out of what is coded.

use rayon::prelude::*;

use super::motion::{AROUND, Block, CENTRE, Search};
use super::noise::Chance;
use crate::colour::Ycc;
use crate::geometry::{Voxels, morton};
use crate::motion::{Places, PreviousLevel};

/// Voxels along the side of a cell.
const CELL: i32 = 4;
/// λ of frames that move in blocks and of warped ones, and the mean squared error up to which coefficients are not coded,
/// in squared steps.
const LAMBDA: [f32; 2] = [0.045, 0.06];
const FLOOR: f32 = 0.06;
/// Squared error of luma, in 255ths, that stands for a squared voxel of displacement: about what pictures lose of both.
const PLACE: f32 = 3000.0;
/// Bits of a voxel that is not where it is predicted.
const CHANGED_BITS: f32 = 2.5;
/// What a voxel that is displaced by one costs, if it stays, as a share of what it costs to code it: at levels above the
/// cloud's own one, and at that one. It may be chance, but roughens the surface, more from frame to frame.
const ROUGH: [f32; 2] = [0.5, 0.75];
/// Bits of a voxel that is as it is predicted, in a block that is not kept: of its place and colour.
const STEADY_BITS: f32 = 0.5;
/// The square of a sum of displacements that chance alone brings, for each voxel that is displaced.
const CHANCE: f32 = 0.7;
/// How many times a frame's squared error of sampling both frames together may differ by: where nothing moves, by that of
/// both. Elsewhere vectors of whole voxels bring errors of their own, which must not add up.
const SAMPLINGS: [f32; 2] = [2.0, 1.5];

/// What bits and errors are worth.
#[derive(Debug, Clone, Copy)]
pub(super) struct Weights {
    /// Squared error of luma, in 255ths, that a bit must save.
    pub lambda: f32,
    /// Mean squared error up to which coefficients are not coded.
    pub floor: f32,
    /// What a voxel costs that is displaced by one, as a share of what it costs to code it.
    pub rough: f32,
}

impl Weights {
    /// Those of a quantisation step of luma, in 255ths, at the cloud's `own` level or one above it, of a frame that is
    /// `warped` or not.
    pub fn of_step(step: f32, own: bool, warped: bool) -> Self {
        Weights {
            rough: ROUGH[usize::from(own)],
            lambda: LAMBDA[usize::from(warped)] * step * step,
            floor: FLOOR * step * step,
        }
    }
}

/// Voxels that a block shows: their keys, and their colours if they are copied.
pub(super) type Shown = Vec<(u64, Option<Ycc>)>;

/// A cell's differences between both frames.
#[derive(Debug, Clone, Copy, Default)]
struct Cell {
    /// Voxels of either frame; those that have none at their place in the other; those that have none within one.
    placed: f32,
    near: f32,
    far: f32,
    displaced: [f32; 3],
    /// Voxels whose colours were compared; sums of differences, and of their squares.
    coloured: f32,
    sums: [f32; 3],
    squares: f32,
    /// The squared error that chance alone brings to a colour of the block.
    chance: f32,
    show: Show,
}

/// What a cell shows.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
enum Show {
    #[default]
    Copy,
    Mend,
    Own,
}

impl Cell {
    /// Compares a voxel with the cells `around` it in the other frame. `sign` tells from which side.
    fn place(&mut self, mut around: u64, sign: f32) {
        self.placed += 1.0;
        if around & CENTRE != 0 {
            return;
        }
        if around == 0 {
            self.far += 1.0;
            return;
        }
        self.near += 1.0;
        let weight = sign / around.count_ones() as f32;
        while around != 0 {
            let cell = around.trailing_zeros();
            around &= around - 1;
            for axis in 0..3 {
                self.displaced[axis] += weight * ((cell >> (2 * axis) & 3) as f32 - 1.0);
            }
        }
    }

    /// Compares colours, in 255ths.
    fn colour(&mut self, apart: [f32; 3]) {
        let apart = in_255ths(apart);
        self.coloured += 1.0;
        for (sum, apart) in self.sums.iter_mut().zip(apart) {
            *sum += apart;
            self.squares += apart * apart;
        }
    }

    /// Squared voxels of the cell's displacement as a whole, over its voxels, without what chance brings.
    fn drift(&self) -> f32 {
        if self.placed == 0.0 {
            return 0.0;
        }
        let squares: f32 = self.displaced.iter().map(|sum| sum * sum).sum();
        (squares - CHANCE * self.near).max(0.0) / self.placed
    }

    /// Chooses what is shown. Returns the Lagrangian costs of a copy, and of the choice.
    fn choose(&mut self, weights: Weights) -> [f32; 2] {
        // Both frames' voxels are counted.
        let changed = weights.lambda * CHANGED_BITS;
        let drift = PLACE * self.drift() / 2.0 + weights.rough * changed * self.near;
        let copy = drift + PLACE * self.far;
        let mend = drift + changed * self.far;
        let own = changed * (self.far + self.near);
        let (show, cost) = match () {
            _ if copy <= mend && copy <= own => (Show::Copy, copy),
            _ if mend <= own => (Show::Mend, mend),
            _ => (Show::Own, own),
        };
        self.show = show;
        [copy, cost]
    }

    /// Squared errors of copied colours as a whole, and of the rest.
    fn squares(&self) -> [f32; 2] {
        let whole = self.sums.iter().map(|sum| sum * sum).sum::<f32>() / self.coloured.max(1.0);
        [whole, (self.squares - whole).max(0.0)]
    }

    /// The errors less what chance brings; below 0 where it brought less.
    fn apart(&self) -> [f32; 2] {
        let [whole, rest] = self.squares();
        [whole - self.chance, rest - self.chance * (self.coloured - 1.0).max(0.0)]
    }

    /// What a voxel's colour is to become that differs by `apart` from the copied one: the difference of the cell, and the
    /// voxel's own, each as far as chance does not explain them.
    fn change(&self, apart: [f32; 3]) -> [f32; 3] {
        let squares = self.squares();
        let left = self.apart().map(|x| x.max(0.0));
        let [whole, rest] = [0, 1].map(|i| if squares[i] > 0.0 { left[i] / squares[i] } else { 0.0 });
        [0, 1, 2].map(|t| {
            let scale = if t == 0 { 1.0 } else { 2.0 };
            let mean = scale * self.sums[t] / self.coloured.max(1.0);
            whole * mean + rest * (apart[t] - mean)
        })
    }

    /// Lagrangian costs of colours that are copied, and of coded ones. The former is below 0 where chance brought less
    /// than it does on average, so that a block has its sum.
    fn colours(&self, weights: Weights) -> [f32; 2] {
        if self.coloured == 0.0 {
            return [0.0; 2];
        }
        let coded = |x: f32, count: f32| {
            let mean = x / count;
            match mean <= weights.floor {
                true => x,
                false => count * weights.floor * (1.0 + (mean / weights.floor).ln()),
            }
        };
        let [whole, rest] = self.apart();
        let rate = weights.lambda * STEADY_BITS * self.coloured;
        let coded = coded(whole.max(0.0), 1.0) + coded(rest.max(0.0), self.coloured);
        [whole + rest, coded + rate]
    }
}

/// A difference of colours, in 255ths, whose squares can be added up: as much error in red, green and blue comes of twice
/// as much chroma.
pub(super) fn in_255ths(apart: [f32; 3]) -> [f32; 3] {
    [apart[0], apart[1] / 2.0, apart[2] / 2.0]
}

/// A block and the moved previous frame.
struct Compared {
    /// The places of its voxels, each with the 3³ cells around it in the moved previous frame.
    own: Vec<([i32; 3], u64)>,
    /// The voxels of the moved previous frame: places, numbers there, and the cells around them in this frame.
    copied: Vec<([i32; 3], usize, u64)>,
    cells: Vec<Cell>,
    /// Voxels along its side.
    side: i32,
}

impl Compared {
    /// Compares a block with the previous frame moved by `vector`.
    fn new(search: &Search, key: u64, vector: [i16; 3], [previous, current]: [&PreviousLevel; 2]) -> Self {
        let side = 1i32 << (search.top - search.block_level);
        let cells = (side / CELL).max(1);
        let mut compared = Compared {
            own: Vec::new(),
            copied: Vec::new(),
            cells: vec![Cell::default(); (cells * cells * cells) as usize],
            side,
        };
        let mut chance = Chance::default();
        let around = |other: &PreviousLevel, at: [i32; 3]| other.window(at.map(|x| x - 1)) & AROUND;
        let voxels = search.octree.level(search.top);
        for i in search.voxels(search.top, key) {
            let at = voxels.coordinate(i).map(|x| x as i32);
            let from = [0, 1, 2].map(|axis| at[axis] - i32::from(vector[axis]));
            let there = around(previous, from);
            let number = compared.number(at);
            let cell = &mut compared.cells[number];
            cell.place(there, 1.0);
            if let Some(colour) = colour_near(previous, from, there) {
                let truth = search.truth.level(search.top)[i];
                cell.colour(apart(truth, colour));
                chance.add(search.samples[i]);
            }
            compared.own.push((at, there));
        }
        let chance = SAMPLINGS[usize::from(vector != [0; 3])] * chance.squared_error();
        compared.cells.iter_mut().for_each(|cell| cell.chance = chance);
        for (at, index) in search.moved(key, vector) {
            let (there, number) = (around(current, at), compared.number(at));
            compared.cells[number].place(there, -1.0);
            compared.copied.push((at, index, there));
        }
        compared
    }

    /// The cell that a place is in.
    fn number(&self, at: [i32; 3]) -> usize {
        let cells = (self.side / CELL).max(1);
        let [x, y, z] = at.map(|x| (x & (self.side - 1)) / CELL);
        (x + cells * (y + cells * z)) as usize
    }

    /// Lagrangian costs of a copy, and of what is best for each cell, which is chosen.
    fn costs(&mut self, weights: Weights) -> [f32; 2] {
        let (mut places, mut colours) = ([0.0; 2], [0.0; 2]);
        for cell in &mut self.cells {
            let costs = [cell.choose(weights), cell.colours(weights)];
            (0..2).for_each(|i| (places[i], colours[i]) = (places[i] + costs[0][i], colours[i] + costs[1][i]));
        }
        [0, 1].map(|i| places[i] + colours[i].max(0.0))
    }
}

/// The difference of a colour to another one, in 255ths.
fn apart(a: Ycc, b: [f32; 3]) -> [f32; 3] {
    [0, 1, 2].map(|t| (f32::from(a[t]) - b[t]) / 64.0)
}

/// The finest level of the previous frame, and of this one.
fn levels<'a>(search: &'a Search) -> Option<[&'a PreviousLevel; 2]> {
    Some([search.previous.level(search.top)?, search.current.level(search.top)?])
}

/// The Lagrangian costs of a block whose vector is `vector`, without that of the vector: if it is kept, and if not.
pub(super) fn costs(search: &Search, key: u64, vector: [i16; 3], weights: Weights) -> [f32; 2] {
    match levels(search) {
        Some(levels) => Compared::new(search, key, vector, levels).costs(weights),
        None => [0.0; 2],
    }
}

/// The lesser of both.
pub(super) fn cost(search: &Search, key: u64, vector: [i16; 3], weights: Weights) -> f32 {
    let [kept, coded] = costs(search, key, vector, weights);
    kept.min(coded)
}

/// Chooses what a block shows, and whether it is kept, unless that is known.
pub(super) fn choose(search: &Search, block: &mut Block, weights: Weights) -> Shown {
    let Some(levels) = levels(search) else {
        return own(search, block);
    };
    let mut compared = Compared::new(search, block.key, block.vector, levels);
    let costs = compared.costs(weights);
    block.keep |= costs[0] <= costs[1] && !compared.copied.is_empty();
    let mut shown = Shown::new();
    let key = |at: [i32; 3]| morton::encode(at.map(|x| x as u32));
    for &(at, index, there) in &compared.copied {
        let cell = &compared.cells[compared.number(at)];
        let show = if block.keep { Show::Copy } else { cell.show };
        match show {
            Show::Own => {}
            Show::Mend if there == 0 => {}
            _ if block.keep || there & CENTRE == 0 => shown.push((key(at), Some(levels[0].values[index]))),
            _ => {
                let old = levels[0].values[index];
                let colour = levels[1].index(at).map(|i| {
                    let change = cell.change(apart(levels[1].values[i], old.map(f32::from)));
                    [0, 1, 2].map(|t| (f32::from(old[t]) + 64.0 * change[t]).round() as i16)
                });
                shown.push((key(at), colour));
            }
        }
    }
    for &(at, there) in &compared.own {
        let missing = match compared.cells[compared.number(at)].show {
            Show::Own => true,
            Show::Mend => there == 0,
            Show::Copy => false,
        };
        if missing && !block.keep {
            shown.push((key(at), None));
        }
    }
    if shown.is_empty() && !block.keep {
        return own(search, block);
    }
    shown
}

/// Adds the true voxels that are in holes of what all blocks show together: what moves apart leaves gaps. Blocks that are
/// kept and move together have what they had.
pub(super) fn close(search: &Search, blocks: &[Block], shown: &mut Shown) {
    let Some(current) = search.current.level(search.top) else {
        return;
    };
    shown.sort_unstable_by_key(|voxel| voxel.0);
    let keys = shown.iter().map(|voxel| voxel.0).collect();
    let places = Places::new(&Voxels::from_sorted(search.top, keys));
    let voxels = search.octree.level(search.top);
    let holes = (0..voxels.len()).into_par_iter().filter(|i| {
        let at = voxels.coordinate(*i).map(|x| x as i32);
        !is_steady(search, blocks, at) && in_a_hole(&places, at, normal(current.window(at.map(|x| x - 1))))
    });
    let holes: Vec<_> = holes.map(|i| (voxels.keys()[i], None)).collect();
    shown.extend(holes);
    shown.sort_unstable_by_key(|voxel| voxel.0);
}

/// Whether all blocks within two of a place are kept, and move together.
fn is_steady(search: &Search, blocks: &[Block], at: [i32; 3]) -> bool {
    let down = search.top - search.block_level;
    let block_at = |corner: i32| {
        let step = [corner & 1, corner >> 1 & 1, corner >> 2];
        let place = [0, 1, 2].map(|axis| (at[axis] + 4 * step[axis] - 2).max(0) as u32 >> down);
        let key = morton::encode(place);
        blocks
            .binary_search_by_key(&key, |block| block.key)
            .ok()
            .map(|i| &blocks[i])
    };
    let mut around = (0..8).filter_map(block_at);
    let first = around.next();
    first.is_none_or(|first| first.keep && around.all(|block| block.keep && block.vector == first.vector))
}

/// Whether nothing is shown within one of a place along the axis `normal`, but on two opposite sides of it.
fn in_a_hole(places: &Places, at: [i32; 3], normal: usize) -> bool {
    let beside = |axis: usize, offset: i32| {
        (-1..=1).any(|height| {
            let mut place = at;
            place[axis] += offset;
            place[normal] += height;
            places.index(place).is_some()
        })
    };
    let across = |axis: usize| {
        [[1, 2], [-1, -2]]
            .iter()
            .all(|side| side.iter().any(|x| beside(axis, *x)))
    };
    !beside(normal, 0) && (0..3).any(|axis| axis != normal && across(axis))
}

/// The axis nearest to the normal of a surface of which 3³ cells are known: along it the fewest of them are before and
/// behind the middle.
fn normal(surface: u64) -> usize {
    /// The cells that are not in the middle along each axis.
    const BESIDE: [u64; 3] = [0x0555_0555_0555, 0x0707_0707_0707, 0x0777_0000_0777];
    let beside = |axis: &usize| (surface & BESIDE[*axis]).count_ones();
    (0..3).min_by_key(beside).unwrap_or(0)
}

/// The block's true voxels.
pub(super) fn own(search: &Search, block: &Block) -> Shown {
    let keys = search.octree.level(search.top).keys();
    search.voxels(search.top, block.key).map(|i| (keys[i], None)).collect()
}

/// The colour at a place, or the mean of those around it.
fn colour_near(level: &PreviousLevel, at: [i32; 3], mut around: u64) -> Option<[f32; 3]> {
    if around & CENTRE != 0 {
        around = CENTRE;
    }
    let (mut sum, mut count) = ([0.0; 3], 0.0);
    while around != 0 {
        let cell = around.trailing_zeros() as i32;
        around &= around - 1;
        let place = [0, 1, 2].map(|axis| at[axis] + (cell >> (2 * axis) & 3) - 1);
        if let Some(index) = level.index(place) {
            (0..3).for_each(|t| sum[t] += f32::from(level.values[index][t]));
            count += 1.0;
        }
    }
    (count > 0.0).then(|| sum.map(|x| x / count))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cells(inside: impl Fn([i32; 3]) -> bool) -> u64 {
        let places = (0..27).map(|i| [i % 3, i / 3 % 3, i / 9]);
        let occupied = places.filter(|at| inside(at.map(|x| x - 1)));
        occupied.map(|[x, y, z]| 1 << (x + 4 * y + 16 * z)).sum()
    }

    #[test]
    fn what_chance_explains_costs_nothing_and_changes_nothing() {
        let weights = Weights::of_step(8.0, false, false);
        let cell = |shift: f32| {
            let mut cell = Cell {
                chance: 50.0,
                ..Cell::default()
            };
            (0..64).for_each(|i| cell.colour([shift + if i % 2 == 0 { 5.0 } else { -5.0 }, 0.0, 0.0]));
            cell
        };
        let noise = cell(0.0);
        assert!(noise.colours(weights)[0] <= 0.0);
        assert_eq!(noise.change([5.0, 0.0, 0.0]), [0.0; 3]);
        // The light changes: the noise is still left out.
        let lighter = cell(30.0);
        let [copied, coded] = lighter.colours(weights);
        assert!(coded < copied);
        let change = lighter.change([35.0, 0.0, 0.0]);
        assert!((change[0] - 30.0).abs() < 1.0, "{change:?}");
        // What is not known to be noise counts in full.
        let mut unknown = Cell::default();
        unknown.colour([5.0, 8.0, 0.0]);
        assert_eq!(unknown.change([5.0, 8.0, 0.0]), [5.0, 8.0, 0.0]);
    }

    #[test]
    fn the_normal_is_the_axis_across_a_surface() {
        for axis in 0..3 {
            assert_eq!(normal(cells(|at| at[axis] == 0)), axis);
            let other = (axis + 1) % 3;
            let slanted = |at: [i32; 3]| at[axis] == i32::from(at[other] > 0);
            assert_eq!(normal(cells(slanted)), axis);
        }
    }

    #[test]
    fn gaps_of_a_surface_are_holes_but_its_edges_and_what_moved_across_it_are_not() {
        // The plane z = 8 for x below 12, with a gap of two voxels.
        let shown = |[x, _, z]: [u32; 3]| z == 8 && x < 12 && x != 5 && x != 6;
        let all = (0..1 << 12).filter(|key| shown(morton::decode(*key)));
        let places = Places::new(&Voxels::new(4, all.collect()));
        for (x, z, hole) in [
            (5, 8, true),
            (6, 8, true),
            (4, 8, false),
            (4, 9, false),
            (12, 8, false),
            (13, 8, false),
        ] {
            assert_eq!(in_a_hole(&places, [x, 7, z], 2), hole, "{x} {z}");
        }
        // The true surface is one higher.
        assert!(in_a_hole(&places, [5, 7, 9], 2));
    }
}
