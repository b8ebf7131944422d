//! Frames of a sequence that are predicted from the frame before (`docs/format.md`, clauses 17.5 to 17.9).

use std::sync::{Arc, OnceLock};

use b2p_kernels::Isa;
use rayon::prelude::*;

use super::candidates::{Candidate, Frame};
use super::choice::{self, Shown};
use super::head_maps;
use super::motion::{Block, Search};
use super::noise;
use super::shape::{points_in_children, points_within};
use super::votes::Votes;
use super::warp::Warp;
use super::{EncoderInput, GeometryTarget, Guides, Options, choose_levels, octree_of};
use crate::cloud::ColouredVoxels;
use crate::colour::{Truth, trunk_depth};
use crate::error::Result;
use crate::geometry::{Octree, Voxels, codec};
use crate::log::Log;
use crate::motion::{Blocks, GeometryGuide, Head, Inter, Mode, Modes, Previous, Warped, own as own_of};

/// A coded frame that is predicted from the frame before.
#[derive(Debug)]
pub struct PredictedFrame {
    /// Its sections behind a header of its own.
    pub stream: Vec<u8>,
    /// The motion of each level, from the base level on.
    pub motion: Vec<Vec<u8>>,
}

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
    let isa = options.isa.unwrap_or_else(Isa::detect);
    let frame = Frame {
        cloud,
        octree: &octree,
        truth: &truth,
        previous,
        options,
        steps,
        base,
        top,
    };
    let Candidate { warp, mut target, plan } = frame.best()?;
    let warped = warp.as_ref().map(|warp| &warp.warped);
    let inter = Inter::of(
        Arc::clone(previous),
        plan.head,
        warped.cloned(),
        plan.blocks.clone(),
        base,
    );
    let own = top == cloud.voxels.depth();
    let lambda = match options.geometry {
        // As in frames that are coded by themselves.
        GeometryTarget::Visual if own && head_maps::is_sparse(cloud)? => 0,
        geometry => geometry.lambda(steps, cloud.voxels.depth() - top, true),
    };
    if lambda > 0 && top > target.trunk {
        let guide = inter.geometry(&target.octree, top)?;
        target.move_voxels(cloud, &guide, lambda, options.slice_voxels as usize, isa)?;
    }
    let guides = Guides {
        geometry: (1..=top)
            .map(|n| inter.geometry(&target.octree, n))
            .collect::<Result<_>>()?,
        colours: (1..=top)
            .map(|n| inter.colours(&target.octree, n, n.max(target.trunk)))
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
        pictures: OnceLock::new(),
        guides: Some(guides),
    };
    let keys = target.keys();
    let subject = subject.with_octree(target.octree, top, log)?;
    let stream = subject.code_towards(&target.truth, top, steps, None, log)?.bytes;
    let motion = plan.write(base, &keys, warp.as_ref())?;
    Ok(PredictedFrame { stream, motion })
}

impl Plan {
    /// The motion of each level, from `base` on, as bytes.
    pub fn write(&self, base: u8, keys: &[Vec<u64>; 2], warp: Option<&Warp>) -> Result<Vec<Vec<u8>>> {
        let keys = keys.each_ref().map(Vec::as_slice);
        let mut motion = self.head.write(base, keys, self.blocks.each_ref())?;
        if let Some(warp) = warp {
            Head::put_lattice(&mut motion[0], &warp.lattice, warp.least)?;
        }
        Ok(motion)
    }
}

/// What a frame is to decode to: its own voxels and those of the moved previous frame, as `choice` says.
pub(super) struct Target {
    octree: Octree,
    truth: Truth,
    /// The blocks with voxels, in order.
    blocks: Vec<Block>,
    /// Their parts, or the blocks themselves if they are not divided.
    parts: Vec<Block>,
    pub root: Modes,
    top: u8,
    /// Last level of the colour trunk.
    trunk: u8,
    block_level: u8,
    part_level: u8,
    lossless: bool,
    warped: bool,
    /// Rate and distortion, about, without the bits of motion.
    pub cost: f32,
}

/// The motion of a frame.
pub(super) struct Plan {
    head: Head,
    /// The blocks, and their parts if they are divided.
    blocks: [Blocks; 2],
}

impl Target {
    pub fn new(frame: &Frame, warp: Option<&Warp>, [block_level, part_level]: [u8; 2]) -> Result<Self> {
        let Frame {
            cloud,
            octree,
            truth,
            previous,
            steps,
            base,
            top,
            ..
        } = *frame;
        let lossless = steps.is_lossless();
        let levels = (0..=top).map(|level| (truth.level(level).to_vec(), None, None));
        let current = Previous::new(octree, levels.collect());
        let samples = noise::samples(cloud, octree, top);
        let search = Search {
            octree,
            truth,
            previous: warp.map_or(previous, |warp| &warp.frame),
            current: &current,
            samples: &samples,
            top,
            block_level,
        };
        let weights = frame.weights(warp.is_some());
        let mut blocks = match warp {
            Some(_) => search.still(),
            None => search.blocks(weights),
        };
        let search = Search {
            block_level: part_level,
            ..search
        };
        let mut parts = match part_level > block_level {
            true => search.parts(&blocks, weights),
            false => blocks.clone(),
        };
        // Alike for all candidates.
        let common = frame.weights(true);
        let costs = parts
            .par_iter()
            .map(|part| choice::cost(&search, part.key, part.vector, common));
        let costs: Vec<f32> = costs.collect();
        let choose = |block: &mut Block| match lossless {
            true => choice::own(&search, block),
            false => choice::choose(&search, block, weights),
        };
        let mut shown: Vec<Shown> = parts.par_iter_mut().map(choose).collect();
        if shown.iter().all(Vec::is_empty) {
            // A frame has at least one voxel.
            for (shown, block) in shown.iter_mut().zip(&mut parts) {
                block.keep = false;
                *shown = choice::own(&search, block);
            }
        }
        let mut all: Shown = shown.concat();
        if !lossless {
            choice::close(&search, &parts, &mut all);
        }
        let keys: Vec<u64> = all.iter().map(|voxel| voxel.0).collect();
        for (level, blocks) in [(block_level, &mut blocks), (part_level, &mut parts)] {
            let down = 3 * (top - level);
            blocks.retain(|block| {
                let first = keys.partition_point(|key| key >> down < block.key);
                keys.get(first).is_some_and(|key| key >> down == block.key)
            });
        }
        // A block is kept if all of its parts are.
        for block in &mut blocks {
            let down = 3 * (part_level - block_level);
            let first = parts.partition_point(|part| part.key >> down < block.key);
            let mut own = parts[first..].iter().take_while(|part| part.key >> down == block.key);
            block.keep = own.all(|part| part.keep);
        }
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
            parts,
            root: Modes {
                geometry: Mode::Inter,
                colours: Mode::Inter,
            },
            top,
            trunk,
            block_level,
            part_level,
            lossless,
            warped: warp.is_some(),
            cost: costs.iter().sum(),
        })
    }

    /// Share of its blocks, or their parts, whose vectors are not 0.
    pub fn moving(&self) -> f32 {
        let moving = self.parts.iter().filter(|part| part.vector != [0; 3]).count();
        moving as f32 / self.parts.len().max(1) as f32
    }

    /// Moves voxels of the finest level by one where that saves bits (`codec::optimise_level`). What is skipped stays.
    fn move_voxels(
        &mut self,
        cloud: &ColouredVoxels,
        guide: &GeometryGuide,
        lambda: u32,
        slice: usize,
        isa: Isa,
    ) -> Result<()> {
        let (top, trunk) = (self.top, self.trunk);
        let map = self.octree.kernel_map(top - 1);
        let guide = Some(guide.guide());
        let above = top < cloud.voxels.depth();
        let with_own = above.then(|| self.with_own(cloud)).transpose()?;
        let (octree, points) = match &with_own {
            Some(both) => {
                let keys = both.level(top).keys().par_iter();
                (both, keys.map(|key| points_within(cloud, *key, top)).collect())
            }
            None => (&self.octree, points_in_children(cloud, &self.octree, top)),
        };
        let distortion = codec::Distortion {
            points: &points,
            lambda,
            shown: with_own.as_ref().map(|_| self.octree.occupancy(top - 1)),
        };
        let (masks, _) = codec::optimise_level(isa, octree, &map, top, slice, distortion, guide);
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

    /// Its octree with all of the cloud's voxels that its parents of the finest level have room for.
    fn with_own(&self, cloud: &ColouredVoxels) -> Result<Octree> {
        let (top, parents) = (self.top, self.octree.level(self.top - 1).keys());
        let shift = 3 * (cloud.voxels.depth() - top);
        let mut keys = self.octree.level(top).keys().to_vec();
        let own = cloud.voxels.keys().chunk_by(|a, b| a >> shift == b >> shift);
        let own = own.filter_map(|voxels| Some(voxels.first()? >> shift));
        keys.extend(own.filter(|key| parents.binary_search(&(key >> 3)).is_ok()));
        keys.sort_unstable();
        keys.dedup();
        Octree::new(Voxels::from_sorted(top, keys))
    }

    fn is_divided(&self) -> bool {
        self.part_level > self.block_level
    }

    /// Keys of the blocks, and of their parts.
    pub fn keys(&self) -> [Vec<u64>; 2] {
        [&self.blocks, &self.parts].map(|blocks| blocks.iter().map(|block| block.key).collect())
    }

    /// The blocks or parts whose modes are those of a level after the level of blocks.
    fn blocks_of(&self, level: u8) -> &[Block] {
        if level > self.part_level {
            &self.parts
        } else {
            &self.blocks
        }
    }

    /// Vectors of all blocks and parts, and everywhere the same modes.
    fn even(&self, modes: Modes) -> [Blocks; 2] {
        let [mut blocks, mut parts] = [&self.blocks, &self.parts].map(|blocks| Blocks {
            vectors: blocks.iter().map(|block| block.vector).collect(),
            modes: Vec::new(),
        });
        for level in self.block_level + 1..=self.top {
            let of_parts = self.is_divided() && level > self.part_level;
            let blocks = if of_parts { &mut parts } else { &mut blocks };
            blocks.modes.push(vec![modes; blocks.vectors.len()]);
        }
        match self.is_divided() {
            true => [blocks, parts],
            false => [blocks, Blocks::default()],
        }
    }

    /// Chooses the modes of all levels.
    pub fn modes(
        &self,
        (previous, warped): (&Arc<Previous>, Option<&Arc<Warped>>),
        head: Head,
        base: u8,
    ) -> Result<Plan> {
        let inter = Modes {
            geometry: Mode::Inter,
            colours: Mode::Inter,
        };
        // Colours of skipped blocks are not interpolated.
        let still = Modes {
            colours: Mode::Skip,
            ..inter
        };
        let tried = |head: Head| {
            let tried = [(head, inter), (Head { root: still, ..head }, still)];
            tried.map(|(head, modes)| Inter::of(Arc::clone(previous), head, warped.cloned(), self.even(modes), base))
        };
        let (mut head, mut tries) = (head, tried(head));
        if head.moves_coarse {
            // Where little moves, coarse levels are as they were.
            let as_they_were = Head {
                moves_coarse: false,
                ..head
            };
            let others = tried(as_they_were);
            if self.left_of_coarse(&others)? <= self.left_of_coarse(&tries)? {
                (head, tries) = (as_they_were, others);
            }
        }
        let mut plan = Plan {
            head,
            blocks: self.even(inter),
        };
        let mut root = Votes::default();
        let mut chosen = Vec::new();
        for level in 1..=self.top {
            let votes = self.votes(&tries, level)?;
            if level <= self.block_level {
                root.add(votes[0]);
                continue;
            }
            let blocks = votes.iter().zip(self.blocks_of(level));
            chosen.push(
                blocks
                    .map(|(votes, block)| votes.modes(block.keep, [self.lossless, self.warped]))
                    .collect(),
            );
        }
        let [blocks, parts] = &mut plan.blocks;
        for (modes, chosen) in blocks.modes.iter_mut().chain(&mut parts.modes).zip(chosen) {
            *modes = chosen;
        }
        let all = self.blocks.iter().all(|block| block.keep);
        plan.head.root = root.modes(all, [self.lossless, self.warped]);
        Ok(plan)
    }

    /// What prediction leaves of the colours of the levels 1 to B + 1. Steps halve from level to level.
    fn left_of_coarse(&self, tried: &[Inter; 2]) -> Result<f32> {
        let last = self.block_level + 1;
        let left = |level: u8| {
            let votes = self.votes(tried, level)?;
            let sum: f32 = votes.iter().map(|votes| votes.inter + votes.new).sum();
            Ok(sum * f32::from(last - level).exp2())
        };
        (1..=last).map(left).sum()
    }

    /// How well each block of `level` is predicted; for levels of no blocks, the whole level.
    fn votes(&self, [inter, still]: &[Inter; 2], level: u8) -> Result<Vec<Votes>> {
        let (geometry, colours) = (
            inter.geometry(&self.octree, level)?,
            inter.colours(&self.octree, level, level.max(self.trunk))?,
        );
        let exact = still.colours(&self.octree, level, level.max(self.trunk))?;
        let nodes = self.octree.level(level - 1).keys();
        let (masks, first) = (self.octree.occupancy(level - 1), self.octree.first_child(level - 1));
        let blocks = level > self.block_level;
        let own = if level > self.part_level {
            self.part_level
        } else {
            self.block_level
        };
        let of_level = self.blocks_of(level);
        let down = 3 * (level - 1).saturating_sub(own);
        let mut votes = vec![Votes::default(); if blocks { of_level.len() } else { 1 }];
        let mut block = 0;
        for (node, key) in nodes.iter().enumerate() {
            while blocks && of_level[block].key < key >> down {
                block += 1;
            }
            let vote = &mut votes[block];
            let (mask, moved) = (masks[node], own_of(geometry.windows()[node]));
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
