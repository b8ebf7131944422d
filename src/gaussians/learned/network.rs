//! Evaluation of the network in integers or in floats.

use std::convert::Infallible;
use std::sync::OnceLock;

use b2p_kernels::{ExactConv, FloatConv, Isa, Precision as Sums, Taps, zeros};

use super::activate::{Drawing, PART};
use super::inputs::{self, CHILD_STEP, Links, PARENT_STEP};
use super::load::{INPUTS, Shape};
use super::spans::{Span, for_each_span};
use super::{LevelInput, RAW};
use crate::gaussians::Gaussians;
use crate::layers::{Conv, Pool, Precision, ResBlock, Stored, apply, apply_onto, apply_part, reals};
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

    /// Makes the Gaussians of a level, on at most `most` rows at a time, and calls `taken` with what has been drawn
    /// whenever a part has been added. `blur` is in squares of half the unit.
    pub fn generate<E>(
        &self,
        isa: Isa,
        precision: Precision,
        most: usize,
        input: &LevelInput<'_>,
        mut drawing: Drawing<'_>,
        taken: &mut Taken<'_, E>,
    ) -> Result<Gaussians, E> {
        let run = Run { isa, input, most };
        let floats =
            |cell: &'_ OnceLock<Net<FloatConv>>, sums: Sums, drawing: &mut Drawing<'_>, taken: &mut Taken<'_, E>| {
                let make = |layer: &Stored, _, _| layer.float().with_precision(sums);
                let net = cell.get_or_init(|| self.stored.with_steps(&self.steps, make));
                let rows = |channels: Vec<i16>| reals(isa, &channels, PARENT_STEP);
                run.run(net, inputs::fine, rows, drawing, taken)
            };
        match precision {
            Precision::Int16 => {
                let make = || self.stored.with_steps(&self.steps, Stored::integer);
                let net = self.integer.get_or_init(make);
                run.run(net, inputs::within_limit, |channels| channels, &mut drawing, taken)?;
            }
            Precision::F16 => floats(&self.float, Sums::F32, &mut drawing, taken)?,
            Precision::Half => floats(&self.half, Sums::Half, &mut drawing, taken)?,
        }
        Ok(drawing.gaussians)
    }
}

/// Called with the Gaussians drawn so far; it may take them away.
pub type Taken<'t, E> = dyn FnMut(&mut Gaussians) -> Result<(), E> + 't;

/// What a network is evaluated on.
struct Run<'a> {
    isa: Isa,
    input: &'a LevelInput<'a>,
    /// Rows at a time.
    most: usize,
}

impl Run<'_> {
    /// Evaluates all layers. `of_child` rounds a child's channel, `rows` makes input rows of channels.
    fn run<C: Conv, E>(
        &self,
        net: &Net<C>,
        of_child: fn(i32) -> i16,
        rows: impl Fn(Vec<i16>) -> Vec<C::Value>,
        drawing: &mut Drawing<'_>,
        taken: &mut Taken<'_, E>,
    ) -> Result<(), E> {
        let input = self.input;
        let h = self.parents(net, &rows);
        let rings = 2 * net.child.len() + 2;
        let voxels = input.octree.level(input.level);
        let mut pool = Pool::new();
        for_each_span(voxels, input.map, input.range(), rings, self.most, |span| {
            let links = Links::new(input, &span.voxels);
            let child = rows(inputs::children(input, &span.voxels, &links.parents, of_child));
            let x = self.children(&mut pool, net, &span, &links, &child, &h);
            drop(child);
            let range = &span.range;
            let mut raw = zeros(range.len().min(PART) * net.out.cout());
            for first in (0..range.len()).step_by(PART) {
                let count = PART.min(range.len() - first);
                let raw = &mut raw[..count * net.out.cout()];
                apply_part(self.isa, &net.out, span.taps(), &x, first, raw);
                drawing.add(range.start + first, raw);
                taken(&mut drawing.gaussians)?;
            }
            pool.give(x);
            Ok(())
        })
    }

    /// The features of all voxels of the level above.
    fn parents<C: Conv>(&self, net: &Net<C>, rows: &impl Fn(Vec<i16>) -> Vec<C::Value>) -> Vec<C::Value> {
        let (isa, input) = (self.isa, self.input);
        let rings = 2 * net.parent.len() + 1;
        let voxels = input.octree.level(input.level - 1);
        let mut all = Vec::new();
        let mut pool = Pool::new();
        let all_voxels = 0..voxels.len();
        let done: Result<(), Infallible> = for_each_span(voxels, input.above, all_voxels, rings, self.most, |span| {
            let parent = rows(inputs::parents(input, &span.voxels));
            let taps = span.taps();
            let mut h = apply(
                &mut pool,
                isa,
                &net.parent_in,
                taps,
                &parent,
                span.rows(rings - 1),
                true,
            );
            drop(parent);
            for (block, outer) in net.parent.iter().zip((0..rings.saturating_sub(2)).rev().step_by(2)) {
                let some = [span.rows(outer + 1), span.rows(outer)];
                h = block.apply_to_some(&mut pool, isa, taps, h, some);
            }
            if span.range.len() == voxels.len() {
                all = h;
                return Ok(());
            }
            if all.is_empty() {
                all = Vec::with_capacity(voxels.len() * net.parent_in.cout());
            }
            all.extend_from_slice(&h);
            pool.give(h);
            Ok(())
        });
        match done {
            Ok(()) => all,
        }
    }

    /// The features of a span's voxels and of those next to them.
    fn children<C: Conv>(
        &self,
        pool: &mut Pool<C::Value>,
        net: &Net<C>,
        span: &Span<'_>,
        links: &Links,
        child: &[C::Value],
        h: &[C::Value],
    ) -> Vec<C::Value> {
        let (isa, taps) = (self.isa, span.taps());
        let rings = 2 * net.child.len() + 2;
        let descent = Taps::Octants {
            parents: &links.parents,
            octants: &links.octants,
        };
        let mut x = apply(pool, isa, &net.up, descent, h, span.rows(rings - 1), false);
        apply_onto(isa, &net.child_in, taps, child, &mut x, true);
        for (block, outer) in net.child.iter().zip((1..rings - 2).rev().step_by(2)) {
            let some = [span.rows(outer + 1), span.rows(outer)];
            x = block.apply_to_some(pool, isa, taps, x, some);
        }
        x
    }
}

/// Bytes of a voxel's row of a kernel map, of the same as it is arranged for layers, and of the number of a voxel.
const MAP: u64 = 27 * 4;
const PLAN: u64 = 100;
const NUMBER: u64 = 4;
const ABOVE: Term = Term {
    each: "voxel of a span of the level above, with learned heads of H channels",
    takes: "kernel map arranged for layers, inputs as integers and as f16; rows of a block, and inner ones",
    fixed: PLAN + NUMBER + 4 * INPUTS[0] as u64,
    by: ROWS,
};
const VOXEL: Term = Term {
    each: "voxel of a span of the level, with learned heads of H channels",
    takes: "the same, octant and parent",
    fixed: PLAN + NUMBER + 4 * INPUTS[1] as u64 + 5,
    by: ROWS,
};
const ROWS: Sizes = Sizes {
    generator: 2 * 2,
    ..NOTHING
};
const SPLIT: Term = Term {
    each: "voxel of a span, if the level has several",
    takes: "kernel map of the span",
    fixed: MAP,
    by: NOTHING,
};
const PLACES: Term = Term {
    each: "voxel of a level of several spans",
    takes: "row in a span",
    fixed: NUMBER,
    by: NOTHING,
};
const FEATURES: Term = Term {
    each: "voxel of the level above, with learned heads of H channels",
    takes: "features",
    fixed: 0,
    by: Sizes {
        generator: 2,
        ..NOTHING
    },
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

/// The terms of [`work_bytes`] and [`gaussian_bytes`].
#[cfg(test)]
pub const TERMS: [Term; 7] = [ABOVE, VOXEL, SPLIT, PLACES, FEATURES, OUTPUTS, GAUSSIANS];

/// Rows that a network is evaluated on at a time, at most: those asked for, and enough for any voxel with its halo.
pub fn enough_rows(shape: &Shape, rows: usize) -> usize {
    let rings = 2 * shape.parent_blocks.max(shape.child_blocks) + 2;
    rows.max((2 * rings + 1).pow(3))
}

/// How many voxels of the level above lie between a voxel's parent and the farthest parent that its Gaussians depend
/// on.
pub fn reach(shape: &Shape) -> u32 {
    let child_rings = 2 * shape.child_blocks as u32 + 2;
    child_rings.div_ceil(2) + 2 * shape.parent_blocks as u32 + 1
}

/// Maximum memory in bytes of the Gaussians of so many voxels.
pub fn gaussian_bytes(shape: &Shape, voxels: u64) -> u64 {
    total(&[(GAUSSIANS, voxels.saturating_mul(shape.gaussians as u64))], NOTHING)
}

/// Maximum memory in bytes of evaluating the network on spans of at most `rows` rows, beyond its Gaussians.
pub fn work_bytes(shape: &Shape, voxels: u64, above: u64, rows: usize) -> u64 {
    let sizes = Sizes {
        generator: shape.channels as u64,
        ..NOTHING
    };
    let most = enough_rows(shape, rows) as u64;
    let spans = |term, voxels: u64| {
        let [rows, places] = if voxels > most { [most, voxels] } else { [0; 2] };
        total(&[(term, voxels.min(most)), (SPLIT, rows), (PLACES, places)], sizes)
    };
    let outputs = voxels.min(PART as u64) * shape.gaussians as u64;
    let kept = total(&[(FEATURES, above), (OUTPUTS, outputs)], sizes);
    // The spans of the level above are given back before those of the level are taken.
    kept.saturating_add(spans(ABOVE, above).max(spans(VOXEL, voxels)))
}
