//! Frames of a sequence that are predicted from the frame before (`docs/format.md`, clauses 17.5 to 17.7).

use std::sync::Arc;

use b2p_kernels::Isa;
use rayon::prelude::*;

use super::choice::{self, Shown, Weights};
use super::head_maps;
use super::motion::{Block, Search};
use super::noise;
use super::shape::points_in_children;
use super::{EncoderInput, GeometryTarget, Guides, Options, choose_levels, octree_of};
use crate::cloud::ColouredVoxels;
use crate::colour::{Steps, Truth, Ycc, trunk_depth};
use crate::error::Result;
use crate::geometry::{Octree, Voxels, codec};
use crate::log::Log;
use crate::motion::moved::{self, REACH};
use crate::motion::{Blocks, GeometryGuide, Head, Inter, Mode, Modes, Previous, own};

/// A coded frame that is predicted from the frame before.
#[derive(Debug)]
pub struct PredictedFrame {
    /// Its sections behind a header of its own.
    pub stream: Vec<u8>,
    /// The motion of each level, from the base level on.
    pub motion: Vec<Vec<u8>>,
}

/// The level whose nodes are the blocks.
fn block_level(base: u8, top: u8) -> u8 {
    base.min(top.saturating_sub(BLOCK_DEPTH))
}

/// Levels from the blocks to the finest one: blocks have 16³ voxels, if the base level is not above them.
const BLOCK_DEPTH: u8 = 4;
/// Colours of a block are predicted from the previous frame if what is left is at most this share of the differences.
const INTER_COLOURS: f32 = 0.9;

/// Codes a cloud as a frame that is predicted from `previous`, the frame before as it was decoded, down to the last
/// level of `options`.
///
/// # Errors
/// Those of [`encode`](super::encode).
pub fn encode_predicted(
    cloud: &ColouredVoxels,
    previous: &Arc<Previous>,
    options: &Options,
    log: &Log,
) -> Result<PredictedFrame> {
    let steps = options.fineness.steps()?;
    let levels = choose_levels(cloud.voxels.depth(), options.levels.clone())?;
    let (base, top) = (*levels.start(), *levels.end());
    let octree = octree_of(cloud, top, log)?;
    let trunk = trunk_depth(base, |level| octree.level(level).len());
    let truth = Truth::new(&cloud.voxels, &cloud.colours, &octree, trunk, top, steps.is_lossless());
    let block_level = block_level(base, top);
    let isa = options.isa.unwrap_or_else(Isa::detect);
    let mut target = Target::new(cloud, &octree, &truth, previous, [base, block_level, top], steps)?;
    let head = Head {
        block_level,
        unit_level: top,
        reference_level: if options.scalable { base } else { top }.min(block_level + REACH),
        root: target.root,
        vector: [0; 3],
    };
    let plan = match target.modes(previous, head, base) {
        // Blocks that come from the same place may together have too many voxels.
        Err(error) if error.clause() == Some(moved::TOO_MANY) => {
            let reference_level = block_level;
            target.modes(
                previous,
                Head {
                    reference_level,
                    ..head
                },
                base,
            )?
        }
        plan => plan?,
    };
    let inter = Inter::of(Arc::clone(previous), plan.head, plan.blocks.clone(), base);
    let own = top == cloud.voxels.depth();
    let lambda = match options.geometry {
        // As in frames that are coded by themselves.
        GeometryTarget::Visual if own && head_maps::is_sparse(cloud)? => 0,
        geometry => geometry.lambda(steps, own, true),
    };
    if lambda > 0 && top > trunk {
        let guide = inter.geometry(&target.octree, top)?;
        target.move_voxels(cloud, &guide, lambda, options.slice_voxels as usize, isa, trunk)?;
    }
    let guides = Guides {
        geometry: (1..=top)
            .map(|n| inter.geometry(&target.octree, n))
            .collect::<Result<_>>()?,
        colours: (1..=top)
            .map(|n| inter.colours(&target.octree, n))
            .collect::<Result<_>>()?,
    };
    let count = target.octree.level(top).len() as u64;
    // At level N the points are its voxels, and kept blocks may have others than the cloud.
    let points = match own {
        true => count,
        false => count.max(cloud.voxels.len() as u64),
    };
    let subject = EncoderInput {
        cloud,
        options,
        isa,
        levels,
        octree: Octree::root(),
        maps: Vec::new(),
        geometry: Vec::new(),
        grey: cloud.colours.par_iter().all(|[r, g, b]| r == g && g == b),
        // Predicted frames have no head maps.
        sparse: false,
        points,
        guides: Some(guides),
    };
    let subject = subject.with_octree(target.octree, top, log)?;
    let stream = subject.code_towards(&target.truth, top, steps, None, log)?.bytes;
    let keys: Vec<u64> = target.blocks.iter().map(|block| block.key).collect();
    let motion = plan.head.write(base, &keys, &plan.blocks)?;
    Ok(PredictedFrame { stream, motion })
}

/// What a frame is to decode to: its own voxels and those of the moved previous frame, as `choice` says.
struct Target {
    octree: Octree,
    truth: Truth,
    /// The blocks with voxels, in order.
    blocks: Vec<Block>,
    root: Modes,
    top: u8,
    block_level: u8,
    lossless: bool,
}

/// The motion of a frame.
struct Plan {
    head: Head,
    blocks: Blocks,
}

impl Target {
    fn new(
        cloud: &ColouredVoxels,
        octree: &Octree,
        truth: &Truth,
        previous: &Arc<Previous>,
        [base, block_level, top]: [u8; 3],
        steps: Steps,
    ) -> Result<Self> {
        let lossless = steps.is_lossless();
        let levels = (0..=top).map(|level| (truth.level(level).to_vec(), None, None));
        let current = Previous::new(octree, levels.collect());
        let samples = noise::samples(cloud, octree, top);
        let search = Search {
            octree,
            truth,
            previous,
            current: &current,
            samples: &samples,
            top,
            block_level,
        };
        let weights = Weights::of_step(steps.luma_step(), top == cloud.voxels.depth());
        let mut blocks = search.blocks(weights);
        let choose = |block: &mut Block| match lossless {
            true => choice::own(&search, block),
            false => choice::choose(&search, block, weights),
        };
        let mut shown: Vec<Shown> = blocks.par_iter_mut().map(choose).collect();
        if shown.iter().all(Vec::is_empty) {
            // A frame has at least one voxel.
            for (shown, block) in shown.iter_mut().zip(&mut blocks) {
                block.keep = false;
                *shown = choice::own(&search, block);
            }
        }
        let mut all: Shown = shown.concat();
        if !lossless {
            choice::close(&search, &blocks, &mut all);
        }
        let keys: Vec<u64> = all.iter().map(|voxel| voxel.0).collect();
        let down = 3 * (top - block_level);
        blocks.retain(|block| {
            let first = keys.partition_point(|key| key >> down < block.key);
            keys.get(first).is_some_and(|key| key >> down == block.key)
        });
        let octree = Octree::new(Voxels::from_sorted(top, keys))?;
        let trunk = trunk_depth(base, |level| octree.level(level).len());
        let own = Truth::finest(&cloud.voxels, &cloud.colours, &octree, top, lossless);
        let values = all
            .iter()
            .zip(&own)
            .map(|((_, copied), own)| copied.unwrap_or(*own))
            .collect();
        let truth = Truth::of_values(&octree, trunk, top, values, lossless);
        Ok(Target {
            octree,
            truth,
            blocks,
            root: Modes {
                geometry: Mode::Inter,
                colours: Mode::Inter,
            },
            top,
            block_level,
            lossless,
        })
    }

    /// Moves voxels of the finest level by one where that saves bits (`codec::optimise_level`). What is skipped stays.
    fn move_voxels(
        &mut self,
        cloud: &ColouredVoxels,
        guide: &GeometryGuide,
        lambda: u32,
        slice: usize,
        isa: Isa,
        trunk: u8,
    ) -> Result<()> {
        let top = self.top;
        let points = points_in_children(cloud, &self.octree, top);
        let distortion = codec::Distortion {
            points: &points,
            lambda,
        };
        let map = self.octree.kernel_map(top - 1);
        let guide = Some(guide.guide());
        let (masks, _) = codec::optimise_level(isa, &self.octree, &map, top, slice, distortion, guide);
        let mut octree = self.octree.truncated(top - 1);
        octree.grow(masks)?;
        let (before, colours) = (self.octree.level(top).keys(), self.truth.level(top));
        let own = Truth::finest(&cloud.voxels, &cloud.colours, &octree, top, false);
        let keys = octree.level(top).keys().iter();
        let values = keys.zip(own).map(|(key, own)| match before.binary_search(key) {
            Ok(i) => colours[i],
            Err(_) => own,
        });
        self.truth = Truth::of_values(&octree, trunk, top, values.collect(), false);
        self.octree = octree;
        Ok(())
    }

    /// Chooses the modes of all levels.
    fn modes(&self, previous: &Arc<Previous>, head: Head, base: u8) -> Result<Plan> {
        let inter = Modes {
            geometry: Mode::Inter,
            colours: Mode::Inter,
        };
        let levels = usize::from(self.top - self.block_level);
        let mut plan = Plan {
            head,
            blocks: Blocks {
                vectors: self.blocks.iter().map(|block| block.vector).collect(),
                modes: vec![vec![inter; self.blocks.len()]; levels],
            },
        };
        // Colours of skipped blocks are not interpolated.
        let still = Modes {
            colours: Mode::Skip,
            ..inter
        };
        let kept = Blocks {
            vectors: plan.blocks.vectors.clone(),
            modes: vec![vec![still; self.blocks.len()]; levels],
        };
        let root_kept = Head { root: still, ..head };
        let tried = [
            Inter::of(Arc::clone(previous), head, plan.blocks.clone(), base),
            Inter::of(Arc::clone(previous), root_kept, kept, base),
        ];
        let mut root = [Votes::default(), Votes::default()];
        for level in 1..=self.top {
            let votes = self.votes(&tried, level)?;
            match level.checked_sub(self.block_level + 1) {
                None => root[1].add(votes[0]),
                Some(i) => {
                    for ((modes, votes), block) in plan.blocks.modes[usize::from(i)]
                        .iter_mut()
                        .zip(votes)
                        .zip(&self.blocks)
                    {
                        *modes = votes.modes(block.keep, self.lossless);
                    }
                }
            }
        }
        let all = self.blocks.iter().all(|block| block.keep);
        plan.head.root = root[1].modes(all, self.lossless);
        Ok(plan)
    }

    /// How well each block of `level` is predicted; for levels of no blocks, the whole level.
    fn votes(&self, [inter, still]: &[Inter; 2], level: u8) -> Result<Vec<Votes>> {
        let (geometry, colours) = (
            inter.geometry(&self.octree, level)?,
            inter.colours(&self.octree, level)?,
        );
        let exact = still.colours(&self.octree, level)?;
        let nodes = self.octree.level(level - 1).keys();
        let (masks, first) = (self.octree.occupancy(level - 1), self.octree.first_child(level - 1));
        let blocks = level > self.block_level;
        let down = 3 * (level - 1).saturating_sub(self.block_level);
        let mut votes = vec![Votes::default(); if blocks { self.blocks.len() } else { 1 }];
        let mut block = 0;
        for (node, key) in nodes.iter().enumerate() {
            while blocks && self.blocks[block].key < key >> down {
                block += 1;
            }
            let vote = &mut votes[block];
            let (mask, moved) = (masks[node], own(geometry.windows()[node]));
            vote.geometry(mask, moved);
            let first = first[node] as usize;
            let children = first..first + mask.count_ones() as usize;
            let above = self.truth.level(level - 1)[node];
            let truth = &self.truth.level(level)[children.clone()];
            let same = truth.iter().zip(&exact.moved()[children.clone()]);
            vote.coloured += same.filter(|(truth, moved)| Some(**truth) != **moved).count() as u64;
            vote.colours(truth, &colours.moved()[children], above);
        }
        Ok(votes)
    }
}

/// How well the previous frame predicts a block at a level.
#[derive(Debug, Clone, Copy, Default)]
struct Votes {
    /// Parents whose children are there, but not those of the window.
    other: u64,
    /// Children that are there in both frames, and in one of them.
    hits: u64,
    misses: u64,
    /// Children without, or with other colours.
    coloured: u64,
    /// Differences of luma to the parent, and those left by the prediction.
    intra: f32,
    inter: f32,
}

impl Votes {
    fn geometry(&mut self, mask: u8, moved: u8) {
        self.other += u64::from(moved != 0 && moved != mask);
        self.hits += u64::from((mask & moved).count_ones());
        self.misses += u64::from((mask ^ moved).count_ones());
    }

    fn colours(&mut self, truth: &[Ycc], moved: &[Option<Ycc>], above: Ycc) {
        let there = || {
            truth
                .iter()
                .zip(moved)
                .filter_map(|(truth, moved)| Some((truth, (*moved)?)))
        };
        let mut shift = 0;
        let mut count = 0;
        for (truth, moved) in there() {
            shift += i32::from(truth[0]) - i32::from(moved[0]);
            count += 1;
        }
        let shift = shift as f32 / count.max(1) as f32;
        for (truth, moved) in there() {
            self.intra += (f32::from(truth[0]) - f32::from(above[0])).abs();
            self.inter += (f32::from(truth[0]) - f32::from(moved[0]) - shift).abs();
        }
    }

    fn add(&mut self, other: Votes) {
        self.other += other.other;
        self.hits += other.hits;
        self.misses += other.misses;
        self.coloured += other.coloured;
        self.intra += other.intra;
        self.inter += other.inter;
    }

    /// The modes for a block, which is to stay what it was if `keep`.
    fn modes(&self, keep: bool, lossless: bool) -> Modes {
        let geometry = match (self.other, self.hits > 0) {
            (0, true) => Mode::Skip,
            _ if 2 * self.hits >= self.misses => Mode::Inter,
            _ => Mode::Intra,
        };
        let colours = match self.hits {
            0 => Mode::Intra,
            _ if self.coloured == 0 || (keep && !lossless) => Mode::Skip,
            _ if self.inter <= INTER_COLOURS * self.intra => Mode::Inter,
            _ => Mode::Intra,
        };
        Modes { geometry, colours }
    }
}
