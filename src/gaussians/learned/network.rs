//! Evaluation of the network in integers or in floats.

use std::sync::OnceLock;

use b2p_kernels::{ExactConv, FloatConv, Isa, Precision as Sums, Taps, zeros};

use super::activate::{Drawing, PART};
use super::inputs::{CHILD_STEP, Channels, PARENT_STEP};
use super::load::{INPUTS, Shape};
use super::{LevelInput, RAW};
use crate::gaussians::{Frame, Gaussians};
use crate::layers::{Conv, Pool, Precision, ResBlock, Stored, apply, apply_added, apply_part, reals};
use crate::memory::{NOTHING, Sizes, Term, total};

/// The layers of a network.
pub struct Net<L> {
    pub parent_in: L,
    pub parent: Vec<ResBlock<L>>,
    pub up: L,
    pub child_in: L,
    pub child: Vec<ResBlock<L>>,
    pub out: L,
}

/// Scales of integer activations: for each side that of its residual sums, and that inside each of its blocks.
pub struct Steps {
    pub parent: (f32, Vec<f32>),
    pub child: (f32, Vec<f32>),
}

impl<L> Net<L> {
    /// Converts every layer by `make`, whose arguments are a layer and the scales of its input and output. The scale of
    /// the network's output is 1.
    fn with_steps<M>(&self, steps: &Steps, make: impl Fn(&L, f32, f32) -> M) -> Net<M> {
        let blocks = |blocks: &[ResBlock<L>], (sum, inner): &(f32, Vec<f32>)| {
            let blocks = blocks.iter().zip(inner);
            let block = blocks.map(|(block, &inner)| ResBlock {
                c1: make(&block.c1, *sum, inner),
                c2: make(&block.c2, inner, *sum),
                relu: block.relu,
            });
            block.collect()
        };
        let (parent, child) = (steps.parent.0, steps.child.0);
        Net {
            parent_in: make(&self.parent_in, PARENT_STEP, parent),
            parent: blocks(&self.parent, &steps.parent),
            up: make(&self.up, parent, child),
            child_in: make(&self.child_in, CHILD_STEP, child),
            child: blocks(&self.child, &steps.child),
            out: make(&self.out, child, 1.0),
        }
    }
}

/// A network: its layers as stored, and as converted on first use to each precision.
pub struct Generator {
    shape: Shape,
    steps: Steps,
    stored: Net<Stored>,
    integer: OnceLock<Net<ExactConv>>,
    float: OnceLock<Net<FloatConv>>,
    half: OnceLock<Net<FloatConv>>,
}

impl Generator {
    pub fn new(shape: Shape, steps: Steps, stored: Net<Stored>) -> Self {
        Generator {
            shape,
            steps,
            stored,
            integer: OnceLock::new(),
            float: OnceLock::new(),
            half: OnceLock::new(),
        }
    }

    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// Makes the Gaussians of a level. `blur` is in squares of half the unit.
    pub fn generate(
        &self,
        isa: Isa,
        precision: Precision,
        input: &LevelInput<'_>,
        blur: f32,
        frame: Frame,
    ) -> Gaussians {
        let drawing = Drawing::new(input, self.shape.gaussians, blur, frame);
        let floats = |cell: &'_ OnceLock<Net<FloatConv>>, sums: Sums, drawing| {
            let make = |layer: &Stored, _, _| layer.float().with_precision(sums);
            let net = cell.get_or_init(|| self.stored.with_steps(&self.steps, make));
            let channels = Channels::fine(input);
            let real = |channels: &[i16]| reals(isa, channels, PARENT_STEP);
            let (parent, child) = (real(&channels.parent), real(&channels.child));
            run(isa, net, input, &channels, [&parent, &child], drawing)
        };
        match precision {
            Precision::Int16 => {
                let make = || self.stored.with_steps(&self.steps, Stored::integer);
                let net = self.integer.get_or_init(make);
                let channels = Channels::within_limit(input);
                let rows = [&channels.parent[..], &channels.child];
                run(isa, net, input, &channels, rows, drawing)
            }
            Precision::F16 => floats(&self.float, Sums::F32, drawing),
            Precision::Half => floats(&self.half, Sums::Half, drawing),
        }
    }
}

/// Evaluates all layers on the channels of parents and children.
fn run<C: Conv>(
    isa: Isa,
    net: &Net<C>,
    input: &LevelInput<'_>,
    channels: &Channels,
    [parent, child]: [&[C::Value]; 2],
    mut drawing: Drawing<'_>,
) -> Gaussians {
    let pool = &mut Pool::new();
    let (above, map) = (input.above, input.map);
    let mut h = apply(pool, isa, &net.parent_in, above.taps(), parent, above.len(), true);
    for block in &net.parent {
        h = block.apply(pool, isa, above.taps(), h);
    }
    let descent = Taps::Octants {
        parents: &channels.parents,
        octants: &channels.octants,
    };
    let up = apply(pool, isa, &net.up, descent, &h, map.len(), false);
    pool.give(h);
    let mut x = apply_added(pool, isa, &net.child_in, map.taps(), child, &up);
    pool.give(up);
    for block in &net.child {
        x = block.apply(pool, isa, map.taps(), x);
    }
    let mut raw = zeros(map.len().min(PART) * net.out.cout());
    for first in (0..map.len()).step_by(PART) {
        let rows = PART.min(map.len() - first);
        let raw = &mut raw[..rows * net.out.cout()];
        apply_part(isa, &net.out, map.taps(), &x, first, raw);
        drawing.add(first, raw);
    }
    drawing.gaussians
}

/// Bytes of a voxel's row of a kernel map as it is arranged for layers.
const PLAN: u64 = 100;
const ABOVE: Term = Term {
    each: "voxel of the level above, with learned heads of H channels",
    takes: "kernel map arranged for layers, inputs as integers and as f16; input, inner rows and output of a block",
    fixed: PLAN + 4 * INPUTS[0] as u64,
    by: ROWS,
};
const VOXEL: Term = Term {
    each: "voxel of the level, with learned heads of H channels",
    takes: "the same, octant and parent",
    fixed: PLAN + 4 * INPUTS[1] as u64 + 5,
    by: ROWS,
};
const ROWS: Sizes = Sizes {
    generator: 3 * 2,
    ..NOTHING
};
const OUTPUTS: Term = Term {
    each: "Gaussian of a part of at most 16,384 voxels, with learned heads",
    takes: "the network's output",
    fixed: 4 * RAW as u64,
    by: NOTHING,
};
const GAUSSIANS: Term = Term {
    each: "Gaussian of learned heads",
    takes: "itself",
    fixed: size_of::<[f32; 14]>() as u64,
    by: NOTHING,
};

/// The terms that [`bytes`] adds.
#[cfg(test)]
pub const TERMS: [Term; 4] = [ABOVE, VOXEL, OUTPUTS, GAUSSIANS];

/// Maximum memory in bytes of evaluating the network, Gaussians included.
pub fn bytes(shape: &Shape, voxels: u64, above: u64) -> u64 {
    let sizes = Sizes {
        generator: shape.channels as u64,
        ..NOTHING
    };
    let of_each = shape.gaussians as u64;
    let terms = [
        (ABOVE, above),
        (VOXEL, voxels),
        (OUTPUTS, voxels.min(PART as u64) * of_each),
        (GAUSSIANS, voxels.saturating_mul(of_each)),
    ];
    total(&terms, sizes)
}
