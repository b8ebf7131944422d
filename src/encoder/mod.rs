//! Point cloud to stream: of version 3 in [`transform`], of version 2, with learned features, here.
//!
//! Both run the decoder in the loop: what a level is predicted from is what the decoder will have.

mod builder;
mod colours;
mod corrections;
mod rate_control;
mod skeleton;
pub mod transform;

use std::ops::RangeInclusive;

use b2p_kernels::f16;
use rayon::prelude::*;

use crate::cloud::ColouredVoxels;
use crate::container::{Format, Header, MAX_SLICE_VOXELS, Section};
use crate::error::{Error, Result};
use crate::geometry::{KernelMap, Octree, Voxels};
use crate::latents::LatentDecoder;
use crate::latents::entropy::{Coding, Rounding};
use crate::latents::network::{Model, ROLES};
use crate::limits::Limits;
use crate::log::Log;
pub use builder::Encoder;
pub use corrections::Residual;
use corrections::{ColourError, Level, corrections};
pub use rate_control::encode_to_rate;
use skeleton::{Coded, Correct, Skeleton};

/// What may be chosen about a stream; [`encode_to_rate`] chooses what decides its size.
#[derive(Debug, Clone)]
pub struct Options {
    /// The levels whose features are coded: at most three, the last below the bit depth N. Default: N−3 to N−1.
    pub levels: Option<RangeInclusive<u8>>,
    /// Scale of λ in the rate–distortion optimised quantisation of latents, relative to the model's
    /// ([`Model::bit_prices`]): 0 rounds to the nearest, more saves bits. Default: 1.
    pub bit_price: f32,
    /// Whether colours that the heads generate are compared with the cloud's, and corrected where that is worth its
    /// bytes: see [`ColourFilter`](crate::latents::ColourFilter).
    pub filter: bool,
    /// How much is coded of the remaining colour error. Default: [`Residual::Coarse`].
    pub residual: Residual,
    /// Whether every level that is drawn has such a residual, one of its own, and not the finest alone: the stream of
    /// the finest is larger for it, and no better.
    pub every_level: bool,
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
            every_level: false,
            slice_voxels: MAX_SLICE_VOXELS,
        }
    }
}

/// A finished stream.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Encoded {
    /// The stream.
    pub bytes: Vec<u8>,
    /// What each level took, base level first.
    pub rates: Vec<Rate>,
}

/// What a level took.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Rate {
    /// The octree level.
    pub level: u8,
    /// Its voxels.
    pub voxels: usize,
    /// Bytes of its geometry, chunk headers included; the base level's include those of all levels above it.
    pub geometry_bytes: usize,
    /// Bytes of its colours (in version 2, features), chunk headers included.
    pub colour_bytes: usize,
}

/// Codes a cloud, then decodes the stream and compares before giving it out.
///
/// # Errors
/// [`Error::Usage`] for levels that the cloud or the format does not have, [`Error::Malformed`] for slices that the
/// format does not have, [`Error::Unsupported`] if the model can only decode; and, if encoder and decoder disagreed on
/// this machine, whatever the decoder found.
pub fn encode(cloud: &ColouredVoxels, model: &Model, options: &Options, log: &Log) -> Result<Encoded> {
    let subject = EncoderInput::new(cloud, model, options, log)?;
    let wants = options.residual.precision(options.filter).is_some();
    let coded = subject.code(options.bit_price, wants, log)?;
    let stream = || subject.stream(&coded, options.residual);
    let bytes = match coded.left.last() {
        Some(left) => {
            let name = format!("residual of level {}", left.level);
            let voxels = subject.skeleton.octree.level(left.level).len();
            log.step(name, voxels, "voxels", stream)?
        }
        None => stream()?,
    };
    subject.checked(bytes, &coded.features, log)
}

/// A cloud and what all its streams share, for any λ and any residual.
struct EncoderInput<'a> {
    cloud: &'a ColouredVoxels,
    model: &'a Model,
    options: &'a Options,
    skeleton: Skeleton<'a>,
    /// Of every coded level, the finest first.
    features: Vec<Vec<f16>>,
}

impl<'a> EncoderInput<'a> {
    fn new(cloud: &'a ColouredVoxels, model: &'a Model, options: &'a Options, log: &Log) -> Result<Self> {
        let levels = choose_levels(cloud.voxels.depth(), options.levels.clone())?;
        let (base, top) = (*levels.start(), *levels.end());
        // Networks have learned to see a level through all those below it, coded or not.
        let seen = cloud.voxels.depth().min(base + ROLES as u8);
        let (finest, colours) = log.step("pool colours", cloud.voxels.len(), "voxels", || Ok(pooled(cloud, seen)))?;
        let octree = Octree::new(finest)?;
        let maps = log.step("kernel maps", octree.level(seen).len(), "voxels", || {
            Ok(kernel_maps(&octree, base))
        })?;
        let features = log.step("features", colours.len(), "voxels", || {
            let maps: Vec<_> = maps.iter().rev().collect();
            let occupancy: Vec<_> = (base..seen).rev().map(|level| octree.occupancy(level)).collect();
            model.features(&colours, &maps, &occupancy)
        })?;
        let header = Header {
            optional_flags: 0,
            bits: cloud.voxels.depth(),
            base,
            top,
            points: cloud.voxels.len() as u64,
            placement: cloud.placement,
            format: Format::Learned { model: model.id() },
            slice_voxels: options.slice_voxels,
            voxels: Vec::new(),
            sections: Vec::new(),
        };
        Ok(EncoderInput {
            cloud,
            model,
            options,
            skeleton: Skeleton::new(header, octree, maps, model, log)?,
            features,
        })
    }

    /// Codes everything but a residual, and keeps, if one is wanted, what it is to be of.
    fn code(&self, bit_price: f32, residual: bool, log: &Log) -> Result<Coded> {
        let model = self.model;
        let slice = self.options.slice_voxels as usize;
        let mut squeezed = |role: usize, coding: Coding<'_>, context: Option<&[i16]>| {
            let own = &self.features[self.features.len() - 1 - role];
            let real = model.squeeze(role, own, context)?;
            let prices = model.bit_prices(role).iter();
            let rounding = Rounding {
                limit: model.shape().latent_max,
                prices: &prices.map(|price| price * bit_price).collect::<Vec<_>>(),
            };
            Ok(coding.quantise(model.tables(), &real, rounding, slice))
        };
        let Options {
            filter, every_level, ..
        } = *self.options;
        let mut correct = |level: Level<'_>| {
            let residual = residual && (level.finest || every_level);
            corrections(self.cloud, model, filter, residual, level)
        };
        let correct: Option<&mut Correct<'_>> = match filter || residual {
            true => Some(&mut correct),
            false => None,
        };
        self.skeleton.code(&mut squeezed, correct, log)
    }

    /// The stream of what was coded, with such a residual of what was kept for one.
    fn stream(&self, coded: &Coded, residual: Residual) -> Result<Vec<u8>> {
        let precision = residual.precision(self.options.filter);
        let slice = self.options.slice_voxels as usize;
        let payloads = |left: &ColourError| {
            let keys = self.skeleton.octree.level(left.level).keys();
            let payloads = left.payloads(keys, slice, precision?)?;
            Some((left.level, payloads))
        };
        let residuals: Vec<_> = coded.left.iter().filter_map(payloads).collect();
        self.skeleton.stream(coded, &residuals)
    }

    /// The stream, once it has been decoded to what was encoded.
    fn checked(&self, bytes: Vec<u8>, features: &[i16], log: &Log) -> Result<Encoded> {
        let Skeleton { header, octree, .. } = &self.skeleton;
        let top = header.top;
        let exact = log.step("decode again", octree.level(top).len(), "voxels", || {
            LatentDecoder::new(self.model)
                .with_limits(Limits::unlimited())
                .exact(&bytes, top, &Log::off())
        })?;
        if exact.octree != octree.truncated(top) || exact.features != features {
            return Err(Error::Usage(
                "the stream does not decode to what was encoded: this machine computes wrongly".into(),
            ));
        }
        let rates = rates(&Header::parse(&bytes, &Limits::unlimited())?);
        Ok(Encoded { bytes, rates })
    }
}

/// What the levels of a stream with this header took.
fn rates(header: &Header) -> Vec<Rate> {
    let levels = (header.base..).zip(header.voxels.iter().zip(&header.sections));
    let rate = |(level, (&voxels, section)): (u8, (&u32, &Section))| Rate {
        level,
        voxels: voxels as usize,
        geometry_bytes: section.geometry as usize,
        colour_bytes: section.colours as usize,
    };
    levels.map(rate).collect()
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
fn kernel_maps(octree: &Octree, base: u8) -> Vec<KernelMap> {
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
