//! What both convolutions share: words of 32 bits in panels, the extents of weights, and where a layer writes.

use bytemuck::{Pod, Zeroable};

/// Channels of one weight panel.
pub(crate) const PANEL: usize = 16;
/// Output rows of a tile: enough that every tap finds full blocks, few enough that their sums stay in the cache.
pub(crate) const TILE: usize = 512;
/// Taps of the largest kernel: as many bits, and a tile's row, fit a word.
pub(crate) const MOST_TAPS: usize = 54;
/// The numbers of a tile's rows.
pub(crate) static IN_ORDER: [u16; TILE] = {
    let mut rows = [0; TILE];
    let mut i = 0;
    while i < TILE {
        rows[i] = i as u16;
        i += 1;
    }
    rows
};
/// By how many rows memory is asked before they are read.
pub(crate) const AHEAD: usize = 32;

/// Where a layer writes, and what it adds on the way.
pub struct Output<'a, T, R = T> {
    /// Whole rows of `stride` values, one after the other.
    pub rows: &'a mut [T],
    /// Values per row.
    pub stride: usize,
    /// The first value of each row that the layer writes.
    pub column: usize,
    /// Laid out as `rows`: added to what is written.
    pub residual: Option<&'a [R]>,
    /// Whether negative results become zero, after the addition.
    pub relu: bool,
}

impl<T, R> Output<'_, T, R> {
    /// The output cut into tiles, each with the number of its first row.
    pub(crate) fn tiles(&mut self) -> impl Iterator<Item = (usize, Output<'_, T, R>)> {
        let (stride, column, residual, relu) = (self.stride, self.column, self.residual, self.relu);
        self.rows.chunks_mut(TILE * stride).enumerate().map(move |(t, rows)| {
            let residual = residual.map(|all| &all[t * TILE * stride..][..rows.len()]);
            let output = Output {
                rows,
                stride,
                column,
                residual,
                relu,
            };
            (t * TILE, output)
        })
    }

    /// Rows.
    pub(crate) fn len(&self) -> usize {
        self.rows.len() / self.stride
    }
}

/// Sixteen words of 32 bits: a panel's sums, or its weights of one step. Floats are kept as their bits.
#[repr(C, align(64))]
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct Words(pub [u32; PANEL]);

impl Words {
    /// The words as signed integers.
    #[inline(always)]
    pub fn i32(&self) -> &[i32; PANEL] {
        bytemuck::must_cast_ref(&self.0)
    }

    /// The words as signed integers.
    #[inline(always)]
    pub fn i32_mut(&mut self) -> &mut [i32; PANEL] {
        bytemuck::must_cast_mut(&mut self.0)
    }

    /// The words as floats.
    #[cfg(feature = "close")]
    #[inline(always)]
    pub fn f32(&self) -> &[f32; PANEL] {
        bytemuck::must_cast_ref(&self.0)
    }
}

/// One value per channel, in whole panels; the rest is zero.
pub(crate) fn panels<T: Copy + Default>(values: &[T]) -> Vec<[T; PANEL]> {
    let panel = |chunk: &[T]| {
        let mut panel = [T::default(); PANEL];
        panel[..chunk.len()].copy_from_slice(chunk);
        panel
    };
    values.chunks(PANEL).map(panel).collect()
}

/// At most a panel's values, and zeros after them.
#[cfg(feature = "close")]
#[inline(always)]
pub(crate) fn panel<T: Copy + Default>(from: &[T]) -> [T; PANEL] {
    match <&[T; PANEL]>::try_from(from) {
        Ok(from) => *from,
        Err(_) => part(from),
    }
}

/// Values of half a panel, which many layers end with.
const HALF: usize = PANEL / 2;

/// Less than a panel's values, and zeros after them.
#[inline(always)]
pub(crate) fn part<T: Copy + Default>(from: &[T]) -> [T; PANEL] {
    let mut to = [T::default(); PANEL];
    match from.split_first_chunk::<HALF>() {
        Some((from, [])) => to[..HALF].copy_from_slice(from),
        _ => to = any_part(from),
    }
    to
}

/// Apart, or else compilers make one copy of any length of both.
#[inline(never)]
fn any_part<T: Copy + Default>(from: &[T]) -> [T; PANEL] {
    let mut to = [T::default(); PANEL];
    to[..from.len()].copy_from_slice(from);
    to
}

/// Writes as many of a panel's values as there is room for.
#[inline(always)]
pub(crate) fn store_part<T: Copy>(from: [T; PANEL], to: &mut [T]) {
    match to.split_first_chunk_mut::<HALF>() {
        Some((to, [])) => to.copy_from_slice(&from[..HALF]),
        _ => store_any(&from, to),
    }
}

#[inline(never)]
fn store_any<T: Copy>(from: &[T; PANEL], to: &mut [T]) {
    to.copy_from_slice(&from[..to.len()]);
}

/// The extents of a layer's weights.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Extents {
    pub volume: usize,
    pub cin: usize,
    pub cout: usize,
}

impl Extents {
    pub fn panels(&self) -> usize {
        self.cout.div_ceil(PANEL)
    }

    /// Checks that `len` weights fill the extents.
    pub fn check(&self, len: usize) {
        assert!(
            self.volume > 0 && self.cin > 0 && self.cout > 0,
            "a layer has no extent"
        );
        assert!(self.volume <= MOST_TAPS, "a kernel has too many taps");
        assert_eq!(
            len,
            self.volume * self.cin * self.cout,
            "weights must fill [volume, cin, cout]"
        );
    }

    /// Tap, input and panel of outputs of each panel of weights.
    #[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
    pub fn each(self) -> impl Iterator<Item = (usize, usize, usize)> {
        (0..self.volume)
            .flat_map(move |tap| (0..self.cin).flat_map(move |c| (0..self.panels()).map(move |panel| (tap, c, panel))))
    }

    /// Calls `place(weight, tap · panels + panel, input, lane)` for each weight of `[tap][input][output]`.
    pub fn place<T: Copy>(&self, weights: &[T], mut place: impl FnMut(T, usize, usize, usize)) {
        for (i, weights) in weights.chunks_exact(self.cout).enumerate() {
            let (k, c) = (i / self.cin, i % self.cin);
            for (o, &w) in weights.iter().enumerate() {
                place(w, k * self.panels() + o / PANEL, c, o % PANEL);
            }
        }
    }
}
