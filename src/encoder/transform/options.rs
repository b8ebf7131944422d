//! What may be chosen about a stream.

use std::ops::RangeInclusive;

use b2p_kernels::Isa;

#[cfg(doc)]
use super::encode_to_rate;
use super::{GeometryTarget, QualityTarget};
#[cfg(doc)]
use crate::container::MAX_COLOUR_SLICE;
use crate::container::MAX_SLICE_VOXELS;
use crate::gaussians::learned::HeadsModel;

/// What may be chosen about a stream of version 3; [`encode_to_rate`] chooses how exactly colours are coded, and may
/// leave out the finest levels.
#[derive(Debug, Clone)]
pub struct Options {
    /// The levels that a stream may be cut after, the last one at most the bit depth N. Default: N−3 to N−1.
    pub levels: Option<RangeInclusive<u8>>,
    /// How exactly colours are coded.
    pub fineness: QualityTarget,
    /// How exactly the finest level's voxels are coded. Default: exactly.
    pub geometry: GeometryTarget,
    /// Whether levels have a filter that the decoder runs on their colours.
    pub filter: bool,
    /// Whether quantisation is rate–distortion optimised; otherwise coefficients are rounded to the nearest.
    pub optimised: bool,
    /// Streams that [`encode_to_rate`] tries for a level at most, once one fits; of [`Tune::Visual`] as many again.
    pub tries: usize,
    /// Voxels per slice of the geometry, 1 to [`MAX_SLICE_VOXELS`], the default: less lets more threads decode a level,
    /// and costs bits.
    pub slice_voxels: u32,
    /// Parents per slice of the colours, 1 to [`MAX_COLOUR_SLICE`]: fewer let more threads decode a level, and cost
    /// bits.
    pub colour_slice: u32,
    /// For frames of a sequence: whether a decoder of a level of all frames needs no finer level of any.
    pub scalable: bool,
    /// For frames of a sequence: how the previous frame moves, unless `scalable`.
    pub motion: Motion,
    /// What coded colours approach.
    pub tune: Tune,
    /// With [`Tune::Visual`], in how many rounds at most colours are moved further, by gradient descent through pictures.
    /// Default: 0. One round takes about a second for a person, on two cores.
    pub rounds: usize,
    /// How far the Gaussians that the stream's head maps are for reach.
    pub outline: Outline,
    /// For frames of a sequence: levels, and how much thicker learned Gaussians and surfels of these are, in 128ths of a
    /// voxel, at most 127. A sequence with [`Outline::Cloud`] sets what is chosen for its first frame.
    pub thickness: Vec<(u8, [u8; 2])>,
    /// Heads that will draw the stream; `None` for surfels.
    pub heads: Option<HeadsModel>,
    /// Whether pictures of the heads are compared with those of surfels, so that the stream says where surfels are
    /// better.
    pub head_maps: bool,
    /// The instructions to use; any give the same stream, but for what is chosen by pictures: head maps, [`rounds`](Options::rounds), and
    /// which colours [`encode_to_rate`] keeps where steps are coarse. Default: the best of this machine.
    pub isa: Option<Isa>,
}

impl Default for Options {
    fn default() -> Self {
        Options {
            levels: None,
            fineness: QualityTarget::Step(20.0),
            geometry: GeometryTarget::Exact,
            filter: true,
            optimised: true,
            tries: usize::MAX,
            slice_voxels: MAX_SLICE_VOXELS,
            colour_slice: COLOUR_SLICE,
            scalable: false,
            motion: Motion::Best,
            tune: Tune::Visual,
            rounds: 0,
            outline: Outline::Surface,
            thickness: Vec::new(),
            heads: None,
            head_maps: true,
            isa: None,
        }
    }
}

impl Options {
    /// Whether the stream has head maps, if its levels may have.
    pub(crate) fn has_head_maps(&self) -> bool {
        self.head_maps && self.heads.is_some()
    }
}

/// What coded colours approach.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Tune {
    /// Colours with which the cloud is drawn as it is: Gaussians overlap, so that a picture of them is smoother than their
    /// colours. A stream is coded, decoded and compared with the cloud, then coded again. Without effect on exact colours
    /// and on predicted frames of a sequence.
    Visual,
    /// The mean colours of voxels.
    Psnr,
}

/// How the previous frame of a sequence moves (`docs/format.md`, 17.5, 17.9 and 17.10).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Motion {
    /// In blocks of 16³ voxels.
    Blocks,
    /// In blocks, and in parts of 8³ voxels of them.
    Parts,
    /// By a smooth field of vectors.
    Warped,
    /// In parts or by a smooth field, as each frame takes less rate and distortion.
    #[default]
    Best,
}

/// How far the Gaussians of a stream reach.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Outline {
    /// To the surface that the cloud's points sample, as the heads that ship learned it.
    #[default]
    Surface,
    /// As far as the cloud's own surfels, which overlap and reach beyond the surface: Gaussians are thicker. For clouds
    /// that pictures are compared with themselves, such as captures, of which no surface is known.
    Cloud,
}

/// Parents per colour slice by default: two threads share level 8 of a person, eight level 9.
const COLOUR_SLICE: u32 = 8192;
