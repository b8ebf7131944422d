//! Gaussian generation (GG), in floats or in integers.

use std::sync::OnceLock;

use b2p_kernels::{ExactConv, FloatConv, Precision as Sums, Taps, zeros};
use rayon::prelude::*;

use super::Model;
use super::children::{VoxelPart, VoxelParts};
use super::head::Head;
use super::structure::{Generate, RAW};
use crate::error::{Error, Result};
use crate::gaussians::Heads;
use crate::geometry::KernelMap;
use crate::layers::{Conv, Pool, Precision, Stored, apply, apply_f32, missing, reals};

/// One head: its layers as stored, and ready to run in the precisions that were asked for.
pub(super) struct Generator {
    stored: Generate<Stored>,
    /// The real value of one step of the features that it reads.
    input: f32,
    /// Those of its own integers.
    scales: Option<Vec<f32>>,
    float: OnceLock<Generate<FloatConv>>,
    half: OnceLock<Generate<FloatConv>>,
    integer: OnceLock<Generate<ExactConv>>,
}

impl Generator {
    pub fn new(stored: Generate<Stored>, input: f32, scales: Option<Vec<f32>>) -> Self {
        Generator {
            stored,
            input,
            scales,
            float: OnceLock::new(),
            half: OnceLock::new(),
            integer: OnceLock::new(),
        }
    }

    pub fn head(&self) -> &Head {
        &self.stored.head
    }

    pub fn has_integers(&self) -> bool {
        self.scales.is_some()
    }

    #[cfg(test)]
    pub fn is_ready(&self) -> bool {
        let floats = [&self.float, &self.half].map(|floats| floats.get().is_some());
        floats.contains(&true) || self.integer.get().is_some()
    }

    /// The same of layers that take reals, made by `make`.
    pub fn of_layers<L>(&self, make: impl Fn(&Stored) -> L) -> Generate<L> {
        let any = vec![1.0; self.stored.head.scales()];
        self.stored.with_scales(1.0, &any, |layer, _, _| make(layer))
    }

    fn float(&self) -> &Generate<FloatConv> {
        self.float.get_or_init(|| self.of_layers(Stored::float))
    }

    fn half(&self) -> &Generate<FloatConv> {
        let half = |stored: &Stored| stored.float().with_precision(Sums::Half);
        self.half.get_or_init(|| self.of_layers(half))
    }

    fn integer(&self, scales: &[f32]) -> &Generate<ExactConv> {
        self.integer
            .get_or_init(|| self.stored.with_scales(self.input, scales, Stored::integer))
    }
}

#[doc(hidden)]
impl Model {
    /// [`Model::generate_with`] the best heads.
    ///
    /// # Errors
    /// Those of [`Model::generate_with`].
    ///
    /// # Panics
    /// If `g` and `map` disagree in length.
    pub fn generate(&self, role: usize, g: &[i16], map: &KernelMap) -> Result<Vec<f32>> {
        self.generate_with(Heads::Best, role, g, map)
    }

    /// The raw parameters of the Gaussians of a role's level, [`RAW`] numbers each: see `latents::activate`.
    ///
    /// `g` holds its features [voxels, C], `map` is its 3³ kernel map. Role 2 gives one Gaussian per voxel, role 1
    /// eight, those of all eight children of the first voxel first. All numbers are finite.
    ///
    /// # Errors
    /// [`crate::Error::Unsupported`], naming the roles that have one, if the model has no such generator for `role`.
    ///
    /// # Panics
    /// If `g` and `map` disagree in length.
    pub fn generate_with(&self, heads: Heads, role: usize, g: &[i16], map: &KernelMap) -> Result<Vec<f32>> {
        self.generate_in(&mut Pool::new(), heads, role, g, map)
    }

    /// [`Model::generate_with`] the memory of a pool.
    pub(crate) fn generate_in(
        &self,
        pool: &mut Pool<i16>,
        heads: Heads,
        role: usize,
        g: &[i16],
        map: &KernelMap,
    ) -> Result<Vec<f32>> {
        let generator = self.generator(role, heads)?;
        // A residual block's input, inner rows and output.
        pool.keep(3);
        self.check(g, self.shape.channels, map);
        match (&generator.scales, self.precision) {
            (Some(scales), Precision::Int16) => Ok(self.run_generator(pool, generator.integer(scales), g, map, PART)),
            (_, precision) => {
                let g = reals(self.isa, g, self.g_scale[role]);
                let layers = match precision {
                    Precision::Half => generator.half(),
                    _ => generator.float(),
                };
                Ok(self.run_generator(&mut Pool::new(), layers, &g, map, PART))
            }
        }
    }

    /// The generator of a role.
    pub(super) fn generator(&self, role: usize, heads: Heads) -> Result<&Generator> {
        let of_set = || self.generators.iter().filter(|gg| gg.head().heads == heads);
        let found = of_set().find(|gg| gg.head().role == role);
        found.ok_or_else(|| {
            let roles: Vec<_> = of_set().map(|gg| gg.head().role.to_string()).collect();
            if roles.is_empty() {
                return no_such_heads(heads);
            }
            missing(
                "drawing this level",
                format!(
                    "it lies {role} above the base level, the model has generators for {}",
                    roles.join(" and ")
                ),
            )
        })
    }

    /// Fails unless the model has these heads.
    ///
    /// # Errors
    /// [`Error::Unsupported`].
    pub fn check_heads(&self, heads: Heads) -> Result<()> {
        // A model without any head at all has none to be missed.
        match heads == Heads::Best || self.shape.heads().contains(&heads) {
            true => Ok(()),
            false => Err(no_such_heads(heads)),
        }
    }

    /// What a generator makes of features; the children of so many voxels at once.
    pub(super) fn run_generator<C: Conv>(
        &self,
        pool: &mut Pool<C::Value>,
        gg: &Generate<C>,
        g: &[C::Value],
        map: &KernelMap,
        part: usize,
    ) -> Vec<f32> {
        let (isa, n) = (self.isa, map.len());
        let mut x = apply(pool, isa, &gg.conv_in, map.taps(), g, n, true);
        for block in &gg.before {
            x = block.apply(pool, isa, map.taps(), x);
        }
        let mut out = zeros(n * gg.head.children * RAW);
        if gg.head.children == 8 {
            self.finish_children(pool, gg, x, map, part, &mut out);
        } else {
            let forward = map.forward();
            let next = apply(pool, isa, &gg.layer4, forward.taps(), &x, n, false);
            pool.give(x);
            let mut x = next;
            for block in &gg.after {
                x = block.apply(pool, isa, map.taps(), x);
            }
            apply_f32(isa, &gg.conv_out, map.taps(), &x, &mut out);
            pool.give(x);
        }
        out
    }

    /// What a generator makes of the features of all eight children of every voxel, part by part.
    fn finish_children<C: Conv>(
        &self,
        pool: &mut Pool<C::Value>,
        gg: &Generate<C>,
        x: Vec<C::Value>,
        map: &KernelMap,
        part: usize,
        out: &mut [f32],
    ) {
        let (isa, h, n) = (self.isa, gg.head.channels, map.len());
        let layers = 2 * gg.after.len() + 1;
        let mut parts = VoxelParts::new(map);
        let (mut first, mut rest) = (0, out);
        while first < n {
            let rows = first..n.min(first + part);
            let VoxelPart { voxels, ends, map } = parts.part(rows, layers.div_ceil(2), AROUND * part);
            let (out, after) = rest.split_at_mut(ends[0] * 8 * RAW);
            (first, rest) = (first + ends[0], after);
            // After that many layers, the children whose results some later layer reads.
            let rows = |done: usize| 8 * ends[(layers - done).div_ceil(2)];
            let mut parents = pool.take(voxels.len() * h);
            let copies = parents.par_chunks_exact_mut(h).zip(&voxels);
            copies.with_min_len(1024).for_each(|(to, &voxel)| {
                to.copy_from_slice(&x[voxel as usize * h..][..h]);
            });
            let map = map.generated_children();
            let mut y = apply(pool, isa, &gg.layer4, Taps::Children, &parents, rows(0), false);
            pool.give(parents);
            for (block, done) in gg.after.iter().zip((0..).step_by(2)) {
                let rows = [rows(done + 1), rows(done + 2)];
                y = block.apply_to_some(pool, isa, map.taps(), y, rows);
            }
            apply_f32(isa, &gg.conv_out, map.taps(), &y, out);
            pool.give(y);
        }
    }
}

fn no_such_heads(heads: Heads) -> Error {
    let detail = format!("the model has no {heads} heads");
    missing("generating Gaussians with these heads", detail)
}

/// Voxels whose children are generated at once. Fewer need less memory, and more time for the rings around them: of a
/// body's 59,046 voxels at level 8 (`lite`) parts of 16,384 take 165 MB in all and an eighth longer than all at once
/// with 249 MB.
const PART: usize = 32768;
/// How many times as many voxels as a part has may be in memory with it and the rings around it: more are only in
/// streams that are made for it, whose parts are smaller then.
const AROUND: usize = 4;
/// As many voxels at most are in memory with their children.
pub(crate) const AT_ONCE: usize = AROUND * PART;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Octree, Voxels, morton};
    use crate::latents::network::{Shape, untrained};

    #[test]
    fn children_generated_in_parts_are_those_generated_at_once() {
        let bowl = (0..1u32 << 10).map(|i| {
            let [x, y] = [i % 32, i / 32];
            morton::encode([x, y, (x * x + y * y) / 64])
        });
        let octree = Octree::new(Voxels::new(5, bowl.collect())).unwrap();
        let map = &octree.kernel_map(5);
        for blocks_after in [0, 1, 2] {
            let mut shape = Shape::tiny();
            shape.gg[0].blocks_after = blocks_after;
            let model = Model::from_bytes(&untrained(&shape, 7)).unwrap();
            let g = (0..map.len() * shape.channels).map(|i| (i * 7919 % 3001) as i16 - 1500);
            let g: Vec<i16> = g.collect();
            let generator = model.generator(1, Heads::Best).unwrap();
            let integer = generator.integer(generator.scales.as_ref().unwrap());
            let whole = model.run_generator(&mut Pool::new(), integer, &g, map, map.len());
            let real = reals(model.isa, &g, model.g_scale[1]);
            let whole_real = model.run_generator(&mut Pool::new(), generator.float(), &real, map, map.len());
            for part in [1, 37, 1000] {
                let parts = model.run_generator(&mut Pool::new(), integer, &g, map, part);
                assert!(parts == whole, "{blocks_after} blocks, {part} voxels");
                let parts = model.run_generator(&mut Pool::new(), generator.float(), &real, map, part);
                assert!(parts == whole_real, "{blocks_after} blocks, {part} voxels");
            }
        }
    }
}
