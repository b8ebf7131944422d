//! What a value between cells gives to the eight around it, in integers.

use crate::simd::{I32Vector, Simd};

/// Numbers of a cell: sums of weights, and of three weighted values.
pub const NUMBERS: usize = 4;
/// Parts of the side of a cell: a place is a whole number of them.
pub const PARTS: i32 = 16;

/// Of each number of parts that a place is beyond a cell, what this cell gets, and the one after it, along an axis.
const SHARES: [[i32; 2 * NUMBERS]; PARTS as usize] = {
    let mut shares = [[0; 2 * NUMBERS]; PARTS as usize];
    let mut high = 0;
    while high < PARTS as usize {
        let mut i = 0;
        while i < NUMBERS {
            shares[high][i] = PARTS - high as i32;
            shares[high][NUMBERS + i] = high as i32;
            i += 1;
        }
        high += 1;
    }
    shares
};

/// Adds to the cell whose numbers begin at `first`, and to those one further on along one axis or more, their shares of
/// `value`: 1 and three values, twice. It is `high` parts beyond the cell along each axis, 0 to 15. Cells are next to each
/// other along x, `row` numbers apart along y, and `layer` along z. Sums are modulo 2³².
///
/// # Panics
/// If there are no such cells.
#[inline(always)]
pub fn scatter<S: Simd>(
    simd: S,
    cells: &mut [i32],
    first: usize,
    [row, layer]: [usize; 2],
    value: &[i16; 2 * NUMBERS],
    high: [i32; 3],
) {
    scatter_narrow(simd.narrow(), cells, first, [row, layer], value, high);
}

#[inline(always)]
fn scatter_narrow<S: Simd>(
    simd: S,
    cells: &mut [i32],
    first: usize,
    [row, layer]: [usize; 2],
    value: &[i16; 2 * NUMBERS],
    [x, y, z]: [i32; 3],
) {
    let shares = &SHARES[x as usize & 15];
    for at in (0..2 * NUMBERS).step_by(S::LANES) {
        let along_x = S::I32::load_i16(simd, &value[at..]) * S::I32::load(simd, &shares[at..]);
        let mut give = |step: usize, weight: i32| {
            let cells = &mut cells[first + step + at..][..S::LANES];
            (S::I32::load(simd, cells) + along_x * S::I32::splat(simd, weight)).store(cells);
        };
        give(0, (PARTS - y) * (PARTS - z));
        give(row, y * (PARTS - z));
        give(layer, (PARTS - y) * z);
        give(row + layer, y * z);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Isa, Work};
    use proptest::prelude::*;

    const SIDE: usize = 4;
    const ROW: usize = NUMBERS * SIDE;
    const LAYER: usize = ROW * SIDE;

    fn plain(cells: &mut [i32], at: [usize; 3], value: &[i16; 8], high: [i32; 3]) {
        for corner in 0..8 {
            let step = [corner & 1, corner >> 1 & 1, corner >> 2];
            let share = |axis: usize| if step[axis] == 1 { high[axis] } else { 16 - high[axis] };
            let cell = [0, 1, 2].map(|axis| at[axis] + step[axis]);
            let first = NUMBERS * cell[0] + ROW * cell[1] + LAYER * cell[2];
            for (number, value) in cells[first..][..NUMBERS].iter_mut().zip(value) {
                let given = share(0) * share(1) * share(2) * i32::from(*value);
                *number = number.wrapping_add(given);
            }
        }
    }

    struct Scatter<'a> {
        cells: &'a mut [i32],
        voxels: &'a [([usize; 3], [i16; 8], [i32; 3])],
    }

    impl Work for Scatter<'_> {
        type Output = ();

        #[inline(always)]
        fn run<S: Simd>(self, simd: S) {
            for (at, value, high) in self.voxels {
                let first = NUMBERS * at[0] + ROW * at[1] + LAYER * at[2];
                scatter(simd, self.cells, first, [ROW, LAYER], value, *high);
            }
        }
    }

    proptest! {
        #[test]
        fn every_instruction_set_gives_what_plain_code_does(
            voxels in prop::collection::vec(
                (prop::array::uniform3(0..SIDE - 1), prop::array::uniform3(any::<i16>()), prop::array::uniform3(0..16)),
                0..60,
            ),
            before in prop::collection::vec(any::<i32>(), LAYER * SIDE),
        ) {
            let voxels: Vec<_> = { voxels.into_iter() }
                .map(|(at, [y, co, cg], high)| (at, [1, y, co, cg, 1, y, co, cg], high))
                .collect();
            let mut expected = before.clone();
            for (at, value, high) in &voxels {
                plain(&mut expected, *at, value, *high);
            }
            for isa in Isa::available() {
                let mut cells = before.clone();
                isa.run(Scatter { cells: &mut cells, voxels: &voxels });
                prop_assert_eq!(&cells, &expected, "{}", isa);
            }
        }
    }
}
