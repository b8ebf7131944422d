//! One level: slices in parallel, and what its latents hash to.

use rayon::prelude::*;
use xxhash_rust::xxh3::Xxh3Default;

use super::slice::{Condition, decode_into, encode_slice};
use super::tables::Tables;
use crate::cancel::Cancel;
use crate::container::Slice;
use crate::error::{Error, Result, Stage};

/// Codes a level's latents in slices of `slice_voxels` voxels, the last one what is left.
///
/// # Panics
/// As [`encode_slice`] does, and if `slice_voxels` is 0.
pub fn encode_level(tables: &Tables, condition: Condition, latents: &[i16], slice_voxels: usize) -> Vec<Vec<u8>> {
    condition.check(tables, latents.len());
    let width = slice_voxels * tables.channels();
    latents
        .par_chunks(width)
        .enumerate()
        .map(|(i, part)| {
            let start = i * width;
            encode_slice(tables, condition.of(start..start + part.len()), part)
        })
        .collect()
}

/// Decodes the latents of a level of `voxels` voxels, whose number the caller has held against its limits.
///
/// # Errors
/// [`Error::Malformed`] if there are more or fewer slices than the voxels fill; else the error of the first slice that
/// has one; [`Error::Cancelled`].
///
/// # Panics
/// As [`encode_level`] does.
pub fn decode_level(
    tables: &Tables,
    condition: Condition,
    slices: &[Slice],
    voxels: usize,
    slice_voxels: usize,
    level: u8,
    cancel: &Cancel,
) -> Result<Vec<i16>> {
    let mut latents = vec![0; voxels * tables.channels()];
    condition.check(tables, latents.len());
    expect_slices(slices.len(), voxels, slice_voxels, level)?;
    let width = slice_voxels * tables.channels();
    let results: Vec<Result<()>> = latents
        .par_chunks_mut(width)
        .zip(slices)
        .enumerate()
        .map(|(i, (part, slice))| {
            cancel.check()?;
            let start = i * width;
            let condition = condition.of(start..start + part.len());
            let at = place(level, i, slice);
            decode_into(tables, condition, slice.bytes, part, &at)
        })
        .collect();
    results.into_iter().collect::<Result<()>>()?;
    Ok(latents)
}

/// Where a feature slice lies.
pub(super) fn place(level: u8, slice: usize, part: &Slice) -> String {
    format!("byte {}, level {level}, feature slice {slice}", part.offset)
}

/// Sees that a level has as many slices as its voxels fill.
///
/// # Errors
/// [`Error::Malformed`] if it has more or fewer.
pub(super) fn expect_slices(slices: usize, voxels: usize, slice_voxels: usize, level: u8) -> Result<()> {
    expect_number(slices, voxels.div_ceil(slice_voxels), level)
}

/// Sees that a level whose role has no latents has no slices.
///
/// # Errors
/// [`Error::Malformed`] if it has any.
pub fn expect_no_latents(slices: &[Slice], level: u8) -> Result<()> {
    expect_number(slices.len(), 0, level)
}

fn expect_number(slices: usize, needed: usize, level: u8) -> Result<()> {
    match slices == needed {
        true => Ok(()),
        false => Err(Error::malformed(
            Stage::Entropy,
            format!("level {level}"),
            "number of feature slices",
            slices,
            needed,
        )
        .breaks("8.2.2")),
    }
}

/// XXH3-64 of a level's latents as little-endian 16-bit numbers, voxel by voxel.
pub fn latent_hash(latents: &[i16]) -> u64 {
    let mut hasher = Xxh3Default::new();
    let mut bytes = [0; 4096];
    for part in latents.chunks(bytes.len() / 2) {
        for (bytes, latent) in bytes.chunks_exact_mut(2).zip(part) {
            bytes.copy_from_slice(&latent.to_le_bytes());
        }
        hasher.update(&bytes[..2 * part.len()]);
    }
    hasher.digest()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::latents::entropy::tests::tables;
    use crate::testing::{Random, slices_of};

    fn sample(voxels: usize) -> (Vec<i16>, Vec<u8>, Vec<i16>) {
        let mut random = Random(3);
        let count = voxels * tables().channels();
        let mu = (0..count).map(|_| (random.next() % 1000) as i16 - 500).collect();
        let sigma = (0..count).map(|_| (random.next() % 64) as u8).collect();
        let latents = (0..count).map(|_| (random.next() % 63) as i16 - 31).collect();
        (mu, sigma, latents)
    }

    #[test]
    fn one_thread_and_two_make_the_same_bytes_and_latents() {
        let tables = tables();
        let (mu, sigma, latents) = sample(1000);
        let gauss = Condition::Gauss { mu: &mu, sigma: &sigma };
        for condition in [Condition::Prior, gauss] {
            let run = |threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| {
                    let bytes = encode_level(&tables, condition, &latents, 64);
                    let slices = slices_of(&bytes);
                    let back = decode_level(&tables, condition, &slices, 1000, 64, 7, &Cancel::default()).unwrap();
                    (bytes.clone(), back)
                })
            };
            let one = run(1);
            assert_eq!(one.0.len(), 16);
            assert_eq!(one.1, latents);
            assert_eq!(one, run(2));
        }
    }

    #[test]
    fn a_missing_or_damaged_slice_is_named() {
        let tables = tables();
        let (.., latents) = sample(100);
        let bytes = encode_level(&tables, Condition::Prior, &latents, 40);
        let mut slices = slices_of(&bytes);
        slices[1].offset = 1000;
        let decode = |slices: &[Slice]| decode_level(&tables, Condition::Prior, slices, 100, 40, 7, &Cancel::default());
        let error = decode(&slices[..2]).unwrap_err().to_string();
        assert!(
            error.contains("level 7: number of feature slices is 2, expected 3"),
            "{error}"
        );
        let error = expect_no_latents(&slices, 9).unwrap_err().to_string();
        assert!(
            error.contains("level 9: number of feature slices is 3, expected 0"),
            "{error}"
        );
        assert!(expect_no_latents(&[], 9).is_ok());
        slices[1].bytes = &bytes[1][4..];
        let error = decode(&slices).unwrap_err().to_string();
        let place = "byte 1000, level 7, feature slice 1";
        assert!(error.contains(place), "{error}");
    }

    #[test]
    fn the_hash_is_that_of_the_little_endian_bytes() {
        let (.., latents) = sample(3000);
        let bytes: Vec<u8> = latents.iter().flat_map(|l| l.to_le_bytes()).collect();
        assert_eq!(latent_hash(&latents), xxhash_rust::xxh3::xxh3_64(&bytes));
        assert_eq!(latent_hash(&[]), 0x2d06_8005_38d3_94c2);
    }
}
