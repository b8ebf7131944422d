//! The learned part: features and latents (the exact zone, in integers), Gaussians, and the encoder's own layers (in
//! floats).
//!
//! A level of the stream has a *role*: 0 for its base level L, then 1 and 2. Role 3 is the level above the finest coded
//! one; the encoder starts from its colours. All modules are those of the paper's appendix (arXiv 2406.05915); where it
//! is silent, here is what holds:
//!
//! - **Geometry-invariant convolution**: output channel `o` is `gain_o · (Σ W x)_o / √D_o + bias_o`, with `D_o = Σ
//!   W²_o` and both sums over the taps that read an occupied voxel. The integer code divides by `√max(D_o, 1)`, the
//!   float code by `√(D_o + 1e-8)`.
//! - **Context**: `c` of a voxel is a linear layer, one per octant, of its parent's feature `g` (or a copy of it).
//! - **Base level**: no context. Beyond the paper, a small network predicts its latents from those of neighbours that
//!   were coded before ([`Model::pass_parameters`]); without one, they have one distribution per channel.
//! - **Latents**: a model may have none in its finest roles ([`Shape::latent_roles`]), beyond the paper: such a level
//!   brings geometry alone. Its features are made of the context, or are the context ([`Shape::fr_roles`]).
//! - **Neighbours**: beyond the paper, another such network may correct, at the levels above, what PEM predicts from
//!   the context.
//!
//! # The exact zone
//! Whatever reaches a probability is computed in integers, and the same on every machine: [`Model::upsample`],
//! [`Model::entropy_parameters`] (PEM), [`Model::pass_parameters`] and [`Model::reconstruct`] (FR).
//!
//! Activations are `i16` in ±2047, weights `i16` in ±511, sums `i32`; loading proves per output channel that no sum can
//! overflow. A sum becomes an activation by `clamp((sum + bias) >> shift)`, the rounding constant being part of the
//! bias; in geometry-invariant layers by `clamp(round_ties_even(f32(sum) · (gain / √f32(max(D, 1))) + bias))`, `D`
//! being the sum of the squared weights of the taps that read something: one square root, one division, one product,
//! one sum of IEEE f32, in that order, never fused. A residual is added after that and clamped again, then the ReLU
//! follows. No transcendental function, no float sum.
//!
//! Means are in sixteenths; standard deviations are an index i, σ = 0.11·(64 / 0.11)^(i / 63).
//!
//! # The close zone
//! Gaussian generation (GG) and the encoder's feature conversion (FC) and squeezing (FS) are f16 in the file. In f16
//! they store f16, saturating, and sum in f32; where there are matrix tiles, FC of the finest level multiplies in bf16.
//! A decoder may run GG in integers instead ([`Precision`]), with the arithmetic of the exact zone, which is faster,
//! and gives the same Gaussians to the bit everywhere; or, where processors have it, with sums in f16, which do not.
//!
//! # The model file
//! Safetensors. The metadata's `b2p` is JSON: [`Shape`]. Layer `NAME` has `NAME.weight` [taps, in, out] and, in the
//! exact zone, `.bias` i32 and `.shift` u8, or, if geometry-invariant, `.gain` and `.bias` f32; in the close zone,
//! where weights are f16, `.bias` f32 and, if geometry-invariant, `.gain` f32. The names are those in `structure.rs`.
//! `g_scale[r]` is the real value of one step of role r's features `g`, `c_scale[r]` that of its context. `gg.r.scale`,
//! which may be left out, has the same for a generator: of the chain of residual blocks before layer 4 (what enters it,
//! every branch, every sum), of the inside of each of its blocks, and of the same after layer 4. Where `gg` of the
//! metadata has further generators that say `"heads": "quick"`, their layers are `gg.quick.r.*` (quick heads). Tables:
//! see [`crate::latents::entropy::Tables`]. A file without `fc.*` and `fs.*` can decode only. The JSON may also say at
//! which `bit_price` latents are best rounded: one for all, or K for each of the three roles.

mod children;
mod convert;
#[cfg(feature = "encoder")]
mod double;
mod exact;
mod generate;
mod head;
mod load;
mod predict;
#[cfg(test)]
mod reference;
mod shape;
mod structure;
#[cfg(test)]
mod tests;
mod untrained;
mod work;

use std::path::Path;
use std::sync::Arc;

use b2p_kernels::{ExactConv, FloatConv, Isa};

use crate::error::Result;
use crate::input;
use crate::latents::entropy::{RawRows, Tables};
use crate::layers::{Precision, Spec, Stored, Tensors, malformed, missing};
use crate::limits::Limits;
use generate::Generator;
use structure::{Encoder, Exact, Generate};

pub(crate) use generate::AT_ONCE;
pub use head::Head;
pub use predict::{Parameters, Pass};
pub use shape::{Shape, Upsample};
pub use structure::{RAW, ROLES};
pub use untrained::untrained;
pub use work::{Module, Work};

/// A model of learned colours, which codes and decodes streams of version 2. Clones share the weights.
#[derive(Clone)]
pub struct Model {
    shape: Arc<Shape>,
    id: [u8; 16],
    isa: Isa,
    tables: Arc<Tables>,
    exact: Arc<Exact<ExactConv>>,
    generators: Arc<[Generator]>,
    precision: Precision,
    encoder: Option<Arc<Encoder<FloatConv>>>,
    bit_prices: Arc<[Vec<f32>; ROLES]>,
    g_scale: Arc<[f32]>,
    c_scale: Arc<[f32]>,
}

impl std::fmt::Debug for Model {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Model").field("id", &self.id).finish_non_exhaustive()
    }
}

impl Model {
    /// Loads a model file.
    ///
    /// # Errors
    /// [`Error::Io`](crate::Error::Io), [`Error::LimitExceeded`](crate::Error::LimitExceeded) for a file of more than 2
    /// GiB, or as [`Model::from_bytes`].
    pub fn open(path: &Path) -> Result<Self> {
        // Read, not mapped: another program may shorten the file meanwhile.
        let bytes = input::read_file(path, &Limits::default())?;
        Model::from_bytes(&bytes)
    }

    /// Loads a model file's content. Memory is bounded by its length.
    ///
    /// # Errors
    /// [`Error::Malformed`](crate::Error::Malformed), naming field or tensor, if anything is missing, of another type
    /// or extent, not finite, out of range, or could overflow a sum; [`Error::Unsupported`](crate::Error::Unsupported)
    /// for another format.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self> {
        let tensors = Tensors::new(bytes)?;
        let shape = tensors.shape()?;
        let tables = tables(&tensors, &shape)?;
        let mut float = |spec: Spec| {
            let precision = convert::precision(&spec);
            Ok(tensors.stored_layer(spec)?.float().with_precision(precision))
        };
        let encoder = match tensors.any("fc.") || tensors.any("fs.") {
            true => Some(shape.encoder(&mut float)?),
            false => None,
        };
        let g_scale = scales(&tensors, "g_scale", ROLES, 0)?;
        let generators = generators(&tensors, &shape, &g_scale)?;
        let integers = generators.iter().all(Generator::has_integers);
        Ok(Model {
            precision: if integers { Precision::Int16 } else { Precision::F16 },
            generators: generators.into(),
            exact: Arc::new(shape.exact(&mut |spec| tensors.exact_layer(spec))?),
            encoder: encoder.map(Arc::new),
            g_scale: g_scale.into(),
            c_scale: scales(&tensors, "c_scale", ROLES, 1)?.into(),
            id: tensors.id(&shape),
            bit_prices: Arc::new(tensors.bit_prices(shape.latents)?),
            isa: Isa::detect(),
            tables: Arc::new(tables),
            shape: Arc::new(shape),
        })
    }

    /// Generates Gaussians in that precision.
    ///
    /// # Errors
    /// [`Error::Unsupported`](crate::Error::Unsupported) if the model file lacks what integers need, or the
    /// instructions lack what [`Precision::Half`] needs.
    pub fn with_precision(self, precision: Precision) -> Result<Self> {
        if precision == Precision::Half && !self.isa.has_half() {
            let detail = format!("{} has no arithmetic in f16, take f16 or int16", self.isa);
            return Err(missing("generating Gaussians in half", detail));
        }
        let lacks = |generator: &&Generator| !generator.has_integers();
        match self.generators.iter().find(lacks) {
            Some(generator) if precision == Precision::Int16 => {
                let module = generator.head().module();
                let detail = format!("the model has no tensor {module}.scale");
                Err(missing("generating Gaussians in integers", detail))
            }
            _ => Ok(Model { precision, ..self }),
        }
    }

    /// The precision that Gaussians are generated in: integers if the model has what they need, unless told otherwise.
    pub fn precision(&self) -> Precision {
        self.precision
    }

    /// Uses no more than these instructions. Whatever is computed in integers stays as it is; [`Precision::Half`]
    /// becomes [`Precision::F16`] where they have no arithmetic in f16.
    pub fn with_isa(self, isa: Isa) -> Self {
        Model { isa, ..self }
    }

    /// The instructions that it uses: the best of this machine unless told otherwise.
    pub fn isa(&self) -> Isa {
        self.isa
    }

    /// The model's extents.
    #[doc(hidden)]
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// What streams call it: a hash of all that bears on the decoded bits.
    pub fn id(&self) -> [u8; 16] {
        self.id
    }

    /// The probability tables.
    #[doc(hidden)]
    pub fn tables(&self) -> &Tables {
        &self.tables
    }

    /// What a bit is best worth when a role's latents are rounded, in squared latent steps, of each channel: see
    /// [`crate::latents::entropy::Rounding`].
    ///
    /// # Panics
    /// If `role` is above 2.
    #[doc(hidden)]
    pub fn bit_prices(&self, role: usize) -> &[f32] {
        &self.bit_prices[role]
    }

    /// Whether the file had the encoder's layers.
    pub fn can_encode(&self) -> bool {
        self.encoder.is_some()
    }
}

fn tables(tensors: &Tensors, shape: &Shape) -> Result<Tables> {
    let rows = |name: &str| -> Result<_> {
        let entries: Vec<u16> = tensors.list(name)?;
        let offsets: Vec<u32> = tensors.list(&format!("{name}.offset"))?;
        let low: Vec<i16> = tensors.list(&format!("{name}.low"))?;
        Ok((entries, offsets, low))
    };
    let (gauss, prior) = (rows("cdf.gauss")?, rows("cdf.prior")?);
    let raw = |name, (entries, offsets, low)| RawRows {
        name,
        entries,
        offsets,
        low,
    };
    let tables = Tables::new(
        raw("cdf.gauss", (&gauss.0, &gauss.1, &gauss.2)),
        raw("cdf.prior", (&prior.0, &prior.1, &prior.2)),
    )?
    .with_learning(shape.learning);
    match tables.channels() == shape.latents {
        true => Ok(tables),
        false => Err(malformed("cdf.prior.low", "rows", tables.channels(), shape.latents)),
    }
}

/// The generators, and what they need to run in integers, if the file has it.
fn generators(tensors: &Tensors, shape: &Shape, g_scale: &[f32]) -> Result<Vec<Generator>> {
    let stored = shape.generators(&mut |spec| tensors.stored_layer(spec))?;
    let generator = |stored: Generate<Stored>| {
        let role = stored.head.role;
        let name = format!("{}.scale", stored.head.module());
        let scales = match tensors.has(&name) {
            true => Some(scales(tensors, &name, stored.head.scales(), 0)?),
            false => None,
        };
        Ok(Generator::new(stored, g_scale[role], scales))
    };
    stored.into_iter().map(generator).collect()
}

/// The real values of one integer step, `count` of them; those from `first` on are above 0.
fn scales(tensors: &Tensors, name: &str, count: usize, first: usize) -> Result<Vec<f32>> {
    // 2047 steps of the largest still fit f16.
    const MAX: f32 = 31.0;
    let scales = tensors.finite(name, count, MAX)?;
    match scales[first..].iter().find(|&&scale| scale <= 0.0) {
        Some(scale) => Err(malformed(name, "entry", scale, "above 0")),
        None => Ok(scales),
    }
}
