//! The register-blocked loop that multiplies rows by weights.

use super::rows::{PANEL, Words};

/// The smallest [`group`].
pub(crate) const MIN_GROUP: usize = 4;
/// Panels that AVX-512 multiplies at once, by the rows of the smallest group, where a layer has so many.
pub(crate) const WIDE: usize = 4;
/// A micro-kernel: vectors of 32-bit sums, and what multiplies and adds one step, which is an f32 or a pair of i16 or
/// bf16.
pub(crate) trait Microkernel: Copy {
    /// Sums.
    type Sum: Copy;
    /// The weights of as many channels, for one step.
    type Weight: Copy;
    /// An input row's values of one step, for all channels.
    type Factor: Copy;
    /// Words in a vector; divides [`PANEL`].
    const LANES: usize;

    /// Zeros.
    fn zero(self) -> Self::Sum;
    /// The first sums of `from`.
    fn load(self, from: &[u32]) -> Self::Sum;
    /// Writes the first sums of `to`.
    fn store(self, sum: Self::Sum, to: &mut [u32]);
    /// The first weights of `from`.
    fn weight(self, from: &[u32]) -> Self::Weight;
    /// A row's values of one step.
    fn factor(self, word: u32) -> Self::Factor;
    /// `a + b`.
    fn add(self, a: Self::Sum, b: Self::Sum) -> Self::Sum;
    /// `sum + weight · factor`.
    fn add_product(self, sum: Self::Sum, weight: Self::Weight, factor: Self::Factor) -> Self::Sum;
}

/// A group's rows, some taps and some panels.
pub(crate) struct Block<'a> {
    /// Rows of the group.
    pub group: usize,
    /// Its taps.
    pub taps: &'a [u8],
    /// For each tap and row, which of `inputs` it reads.
    pub(super) places: &'a [u16],
    /// None of them is above: both are those of a [`Places`](super::plan::Places).
    pub(super) most: usize,
    /// Input rows, `steps` words each.
    pub inputs: &'a [u32],
    /// Steps.
    pub steps: usize,
    /// The first panel's weights of tap 0, `steps` [`Words`] a panel; those of the next panel follow.
    pub weights: &'a [Words],
    /// Taps that there are weights for.
    pub volume: usize,
    /// [`Words`] from one tap's weights to the next's.
    pub tap: usize,
    /// The first panel's sums of the group's rows, each `stride` [`Words`] after the last's; those of the next panel
    /// follow.
    pub sums: &'a mut [Words],
    /// [`Words`] from one row's sums to the next's.
    pub stride: usize,
    /// Whether there are sums to add to.
    pub more: bool,
}

impl Block<'_> {
    /// Which of `inputs` each tap and row reads.
    #[cfg(all(target_arch = "aarch64", feature = "close"))]
    pub fn places(&self) -> &[u16] {
        self.places
    }
}

/// Sums a block's products, for `V` vectors of channels from the first panel on, `R` rows at once, which divide the
/// group. Each sum is computed in `P` parts, of every `P`th step, where there would be too few to hide the latency of
/// an addition.
///
/// # Panics
/// If the block reads or writes beyond its slices.
#[inline(always)]
pub(crate) fn columns<K: Microkernel, const R: usize, const V: usize, const P: usize>(
    kernel: K,
    block: &mut Block<'_>,
) {
    let (group, steps) = (block.group, block.steps);
    let places = &block.places[..block.taps.len() * group];
    let rows = places.is_empty() || (block.most + 1).saturating_mul(steps) <= block.inputs.len();
    assert!(rows, "a place names a row that is not there");
    assert!(group.is_multiple_of(R), "whole groups");
    let panels = (V * K::LANES).div_ceil(PANEL);
    let last = block.volume.saturating_sub(1).saturating_mul(block.tap);
    assert!(
        last.saturating_add(panels.saturating_mul(steps)) <= block.weights.len(),
        "weights of all taps"
    );
    let last = group.saturating_sub(1).saturating_mul(block.stride);
    assert!(last.saturating_add(panels) <= block.sums.len(), "sums of all rows");
    for first in (0..group).step_by(R) {
        // SAFETY: there are places for all taps and rows of the group, `first + R` among them at most, and rows for all
        // places; all taps have weights of all panels, and all rows sums of them.
        unsafe { multiply::<K, R, V, P>(kernel, block, first) };
    }
}

/// Sums the products of `R` rows from `first` on.
///
/// # Safety
/// The block must have a place for each tap and each row of the group, and these rows; the places must name whole rows
/// of `inputs`, each of the `volume` taps have `steps` weights of the panels of `V` vectors, and each row sums of them.
///
/// # Panics
/// If a tap is none of the `volume`.
#[inline(always)]
#[expect(clippy::needless_range_loop, reason = "rows, vectors and parts are counted alike")]
unsafe fn multiply<K: Microkernel, const R: usize, const V: usize, const P: usize>(
    k: K,
    block: &mut Block<'_>,
    first: usize,
) {
    let steps = block.steps;
    let mut sums = [[[k.zero(); V]; R]; P];
    if block.more {
        for r in 0..R {
            for v in 0..V {
                let at = v * K::LANES;
                // SAFETY: the caller's promise of sums.
                let panel = unsafe { block.sums.get_unchecked((first + r) * block.stride + at / PANEL) };
                sums[0][r][v] = k.load(&panel.0[at % PANEL..]);
            }
        }
    }
    let mut row = first;
    for &tap in block.taps {
        let mut inputs = [(&[][..], &[][..]); R];
        for r in 0..R {
            // SAFETY: the caller's promise of places and rows.
            let values = unsafe {
                let place = usize::from(*block.places.get_unchecked(row + r));
                std::slice::from_raw_parts(block.inputs.as_ptr().add(place * steps), steps)
            };
            inputs[r] = values.as_chunks::<P>();
        }
        row += block.group;
        let tap = usize::from(tap);
        assert!(tap < block.volume, "a tap that has no weights");
        let mut weights = [(&[][..], &[][..]); V];
        for v in 0..V {
            let start = tap * block.tap + v * K::LANES / PANEL * steps;
            // SAFETY: the caller's promise of weights, for the tap is one of those.
            let panel = unsafe { block.weights.get_unchecked(start..start + steps) };
            weights[v] = panel.as_chunks::<P>();
        }
        for s in 0..steps / P {
            for part in 0..P {
                let mut weight = [k.weight(&weights[0].0[s][part].0); V];
                for v in 1..V {
                    weight[v] = k.weight(&weights[v].0[s][part].0[v * K::LANES % PANEL..]);
                }
                for r in 0..R {
                    let factor = k.factor(inputs[r].0[s][part]);
                    for v in 0..V {
                        sums[part][r][v] = k.add_product(sums[part][r][v], weight[v], factor);
                    }
                }
            }
        }
        if P == 1 {
            continue;
        }
        for s in 0..steps % P {
            for r in 0..R {
                let factor = k.factor(inputs[r].1[s]);
                for v in 0..V {
                    let weight = k.weight(&weights[v].1[s].0[v * K::LANES % PANEL..]);
                    sums[0][r][v] = k.add_product(sums[0][r][v], weight, factor);
                }
            }
        }
    }
    for r in 0..R {
        for v in 0..V {
            let mut sum = sums[0][r][v];
            for part in 1..P {
                sum = k.add(sum, sums[part][r][v]);
            }
            let at = v * K::LANES;
            // SAFETY: the caller's promise of sums.
            let panel = unsafe { block.sums.get_unchecked_mut((first + r) * block.stride + at / PANEL) };
            k.store(sum, &mut panel.0[at % PANEL..]);
        }
    }
}
