//! Model files: safetensors, everything checked before it is used.

use b2p_kernels::f16;
use b2p_kernels::{ExactConv, LIMIT, Requantise};
use serde_json::Value;
use xxhash_rust::xxh3::Xxh3Default;

use super::ROLES;
use super::shape::Shape;
use crate::error::{Error, Result, Stage};
use crate::layers::{Spec, Stored, Tensors, malformed};

/// The largest weight of the exact zone.
const MAX_WEIGHT: u16 = 511;
/// The largest shift of the exact zone.
const MAX_SHIFT: u8 = 30;
/// Sums of the exact zone stay below this.
const SUM_LIMIT: u64 = 1 << 31;
/// The largest gain or bias of the close zone: no layer of f16 values can then leave f32's range.
const MAX_FLOAT: f32 = 65504.0;

impl Tensors<'_> {
    /// The model's description.
    ///
    /// # Errors
    /// [`Error::Malformed`] if there is none, or as [`Shape::from_json`].
    pub fn shape(&self) -> Result<Shape> {
        let json = self
            .metadata("b2p")
            .ok_or_else(|| Error::malformed(Stage::Network, "metadata", "b2p", "missing", "the model's description"))?;
        Shape::from_json(json)
    }

    /// What a bit is worth when latents are rounded, in squared latent steps, for each of a role's K channels, if the
    /// description says: 0 if it does not.
    ///
    /// # Errors
    /// [`Error::Malformed`] if it is neither a number from 0 to 100 nor K such numbers for each role.
    pub fn bit_prices(&self, latents: usize) -> Result<[Vec<f32>; ROLES]> {
        let json = self.metadata("b2p").unwrap_or("{}");
        let description: Value = serde_json::from_str(json).unwrap_or_default();
        let Some(said) = description.get("bit_price") else {
            return Ok(std::array::from_fn(|_| vec![0.0; latents]));
        };
        let prices = match said {
            Value::Array(roles) => roles.iter().map(|role| prices(role, latents)).collect(),
            one => price(one).map(|price| vec![vec![price; latents]; ROLES]),
        };
        prices.and_then(|p| p.try_into().ok()).ok_or_else(|| {
            let expected = format!("a number from 0 to 100, or {latents} such numbers for each of {ROLES} roles");
            let (field, said) = ("bit_price", said.to_string());
            Error::malformed(Stage::Network, "metadata", field, said, expected)
        })
    }

    /// What a stream calls the model: XXH3-128 of the description's exact part, and of name, type, extents and bytes of
    /// every tensor that bears on the decoded bits, in the order of their names.
    pub fn id(&self, shape: &Shape) -> [u8; 16] {
        const EXACT: [&str; 6] = ["up.", "base.", "near.", "pem.", "fr.", "cdf."];
        let mut hash = Xxh3Default::new();
        hash.update(shape.exact_text().as_bytes());
        for (name, info, bytes) in self.entries() {
            if !EXACT.iter().any(|prefix| name.starts_with(prefix)) {
                continue;
            }
            hash.update(format!("\n{name} {:?} {:?}\n", info.dtype, info.shape).as_bytes());
            hash.update(bytes);
        }
        hash.digest128().to_be_bytes()
    }

    /// A layer of the exact zone, with the proof that no sum of it overflows.
    ///
    /// # Errors
    /// [`Error::Malformed`], naming the tensor, if one is missing, of another type or shape, or out of range.
    pub fn exact_layer(&self, spec: Spec) -> Result<ExactConv> {
        let Spec {
            name,
            volume,
            cin,
            cout,
            invariant,
        } = spec;
        let tensor = format!("{name}.weight");
        let weights: Vec<i16> = self.get(&tensor, &[volume, cin, cout])?;
        if let Some(w) = weights.iter().find(|w| w.unsigned_abs() > MAX_WEIGHT) {
            return Err(malformed(&tensor, "weight", w, "within ±511"));
        }
        let requantise = if invariant {
            let gain = self.finite(&format!("{name}.gain"), cout, f32::MAX)?;
            let bias = self.finite(&format!("{name}.bias"), cout, f32::MAX)?;
            Requantise::Invariant { gain, bias }
        } else {
            let bias = self.get(&format!("{name}.bias"), &[cout])?;
            let shift: Vec<u8> = self.get(&format!("{name}.shift"), &[cout])?;
            if let Some(shift) = shift.iter().find(|&&shift| shift > MAX_SHIFT) {
                return Err(malformed(&format!("{name}.shift"), "shift", shift, "at most 30"));
            }
            Requantise::Shift { bias, shift }
        };
        for o in 0..cout {
            let (mut sum, mut squares) = (0, 0);
            for w in weights[o..].iter().step_by(cout) {
                sum += u64::from(w.unsigned_abs());
                squares += u64::from(w.unsigned_abs()).pow(2);
            }
            let bias = match &requantise {
                Requantise::Shift { bias, .. } => u64::from(bias[o].unsigned_abs()),
                Requantise::Scale { .. } | Requantise::Invariant { .. } => 0,
            };
            let reach = sum * u64::from(LIMIT.unsigned_abs()) + bias;
            if reach >= SUM_LIMIT {
                return Err(malformed(
                    &tensor,
                    &format!("reach of channel {o}"),
                    reach,
                    "below 2^31",
                ));
            }
            if invariant && squares >= SUM_LIMIT {
                return Err(malformed(
                    &tensor,
                    &format!("squared norm of channel {o}"),
                    squares,
                    "below 2^31",
                ));
            }
        }
        Ok(ExactConv::new(volume, cin, cout, &weights, requantise))
    }

    /// A layer of the close zone.
    ///
    /// # Errors
    /// As [`Tensors::exact_layer`].
    pub fn stored_layer(&self, spec: Spec) -> Result<Stored> {
        let name = &spec.name;
        let tensor = format!("{name}.weight");
        let weights: Vec<f16> = self.get(&tensor, &[spec.volume, spec.cin, spec.cout])?;
        if let Some(w) = weights.iter().find(|w| !w.is_finite()) {
            return Err(malformed(&tensor, "weight", w, "a finite number"));
        }
        let bias = self.finite(&format!("{name}.bias"), spec.cout, MAX_FLOAT)?;
        let gain = match spec.invariant {
            true => Some(self.finite(&format!("{name}.gain"), spec.cout, MAX_FLOAT)?),
            false => None,
        };
        Ok(Stored {
            weights,
            bias,
            gain,
            spec,
        })
    }
}

/// A price of each of so many channels.
fn prices(said: &Value, latents: usize) -> Option<Vec<f32>> {
    let said = said.as_array().filter(|said| said.len() == latents)?;
    said.iter().map(price).collect()
}

fn price(said: &Value) -> Option<f32> {
    let price = said.as_f64().filter(|price| (0.0..=100.0).contains(price));
    price.map(|price| price as f32)
}
