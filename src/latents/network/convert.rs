//! The encoder's own modules: feature conversion (FC), pooling, feature squeezing (FS), in floats.

use b2p_kernels::f16;
use b2p_kernels::{FloatConv, Isa, Precision, Taps, to_f16, to_f32};
use rayon::prelude::*;

use super::Model;
use super::structure::{Convert, Encoder, ROLES};
use crate::error::Result;
use crate::geometry::KernelMap;
use crate::layers::Spec;
use crate::layers::missing;
use crate::layers::{Pool, apply, apply_f32, concat, reals};

#[doc(hidden)]
impl Model {
    /// The encoder's features of every coded level, finest first: [voxels, C] each.
    ///
    /// `colours` are those of the level above the finest coded one, in 0..=1, and `maps[0]` is its 3³ kernel map; the
    /// maps of the coded levels follow, down to the base level's, and `occupancy[i]` says which children in `maps[i]`
    /// the voxels of `maps[i + 1]` have.
    ///
    /// # Errors
    /// [`crate::Error::Unsupported`] if the model can only decode.
    ///
    /// # Panics
    /// If there are not one to three coded levels, or lengths disagree.
    pub fn features(&self, colours: &[[f32; 3]], maps: &[&KernelMap], occupancy: &[&[u8]]) -> Result<Vec<Vec<f16>>> {
        let encoder = self.encoder()?;
        let coded = maps.len() - 1;
        assert!((1..=ROLES).contains(&coded), "one to three levels are coded");
        assert_eq!(occupancy.len(), coded, "one link between every two levels");
        let centred: Vec<f32> = colours.as_flattened().iter().map(|c| c - 0.5).collect();
        let mut x = vec![f16::ZERO; centred.len()];
        to_f16(self.isa, &centred, &mut x);
        self.check(&x, 3, maps[0]);
        let memory = &mut Pool::new();
        let mut finest = Some(encoder.fc[ROLES].apply(memory, self.isa, &x, maps[0]));
        let mut out: Vec<Vec<f16>> = Vec::with_capacity(coded);
        for (i, (map, occupancy)) in maps[1..].iter().zip(occupancy).enumerate() {
            let finer = finest.as_ref().or(out.last()).expect("one has been made");
            let pooled = pool(self.isa, finer, occupancy, self.shape.channels);
            if let Some(read) = finest.take() {
                memory.give(read);
            }
            self.check(&pooled, self.shape.channels, map);
            out.push(encoder.fc[coded - 1 - i].apply(memory, self.isa, &pooled, map));
        }
        Ok(out)
    }

    /// The latents [voxels, K] of a role before they are rounded and bounded ([`crate::latents::entropy::quantise`]),
    /// from its encoder features and, above role 0, its context. None of a role that has none.
    ///
    /// # Errors
    /// [`crate::Error::Unsupported`] if the model can only decode.
    ///
    /// # Panics
    /// If `role` is above 2, the context is there for role 0 or not for another, or lengths disagree.
    pub fn squeeze(&self, role: usize, features: &[f16], context: Option<&[i16]>) -> Result<Vec<f32>> {
        assert_eq!(role > 0, context.is_some(), "all roles but 0 have a context");
        let (fs, c) = (&self.encoder()?.fs[role], self.shape.channels);
        let Some(fs) = fs else {
            return Ok(Vec::new());
        };
        let (rows, pool) = (features.len() / c, &mut Pool::new());
        let hidden = match context {
            None => apply(pool, self.isa, &fs.lin1, Taps::Same, features, rows, true),
            Some(context) => {
                assert_eq!(features.len(), context.len(), "one context per feature");
                let context = reals(self.isa, context, self.c_scale[role]);
                let x = concat(pool, features, c, &context, c);
                apply(pool, self.isa, &fs.lin1, Taps::Same, &x, rows, true)
            }
        };
        let mut out = vec![0.0; rows * self.shape.latents];
        apply_f32(self.isa, &fs.lin2, Taps::Same, &hidden, &mut out);
        Ok(out)
    }

    fn encoder(&self) -> Result<&Encoder<FloatConv>> {
        self.encoder.as_deref().ok_or_else(|| {
            missing(
                "encoding",
                format!("model {} has the decoder's layers only", self.shape.name),
            )
        })
    }
}

/// What a layer of the encoder is computed in. The finest level has most of the voxels, and what is made of it is
/// averaged before anything comes of it: that may be off a little, but for the colours themselves.
pub(super) fn precision(layer: &Spec) -> Precision {
    match layer.name.starts_with("fc.3.") && layer.cin > 3 {
        true => Precision::Fastest,
        false => Precision::F32,
    }
}

impl Convert<FloatConv> {
    fn apply(&self, pool: &mut Pool<f16>, isa: Isa, x: &[f16], map: &KernelMap) -> Vec<f16> {
        let n = map.len();
        let x = apply(pool, isa, &self.conv_in, map.taps(), x, n, false);
        let blocks = self.blocks.iter();
        let x = blocks.fold(x, |x, block| block.apply(pool, isa, map.taps(), x));
        let out = apply(pool, isa, &self.conv_out, map.taps(), &x, n, false);
        pool.give(x);
        out
    }
}

/// The mean of each voxel's occupied children.
fn pool(isa: Isa, x: &[f16], occupancy: &[u8], c: usize) -> Vec<f16> {
    const BLOCK: usize = 1024;
    let children = |mask: &u8| mask.count_ones() as usize;
    // Where each block's children begin.
    let mut starts = vec![0];
    for block in occupancy.chunks(BLOCK) {
        starts.push(starts[starts.len() - 1] + block.iter().map(children).sum::<usize>());
    }
    assert_eq!(x.len(), starts[starts.len() - 1] * c, "one feature per child");
    let mut out = vec![f16::ZERO; occupancy.len() * c];
    let blocks = out
        .par_chunks_mut(BLOCK * c)
        .zip(occupancy.par_chunks(BLOCK))
        .zip(&starts);
    blocks.for_each(|((out, occupancy), &start)| {
        let (mut child, mut sum) = (vec![0.0; c], vec![0.0; c]);
        let mut rows = x[start * c..].chunks_exact(c);
        for (out, mask) in out.chunks_exact_mut(c).zip(occupancy) {
            sum.fill(0.0f32);
            for row in rows.by_ref().take(children(mask)) {
                to_f32(isa, row, &mut child);
                sum.iter_mut().zip(&child).for_each(|(sum, x)| *sum += x);
            }
            let count = children(mask) as f32;
            sum.iter_mut().for_each(|sum| *sum /= count);
            to_f16(isa, &sum, out);
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pooling_averages_over_the_children_that_are_there() {
        // More parents than one task takes.
        let occupancy: Vec<u8> = (0..3000u32).map(|i| (i * 37 % 255) as u8 + 1).collect();
        let count: u32 = occupancy.iter().map(|mask| mask.count_ones()).sum();
        let x: Vec<f16> = (0..2 * count).map(|i| f16::from_f32((i % 64) as f32)).collect();
        let pooled = pool(Isa::detect(), &x, &occupancy, 2);
        let mut rows = x.chunks_exact(2);
        for (got, mask) in pooled.chunks_exact(2).zip(&occupancy) {
            let children: Vec<_> = rows.by_ref().take(mask.count_ones() as usize).collect();
            for (c, got) in got.iter().enumerate() {
                let sum: f32 = children.iter().map(|row| row[c].to_f32()).sum();
                assert_eq!(*got, f16::from_f32(sum / children.len() as f32));
            }
        }
        assert!(rows.next().is_none());
    }
}
