//! Streams of version 3 on their way to colours and Gaussians.

use std::borrow::Cow;

use xxhash_rust::xxh3::Xxh3Default;

use super::decoding::nothing_reached;
use super::feed::{Feed, Goal};
use super::stream::StreamDecoder;
use crate::bitstream::{Colours, Header, Level, Slice, Trunk};
use crate::colour::{self, Coloured, Filter};
use crate::error::Result;
use crate::gaussians::Gaussians;
use crate::geometry::{KernelMap, Octree, codec};
use crate::log::Log;

/// A stream of version 3 that is decoded level by level.
#[derive(Debug)]
pub(super) struct Transform<'b> {
    pub decoder: StreamDecoder,
    feed: Feed<'b>,
    reached: Option<Reached>,
}

/// The deepest level so far.
#[derive(Debug)]
pub(super) struct Reached {
    pub level: u8,
    pub octree: Octree,
    /// Its 3³ kernel map.
    pub map: KernelMap,
    /// That of the level above; level 0 has none.
    pub above_map: Option<KernelMap>,
    /// Decoded, before the filter: what the next level is coded from.
    pub coloured: Coloured,
    /// Filtered, as they are drawn.
    pub colours: Vec<[u8; 3]>,
    /// Of the level above, before its filter.
    pub colours_above: Vec<[u8; 3]>,
}

impl<'b> Transform<'b> {
    pub fn new(decoder: StreamDecoder, goal: Goal, bytes: Cow<'b, [u8]>) -> Self {
        Transform {
            decoder,
            feed: Feed::new(goal, bytes),
            reached: None,
        }
    }

    pub fn push(&mut self, bytes: &[u8]) {
        self.feed.push(bytes);
    }

    pub fn header(&self) -> Option<&Header> {
        self.feed.header()
    }

    pub fn level(&self) -> Option<u8> {
        self.reached.as_ref().map(|reached| reached.level)
    }

    pub fn reached(&self) -> Option<&Reached> {
        self.reached.as_ref()
    }

    /// Takes the next step; `ended` tells that all bytes have come.
    pub fn step(&mut self, ended: bool, log: &mut Log) -> Result<Option<u8>> {
        self.feed.check_usable()?;
        let (decoder, level) = (&self.decoder, self.level());
        let plan = |header: &Header, goal| decoder.plan(header, goal);
        let next = self.feed.next_level(ended, level, decoder.limits(), plan);
        let step = next.and_then(|next| match next {
            Some(level) => self.decode(level, log).map(|()| Some(level)),
            None => Ok(None),
        });
        if step.is_err() {
            self.feed.fail();
        }
        step
    }

    /// Decodes a level, all or nothing.
    fn decode(&mut self, level: u8, log: &mut Log) -> Result<()> {
        let Some(header) = self.feed.header() else {
            return Err(nothing_reached());
        };
        let part = Level::read(self.feed.bytes(), header, level)?;
        let Some(colours) = &part.colours else {
            return Err(nothing_reached());
        };
        let parse = |payload: &Slice| Filter::parse(payload.bytes, payload.offset);
        let filter = colours.filter.as_ref().map(parse).transpose()?;
        let mut octree = match &mut self.reached {
            Some(above) => std::mem::replace(&mut above.octree, Octree::root()),
            None => Octree::root(),
        };
        let growing = Growing {
            decoder: &self.decoder,
            header,
            part: &part,
            colours,
        };
        match growing.level(&mut octree, self.reached.as_ref(), filter.as_ref(), log) {
            Ok(grown) => {
                self.reached = Some(Reached { octree, ..grown });
                Ok(())
            }
            Err(error) => {
                if let Some(above) = &mut self.reached {
                    octree.truncate(above.level);
                    above.octree = octree;
                }
                Err(error)
            }
        }
    }

    /// The Gaussians of the level reached.
    pub fn gaussians(&self, log: &mut Log) -> Result<Gaussians> {
        let (Some(header), Some(reached)) = (self.header(), &self.reached) else {
            return Err(nothing_reached());
        };
        let decoder = &self.decoder;
        decoder.check_drawable(header, reached.level)?;
        decoder.check_memory(header, reached.level)?;
        decoder.cancel().check()?;
        let set = decoder.heads();
        let name = format!("Gaussians of level {}, {set}", reached.level);
        let voxels = reached.octree.level(reached.level).len();
        log.step(name, voxels, "voxels", || decoder.generate(header, reached))
    }
}

/// One level, and what it is decoded with.
struct Growing<'a> {
    decoder: &'a StreamDecoder,
    header: &'a Header,
    part: &'a Level<'a>,
    colours: &'a Colours<'a>,
}

/// The kernel map and the colours of a level on the way to the one that a section is of.
struct Step {
    map: KernelMap,
    coloured: Coloured,
    above_map: Option<KernelMap>,
    colours_above: Vec<[u8; 3]>,
}

impl Growing<'_> {
    /// Grows `octree` to the level of the part; the octree of what is returned is not set.
    fn level(
        &self,
        octree: &mut Octree,
        above: Option<&Reached>,
        filter: Option<&Filter>,
        log: &mut Log,
    ) -> Result<Reached> {
        let level = self.part.level;
        let mut step = None;
        if let Some(trunk) = &self.colours.trunk {
            step = Some(self.trunk(octree, trunk, log)?);
        }
        let first = step.as_ref().map_or(level, |_| octree.depth() + 1);
        for n in first..=level {
            let (map, coloured) = match (&step, above) {
                (Some(step), _) => (&step.map, &step.coloured),
                (None, Some(above)) => (&above.map, &above.coloured),
                (None, None) => return Err(nothing_reached()),
            };
            let mut next = self.next(octree, n, map, coloured, log)?;
            if n == level {
                next.above_map = Some(map.clone());
            }
            step = Some(next);
        }
        let Some(step) = step else {
            return Err(nothing_reached());
        };
        let Step {
            map,
            coloured,
            above_map,
            mut colours_above,
        } = step;
        self.part.check_colours(colour_hash(&coloured))?;
        if colours_above.is_empty() && level > 0 {
            colours_above = means(octree, level, &coloured.rgb());
        }
        let (isa, count) = (self.decoder.isa(), self.part.voxels as usize);
        let colours = match filter {
            None => coloured.rgb(),
            Some(filter) => {
                log.step(format!("filter of level {level}"), count, "voxels", || {
                    Ok(filter.rgb(isa, &coloured, &map))
                })?
            }
        };
        Ok(Reached {
            level,
            octree: Octree::root(),
            map,
            above_map,
            coloured,
            colours,
            colours_above,
        })
    }

    /// The levels that the colour trunk holds.
    fn trunk(&self, octree: &mut Octree, trunk: &Trunk, log: &mut Log) -> Result<Step> {
        let (isa, cancel) = (self.decoder.isa(), self.decoder.cancel());
        let (depth, count) = (trunk.level, trunk.slice.voxels as usize);
        let slice = self.header.slice_voxels as usize;
        let mut maps = vec![KernelMap::root()];
        let name = format!("geometry of levels 0 to {depth}");
        log.step(name, count, "voxels", || {
            for part in self.part.geometry.iter().take(depth.into()) {
                let map = &maps[maps.len() - 1];
                codec::decode_level(isa, octree, map, &part.slices, slice, cancel)?;
                maps.push(octree.child_map(part.level - 1, map));
            }
            Ok(())
        })?;
        cancel.check()?;
        let name = format!("colours of levels 0 to {depth}");
        let coloured = log.step(name, count, "voxels", || {
            colour::decode_trunk(isa, octree, &maps, &trunk.slice)
        })?;
        let map = maps.pop().unwrap_or_else(KernelMap::root);
        Ok(Step {
            map,
            coloured,
            above_map: maps.pop(),
            colours_above: Vec::new(),
        })
    }

    /// The level `n`, given the one above it.
    fn next(
        &self,
        octree: &mut Octree,
        n: u8,
        above_map: &KernelMap,
        above: &Coloured,
        log: &mut Log,
    ) -> Result<Step> {
        let (isa, cancel) = (self.decoder.isa(), self.decoder.cancel());
        let header = self.header;
        let geometry = self.part.geometry.iter().find(|part| part.level == n);
        let colours = self.colours.levels.iter().find(|part| part.level == n);
        let (Some(geometry), Some(colours)) = (geometry, colours) else {
            return Err(nothing_reached());
        };
        let slices = &geometry.slices;
        let count = slices.iter().map(|s| s.voxels as usize).sum();
        log.step(format!("geometry of level {n}"), count, "voxels", || {
            let slice = header.slice_voxels as usize;
            codec::decode_level(isa, octree, above_map, slices, slice, cancel)
        })?;
        let map = log.step(format!("kernel map of level {n}"), count, "voxels", || {
            Ok(octree.child_map(n - 1, above_map))
        })?;
        let coloured = log.step(format!("colours of level {n}"), count, "voxels", || {
            let slice = header.colour_slice() as usize;
            let slices = &colours.slices;
            colour::decode_level(
                isa, octree, n, above_map, &map, above, slices, slice, cancel,
            )
        })?;
        Ok(Step {
            map,
            coloured,
            above_map: None,
            colours_above: above.rgb(),
        })
    }
}

/// What a stream says of the colours of a level, to tell whether they were decoded as they were coded: XXH3-64 of Y, Co and Cg of every voxel
/// as 16-bit numbers, little-endian.
pub fn colour_hash(coloured: &Coloured) -> u64 {
    let mut hasher = Xxh3Default::new();
    let mut bytes = Vec::with_capacity(6 * 1024);
    for part in coloured.values().chunks(1024) {
        bytes.clear();
        bytes.extend(part.as_flattened().iter().flat_map(|x| x.to_le_bytes()));
        hasher.update(&bytes);
    }
    hasher.digest()
}

/// The mean colours of the children of every voxel above `level`, rounded to the nearest, halves up.
fn means(octree: &Octree, level: u8, colours: &[[u8; 3]]) -> Vec<[u8; 3]> {
    let parents = octree.occupancy(level - 1).iter();
    let parents = parents.zip(octree.first_child(level - 1));
    let mean = |(mask, &first): (&u8, &u32)| {
        let (first, count) = (first as usize, mask.count_ones());
        let children = &colours[first..first + count as usize];
        [0, 1, 2].map(|c| {
            let sum: u32 = children.iter().map(|colour| u32::from(colour[c])).sum();
            ((2 * sum + count) / (2 * count)) as u8
        })
    };
    parents.map(mean).collect()
}
