//! Learned heads: Gaussians of any octree level from its occupancy and its decoded colours.
//!
//! Decoding does not depend on the heads, so any heads draw any stream. The same weights serve every level, since all
//! lengths are in voxels of the level. A model has up to four networks: [`Heads::Best`] and [`Heads::Quick`], each for
//! one and for eight Gaussians per voxel.
//!
//! # The network
//! The inputs are level ℓ − 1 ("parent") and level ℓ ("child"). For a colour with R, G, B in 0..=255, y = (R + 2G + B)
//! / 512 − 1, co = (R − B) / 128, cg = (G − (R + B) / 2) / 128; s = log2(step) / 4, `step` being the quantisation step
//! of level ℓ's luma.
//! - A parent's 12 channels: 8 occupancy bits (octant x + 2y + 4z), y, co, cg, s.
//! - A child's 7 channels: four times the difference of its y, co, cg to the parent's; its y, co, cg; s.
//!
//! ```text
//! h = relu(conv3(parent));  P times: h = relu(h + conv3(relu(conv3(h))))
//! x = relu(conv3(child) + up[octant](h[parent]));  B times: x = relu(x + conv3(relu(conv3(x))))
//! raw = conv3(x)
//! ```
//! `conv3` is a plain submanifold convolution with bias, `up` has one matrix per octant and no bias. `activate.rs`
//! defines a Gaussian's 14 outputs.
//!
//! # The model file
//! Safetensors, all tensors f16: `SET.parent.in.weight` [27, 12, C] and `.bias` \[C\], `SET.parent.I.a`,
//! `SET.parent.I.b`, `SET.up.weight` [8, C, C], `SET.child.in`, `SET.child.I.a`, `SET.child.I.b`, `SET.out` [27, C,
//! 14·K], `SET` being `best.1`, `best.8`, `quick.1` or `quick.8`. The metadata's `b2p-heads` is JSON: `version` 1,
//! `blur` (see [`Gaussians::blur`]; in squares of half the unit), and `sets`, for each `channels`, `parent_blocks`,
//! `child_blocks`, `gaussians`, and `ranges`: the largest outputs of each layer but the last.
//!
//! # Precision
//! In [`Precision::Int16`], the default, activations and weights are integers in ±2047, scaled by `ranges`. Every sum
//! fits 32 bits by construction, and the Gaussians are bit-exact on every machine. [`Precision::F16`] stores f16 and
//! sums in f32.

mod activate;
mod inputs;
mod load;
mod network;
mod spans;
#[cfg(test)]
mod tests;

use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use b2p_kernels::Isa;

use super::{Frame, Gaussians};
use crate::error::Result;
use crate::gaussians::Heads;
use crate::geometry::{Octree, SiblingMap};
use crate::input;
use crate::layers::{Precision, missing};
use crate::limits::Limits;
use activate::{Drawing, PART};
use network::Generator;
#[cfg(test)]
pub(crate) use network::TERMS;
pub use spans::span_rows;

/// Network outputs per Gaussian.
const RAW: usize = 14;

/// Key of one of a model's networks: quality, and Gaussians per voxel (1 or 8).
pub type Set = (Heads, usize);

/// A model of learned heads, which draw streams of version 3. Clones share the weights.
#[derive(Clone)]
pub struct HeadsModel {
    /// Variance in squares of half the unit.
    blur: f32,
    generators: Arc<[(Set, Generator)]>,
}

/// Inputs of the heads for a level.
#[derive(Debug, Clone, Copy)]
pub struct LevelInput<'a> {
    /// The octree, down to `level` or deeper.
    pub octree: &'a Octree,
    /// The level to draw.
    pub level: u8,
    /// The neighbours in `level`.
    pub map: &'a SiblingMap,
    /// Those in the level above.
    pub above: &'a SiblingMap,
    /// Decoded sRGB colours of the voxels of `level`.
    pub colours: &'a [[u8; 3]],
    /// Decoded sRGB colours of the level above.
    pub colours_above: &'a [[u8; 3]],
    /// Quantisation step of the level's luma (R + 2G + B) / 4, in units of luma: 1 for lossless. Clamped to `1..=2¹⁶`.
    pub luma_step: f32,
    /// For every voxel whether it gets no Gaussians; `None` for none.
    pub without: Option<&'a [bool]>,
    /// The voxels that are drawn; the others are what these depend on. `None` for all.
    pub range: Option<&'a Range<usize>>,
}

impl std::fmt::Debug for HeadsModel {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let sets: Vec<Set> = self.sets().collect();
        f.debug_struct("HeadsModel")
            .field("sets", &sets)
            .finish_non_exhaustive()
    }
}

impl HeadsModel {
    /// Loads a model file.
    ///
    /// # Errors
    /// [`Error::Io`](crate::Error::Io), [`Error::LimitExceeded`](crate::Error::LimitExceeded) for a file of more than 2
    /// GiB, and those of [`HeadsModel::from_bytes`].
    pub fn open(path: &Path) -> Result<Self> {
        // Read, not mapped: another program may shorten the file meanwhile.
        let bytes = input::read_file(path, &Limits::default())?;
        HeadsModel::from_bytes(&bytes)
    }

    /// Loads a model from the content of its file. Memory is bounded by its length.
    ///
    /// # Errors
    /// [`Error::Malformed`](crate::Error::Malformed), with the field or tensor that is missing, of another type or
    /// shape, not finite, or out of range; [`Error::Unsupported`](crate::Error::Unsupported) for another version.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self> {
        load::model(bytes)
    }

    /// The networks of the model.
    #[doc(hidden)]
    pub fn sets(&self) -> impl Iterator<Item = Set> + '_ {
        self.generators.iter().map(|(set, _)| *set)
    }

    /// Maximum memory in bytes of [`HeadsModel::generate_in_parts`] for a level of `voxels` voxels and `above` voxels in
    /// the level above, on spans of at most `rows` rows: that of the Gaussians, or of a part if they come in parts, and
    /// that of the network, which is given back; 0 if the model does not have the set.
    #[doc(hidden)]
    pub fn bytes(&self, set: Set, [voxels, above]: [u64; 2], rows: usize, in_parts: bool) -> [u64; 2] {
        let shape = self.find(set).map(Generator::shape);
        let at_once = if in_parts { voxels.min(PART as u64) } else { voxels };
        shape.map_or([0; 2], |shape| {
            [
                network::gaussian_bytes(shape, at_once),
                network::work_bytes(shape, voxels, above, rows),
            ]
        })
    }

    /// Makes the Gaussians of a level voxel by voxel, one or eight each. Of eight, those with an opacity below 1/255
    /// are omitted.
    ///
    /// # Errors
    /// [`Error::Unsupported`](crate::Error::Unsupported) for level 0, which has no level above, for a set that the
    /// model does not have, and for [`Precision::Half`] if `isa` has no f16 arithmetic.
    ///
    /// # Panics
    /// If the octree is less deep, or if the maps or colours do not match its levels in length.
    #[doc(hidden)]
    pub fn generate(
        &self,
        isa: Isa,
        precision: Precision,
        set: Set,
        input: LevelInput<'_>,
        frame: Frame,
    ) -> Result<Gaussians> {
        self.generate_in_parts(isa, precision, set, input, frame, (usize::MAX, true), &mut |_| Ok(()))
    }

    /// As [`HeadsModel::generate`] on spans of at most `rows` rows, and calls `taken` with the Gaussians whenever some
    /// have been added, which may take them away. There is memory for all from the start if they are `kept`.
    ///
    /// # Errors
    /// Those of [`HeadsModel::generate`] and of `taken`.
    ///
    /// # Panics
    /// As [`HeadsModel::generate`].
    #[doc(hidden)]
    #[allow(clippy::too_many_arguments)]
    pub fn generate_in_parts(
        &self,
        isa: Isa,
        precision: Precision,
        set: Set,
        input: LevelInput<'_>,
        frame: Frame,
        (rows, kept): (usize, bool),
        taken: &mut dyn FnMut(&mut Gaussians) -> Result<()>,
    ) -> Result<Gaussians> {
        let generator = self.generator(isa, precision, set, &input)?;
        let drawing = Drawing::new(&input, generator.shape().gaussians, self.blur, frame, kept);
        generator.generate(
            isa,
            precision,
            network::enough_rows(generator.shape(), rows),
            &input,
            drawing,
            taken,
        )
    }

    /// The network of a set, which can draw this level in this precision.
    fn generator(&self, isa: Isa, precision: Precision, set: Set, input: &LevelInput<'_>) -> Result<&Generator> {
        let Some(generator) = self.find(set) else {
            let sets = self.sets().map(|(heads, k)| format!("{heads}.{k}"));
            let sets = sets.collect::<Vec<_>>().join(", ");
            let detail = format!("the model has {sets}, not {}.{}", set.0, set.1);
            return Err(missing("drawing with these heads", detail));
        };
        if input.level == 0 {
            let detail = "heads read the level above, level 0 has none".into();
            return Err(missing("drawing level 0 with learned heads", detail));
        }
        if precision == Precision::Half && !isa.has_half() {
            let detail = format!("{isa} has no arithmetic in f16, take f16 or int16");
            return Err(missing("generating Gaussians in half", detail));
        }
        input.check();
        Ok(generator)
    }

    /// How many voxels of the level above lie between a voxel's parent and the farthest parent that its Gaussians depend
    /// on. 0 for a set that the model has not.
    pub(crate) fn reach(&self, set: Set) -> u32 {
        self.find(set).map_or(0, |generator| network::reach(generator.shape()))
    }

    fn find(&self, set: Set) -> Option<&Generator> {
        let mut generators = self.generators.iter();
        generators.find(|(of, _)| *of == set).map(|(_, generator)| generator)
    }
}

impl LevelInput<'_> {
    /// The voxels that are drawn.
    fn range(&self) -> Range<usize> {
        let all = 0..self.octree.level(self.level).len();
        self.range.cloned().unwrap_or(all)
    }

    fn check(&self) {
        let (voxels, above) = (
            self.octree.level(self.level).len(),
            self.octree.level(self.level - 1).len(),
        );
        let without = self.without.map_or(voxels, <[bool]>::len);
        assert_eq!(without, voxels, "one choice per voxel");
        assert_eq!(
            [self.map.len(), self.colours.len()],
            [voxels; 2],
            "map and colours of the level"
        );
        assert_eq!(
            [self.above.len(), self.colours_above.len()],
            [above; 2],
            "map and colours of the level above"
        );
    }
}
