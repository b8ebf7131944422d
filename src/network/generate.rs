//! Gaussian generation (GG), in floats or in integers.

use std::fmt;
use std::str::FromStr;
use std::sync::OnceLock;

use b2p_kernels::{ExactConv, FloatConv, Taps};

use super::layers::{Conv, Pool, apply, apply_f32, reals};
use super::shape::Head;
use super::stored::Stored;
use super::structure::{Generate, RAW};
use super::{Model, missing};
use crate::error::{Error, Result};
use crate::geometry::KernelMap;

/// What Gaussians are generated in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Precision {
    /// Activations in ±2047 with a scale per layer, weights in ±2047 with a scale per channel, sums in 32 bits: the same bits on every
    /// machine and with any instruction set.
    Int16,
    /// f16 in memory, sums in f32.
    F16,
}

impl Precision {
    /// All, the default first.
    pub const ALL: [Precision; 2] = [Precision::Int16, Precision::F16];

    fn name(self) -> &'static str {
        match self {
            Precision::Int16 => "int16",
            Precision::F16 => "f16",
        }
    }
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Precision {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        let all = Precision::ALL;
        all.into_iter().find(|p| p.name() == name).ok_or_else(|| {
            let names = all.map(Precision::name).join(", ");
            Error::Usage(format!("no precision `{name}`, but {names}"))
        })
    }
}

/// One head: its layers as stored, and ready to run in the precisions that were asked for.
pub(super) struct Generator {
    stored: Generate<Stored>,
    /// The real value of one step of the features that it reads.
    input: f32,
    /// Those of its own integers.
    scales: Option<Vec<f32>>,
    float: OnceLock<Generate<FloatConv>>,
    integer: OnceLock<Generate<ExactConv>>,
}

impl Generator {
    pub fn new(stored: Generate<Stored>, input: f32, scales: Option<Vec<f32>>) -> Self {
        Generator {
            stored,
            input,
            scales,
            float: OnceLock::new(),
            integer: OnceLock::new(),
        }
    }

    pub fn head(&self) -> &Head {
        &self.stored.head
    }

    pub fn has_integers(&self) -> bool {
        self.scales.is_some()
    }

    /// The same of layers that take reals, made by `make`.
    pub fn of_layers<L>(&self, make: impl Fn(&Stored) -> L) -> Generate<L> {
        let any = vec![1.0; self.stored.head.scales()];
        self.stored
            .with_scales(1.0, &any, |layer, _, _| make(layer))
    }

    fn float(&self) -> &Generate<FloatConv> {
        self.float.get_or_init(|| self.of_layers(Stored::float))
    }

    fn integer(&self, scales: &[f32]) -> &Generate<ExactConv> {
        self.integer
            .get_or_init(|| self.stored.with_scales(self.input, scales, Stored::integer))
    }
}

impl Model {
    /// The raw parameters of the Gaussians of a role's level, [`RAW`] numbers each: see [`crate::gaussians::activate`].
    ///
    /// `g` holds its features [voxels, C], `map` is its 3³ kernel map. Role 2 gives one Gaussian per voxel, role 1 eight, those of
    /// all eight children of the first voxel first. All numbers are finite.
    ///
    /// # Errors
    /// [`crate::Error::Unsupported`], naming the roles that have one, if the model has no generator for `role`.
    ///
    /// # Panics
    /// If `g` and `map` disagree in length.
    pub fn generate(&self, role: usize, g: &[i16], map: &KernelMap) -> Result<Vec<f32>> {
        let generator = self.generator(role)?;
        self.check(g, self.shape.channels, map);
        match (&generator.scales, self.precision) {
            (Some(scales), Precision::Int16) => {
                Ok(self.run_generator(generator.integer(scales), g, map))
            }
            _ => {
                let g = reals(self.isa, g, self.g_scale[role]);
                Ok(self.run_generator(generator.float(), &g, map))
            }
        }
    }

    /// The generator of a role.
    pub(super) fn generator(&self, role: usize) -> Result<&Generator> {
        let of_role = |generator: &&Generator| generator.head().role == role;
        self.generators.iter().find(of_role).ok_or_else(|| {
            let roles = self.generators.iter().map(|gg| gg.head().role.to_string());
            let roles: Vec<_> = roles.collect();
            missing(
                "drawing this level",
                format!(
                    "it lies {role} above the base level, the model has generators for {}",
                    roles.join(" and ")
                ),
            )
        })
    }

    pub(super) fn run_generator<C: Conv>(
        &self,
        gg: &Generate<C>,
        g: &[C::Value],
        map: &KernelMap,
    ) -> Vec<f32> {
        let (isa, n) = (self.isa, map.len());
        let pool = &mut Pool::new();
        let mut x = apply(pool, isa, &gg.conv_in, map.taps(), g, n, true);
        for block in &gg.before {
            x = block.apply(pool, isa, map.taps(), x);
        }
        let finish = |pool: &mut Pool<C::Value>, mut x: Vec<C::Value>, map: &KernelMap| {
            for block in &gg.after {
                x = block.apply(pool, isa, map.taps(), x);
            }
            apply_f32(isa, &gg.conv_out, map.taps(), &x, map.len())
        };
        let out = if gg.head.children == 8 {
            let children = apply(pool, isa, &gg.layer4, Taps::Children, &x, 8 * n, false);
            // Theirs are eight times as large: nothing before is of use to them.
            drop(x);
            finish(&mut Pool::new(), children, &map.generated_children())
        } else {
            let forward = map.forward();
            let next = apply(pool, isa, &gg.layer4, forward.taps(), &x, n, false);
            pool.give(x);
            finish(pool, next, map)
        };
        debug_assert_eq!(out.len(), n * gg.head.children * RAW);
        out
    }
}
