//! A level that nothing below predicts, predicted from itself: its voxels are coded octant by octant, and each pass
//! from those before it.

use std::convert::Infallible;
use std::ops::Range;

use rayon::prelude::*;

use super::learning::Learning;
use super::level::{expect_slices, place};
use super::slice::{Condition, Reader, encode_slice};
use super::tables::Tables;
use crate::cancel::Cancel;
use crate::container::Slice;
use crate::error::Result;

/// Passes of a slice: one for each place that a voxel may have in its parent.
const PASSES: u64 = 8;

/// What predicts a pass.
///
/// Called with the range of the level's voxels that a slice holds, the voxels of the pass, ascending, and the latents
/// of the slice so far, [voxels, K]; it may look at those of lower octants alone. Gives means in sixteenths and scale
/// indices for all latents of the pass, [`super::UNPREDICTED`] where it knows nothing.
pub type Predict<'a> = dyn Fn(Range<usize>, &[u32], &[i16]) -> (Vec<i16>, Vec<u8>) + Sync + 'a;

/// Codes a level's latents in slices of `slice_voxels` voxels; `keys` are the Morton keys of its voxels, ascending,
/// whose lowest three bits are a voxel's octant.
///
/// # Panics
/// If the latents are not K per key, `slice_voxels` is 0, or `predict` gives other than one mean and scale per latent.
pub fn encode_passes(
    tables: &Tables,
    keys: &[u64],
    predict: &Predict,
    latents: &[i16],
    slice_voxels: usize,
) -> Vec<Vec<u8>> {
    let k = tables.channels();
    assert_eq!(latents.len(), keys.len() * k, "K latents per voxel");
    latents
        .par_chunks(slice_voxels * k)
        .enumerate()
        .map(|(i, part)| {
            let slice = range(i, slice_voxels, keys.len());
            let (mut order, mut mu, mut sigma) = (Vec::new(), Vec::new(), Vec::new());
            let mut known = vec![0; part.len()];
            let Ok(()) = each_latent(tables, keys, slice, predict, &mut known, |at, c, m, s| {
                let latent = part[at * k + c];
                mu.push(m);
                sigma.push(s);
                order.push(latent);
                Ok::<_, Infallible>(latent)
            });
            let condition = Condition::Gauss { mu: &mu, sigma: &sigma };
            encode_slice(tables, condition, &order)
        })
        .collect()
}

/// Goes through a slice in the order of coding. `latents` are those of the slice so far, [voxels, K]; `code` gets each
/// latent's voxel in the slice, its channel, its mean in sixteenths and its scale index, and says what it is, or fails.
pub(super) fn each_latent<E>(
    tables: &Tables,
    keys: &[u64],
    slice: Range<usize>,
    predict: &Predict,
    latents: &mut [i16],
    mut code: impl FnMut(usize, usize, i16, u8) -> Result<i16, E>,
) -> Result<(), E> {
    let k = tables.channels();
    let mut learning = Learning::of(tables, &keys[slice.clone()]);
    for voxels in passes(keys, &slice) {
        let (mu, sigma) = predict(slice.clone(), &voxels, latents);
        let count = voxels.len() * k;
        assert_eq!((mu.len(), sigma.len()), (count, count), "one mean and scale per latent");
        let parameters = mu.chunks_exact(k).zip(sigma.chunks_exact(k));
        for (&v, (mu, sigma)) in voxels.iter().zip(parameters) {
            let at = v as usize - slice.start;
            if let Some(learning) = &mut learning {
                learning.look_around(at, sigma);
            }
            for (c, (&mu, &sigma)) in mu.iter().zip(sigma).enumerate() {
                latents[at * k + c] = match &mut learning {
                    Some(learning) => {
                        let (mu, sigma) = learning.prepare(c, mu, sigma, latents);
                        let latent = code(at, c, mu, sigma)?;
                        learning.learn(c, latent);
                        latent
                    }
                    None => code(at, c, mu, sigma)?,
                };
            }
        }
    }
    Ok(())
}

/// Decodes what [`encode_passes`] made. The work is bounded by the number of voxels, which the caller has held against
/// its limits.
///
/// # Errors
/// As [`super::decode_level`].
///
/// # Panics
/// If `slice_voxels` is 0, or `predict` gives other than one mean and scale per latent.
pub fn decode_passes(
    tables: &Tables,
    keys: &[u64],
    predict: &Predict,
    slices: &[Slice],
    slice_voxels: usize,
    level: u8,
    cancel: &Cancel,
) -> Result<Vec<i16>> {
    let k = tables.channels();
    expect_slices(slices.len(), keys.len(), slice_voxels, level)?;
    let mut latents = vec![0; keys.len() * k];
    let results: Vec<Result<()>> = latents
        .par_chunks_mut(slice_voxels * k)
        .zip(slices)
        .enumerate()
        .map(|(i, (part, code))| {
            cancel.check()?;
            let slice = range(i, slice_voxels, keys.len());
            let at = place(level, i, code);
            let mut reader = Reader::open(tables, code.bytes, &at)?;
            each_latent(tables, keys, slice, predict, part, |_, c, mu, sigma| {
                reader.read_one(c, mu, sigma)
            })?;
            reader.finish()
        })
        .collect();
    results.into_iter().collect::<Result<()>>()?;
    Ok(latents)
}

/// The voxels of slice `i`.
pub(super) fn range(i: usize, slice_voxels: usize, voxels: usize) -> Range<usize> {
    let start = i * slice_voxels;
    start..(start + slice_voxels).min(voxels)
}

/// The voxels of a slice, octant by octant.
fn passes<'a>(keys: &'a [u64], slice: &Range<usize>) -> impl Iterator<Item = Vec<u32>> + use<'a> {
    let slice = slice.clone();
    (0..PASSES).map(move |pass| {
        let voxels = slice.clone().filter(|&v| keys[v] & 7 == pass);
        voxels.map(|v| v as u32).collect()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::morton;
    use crate::latents::entropy::UNPREDICTED;
    use crate::latents::entropy::tests::tables;
    use crate::testing::{Random, slices_of};
    use proptest::prelude::*;

    /// A voxel's channels are predicted from the voxel before it, if that is of a lower octant.
    fn predict(keys: &[u64]) -> Box<Predict<'_>> {
        let k = tables().channels();
        Box::new(move |slice, voxels, latents| {
            let (mut mu, mut sigma) = (Vec::new(), Vec::new());
            for &v in voxels {
                let v = v as usize;
                let known = v > slice.start && keys[v - 1] & 7 < keys[v] & 7;
                for c in 0..k {
                    let before = || latents[(v - 1 - slice.start) * k + c];
                    mu.push(if known { before().clamp(-100, 100) * 16 } else { 0 });
                    sigma.push(if known { 20 } else { UNPREDICTED });
                }
            }
            (mu, sigma)
        })
    }

    /// Nothing is predicted of any latent.
    fn nothing(_: Range<usize>, voxels: &[u32], _: &[i16]) -> (Vec<i16>, Vec<u8>) {
        let count = voxels.len() * tables().channels();
        (vec![0; count], vec![UNPREDICTED; count])
    }

    fn size(tables: &Tables, keys: &[u64], predict: &Predict, latents: &[i16]) -> usize {
        let slices = encode_passes(tables, keys, predict, latents, keys.len());
        slices.iter().map(Vec::len).sum()
    }

    proptest! {
        #[test]
        fn latents_come_back_whatever_their_octants_and_slices(
            voxels in prop::collection::btree_map(0u64..4000, (any::<i16>(), any::<bool>()), 0..200),
            slice in 1usize..100,
            learning in any::<bool>(),
        ) {
            let tables = tables().with_learning(learning);
            let keys: Vec<u64> = voxels.keys().copied().collect();
            let value = |v: &(i16, bool)| if v.1 { v.0 % 30 } else { v.0 };
            let latents: Vec<i16> = voxels.values().flat_map(|v| vec![value(v); tables.channels()]).collect();
            let predict = predict(&keys);
            let bytes = encode_passes(&tables, &keys, &*predict, &latents, slice);
            let slices = slices_of(&bytes);
            prop_assert_eq!(decode_passes(&tables, &keys, &*predict, &slices, slice, 7, &Cancel::default()).unwrap(), latents);
        }

        #[test]
        fn arbitrary_bytes_never_panic(
            bytes in prop::collection::vec(any::<u8>(), 0..200),
            keys in prop::collection::btree_set(any::<u64>(), 1..100),
            learning in any::<bool>(),
        ) {
            let keys: Vec<u64> = keys.into_iter().collect();
            let tables = tables().with_learning(learning);
            let _ = decode_passes(&tables, &keys, &*predict(&keys), &slices_of(&[bytes]), 100, 7, &Cancel::default());
        }
    }

    #[test]
    fn neighbours_that_are_known_save_bits() {
        let tables = tables();
        let mut random = Random(5);
        let keys: Vec<u64> = (0..4000).collect();
        let mut value = 0i16;
        let mut latents = Vec::new();
        for _ in &keys {
            value = (value + (random.next() % 3) as i16 - 1).clamp(-30, 30);
            latents.extend(vec![value; tables.channels()]);
        }
        let known = size(&tables, &keys, &*predict(&keys), &latents);
        assert!(known < size(&tables, &keys, &nothing, &latents) * 3 / 4);
    }

    #[test]
    fn passes_that_learn_find_the_mean_and_scale_that_a_prediction_lacks() {
        let tables = tables();
        let keys: Vec<u64> = (0..4000).collect();
        let mut random = Random(6);
        // About normal, around 5 and some 3 wide; another channel is 0 throughout.
        let wide = |random: &mut Random| (0..12).map(|_| (random.next() % 4) as i16).sum::<i16>() - 13;
        let latents: Vec<i16> = keys.iter().flat_map(|_| [wide(&mut random), 0]).collect();
        let constant = |mu: [i16; 2], sigma: [u8; 2]| {
            move |_: Range<usize>, voxels: &[u32], _: &[i16]| (mu.repeat(voxels.len()), sigma.repeat(voxels.len()))
        };
        let right = size(&tables, &keys, &constant([80, 0], [35, 0]), &latents);
        let wrong = constant([0, 0], [16, 30]);
        let plain = size(&tables, &keys, &wrong, &latents);
        let learned = size(&tables.with_learning(true), &keys, &wrong, &latents);
        assert!(plain > 2 * right, "{plain} {right}");
        assert!(learned < right * 21 / 20, "{learned} {right}");
    }

    #[test]
    fn passes_that_learn_predict_voxels_without_neighbours_from_those_two_away() {
        let tables = tables();
        // A plane of voxels whose latents rise slowly.
        let mut voxels: Vec<(u64, i16)> = (0..64 * 64)
            .map(|i| [i % 64, i / 64, 0])
            .map(|at| (morton::encode(at), (at[0] + at[1]) as i16 / 2 - 30))
            .collect();
        voxels.sort_unstable();
        let keys: Vec<u64> = voxels.iter().map(|v| v.0).collect();
        let latents: Vec<i16> = voxels.iter().flat_map(|v| [v.1; 2]).collect();
        let plain = size(&tables, &keys, &nothing, &latents);
        let learned = size(&tables.with_learning(true), &keys, &nothing, &latents);
        assert!(learned < plain / 4, "{learned} {plain}");
    }
}
