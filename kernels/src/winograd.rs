//! All eight children of voxels by minimal filtering: 64 products a voxel and pair of channels instead of up to 216.
//!
//! F(2³, 3³) after Winograd, as Lavin and Gray use it (arXiv 1509.09308): the window of 4³ positions around a voxel's children is
//! transformed, multiplied position by position with transformed weights, and transformed back to the eight children. Weights are taken
//! eightfold, so that no transform divides, and all is computed modulo 2³²: what comes back is eight times the sum, whatever wrapped on the
//! way. So results are those of the definition to the bit where no sum takes more than 29 bits.

use crate::convert::Halves;
use crate::exact::LIMIT;
use crate::family::{copy_mask, window};
use crate::machine::{with_halves, words_mut};
use crate::rows::{Extents, Lanes, PANEL};
use crate::simd::Isa;
use crate::taps::ABSENT;
use crate::tile::multiply_rows;

/// Positions of the window.
const WINDOW: usize = 64;
/// Voxels whose children are computed together: their windows and products fit the second cache. A multiple of every [`crate::tile::group`].
const PART: usize = 16;
/// Sums must stay below this, either side of zero.
const SUM_LIMIT: i64 = 1 << 28;

/// A layer's transformed weights.
#[derive(Debug, Clone)]
pub(crate) struct Weights {
    extents: Extents,
    /// Per position of the window, panel and pair of input channels: each output channel's two weights.
    words: Vec<Lanes>,
}

/// What a thread needs, kept from one call to the next.
#[derive(Default)]
pub(crate) struct Buffers {
    windows: Vec<Lanes>,
    products: Vec<Lanes>,
    masks: Vec<u64>,
}

impl Weights {
    /// Transforms the weights, of which `weights(tap, input, panel)` tells those of a panel of outputs; nothing if sums could be too large, a
    /// weight does not fit 16 bits afterwards, or input channels are not whole panels.
    pub fn new(extents: Extents, weights: impl Fn(usize, usize, usize) -> [i16; PANEL]) -> Option<Self> {
        assert_eq!(extents.volume, 27, "a window is that of a 3³ kernel");
        let cin = extents.cin;
        if !cin.is_multiple_of(PANEL) {
            return None;
        }
        let (steps, panels) = (cin / 2, extents.panels());
        let mut words = vec![Lanes::default(); WINDOW * panels * steps];
        for panel in 0..panels {
            let mut sums = [0; PANEL];
            for c in 0..cin {
                let taps: [[i16; PANEL]; 27] = std::array::from_fn(|k| weights(k, c, panel));
                for (lane, sum) in sums.iter_mut().enumerate() {
                    let taps = taps.map(|weights| i32::from(weights[lane]));
                    *sum += taps.iter().map(|tap| i64::from(tap.abs())).sum::<i64>();
                    for (at, value) in transformed(&taps).into_iter().enumerate() {
                        let value = i16::try_from(value).ok()?;
                        let place = (at * panels + panel) * steps + c / 2;
                        words[place].0[lane] |= crate::exact::place(value, c % 2);
                    }
                }
            }
            if sums.iter().any(|sum| sum * i64::from(LIMIT) >= SUM_LIMIT) {
                return None;
            }
        }
        Some(Weights { extents, words })
    }
}

/// Eightfold transformed weights: (2, 0, 0), (1, 1, 1), (1, −1, 1), (0, 0, 2) along each axis, one after the other.
fn transformed(taps: &[i32; 27]) -> [i32; WINDOW] {
    let along = |[a, b, c]: [i32; 3]| [2 * a, a + b + c, a - b + c, 2 * c];
    let x: [[i32; 4]; 9] = std::array::from_fn(|i| along([taps[3 * i], taps[3 * i + 1], taps[3 * i + 2]]));
    let y: [[[i32; 4]; 4]; 3] =
        std::array::from_fn(|z| std::array::from_fn(|i| along([x[3 * z][i], x[3 * z + 1][i], x[3 * z + 2][i]])));
    std::array::from_fn(|at| {
        let [i, j] = [at & 3, at >> 2 & 3];
        along([y[0][i][j], y[1][i][j], y[2][i][j]])[at >> 4]
    })
}

/// Registers of integers as the transforms take them: all of 16 bits, or all of 32. All arithmetic wraps.
///
/// # Safety
/// Its functions may use instructions that not every processor has, and read and write `BYTES` bytes, aligned or not; they must only be called
/// where the processor has them and the bytes are there.
pub(crate) unsafe trait Registers {
    /// A register.
    type Register: Copy;
    /// Registers that need no wider rows than [`PANEL`] channels of 16 bits.
    type Narrow: Registers;
    /// Its size; divides that of a panel of 32 bits.
    const BYTES: usize;

    /// Reads.
    unsafe fn read(at: *const u8) -> Self::Register;
    /// Writes.
    unsafe fn write(at: *mut u8, register: Self::Register);
    /// `a + b` in 16 bits.
    unsafe fn add16(a: Self::Register, b: Self::Register) -> Self::Register;
    /// `a − b` in 16 bits.
    unsafe fn sub16(a: Self::Register, b: Self::Register) -> Self::Register;
    /// `a + b` in 32 bits.
    unsafe fn add32(a: Self::Register, b: Self::Register) -> Self::Register;
    /// `a − b` in 32 bits.
    unsafe fn sub32(a: Self::Register, b: Self::Register) -> Self::Register;
    /// `a / 8` in 32 bits, towards −∞.
    unsafe fn eighth(a: Self::Register) -> Self::Register;
}

/// Words between positions of windows and products beyond what they hold: without, all positions of a voxel fall into few sets of the cache.
const GAP: usize = PANEL;

/// The sums of all children of voxels: `sums[child · panels + panel]`, and which taps of each child read something.
///
/// `neighbours` are 27 of each voxel; child `o` of voxel `q` is row `8q + o` of the input.
///
/// # Panics
/// If a child's row lies beyond the input.
pub(crate) fn accumulate<'a>(
    isa: Isa,
    weights: &Weights,
    neighbours: &[u32],
    input: &[i16],
    buffers: &'a mut Buffers,
    sums: &mut Vec<Lanes>,
) -> &'a [u64] {
    let Extents { cin, cout, .. } = weights.extents;
    let (steps, panels) = (cin / 2, weights.extents.panels());
    let Buffers {
        windows,
        products,
        masks,
    } = buffers;
    let stride = PART * steps + GAP;
    windows.resize(WINDOW * stride / PANEL, Lanes::default());
    let between = PART * panels + GAP / PANEL;
    products.resize(WINDOW * between, Lanes::default());
    sums.resize(neighbours.len() / 27 * 8 * panels, Lanes::default());
    masks.clear();
    let parts = neighbours.chunks(PART * 27);
    for (neighbours, sums) in parts.zip(sums.chunks_mut(PART * 8 * panels)) {
        let windows = words_mut(windows);
        with_halves!(isa, fn forward<>(neighbours: &[u32], input: &[i16], cin: usize, windows: &mut [u32], masks: &mut Vec<u64>));
        let rows = windows.chunks_exact(stride);
        let weights = weights.words.chunks_exact(panels * steps);
        let each = rows.zip(weights).zip(products.chunks_exact_mut(between));
        for ((rows, weights), products) in each {
            let (rows, products) = (&rows[..PART * steps], &mut products[..PART * panels]);
            multiply_rows(isa, cout, weights, rows, products);
        }
        with_halves!(isa, fn back<>(products: &[Lanes], panels: usize, sums: &mut [Lanes]));
    }
    masks
}

/// Gathers and transforms the windows of up to [`PART`] voxels: `[position][voxel][channel]`, positions [`GAP`] apart.
///
/// # Safety
/// The processor must have `H`'s instructions.
#[inline(always)]
unsafe fn forward<H: Halves>(neighbours: &[u32], input: &[i16], cin: usize, windows: &mut [u32], masks: &mut Vec<u64>) {
    // SAFETY: the caller's promise; rows of whole panels are of whole registers of a kind.
    unsafe {
        match (2 * cin).is_multiple_of(H::BYTES) {
            true => forward_by::<H>(neighbours, input, cin, windows, masks),
            false => forward_by::<H::Narrow>(neighbours, input, cin, windows, masks),
        }
    }
}

/// What a window reads where nothing is.
static NOTHING: Lanes = Lanes([0; PANEL]);

/// # Safety
/// As [`forward`], and a row must consist of whole registers.
#[inline(always)]
unsafe fn forward_by<R: Registers>(
    neighbours: &[u32],
    input: &[i16],
    cin: usize,
    windows: &mut [u32],
    masks: &mut Vec<u64>,
) {
    let (row, rows) = (2 * cin, input.len() / cin);
    let stride = PART * row + 4 * GAP;
    assert!(neighbours.len() <= PART * 27 && 4 * windows.len() >= WINDOW * stride);
    let to = windows.as_mut_ptr().cast::<u8>();
    let from = input.as_ptr().cast::<u8>();
    for (voxel, neighbours) in neighbours.chunks_exact(27).enumerate() {
        let window = window(neighbours, |q, octant| q << 3 | octant);
        let end = window.iter().fold(0, |end, at| end.max(at.wrapping_add(1)));
        assert!(
            end as usize <= rows,
            "a tap reads row {}, but the input has {rows}",
            end - 1
        );
        masks.extend((0..8).map(|octant| copy_mask(&window, octant)));
        for byte in (0..row).step_by(R::BYTES) {
            // SAFETY: rows of the window lie below `rows`, and `NOTHING` is as long as the longest register; what is written lies
            // within the row of this voxel, of each position.
            unsafe {
                let read = |at: usize| match window[at] {
                    ABSENT => R::read((&raw const NOTHING).cast()),
                    q => R::read(from.add(q as usize * row + byte)),
                };
                let mut values = [read(0); WINDOW];
                for z in (0..WINDOW).step_by(16) {
                    for y in (z..z + 16).step_by(4) {
                        let line = [read(y), read(y + 1), read(y + 2), read(y + 3)];
                        values[y..y + 4].copy_from_slice(&differences::<R>(line));
                    }
                    for x in z..z + 4 {
                        let at = [x, x + 4, x + 8, x + 12];
                        let line = differences::<R>(at.map(|at| values[at]));
                        for (at, value) in at.into_iter().zip(line) {
                            values[at] = value;
                        }
                    }
                }
                let to = to.add(voxel * row + byte);
                for i in 0..16 {
                    let at = [i, i + 16, i + 32, i + 48];
                    let line = differences::<R>(at.map(|at| values[at]));
                    for (at, value) in at.into_iter().zip(line) {
                        R::write(to.add(at * stride), value);
                    }
                }
            }
        }
    }
}

/// a − c, b + c, c − b, b − d.
///
/// # Safety
/// The processor must have `R`'s instructions.
#[inline(always)]
unsafe fn differences<R: Registers>([a, b, c, d]: [R::Register; 4]) -> [R::Register; 4] {
    // SAFETY: the caller's promise.
    unsafe { [R::sub16(a, c), R::add16(b, c), R::sub16(c, b), R::sub16(b, d)] }
}

/// Transforms products `[position][voxel][panel]`, positions [`GAP`] apart, back to the sums of eight children a voxel.
///
/// # Safety
/// The processor must have `H`'s instructions.
#[inline(always)]
unsafe fn back<H: Halves>(products: &[Lanes], panels: usize, sums: &mut [Lanes]) {
    let row = size_of::<Lanes>() * panels;
    let stride = PART * row + 4 * GAP;
    assert!(size_of_val(products) >= WINDOW * stride && size_of_val(sums) <= PART * 8 * row);
    let from = products.as_ptr().cast::<u8>();
    for (voxel, sums) in sums.chunks_exact_mut(8 * panels).enumerate() {
        let to = sums.as_mut_ptr().cast::<u8>();
        for byte in (0..row).step_by(H::BYTES) {
            // SAFETY: what is read lies within this voxel's products, what is written within its children's sums.
            unsafe {
                let read = |at: usize| H::read(from.add(at * stride + voxel * row + byte));
                let [mut low, mut high] = [[read(0); 16]; 2];
                for (i, (low, high)) in low.iter_mut().zip(&mut high).enumerate() {
                    let line = [read(i), read(i + 16), read(i + 32), read(i + 48)];
                    [*low, *high] = join::<H>(line);
                }
                for (z, plane) in [low, high].iter().enumerate() {
                    let mut lines = [[plane[0]; 4]; 2];
                    for x in 0..4 {
                        let line = [plane[x], plane[x + 4], plane[x + 8], plane[x + 12]];
                        [lines[0][x], lines[1][x]] = join::<H>(line);
                    }
                    for (y, line) in lines.into_iter().enumerate() {
                        for (x, value) in join::<H>(line).into_iter().enumerate() {
                            let child = x + 2 * y + 4 * z;
                            H::write(to.add(child * row + byte), H::eighth(value));
                        }
                    }
                }
            }
        }
    }
}

/// a + b + c, b − c − d.
///
/// # Safety
/// The processor must have `R`'s instructions.
#[inline(always)]
unsafe fn join<R: Registers>([a, b, c, d]: [R::Register; 4]) -> [R::Register; 2] {
    // SAFETY: the caller's promise.
    unsafe {
        let (sum, difference) = (R::add32(b, c), R::sub32(b, c));
        [R::add32(a, sum), R::sub32(difference, d)]
    }
}
