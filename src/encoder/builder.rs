//! The encoder as users of the library see it.

use std::ops::RangeInclusive;

use b2p_kernels::Isa;

use super::transform::{self, GeometryTarget, Outline, QualityTarget, Tune};
use super::{Encoded, Options, encode, encode_to_rate};
use crate::cancel::Cancel;
use crate::cloud::ColouredVoxels;
use crate::error::Result;
use crate::gaussians::learned::HeadsModel;
use crate::latents::network::Model;
use crate::log::Log;

/// Codes point clouds as streams.
///
/// ```
/// # fn main() -> b2p::Result<()> {
/// use b2p::{Encoder, PointCloud, voxelise};
///
/// let place = |i: u32| [i % 40, i / 40, 20].map(f64::from);
/// let cloud = PointCloud {
///     positions: (0..1600).map(place).collect(),
///     colours: (0..1600).map(|i| [200, (i % 40 * 6) as u8, 40]).collect(),
///     ..PointCloud::default()
/// };
/// let stream = Encoder::new().encode(&voxelise(&cloud, Some(6))?)?.bytes;
/// # assert!(stream.len() < 1600);
/// # Ok(())
/// # }
/// ```
#[derive(Debug, Clone, Default)]
pub struct Encoder {
    options: transform::Options,
    model: Option<Model>,
    lambda_scale: Option<f32>,
    cancel: Cancel,
    log: Option<Log>,
}

impl Encoder {
    /// An encoder of streams of version 3, with a luma step of 20/255 and filters, for the three levels below the
    /// cloud's own.
    pub fn new() -> Self {
        Self::default()
    }

    /// The same encoder for these levels: a stream may be cut after each of them. The last one is at most the bit depth
    /// N of the cloud; with a [model](Encoder::with_model), at most N − 1, and there are at most three. Default: N − 3
    /// to N − 1.
    pub fn with_levels(mut self, levels: RangeInclusive<u8>) -> Self {
        self.options.levels = Some(levels);
        self
    }

    /// The same encoder with another quality of colours. Without effect on streams of version 2.
    pub fn with_quality(mut self, quality: QualityTarget) -> Self {
        self.options.fineness = quality;
        self
    }

    /// The same encoder with exact or optimised geometry of the finest level. Without effect on streams of version 2.
    /// Default: exact.
    pub fn with_geometry(mut self, geometry: GeometryTarget) -> Self {
        self.options.geometry = geometry;
        self
    }

    /// The same encoder, whose colours approach something else. Without effect on streams of version 2. Default:
    /// [`Tune::Visual`].
    pub fn with_tune(mut self, tune: Tune) -> Self {
        self.options.tune = tune;
        self
    }

    /// The same encoder for Gaussians that reach as far as this. Without effect on streams of version 2, and without
    /// [heads](Encoder::with_heads_model). Default: [`Outline::Surface`].
    pub fn with_outline(mut self, outline: Outline) -> Self {
        self.options.outline = outline;
        self
    }

    /// The same encoder with so much effort, from 0 to 9, for fewer bits: of streams of version 3, what
    /// [`Options::set_effort`](transform::Options::set_effort) sets. 8 and 9 compare pictures, which differ slightly between
    /// instruction sets, so that streams may, too. Default: 7.
    pub fn with_effort(mut self, effort: u8) -> Self {
        self.options.set_effort(effort);
        self
    }

    /// The same encoder with or without filters, which the decoder runs on the colours of each level. Default: with.
    pub fn with_filter(mut self, filter: bool) -> Self {
        self.options.filter = filter;
        self
    }

    /// The same encoder for a decoder with these heads: streams of version 3 have colours that are [tuned](Tune) to the
    /// best of them, and head maps, which say where surfels draw better. Decoders with learned heads follow it. The two finest levels of a cloud have none. Maps are chosen by
    /// pictures, which differ slightly between instruction sets, so that maps may, too. Default: surfels, and
    /// no head maps.
    pub fn with_heads_model(mut self, heads: HeadsModel) -> Self {
        self.options.heads = Some(heads);
        self
    }

    /// The same encoder with so many voxels per slice of geometry, 1 to 16,384 (the default). Smaller slices let more
    /// threads decode a level, and cost bits.
    pub fn with_slice_voxels(mut self, voxels: u32) -> Self {
        self.options.slice_voxels = voxels;
        self
    }

    /// The same encoder with kernels of this instruction set. The stream does not depend on it, but for what is chosen
    /// by pictures (see [`Encoder::with_heads_model`], and coarse steps of [`Encoder::encode_to_rate`]). Default: the
    /// best of the machine.
    pub fn with_isa(mut self, isa: Isa) -> Self {
        self.options.isa = Some(isa);
        self
    }

    /// The same encoder, which codes learned colours with this model: streams of version 2, that only this model
    /// decodes.
    pub fn with_model(mut self, model: Model) -> Self {
        self.model = Some(model);
        self
    }

    /// The same encoder with λ of the rate–distortion optimised quantisation of version 2 scaled by this factor.
    /// Default: 1.
    pub fn with_lambda_scale(mut self, factor: f32) -> Self {
        self.lambda_scale = Some(factor);
        self
    }

    /// The same encoder, stopped before its next step when `cancel` is thrown.
    pub fn with_cancel(mut self, cancel: Cancel) -> Self {
        self.cancel = cancel;
        self
    }

    /// The same encoder, whose steps `log` collects.
    pub fn with_log(mut self, log: &Log) -> Self {
        self.log = Some(log.clone());
        self
    }

    /// Codes a cloud, then decodes the stream and compares before it returns it.
    ///
    /// # Errors
    /// [`Error::Usage`](crate::Error::Usage) for levels that the cloud does not have and steps out of range,
    /// [`Error::Malformed`](crate::Error::Malformed) for slices that the format does not have,
    /// [`Error::Unsupported`](crate::Error::Unsupported) if the model can only decode;
    /// [`Error::Cancelled`](crate::Error::Cancelled); the decoder's errors, if this machine computes incorrectly.
    pub fn encode(&self, cloud: &ColouredVoxels) -> Result<Encoded> {
        match &self.model {
            None => transform::encode(cloud, &self.options, &self.log()),
            Some(model) => encode(cloud, model, &self.learned(), &self.log()),
        }
    }

    /// Codes a cloud as well as possible with at most so many bits for each of its points, the whole stream counted.
    ///
    /// # Errors
    /// [`Error::Usage`](crate::Error::Usage) if the bits are not a finite number above 0,
    /// [`Error::TooFewBits`](crate::Error::TooFewBits) if the smallest stream has more, and those of
    /// [`Encoder::encode`].
    pub fn encode_to_rate(&self, cloud: &ColouredVoxels, bits_per_point: f64) -> Result<Encoded> {
        Ok(match &self.model {
            None => transform::encode_to_rate(cloud, &self.options, bits_per_point, &self.log())?.0,
            Some(model) => encode_to_rate(cloud, model, &self.learned(), bits_per_point, &self.log())?.0,
        })
    }

    fn log(&self) -> Log {
        let log = self.log.clone().unwrap_or(Log::off());
        log.with_cancel(self.cancel.clone())
    }

    /// The options of version 2.
    fn learned(&self) -> Options {
        let default = Options::default();
        Options {
            levels: self.options.levels.clone(),
            filter: self.options.filter,
            slice_voxels: self.options.slice_voxels,
            bit_price: self.lambda_scale.unwrap_or(default.bit_price),
            ..default
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Error, PointCloud, voxelise};

    #[test]
    fn a_thrown_switch_stops_encoding_before_its_next_step() {
        let cloud = PointCloud {
            positions: (0..64).map(|i| [i % 8, i / 8, 0].map(f64::from)).collect(),
            colours: vec![[9, 99, 199]; 64],
            ..PointCloud::default()
        };
        let grid = voxelise(&cloud, Some(3)).unwrap();
        let switch = Cancel::default();
        let thrower = switch.clone();
        let log = Log::with_listener(move |step| {
            if step == "geometry" {
                thrower.cancel();
            }
        });
        let encoder = Encoder::new().with_cancel(switch).with_log(&log);
        assert!(matches!(encoder.encode(&grid), Err(Error::Cancelled)));
        assert!(matches!(encoder.encode_to_rate(&grid, 9.0), Err(Error::Cancelled)));
        assert_eq!(log.steps().last().map(|step| step.name.as_str()), Some("geometry"));
    }
}
