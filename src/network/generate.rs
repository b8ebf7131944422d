//! Gaussian generation (GG), in floats.

use b2p_kernels::{FloatConv, Taps};
use half::f16;

use super::layers::{apply, apply_f32, reals, taps};
use super::structure::{Generate, RAW};
use super::{Model, missing};
use crate::error::Result;
use crate::geometry::KernelMap;

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
        let generator = self
            .generators
            .iter()
            .find(|gg| gg.head.role == role)
            .ok_or_else(|| {
                let roles: Vec<_> = self
                    .generators
                    .iter()
                    .map(|gg| gg.head.role.to_string())
                    .collect();
                missing(
                    "drawing this level",
                    format!(
                        "it lies {role} above the base level, the model has generators for {}",
                        roles.join(" and ")
                    ),
                )
            })?;
        self.check(g, self.shape.channels, map);
        let x = reals(self.isa, g, self.g_scale[role]);
        Ok(self.run_generator(generator, x, map))
    }

    fn run_generator(&self, gg: &Generate<FloatConv>, x: Vec<f16>, map: &KernelMap) -> Vec<f32> {
        let (isa, n) = (self.isa, map.len());
        let x = apply(isa, &gg.conv_in, taps(map), &x, n, true);
        let x = gg
            .before
            .iter()
            .fold(x, |x, block| block.apply(isa, taps(map), &x));
        let finish = |x: Vec<f16>, map: &KernelMap| {
            let x = gg
                .after
                .iter()
                .fold(x, |x, block| block.apply(isa, taps(map), &x));
            apply_f32(isa, &gg.conv_out, taps(map), &x, map.len())
        };
        let out = if gg.head.children == 8 {
            let x = apply(isa, &gg.layer4, Taps::Children, &x, 8 * n, false);
            finish(x, &map.generated_children())
        } else {
            let x = apply(isa, &gg.layer4, taps(&map.forward()), &x, n, false);
            finish(x, map)
        };
        debug_assert_eq!(out.len(), n * gg.head.children * RAW);
        out
    }
}
