//! What the network consists of: its modules, their layers, and what those are called in a model file.
//!
//! Written once, for any kind of layer `L`: the layers that run, the ones that tests compute by definition, the ones to
//! be made up. Every constructor asks its `layer` function for one layer after the other.

use super::head::Head;
use super::shape::{Shape, Upsample};
use crate::error::Result;
use crate::layers::{Inception, ResBlock, Spec};

/// Numbers per Gaussian that a generator puts out.
pub const RAW: usize = 14;
/// Levels that a stream may code: roles 0, 1, 2. The level above them, which the encoder starts from, has role 3.
pub const ROLES: usize = 3;

/// What is known of a voxel of the base level: from each of the seven sets of neighbours that lie in one other octant
/// the mean of each of `latents` latents and whether there are any, and the three bits of its own octant.
pub(super) fn base_inputs(latents: usize) -> usize {
    7 * (latents + 1) + 3
}

/// What is known of a voxel above the base level: the same, of neighbours of the same parent and of others; its own
/// means and scales.
pub(super) fn near_inputs(latents: usize) -> usize {
    2 * 7 * (latents + 1) + 2 * latents + 3
}

/// Predictive entropy model (PEM).
pub(crate) struct Entropy<L> {
    pub conv_in: L,
    pub blocks: Vec<Inception<L>>,
    pub mu: L,
    pub sigma: L,
}

/// What predicts latents from those of neighbours.
pub(crate) struct Neighbours<L> {
    pub lin1: L,
    pub lin2: L,
    pub mu: L,
    pub sigma: L,
}

/// Feature reconstruction (FR).
pub(crate) struct Reconstruct<L> {
    pub lin1: L,
    pub blocks: Vec<Inception<L>>,
    pub lin2: L,
}

/// Gaussian generation (GG).
pub(crate) struct Generate<L> {
    pub head: Head,
    pub conv_in: L,
    pub before: Vec<ResBlock<L>>,
    pub layer4: L,
    pub after: Vec<ResBlock<L>>,
    pub conv_out: L,
}

impl<L> Generate<L> {
    /// The same network of other layers; `make` is told the steps of a layer's input and output.
    ///
    /// `scales`: the steps of the chain before layer 4, of the inside of each of its blocks, and the same after it. The
    /// generator's input comes in steps of `input`, its output in steps of 1.
    ///
    /// # Panics
    /// If there are not [`Generate::scales`] scales.
    pub fn with_scales<M>(&self, input: f32, scales: &[f32], make: impl Fn(&L, f32, f32) -> M) -> Generate<M> {
        assert_eq!(scales.len(), self.head.scales(), "one scale per edge");
        let (before, after) = scales.split_at(1 + self.before.len());
        let blocks = |blocks: &[ResBlock<L>], scales: &[f32]| {
            let blocks = blocks.iter().zip(&scales[1..]);
            blocks
                .map(|(block, &inner)| ResBlock {
                    c1: make(&block.c1, scales[0], inner),
                    c2: make(&block.c2, inner, scales[0]),
                    relu: block.relu,
                })
                .collect()
        };
        Generate {
            head: self.head.clone(),
            conv_in: make(&self.conv_in, input, before[0]),
            before: blocks(&self.before, before),
            layer4: make(&self.layer4, before[0], after[0]),
            after: blocks(&self.after, after),
            conv_out: make(&self.conv_out, after[0], 1.0),
        }
    }
}

/// Feature conversion (FC).
pub(crate) struct Convert<L> {
    pub conv_in: L,
    pub blocks: Vec<Inception<L>>,
    pub conv_out: L,
}

/// Feature squeezing (FS).
pub(crate) struct Squeeze<L> {
    pub lin1: L,
    pub lin2: L,
}

/// All that reaches a probability: what must compute the same everywhere.
pub(crate) struct Exact<L> {
    /// Of roles 1 and 2, if learned.
    pub up: Option<[L; 2]>,
    /// Of role 0, if the model has it.
    pub base: Option<Neighbours<L>>,
    /// Of roles 1 and 2, for which the model has it.
    pub near: [Option<Neighbours<L>>; 2],
    /// Of roles 1 and 2, if they have latents.
    pub pem: [Option<Entropy<L>>; 2],
    /// Of roles 0, 1 and 2, for which the model has it.
    pub fr: [Option<Reconstruct<L>>; ROLES],
}

/// What only an encoder needs.
pub(crate) struct Encoder<L> {
    /// Of roles 0 to 3.
    pub fc: [Convert<L>; ROLES + 1],
    /// Of roles 0 to 2, if they have latents.
    pub fs: [Option<Squeeze<L>>; ROLES],
}

/// Makes layers for [`Spec`]s below a name.
struct Maker<'a, F> {
    layer: &'a mut F,
    shape: &'a Shape,
}

impl<L, F: FnMut(Spec) -> Result<L>> Maker<'_, F> {
    fn make(&mut self, name: &str, volume: usize, cin: usize, cout: usize, invariant: bool) -> Result<L> {
        let name = name.to_owned();
        (self.layer)(Spec {
            name,
            volume,
            cin,
            cout,
            invariant,
        })
    }

    fn linear(&mut self, name: &str, cin: usize, cout: usize) -> Result<L> {
        self.make(name, 1, cin, cout, false)
    }

    fn inceptions(&mut self, module: &str, count: usize, invariant: bool) -> Result<Vec<Inception<L>>> {
        let c = self.shape.channels;
        (0..count)
            .map(|b| {
                let mut make = |part: &str, volume, cin, cout| {
                    self.make(&format!("{module}.blocks.{b}.{part}"), volume, cin, cout, invariant)
                };
                Ok(Inception {
                    a1: make("a1", 27, c, c / 4)?,
                    a2: make("a2", 27, c / 4, c / 2)?,
                    b1: make("b1", 1, c, c / 4)?,
                    b2: make("b2", 27, c / 4, c / 4)?,
                    b3: make("b3", 1, c / 4, c / 2)?,
                    relu: self.shape.inception_relu,
                })
            })
            .collect()
    }

    fn res_blocks(&mut self, prefix: &str, count: usize, c: usize) -> Result<Vec<ResBlock<L>>> {
        (0..count)
            .map(|b| {
                Ok(ResBlock {
                    c1: self.make(&format!("{prefix}.{b}.c1"), 27, c, c, false)?,
                    c2: self.make(&format!("{prefix}.{b}.c2"), 27, c, c, false)?,
                    relu: self.shape.resblock_relu,
                })
            })
            .collect()
    }

    fn entropy(&mut self, role: usize) -> Result<Option<Entropy<L>>> {
        let (c, k) = (self.shape.channels, self.shape.latents_of(role));
        let module = format!("pem.{role}");
        if k == 0 {
            return Ok(None);
        }
        Ok(Some(Entropy {
            conv_in: self.make(&format!("{module}.conv_in"), 27, c, c, true)?,
            blocks: self.inceptions(&module, self.shape.pem_blocks, true)?,
            mu: self.linear(&format!("{module}.mu"), c, k)?,
            sigma: self.linear(&format!("{module}.sigma"), c, k)?,
        }))
    }

    fn neighbours(&mut self, module: &str, inputs: usize, hidden: usize) -> Result<Option<Neighbours<L>>> {
        let k = self.shape.latents;
        if hidden == 0 {
            return Ok(None);
        }
        Ok(Some(Neighbours {
            lin1: self.linear(&format!("{module}.lin1"), inputs, hidden)?,
            lin2: self.linear(&format!("{module}.lin2"), hidden, hidden)?,
            mu: self.linear(&format!("{module}.mu"), hidden, k)?,
            sigma: self.linear(&format!("{module}.sigma"), hidden, k)?,
        }))
    }

    fn reconstruct(&mut self, role: usize) -> Result<Option<Reconstruct<L>>> {
        let (c, k) = (self.shape.channels, self.shape.latents_of(role));
        if role >= self.shape.fr_roles {
            return Ok(None);
        }
        let module = format!("fr.{role}");
        let cin = if role == 0 { k } else { k + c };
        Ok(Some(Reconstruct {
            lin1: self.linear(&format!("{module}.lin1"), cin, c)?,
            blocks: self.inceptions(&module, self.shape.fr_blocks, false)?,
            lin2: self.linear(&format!("{module}.lin2"), c, c)?,
        }))
    }

    fn generate(&mut self, head: &Head) -> Result<Generate<L>> {
        let (c, module) = (head.channels, head.module());
        Ok(Generate {
            head: head.clone(),
            conv_in: self.make(&format!("{module}.conv_in"), 27, self.shape.channels, c, true)?,
            before: self.res_blocks(&format!("{module}.before"), head.blocks_before, c)?,
            // With eight children each has one tap alone, so there is nothing to be invariant to.
            layer4: self.make(&format!("{module}.layer4"), 8, c, c, head.children == 1)?,
            after: self.res_blocks(&format!("{module}.after"), head.blocks_after, c)?,
            conv_out: self.make(&format!("{module}.conv_out"), 27, c, RAW, true)?,
        })
    }

    fn convert(&mut self, role: usize) -> Result<Convert<L>> {
        let (c, module) = (self.shape.channels, format!("fc.{role}"));
        let cin = if role == ROLES { 3 } else { c };
        Ok(Convert {
            conv_in: self.make(&format!("{module}.conv_in"), 27, cin, c, true)?,
            blocks: self.inceptions(&module, self.shape.fc_blocks, false)?,
            conv_out: self.make(&format!("{module}.conv_out"), 27, c, c, true)?,
        })
    }

    fn squeeze(&mut self, role: usize) -> Result<Option<Squeeze<L>>> {
        let (c, k) = (self.shape.channels, self.shape.latents_of(role));
        let module = format!("fs.{role}");
        if k == 0 {
            return Ok(None);
        }
        let cin = if role == 0 { c } else { 2 * c };
        Ok(Some(Squeeze {
            lin1: self.linear(&format!("{module}.lin1"), cin, c)?,
            lin2: self.linear(&format!("{module}.lin2"), c, k)?,
        }))
    }
}

impl Shape {
    /// The exact zone, of layers that `layer` makes.
    pub(crate) fn exact<L>(&self, layer: &mut impl FnMut(Spec) -> Result<L>) -> Result<Exact<L>> {
        let (c, k) = (self.channels, self.latents);
        let mut maker = Maker { layer, shape: self };
        let [near1, near2] = self.near_channels;
        let up = match self.upsample {
            Upsample::Nearest => None,
            Upsample::Learned => Some([maker.make("up.1", 8, c, c, false)?, maker.make("up.2", 8, c, c, false)?]),
        };
        Ok(Exact {
            up,
            pem: [maker.entropy(1)?, maker.entropy(2)?],
            fr: [maker.reconstruct(0)?, maker.reconstruct(1)?, maker.reconstruct(2)?],
            base: maker.neighbours("base", base_inputs(k), self.base_channels)?,
            near: [
                maker.neighbours("near.1", near_inputs(k), near1)?,
                maker.neighbours("near.2", near_inputs(k), near2)?,
            ],
        })
    }

    /// The generators, of layers that `layer` makes.
    pub(crate) fn generators<L>(&self, layer: &mut impl FnMut(Spec) -> Result<L>) -> Result<Vec<Generate<L>>> {
        let mut maker = Maker { layer, shape: self };
        self.gg.iter().map(|head| maker.generate(head)).collect()
    }

    /// The encoder's own part, of layers that `layer` makes.
    pub(crate) fn encoder<L>(&self, layer: &mut impl FnMut(Spec) -> Result<L>) -> Result<Encoder<L>> {
        let mut maker = Maker { layer, shape: self };
        Ok(Encoder {
            fc: [
                maker.convert(0)?,
                maker.convert(1)?,
                maker.convert(2)?,
                maker.convert(3)?,
            ],
            fs: [maker.squeeze(0)?, maker.squeeze(1)?, maker.squeeze(2)?],
        })
    }
}
