//! A model: its shape, its tables, and its layers, checked and packed once.

use std::path::Path;

use b2p_kernels::{ExactConv, FloatConv, Isa};
use safetensors::SafeTensors;
use xxhash_rust::xxh3::Xxh3Default;

use super::shape::{HeadShape, ROLES, Shape, Upsample};
use super::tensors::Tensors;
use crate::entropy::{RawRows, Tables};
use crate::error::{Error, Result, Stage};

/// Numbers of a raw Gaussian: offset 3, scale 3, rotation 4, opacity 1, colour 3.
pub const RAW: usize = 14;

/// A loaded model.
#[derive(Debug, Clone)]
pub struct Model {
    pub(super) shape: Shape,
    id: [u8; 16],
    tables: Tables,
    pub(super) isa: Isa,
    pub(super) roles: Vec<Role>,
    pub(super) encoder: Option<Encoder>,
}

/// The decoder's layers for the level of one role.
#[derive(Debug, Clone)]
pub(super) struct Role {
    /// None at the base level, and where children copy their parents.
    pub upsample: Option<ExactConv>,
    /// None at the base level.
    pub entropy: Option<EntropyModel>,
    pub reconstruct: Reconstruct,
    pub generate: Option<Generate>,
    /// The real value of one step of the reconstructed feature.
    pub g_scale: f32,
    /// The real value of one step of the context; unused at the base level.
    pub c_scale: f32,
}

/// Two branches side by side, added to their input.
#[derive(Debug, Clone)]
pub(super) struct Inception<Conv> {
    pub a1: Conv,
    pub a2: Conv,
    pub b1: Conv,
    pub b2: Conv,
    pub b3: Conv,
}

/// PEM: from the context to μ and σ.
#[derive(Debug, Clone)]
pub(super) struct EntropyModel {
    pub conv_in: ExactConv,
    pub blocks: Vec<Inception<ExactConv>>,
    pub mu: ExactConv,
    pub sigma: ExactConv,
}

/// FR: from latents and context to features.
#[derive(Debug, Clone)]
pub(super) struct Reconstruct {
    pub lin1: ExactConv,
    pub blocks: Vec<Inception<ExactConv>>,
    pub lin2: ExactConv,
}

/// GG: from features to raw Gaussians.
#[derive(Debug, Clone)]
pub(super) struct Generate {
    pub shape: HeadShape,
    pub conv_in: FloatConv,
    pub before: Vec<ResBlock>,
    pub layer4: FloatConv,
    pub after: Vec<ResBlock>,
    pub conv_out: FloatConv,
}

/// Two convolutions, added to their input.
#[derive(Debug, Clone)]
pub(super) struct ResBlock {
    pub c1: FloatConv,
    pub c2: FloatConv,
}

/// What only an encoder needs.
#[derive(Debug, Clone)]
pub(super) struct Encoder {
    /// FC of roles 0, 1, 2 and of the level above the stream's last.
    pub convert: Vec<Convert>,
    /// FS of roles 0, 1, 2.
    pub squeeze: Vec<Squeeze>,
}

/// FC: a feature converter.
#[derive(Debug, Clone)]
pub(super) struct Convert {
    pub conv_in: FloatConv,
    pub blocks: Vec<Inception<FloatConv>>,
    pub conv_out: FloatConv,
}

/// FS: from features and context to latents.
#[derive(Debug, Clone)]
pub(super) struct Squeeze {
    pub lin1: FloatConv,
    pub lin2: FloatConv,
}

impl Model {
    /// Loads a model file, mapped into memory.
    ///
    /// # Errors
    /// [`Error::Io`], and those of [`Model::from_bytes`].
    pub fn open(path: &Path) -> Result<Model> {
        let file = b2p_kernels::map_file(path).map_err(|source| Error::Io {
            path: path.to_owned(),
            source,
        })?;
        Model::from_bytes(&file)
    }

    /// Loads a model from the bytes of a safetensors file.
    ///
    /// # Errors
    /// [`Error::Malformed`] naming the tensor or field at fault: not a model file, a tensor missing or of another type or shape, a
    /// number that is not finite, an exact layer whose sums could leave 32 bits, a table that is none.
    pub fn from_bytes(bytes: &[u8]) -> Result<Model> {
        let shape = read_shape(bytes)?;
        let tensors = Tensors::new(SafeTensors::deserialize(bytes).map_err(not_a_model)?);
        let tables = read_tables(&tensors, shape.latents)?;
        let g_scale = tensors.scales("g_scale", ROLES)?;
        let c_scale = tensors.scales("c_scale", ROLES)?;
        let roles = (0..ROLES)
            .map(|r| Role::read(&tensors, &shape, r, g_scale[r], c_scale[r]))
            .collect::<Result<_>>()?;
        let encoder = tensors
            .has("fc.0.conv_in.weight")
            .then(|| Encoder::read(&tensors, &shape))
            .transpose()?;
        Ok(Model {
            id: identity(&tensors, &shape),
            tables,
            isa: Isa::detect(),
            roles,
            encoder,
            shape,
        })
    }

    /// The same model, computing with other instructions.
    pub fn with_isa(mut self, isa: Isa) -> Model {
        self.isa = isa;
        self
    }

    /// What the network looks like.
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// The hash of everything that decides what a stream's bits mean.
    pub fn id(&self) -> [u8; 16] {
        self.id
    }

    /// The probabilities.
    pub fn tables(&self) -> &Tables {
        &self.tables
    }

    /// Whether the model can encode, or was stripped to decode only.
    pub fn can_encode(&self) -> bool {
        self.encoder.is_some()
    }
}

impl Role {
    fn read(t: &Tensors, shape: &Shape, r: usize, g_scale: f32, c_scale: f32) -> Result<Role> {
        let (c, k) = (shape.channels, shape.latents);
        let learned = r > 0 && shape.upsample == Upsample::Learned;
        let context = if r > 0 { c } else { 0 };
        let fr = format!("fr.{r}");
        Ok(Role {
            upsample: learned
                .then(|| t.shifted(&format!("up.{r}"), 8, c, c))
                .transpose()?,
            entropy: (r > 0)
                .then(|| EntropyModel::read(t, shape, r))
                .transpose()?,
            reconstruct: Reconstruct {
                lin1: t.shifted(&format!("{fr}.lin1"), 1, k + context, c)?,
                blocks: inceptions(&fr, shape.fr_blocks, c, |n, v, i, o| t.shifted(n, v, i, o))?,
                lin2: t.shifted(&format!("{fr}.lin2"), 1, c, c)?,
            },
            generate: shape
                .head(r)
                .map(|head| Generate::read(t, c, head))
                .transpose()?,
            g_scale,
            c_scale,
        })
    }
}

impl EntropyModel {
    fn read(t: &Tensors, shape: &Shape, r: usize) -> Result<EntropyModel> {
        let (c, k, name) = (shape.channels, shape.latents, format!("pem.{r}"));
        Ok(EntropyModel {
            conv_in: t.invariant(&format!("{name}.conv_in"), 27, c, c)?,
            blocks: inceptions(&name, shape.pem_blocks, c, |n, v, i, o| {
                t.invariant(n, v, i, o)
            })?,
            mu: t.shifted(&format!("{name}.mu"), 1, c, k)?,
            sigma: t.shifted(&format!("{name}.sigma"), 1, c, k)?,
        })
    }
}

impl Generate {
    fn read(t: &Tensors, channels: usize, head: &HeadShape) -> Result<Generate> {
        let (w, name) = (head.channels, format!("gg.{}", head.role));
        let blocks = |part: &str, count| -> Result<Vec<ResBlock>> {
            (0..count)
                .map(|b| {
                    Ok(ResBlock {
                        c1: t.plain(&format!("{name}.{part}.{b}.c1"), 27, w, w)?,
                        c2: t.plain(&format!("{name}.{part}.{b}.c2"), 27, w, w)?,
                    })
                })
                .collect()
        };
        let layer4 = format!("{name}.layer4");
        Ok(Generate {
            conv_in: t.normed(&format!("{name}.conv_in"), 27, channels, w)?,
            before: blocks("before", head.blocks_before)?,
            layer4: if head.children == 8 {
                t.plain(&layer4, 8, w, w)?
            } else {
                t.normed(&layer4, 8, w, w)?
            },
            after: blocks("after", head.blocks_after)?,
            conv_out: t.normed(&format!("{name}.conv_out"), 27, w, RAW)?,
            shape: head.clone(),
        })
    }
}

impl Encoder {
    fn read(t: &Tensors, shape: &Shape) -> Result<Encoder> {
        let (c, k) = (shape.channels, shape.latents);
        let convert = (0..=ROLES)
            .map(|r| {
                let name = format!("fc.{r}");
                Ok(Convert {
                    conv_in: t.normed(
                        &format!("{name}.conv_in"),
                        27,
                        if r == ROLES { 3 } else { c },
                        c,
                    )?,
                    blocks: inceptions(&name, shape.fc_blocks, c, |n, v, i, o| {
                        t.plain(n, v, i, o)
                    })?,
                    conv_out: t.normed(&format!("{name}.conv_out"), 27, c, c)?,
                })
            })
            .collect::<Result<_>>()?;
        let squeeze = (0..ROLES)
            .map(|r| {
                Ok(Squeeze {
                    lin1: t.plain(&format!("fs.{r}.lin1"), 1, if r > 0 { 2 * c } else { c }, c)?,
                    lin2: t.plain(&format!("fs.{r}.lin2"), 1, c, k)?,
                })
            })
            .collect::<Result<_>>()?;
        Ok(Encoder { convert, squeeze })
    }
}

/// Reads the blocks of `module` through `conv(name, volume, cin, cout)`.
fn inceptions<Conv>(
    module: &str,
    count: usize,
    c: usize,
    conv: impl Fn(&str, usize, usize, usize) -> Result<Conv>,
) -> Result<Vec<Inception<Conv>>> {
    let (narrow, wide) = (c / 4, c / 2);
    (0..count)
        .map(|b| {
            let at = |part: &str| format!("{module}.blocks.{b}.{part}");
            Ok(Inception {
                a1: conv(&at("a1"), 27, c, narrow)?,
                a2: conv(&at("a2"), 27, narrow, wide)?,
                b1: conv(&at("b1"), 1, c, narrow)?,
                b2: conv(&at("b2"), 27, narrow, narrow)?,
                b3: conv(&at("b3"), 1, narrow, wide)?,
            })
        })
        .collect()
}

fn not_a_model(error: safetensors::SafeTensorError) -> Error {
    Error::malformed(
        Stage::Network,
        "byte 0",
        "model file",
        error,
        "a safetensors file",
    )
}

fn read_shape(bytes: &[u8]) -> Result<Shape> {
    let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(not_a_model)?;
    let text = metadata
        .metadata()
        .as_ref()
        .and_then(|m| m.get("b2p"))
        .ok_or_else(|| {
            Error::malformed(
                Stage::Network,
                "the metadata",
                "b2p",
                "missing",
                "the network's shape as JSON",
            )
        })?;
    let shape: Shape = serde_json::from_str(text).map_err(|e| {
        Error::malformed(
            Stage::Network,
            "the metadata",
            "b2p",
            e,
            "the network's shape as JSON",
        )
    })?;
    shape.check()?;
    Ok(shape)
}

fn read_tables(t: &Tensors, latents: usize) -> Result<Tables> {
    let rows = |name: &str, count: usize| -> Result<_> {
        Ok((
            t.values::<u16>(name, &[None])?,
            t.values::<u32>(&format!("{name}.offset"), &[Some(count + 1)])?,
            t.values::<i16>(&format!("{name}.low"), &[Some(count)])?,
        ))
    };
    let gauss = rows("cdf.gauss", 1024)?;
    let prior = rows("cdf.prior", latents)?;
    Tables::new(
        RawRows {
            name: "cdf.gauss",
            entries: &gauss.0,
            offsets: &gauss.1,
            low: &gauss.2,
        },
        RawRows {
            name: "cdf.prior",
            entries: &prior.0,
            offsets: &prior.1,
            low: &prior.2,
        },
    )
}

/// XXH3-128 of the exact zone: the tensors `up`, `pem`, `fr` and `cdf` by name, each as name, type, shape and bytes, and a line of the
/// shape's fields that change what they mean.
fn identity(tensors: &Tensors, shape: &Shape) -> [u8; 16] {
    let mut hasher = Xxh3Default::new();
    for (name, kind, extents, bytes) in tensors.with_prefixes(&["up.", "pem.", "fr.", "cdf."]) {
        hasher.update(format!("{name} {kind} {extents:?}\n").as_bytes());
        hasher.update(bytes);
    }
    let line = format!(
        "channels {} latents {} pem {} fr {} upsample {:?} relu {} shift {} max {}",
        shape.channels,
        shape.latents,
        shape.pem_blocks,
        shape.fr_blocks,
        shape.upsample,
        shape.inception_relu,
        shape.latent_shift,
        shape.latent_max,
    );
    hasher.update(line.as_bytes());
    hasher.digest128().to_be_bytes()
}
