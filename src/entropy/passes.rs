//! A level that nothing below predicts, predicted from itself: its voxels are coded octant by octant, and each pass from those before it.

use std::ops::Range;

use rayon::prelude::*;

use super::level::{expect_slices, place};
use super::slice::{Condition, Reader, encode_slice};
use super::tables::Tables;
use crate::bitstream::Slice;
use crate::cancel::Cancel;
use crate::error::Result;

/// Passes of a slice: one for each place that a voxel may have in its parent.
const PASSES: u8 = 8;

/// What predicts a pass.
///
/// Called with the range of the level's voxels that a slice holds, the voxels of the pass, ascending, and the latents of the slice so
/// far, [voxels, K]; it may look at those of lower octants alone. Gives means in sixteenths and scale indices for all latents of the
/// pass, [`super::UNPREDICTED`] where it knows nothing.
pub type Predict<'a> = dyn Fn(Range<usize>, &[u32], &[i16]) -> (Vec<i16>, Vec<u8>) + Sync + 'a;

/// Codes a level's latents in slices of `slice_voxels` voxels; `octants[i]` is voxel `i`'s place in its parent, `x + 2y + 4z`.
///
/// # Panics
/// If the latents are not K per octant, `slice_voxels` is 0, or `predict` gives other than one mean and scale per latent.
pub fn encode_passes(
    tables: &Tables,
    octants: &[u8],
    predict: &Predict,
    latents: &[i16],
    slice_voxels: usize,
) -> Vec<Vec<u8>> {
    let k = tables.channels();
    assert_eq!(latents.len(), octants.len() * k, "K latents per voxel");
    latents
        .par_chunks(slice_voxels * k)
        .enumerate()
        .map(|(i, part)| {
            let slice = range(i, slice_voxels, octants.len());
            let (mut order, mut mu, mut sigma) = (Vec::new(), Vec::new(), Vec::new());
            for voxels in passes(octants, &slice) {
                let (m, s) = predict(slice.clone(), &voxels, part);
                mu.extend(m);
                sigma.extend(s);
                order.extend(voxels.iter().flat_map(|&v| {
                    let at = (v as usize - slice.start) * k;
                    part[at..at + k].iter().copied()
                }));
            }
            let condition = Condition::Gauss {
                mu: &mu,
                sigma: &sigma,
            };
            encode_slice(tables, condition, &order)
        })
        .collect()
}

/// Decodes what [`encode_passes`] made. The work is bounded by the number of voxels, which the caller has held against its limits.
///
/// # Errors
/// As [`super::decode_level`].
///
/// # Panics
/// If `slice_voxels` is 0, or `predict` gives other than one mean and scale per latent.
pub fn decode_passes(
    tables: &Tables,
    octants: &[u8],
    predict: &Predict,
    slices: &[Slice],
    slice_voxels: usize,
    level: u8,
    cancel: &Cancel,
) -> Result<Vec<i16>> {
    let k = tables.channels();
    expect_slices(slices.len(), octants.len(), slice_voxels, level)?;
    let mut latents = vec![0; octants.len() * k];
    let results: Vec<Result<()>> = latents
        .par_chunks_mut(slice_voxels * k)
        .zip(slices)
        .enumerate()
        .map(|(i, (part, code))| {
            cancel.check()?;
            let slice = range(i, slice_voxels, octants.len());
            let at = place(level, i, code);
            let mut reader = Reader::open(tables, code.bytes, &at)?;
            for voxels in passes(octants, &slice) {
                let (mu, sigma) = predict(slice.clone(), &voxels, part);
                let mut values = vec![0; voxels.len() * k];
                let condition = Condition::Gauss {
                    mu: &mu,
                    sigma: &sigma,
                };
                reader.read(condition, &mut values)?;
                for (&v, values) in voxels.iter().zip(values.chunks_exact(k)) {
                    part[(v as usize - slice.start) * k..][..k].copy_from_slice(values);
                }
            }
            reader.finish()
        })
        .collect();
    results.into_iter().collect::<Result<()>>()?;
    Ok(latents)
}

/// The voxels of slice `i`.
fn range(i: usize, slice_voxels: usize, voxels: usize) -> Range<usize> {
    let start = i * slice_voxels;
    start..(start + slice_voxels).min(voxels)
}

/// The voxels of a slice, octant by octant.
fn passes<'a>(octants: &'a [u8], slice: &Range<usize>) -> impl Iterator<Item = Vec<u32>> + use<'a> {
    let slice = slice.clone();
    (0..PASSES).map(move |pass| {
        let voxels = slice.clone().filter(|&v| octants[v] == pass);
        voxels.map(|v| v as u32).collect()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::entropy::UNPREDICTED;
    use crate::entropy::test_tables::{Random, slices_of, tables};
    use proptest::prelude::*;

    /// A voxel's channels are predicted from the voxel before it, if that is of a lower octant.
    fn predict(octants: &[u8]) -> Box<Predict<'_>> {
        let k = tables().channels();
        Box::new(move |slice, voxels, latents| {
            let (mut mu, mut sigma) = (Vec::new(), Vec::new());
            for &v in voxels {
                let v = v as usize;
                let known = v > slice.start && octants[v - 1] < octants[v];
                for c in 0..k {
                    let before = || latents[(v - 1 - slice.start) * k + c];
                    mu.push(if known {
                        before().clamp(-100, 100) * 16
                    } else {
                        0
                    });
                    sigma.push(if known { 20 } else { UNPREDICTED });
                }
            }
            (mu, sigma)
        })
    }

    proptest! {
        #[test]
        fn latents_come_back_whatever_their_octants_and_slices(
            voxels in prop::collection::vec((0u8..8, any::<i16>(), any::<bool>()), 0..200),
            slice in 1usize..100,
        ) {
            let tables = tables();
            let octants: Vec<u8> = voxels.iter().map(|v| v.0).collect();
            let value = |v: &(u8, i16, bool)| if v.2 { v.1 % 30 } else { v.1 };
            let latents: Vec<i16> = voxels.iter().flat_map(|v| vec![value(v); tables.channels()]).collect();
            let predict = predict(&octants);
            let bytes = encode_passes(&tables, &octants, &*predict, &latents, slice);
            let slices = slices_of(&bytes);
            prop_assert_eq!(decode_passes(&tables, &octants, &*predict, &slices, slice, 7, &Cancel::default()).unwrap(), latents);
        }

        #[test]
        fn arbitrary_bytes_never_panic(
            bytes in prop::collection::vec(any::<u8>(), 0..200),
            octants in prop::collection::vec(0u8..8, 1..100),
        ) {
            let _ = decode_passes(&tables(), &octants, &*predict(&octants), &slices_of(&[bytes]), 100, 7, &Cancel::default());
        }
    }

    #[test]
    fn neighbours_that_are_known_save_bits() {
        let tables = tables();
        let mut random = Random(5);
        let octants: Vec<u8> = (0..4000).map(|i| (i % 8) as u8).collect();
        let mut value = 0i16;
        let mut latents = Vec::new();
        for _ in &octants {
            value = (value + (random.next() % 3) as i16 - 1).clamp(-30, 30);
            latents.extend(vec![value; tables.channels()]);
        }
        let nothing = |_: Range<usize>, voxels: &[u32], _: &[i16]| {
            let count = voxels.len() * tables.channels();
            (vec![0; count], vec![UNPREDICTED; count])
        };
        let size = |predict: &Predict| {
            let slices = encode_passes(&tables, &octants, predict, &latents, 4000);
            slices.iter().map(Vec::len).sum::<usize>()
        };
        assert!(size(&*predict(&octants)) < size(&nothing) * 3 / 4);
    }
}
