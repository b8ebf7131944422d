//! Point cloud to stream. Runs the decoder in the loop: what a level is predicted from is what the decoder will have.

mod colours;
mod corrections;

use std::ops::RangeInclusive;

use rayon::prelude::*;

use crate::bitstream::{Header, MAX_SLICE_VOXELS, Writer};
use crate::cloud::ColouredVoxels;
use crate::decoder::Decoder;
use crate::entropy::{Coding, Condition, Rounding, latent_hash};
use crate::error::{Error, Result};
use crate::geometry::{KernelMap, Octree, Voxels, codec};
use crate::limits::Limits;
use crate::log::Log;
use crate::network::{Heads, Model, ROLES};
pub use corrections::Residual;
use corrections::{Corrections, Level, corrections};

/// What may be chosen about a stream.
#[derive(Debug, Clone)]
pub struct Options {
    /// The levels whose features are coded: at most three, the last below the bit depth N. Default: N−3 to N−1.
    pub levels: Option<RangeInclusive<u8>>,
    /// How dear a bit is when latents are rounded, times what the model says ([`Model::bit_prices`]): 0 rounds to the nearest, more saves bits.
    /// Default: 1.
    pub bit_price: f32,
    /// Whether colours that the heads generate are compared with the cloud's, and corrected where that is worth its bytes: see
    /// [`ColourFilter`].
    pub filter: bool,
    /// How much is coded of what colours are then still off those of the cloud. Default: [`Residual::Coarse`].
    pub residual: Residual,
    /// Voxels per slice, 1 to [`MAX_SLICE_VOXELS`], the default: less lets more threads decode a level, and costs bits.
    pub slice_voxels: u32,
}

impl Default for Options {
    fn default() -> Self {
        Options {
            levels: None,
            bit_price: 1.0,
            filter: true,
            residual: Residual::Coarse,
            slice_voxels: MAX_SLICE_VOXELS,
        }
    }
}

/// A finished stream.
#[derive(Debug, Clone)]
pub struct Encoded {
    /// The stream.
    pub bytes: Vec<u8>,
    /// What each level took, base level first.
    pub rates: Vec<Rate>,
}

/// What a level took.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rate {
    /// The octree level.
    pub level: u8,
    /// Its voxels.
    pub voxels: usize,
    /// Bytes of its geometry, chunk headers included; the base level's include those of all levels above it.
    pub geometry_bytes: usize,
    /// Bytes of its features, chunk headers included.
    pub feature_bytes: usize,
}

/// Codes a cloud, then decodes the stream and compares before giving it out.
///
/// # Errors
/// [`Error::Usage`] for levels that the cloud or the format does not have, [`Error::Malformed`] for slices that the format does not
/// have, [`Error::Unsupported`] if the model can only decode; and,
/// if encoder and decoder disagreed on this machine, whatever the decoder found.
pub fn encode(
    cloud: &ColouredVoxels,
    model: &Model,
    options: &Options,
    log: &mut Log,
) -> Result<Encoded> {
    let levels = choose_levels(cloud.voxels.depth(), options.levels.clone())?;
    let (base, top) = (*levels.start(), *levels.end());
    // Networks have learned to see a level through all those below it, coded or not.
    let seen = cloud.voxels.depth().min(base + ROLES as u8);
    let (finest, colours) = log.step("pool colours", cloud.voxels.len(), "voxels", || {
        Ok(pooled(cloud, seen))
    })?;
    let octree = Octree::new(finest)?;
    let maps = log.step("kernel maps", octree.level(seen).len(), "voxels", || {
        Ok(kernel_maps(&octree, base))
    })?;
    let mut features = log.step("features", colours.len(), "voxels", || {
        let maps: Vec<_> = maps.iter().rev().collect();
        let occupancy: Vec<_> = (base..seen)
            .rev()
            .map(|level| octree.occupancy(level))
            .collect();
        model.features(&colours, &maps, &occupancy)
    })?;

    let header = Header {
        optional_flags: 0,
        bits: cloud.voxels.depth(),
        base,
        top,
        points: cloud.voxels.len() as u64,
        placement: cloud.placement,
        model: model.id(),
        slice_voxels: options.slice_voxels,
        voxels: Vec::new(),
        sections: Vec::new(),
    };
    let mut squeezed = |role: usize, coding: Coding<'_>, context: Option<&[i16]>| {
        // The finest level's features come first, so those of the level at hand are the last.
        let own = features.pop().unwrap_or_default();
        let real = model.squeeze(role, &own, context)?;
        let prices = model.bit_prices(role).iter();
        let rounding = Rounding {
            limit: model.shape().latent_max,
            prices: &prices
                .map(|price| price * options.bit_price)
                .collect::<Vec<_>>(),
        };
        let slice = options.slice_voxels as usize;
        Ok(coding.quantise(model.tables(), &real, rounding, slice))
    };
    let mut correct = |level: Level<'_>| corrections(cloud, model, options, level);
    let correct: Option<&mut Correct<'_>> =
        match options.filter || matches!(options.residual, Residual::Fine(_)) {
            true => Some(&mut correct),
            false => None,
        };
    let (bytes, below) = write(header, &octree, &maps, model, &mut squeezed, correct, log)?;
    let exact = log.step("decode again", octree.level(top).len(), "voxels", || {
        Decoder::new(model)
            .with_limits(Limits::unlimited())
            .exact(&bytes, top, &mut Log::default())
    })?;
    if exact.octree != octree.truncated(top) || exact.features != below {
        return Err(Error::Usage(
            "the stream does not decode to what was encoded: this machine computes wrongly".into(),
        ));
    }
    let header = Header::parse(&bytes, &Limits::unlimited())?;
    let rates = levels
        .zip(header.voxels.iter().zip(&header.sections))
        .map(|(level, (&voxels, section))| Rate {
            level,
            voxels: voxels as usize,
            geometry_bytes: section.geometry as usize,
            feature_bytes: section.features as usize,
        })
        .collect();
    Ok(Encoded { bytes, rates })
}

/// A role's latents, K per voxel of its level, given what they are coded under and its context.
pub(crate) type Latents<'a> = dyn FnMut(usize, Coding<'_>, Option<&[i16]>) -> Result<Vec<i16>> + 'a;

/// What to say of a level's colours.
type Correct<'a> = dyn FnMut(Level<'_>) -> Result<Corrections> + 'a;

/// A stream of the `header`'s levels of an octree, and the features of the last; voxels and sections are filled in. `maps` are the levels'
/// 3³ kernel maps.
///
/// # Errors
/// Those of [`Writer`], of `latents`, and of `correct`.
pub(crate) fn write(
    header: Header,
    octree: &Octree,
    maps: &[KernelMap],
    model: &Model,
    latents: &mut Latents<'_>,
    mut correct: Option<&mut Correct<'_>>,
    log: &mut Log,
) -> Result<(Vec<u8>, Vec<i16>)> {
    let (levels, slice) = (header.base..=header.top, header.slice_voxels as usize);
    let voxels = levels.clone().map(|level| octree.level(level).len() as u32);
    let mut writer = Writer::new(Header {
        voxels: voxels.collect(),
        ..header
    })?;
    let drawn = |level: &u8| {
        let role = usize::from(level - *levels.start());
        model.shape().head(role, Heads::Best).is_some()
    };
    let finest = levels.clone().rev().find(drawn);
    let mut below: Option<Vec<i16>> = None;
    let mut latent_bytes = 0;
    for (role, level) in levels.enumerate() {
        let (count, map) = (octree.level(level).len(), &maps[role]);
        log.step(
            format!("geometry of level {level}"),
            count,
            "voxels",
            || {
                if role > 0 {
                    return writer.geometry(
                        level,
                        &codec::encode_level(model.isa(), octree, &maps[role - 1], level, slice),
                    );
                }
                let mut map = KernelMap::root();
                (1..=level).try_for_each(|n| {
                    let slices = codec::encode_level(model.isa(), octree, &map, n, slice);
                    map = octree.child_map(n - 1, &map);
                    writer.geometry(n, &slices)
                })
            },
        )?;
        below = log.step(
            format!("features of level {level}"),
            count,
            "voxels",
            || {
                let context = below
                    .as_ref()
                    .map(|g| model.upsample(role, g, octree.occupancy(level - 1)));
                if !model.has_latents(role) {
                    return Ok(Some(model.reconstruct(role, &[], context.as_deref(), map)));
                }
                let parameters = context
                    .as_ref()
                    .map(|c| model.entropy_parameters(role, c, map));
                let (tables, voxels) = (model.tables(), octree.level(level));
                let octants = voxels.octants();
                let predict = model
                    .has_passes(role)
                    .then(|| model.passes(role, &octants, map, parameters.as_ref()));
                let coding = match (&predict, &parameters) {
                    (Some(predict), _) => Coding::Passes {
                        keys: voxels.keys(),
                        predict,
                    },
                    (None, Some((mu, sigma))) => Coding::Known(Condition::Gauss { mu, sigma }),
                    (None, None) => Coding::Known(Condition::Prior),
                };
                let latents = latents(role, coding, context.as_deref())?;
                let slices = coding.encode(tables, &latents, slice);
                latent_bytes += slices.iter().map(Vec::len).sum::<usize>();
                writer.features(level, latent_hash(&latents), &slices)?;
                Ok(Some(model.reconstruct(
                    role,
                    &latents,
                    context.as_deref(),
                    map,
                )))
            },
        )?;
        let head = model.shape().head(role, Heads::Best);
        let (Some(correct), Some(head)) = (&mut correct, head) else {
            continue;
        };
        log.step(format!("colours of level {level}"), count, "voxels", || {
            let found = correct(Level {
                role,
                level,
                finest: Some(level) == finest,
                children: head.children,
                octree,
                maps,
                features: below.as_deref().unwrap_or_default(),
                latents: latent_bytes,
            })?;
            for (heads, filter) in &found.filters {
                writer.filter(level, *heads as usize, &filter.to_bytes())?;
            }
            match &found.residual {
                Some(residual) => writer.residual(level, residual),
                None => Ok(()),
            }
        })?;
    }
    Ok((writer.finish()?, below.unwrap_or_default()))
}

/// The levels to code, for a cloud of bit depth `bits`.
fn choose_levels(bits: u8, wanted: Option<RangeInclusive<u8>>) -> Result<RangeInclusive<u8>> {
    let levels = wanted.unwrap_or(bits.saturating_sub(3)..=bits - 1);
    let (first, last) = (*levels.start(), *levels.end());
    if first > last || last >= bits || usize::from(last - first) >= ROLES {
        return Err(Error::Usage(format!(
            "levels {first}..{last} cannot be coded: a cloud of {bits} bits has levels up to {}, of which at most {ROLES} in a row are coded",
            bits - 1
        )));
    }
    Ok(levels)
}

/// The voxels of a level with the mean colours, in `[0, 1]`, of the cloud's voxels in each.
fn pooled(cloud: &ColouredVoxels, level: u8) -> (Voxels, Vec<[f32; 3]>) {
    let shift = 3 * (cloud.voxels.depth() - level);
    let mut keys: Vec<u64> = Vec::new();
    let mut sums: Vec<([u32; 3], u32)> = Vec::new();
    for (key, colour) in cloud.voxels.keys().iter().zip(&cloud.colours) {
        let key = key >> shift;
        if keys.last() != Some(&key) {
            keys.push(key);
            sums.push(([0; 3], 0));
        }
        if let Some((sum, count)) = sums.last_mut() {
            for (sum, &c) in sum.iter_mut().zip(colour) {
                *sum += u32::from(c);
            }
            *count += 1;
        }
    }
    let mean = |(sum, count): &([u32; 3], u32)| sum.map(|s| s as f32 / (255 * count) as f32);
    let colours = sums.par_iter().map(mean).collect();
    (Voxels::from_sorted(level, keys), colours)
}

/// The kernel maps of `base` and all deeper levels, in this order.
pub(crate) fn kernel_maps(octree: &Octree, base: u8) -> Vec<KernelMap> {
    let mut maps = vec![octree.kernel_map(base)];
    for level in base..octree.depth() {
        let next = octree.child_map(level, &maps[maps.len() - 1]);
        maps.push(next);
    }
    maps
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_default_to_the_three_below_the_bit_depth() {
        assert_eq!(choose_levels(10, None).unwrap(), 7..=9);
        assert_eq!(choose_levels(2, None).unwrap(), 0..=1);
        assert_eq!(choose_levels(1, None).unwrap(), 0..=0);
        assert_eq!(choose_levels(21, None).unwrap(), 18..=20);
    }

    #[test]
    fn levels_that_do_not_exist_are_refused() {
        for wanted in [7..=10, 5..=8, 11..=12] {
            let error = choose_levels(10, Some(wanted)).unwrap_err().to_string();
            assert!(error.contains("up to 9"), "{error}");
        }
    }

    #[test]
    fn pooling_takes_the_mean_of_the_voxels_in_each() {
        let cloud = ColouredVoxels {
            voxels: Voxels::new(2, vec![0, 1, 8]),
            colours: vec![[0, 0, 255], [255, 0, 255], [51, 51, 51]],
            placement: crate::Placement::VOXEL_GRID,
        };
        let (voxels, colours) = pooled(&cloud, 1);
        assert_eq!(voxels.keys(), [0, 1]);
        assert_eq!(colours, [[0.5, 0.0, 1.0], [0.2; 3]]);
    }
}
