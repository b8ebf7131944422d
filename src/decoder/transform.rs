//! Streams of version 3 on their way to colours and Gaussians.

use std::borrow::Cow;
use std::sync::OnceLock;

use xxhash_rust::xxh3::Xxh3Default;

use super::drawing::Each;
use super::reached::{Above, Reached};
use super::stream::Decoder;
use crate::colour::{self, Filter, LevelColours, Ycc};
use crate::container::feed::{Feed, Goal};
use crate::container::{Colours, Geometry, Header, Level, Slice, Trunk};
use crate::error::Result;
use crate::gaussians::{Gaussians, HeadMap};
use crate::geometry::{KernelMap, Octree, SiblingMap, codec};
use crate::latents::nothing_reached;
use crate::log::Log;
use crate::motion::{self, ColourGuide, GeometryGuide, Inter, Previous};

/// A stream of version 3 that is decoded level by level.
#[derive(Debug)]
pub(super) struct Transform<'b> {
    pub decoder: Decoder,
    feed: Feed<'b>,
    reached: Option<Reached>,
    ahead: Ahead,
    /// What a frame of a sequence is predicted from.
    inter: Option<Inter>,
    /// The colours of all levels so far and their filters, if another frame will be predicted from them.
    history: Option<History>,
}

/// What the next frame is predicted from: the levels from 0 on.
type History = Vec<motion::Coloured>;

/// The occupancies of a level that were decoded beside the colours of the level above, which are coded apart from them
/// and take as long.
type Ahead = Option<(u8, Result<Vec<u8>>)>;

impl<'b> Transform<'b> {
    pub(super) fn new(decoder: Decoder, goal: Goal, bytes: Cow<'b, [u8]>) -> Self {
        Transform {
            decoder,
            feed: Feed::new(goal, bytes),
            reached: None,
            ahead: None,
            inter: None,
            history: None,
        }
    }

    /// The same stream as a frame of a sequence that `inter` predicts, if it is not whole. It keeps what the next frame
    /// needs.
    pub(super) fn into_frame(mut self, inter: Option<Inter>) -> Self {
        self.inter = inter;
        self.history = Some(Vec::new());
        self
    }

    /// The level reached, by itself: to be drawn while this one goes on to finer levels.
    pub(super) fn so_far(&self) -> Self {
        Transform {
            decoder: self.decoder.clone(),
            feed: self.feed.clone(),
            reached: self.reached.clone(),
            ahead: None,
            inter: None,
            history: None,
        }
    }

    /// What the next frame is predicted from.
    pub(super) fn previous(&mut self, log: &Log) -> Option<Previous> {
        let history = self.history.take()?;
        let Reached { octree, level, .. } = self.reached.as_ref()?;
        let made = || Ok(Previous::new(octree, history));
        log.step("levels for the next frame", octree.level(*level).len(), "voxels", made)
            .ok()
    }

    pub(super) fn push(&mut self, bytes: &[u8]) {
        self.feed.push(bytes);
    }

    pub(super) fn header(&self) -> Option<&Header> {
        self.feed.header()
    }

    pub(super) fn level(&self) -> Option<u8> {
        self.reached.as_ref().map(|reached| reached.level)
    }

    pub(super) fn reached(&self) -> Option<&Reached> {
        self.reached.as_ref()
    }

    /// Takes the next step; `ended` tells that all bytes have come.
    pub(super) fn step(&mut self, ended: bool, log: &Log) -> Result<Option<u8>> {
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
    fn decode(&mut self, level: u8, log: &Log) -> Result<()> {
        let Some(header) = self.feed.header() else {
            return Err(nothing_reached());
        };
        let part = Level::read(self.feed.bytes(), header, level)?;
        let Some(colours) = &part.colours else {
            return Err(nothing_reached());
        };
        let parse = |payload: &Slice| Filter::parse(payload.bytes, payload.offset);
        let mut filter = colours.filter.as_ref().map(parse).transpose()?;
        let mut inherited = None;
        if let (None, Some(inter)) = (&filter, &self.inter)
            && let Some(previous) = inter.previous().level(level)
        {
            filter = previous.filter.clone();
            inherited = previous.steps;
        }
        let mut octree = match &mut self.reached {
            Some(above) => std::mem::replace(&mut above.octree, Octree::root()),
            None => Octree::root(),
        };
        // Its faults are reported when it is its turn.
        let next = self.feed.after(level);
        let next = next.and_then(|next| Level::read(self.feed.bytes(), header, next).ok());
        let growing = Growing {
            decoder: &self.decoder,
            header,
            part: &part,
            colours,
            next: next.as_ref(),
            inter: self.inter.as_ref(),
        };
        let mut values = Vec::new();
        let kept = self.history.is_some().then_some(&mut values);
        match growing.level(&mut octree, self.reached.as_ref(), &mut self.ahead, kept, log) {
            Ok(Step { map, coloured, above }) => {
                let old = self.reached.take().map(|old| Above {
                    map: old.map,
                    coloured: Some(old.coloured),
                });
                let blocks = HeadMap::block_count(&octree, level);
                let head_map = colours.head_map.as_ref();
                let head_map = head_map.and_then(|map| {
                    Some(HeadMap::parse(map.bytes, blocks)?.with_thickness(HeadMap::thickness_of(map.voxels)))
                });
                let own = coloured.steps();
                let steps = inherited.filter(|steps| steps.is_lossless() == own.is_lossless());
                let steps = steps.unwrap_or(own);
                if let Some(history) = &mut self.history {
                    history.extend(values.into_iter().map(|values| (values, None, None)));
                    if let Some(last) = history.last_mut() {
                        (last.1, last.2) = (filter.clone(), Some(steps));
                    }
                }
                self.reached = Some(Reached {
                    level,
                    octree,
                    map,
                    above: above.or(old),
                    coloured,
                    filter,
                    steps,
                    head_map,
                    filtered: OnceLock::new(),
                });
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
    pub(super) fn gaussians(&self, log: &Log) -> Result<Gaussians> {
        self.draw(log, None)
    }

    /// Calls `each` with the same Gaussians, part by part.
    pub(super) fn gaussians_in_parts(&self, log: &Log, each: &mut Each<'_>) -> Result<()> {
        self.draw(log, Some(each)).map(drop)
    }

    /// How many there are, if that is known before.
    pub(super) fn gaussian_count(&self) -> Result<Option<usize>> {
        match (self.header(), &self.reached) {
            (Some(header), Some(reached)) => self.decoder.gaussian_count(header, reached),
            _ => Err(nothing_reached()),
        }
    }

    fn draw(&self, log: &Log, each: Option<&mut Each<'_>>) -> Result<Gaussians> {
        let (Some(header), Some(reached)) = (self.header(), &self.reached) else {
            return Err(nothing_reached());
        };
        let decoder = &self.decoder;
        decoder.check_drawable(header, reached.level)?;
        decoder.check_memory(header, reached.level, each.is_some())?;
        decoder.cancel().check()?;
        let set = decoder.heads();
        let name = format!("Gaussians of level {}, {set}", reached.level);
        let voxels = reached.octree.level(reached.level).len();
        if reached.filter.is_some() && reached.filtered.get().is_none() {
            let name = format!("filter of level {}", reached.level);
            log.step(name, voxels, "voxels", || {
                reached.colours(decoder.isa());
                Ok(())
            })?;
        }
        log.paused_step(name, voxels, "voxels", |pauses| match each {
            None => decoder.generate(header, reached, None),
            Some(each) => decoder.generate(header, reached, Some(&mut |part| pauses.pause(|| each(part)))),
        })
    }
}

/// One level, and what it is decoded with.
struct Growing<'a> {
    decoder: &'a Decoder,
    header: &'a Header,
    part: &'a Level<'a>,
    colours: &'a Colours<'a>,
    /// The level after it, if its geometry may be decoded already.
    next: Option<&'a Level<'a>>,
    /// What the frame is predicted from.
    inter: Option<&'a Inter>,
}

/// Decoded colours of levels, one after the other, if they are to be kept.
type Kept<'a> = Option<&'a mut Vec<Vec<Ycc>>>;

/// The map and the colours of a level on the way to the one that a section is of, and of the level above if the
/// section has it.
struct Step {
    map: SiblingMap,
    coloured: LevelColours,
    above: Option<Above>,
}

impl Growing<'_> {
    /// Grows `octree` to the level of the part.
    fn level(
        &self,
        octree: &mut Octree,
        above: Option<&Reached>,
        ahead: &mut Ahead,
        mut kept: Kept<'_>,
        log: &Log,
    ) -> Result<Step> {
        let level = self.part.level;
        let mut step = match &self.colours.trunk {
            Some(trunk) => Some(self.trunk(octree, trunk, ahead, kept.as_deref_mut(), log)?),
            None => None,
        };
        for n in octree.depth() + 1..=level {
            let (map, coloured) = match (&step, above) {
                (Some(step), _) => (&step.map, &step.coloured),
                (None, Some(above)) => (&above.map, &above.coloured),
                (None, None) => return Err(nothing_reached()),
            };
            let (map, coloured) = self.next(octree, n, map, coloured, ahead, log)?;
            if let Some(kept) = kept.as_deref_mut() {
                kept.push(coloured.values().to_vec());
            }
            step = Some(Step {
                map,
                coloured,
                above: step.map(|above| Above {
                    map: above.map,
                    coloured: Some(above.coloured),
                }),
            });
        }
        let step = step.ok_or_else(nothing_reached)?;
        self.part.check_colours(colour_hash(&step.coloured))?;
        if let Some(inter) = self.inter {
            inter.check(octree)?;
        }
        Ok(step)
    }

    /// The levels that the colour trunk holds.
    fn trunk(&self, octree: &mut Octree, trunk: &Trunk, ahead: &mut Ahead, kept: Kept<'_>, log: &Log) -> Result<Step> {
        let isa = self.decoder.isa();
        let (depth, count) = (trunk.level, trunk.slice.voxels as usize);
        let mut maps = vec![SiblingMap::root()];
        let name = format!("geometry of levels 0 to {depth}");
        log.step(name, count, "voxels", || {
            for part in self.part.geometry.iter().take(depth.into()) {
                let map = &maps[maps.len() - 1];
                let masks = self.masks(octree, part, &map.table())?;
                octree.grow(masks)?;
                let children = octree.child_siblings(part.level - 1, map);
                maps.push(children);
            }
            Ok(())
        })?;
        self.decoder.cancel().check()?;
        let guides = match self.inter {
            Some(inter) => log.step(
                format!("predicted colours of levels 0 to {depth}"),
                count,
                "voxels",
                || {
                    (1..=depth)
                        .map(|n| inter.colours(octree, n, depth))
                        .collect::<Result<Vec<_>>>()
                },
            )?,
            None => Vec::new(),
        };
        let guides: Vec<colour::Guide> = guides.iter().map(ColourGuide::guide).collect();
        let mut values = Vec::new();
        let name = self.named(format!("colours of levels 0 to {depth}"), depth);
        let coloured = log.step(name, count, "voxels", || {
            let colours = || {
                let mut each = |_: u8, level: &LevelColours| values.push(level.values().to_vec());
                let colours = colour::decode_guided_trunk(isa, octree, &maps, &trunk.slice, &guides, &mut each)?;
                values.push(colours.values().to_vec());
                Ok(colours)
            };
            self.with_next_occupancies(octree, depth, &maps[maps.len() - 1], ahead, colours)
        })?;
        if let Some(kept) = kept {
            kept.append(&mut values);
        }
        let map = maps.pop().unwrap_or_else(SiblingMap::root);
        Ok(Step {
            map,
            coloured,
            above: maps.pop().map(|map| Above { map, coloured: None }),
        })
    }

    /// The level `n`, given the one above it.
    fn next(
        &self,
        octree: &mut Octree,
        n: u8,
        above_map: &SiblingMap,
        above: &LevelColours,
        ahead: &mut Ahead,
        log: &Log,
    ) -> Result<(SiblingMap, LevelColours)> {
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
            let masks = match ahead.take() {
                Some((level, masks)) if level == n => masks?,
                _ => self.masks(octree, geometry, &above_map.table())?,
            };
            octree.grow(masks)
        })?;
        let map = log.step(format!("neighbours of level {n}"), count, "voxels", || {
            Ok(octree.child_siblings(n - 1, above_map))
        })?;
        let guide = self.inter.map(|inter| {
            log.step(format!("predicted colours of level {n}"), count, "voxels", || {
                inter.colours(octree, n, n)
            })
        });
        let guide = guide.transpose()?;
        let name = self.named(format!("colours of level {n}"), n);
        let coloured = log.step(name, count, "voxels", || {
            let slice = header.colour_slice() as usize;
            let slices = &colours.slices;
            let guide = guide.as_ref().map(ColourGuide::guide);
            let colours = || {
                let octree = &*octree;
                colour::decode_level(isa, octree, n, above_map, &map, above, slices, slice, guide, cancel)
            };
            self.with_next_occupancies(octree, n, &map, ahead, colours)
        })?;
        Ok((map, coloured))
    }

    /// The geometry of the level after `n`, if it is there.
    fn after(&self, n: u8) -> Option<&Geometry<'_>> {
        let parts = self.part.geometry.iter();
        let mut parts = parts.chain(self.next.iter().flat_map(|next| &next.geometry));
        parts.find(|part| part.level == n + 1)
    }

    /// The name of a step that decodes `colours`, those of level `n` the last.
    fn named(&self, colours: String, n: u8) -> String {
        match self.after(n) {
            None => colours,
            Some(next) => format!("{colours}, geometry of level {}", next.level),
        }
    }

    /// Decodes the colours of level `n`, and beside them the occupancies of the level after it, if it is there. `map` is
    /// that of level `n`.
    fn with_next_occupancies(
        &self,
        octree: &Octree,
        n: u8,
        map: &SiblingMap,
        ahead: &mut Ahead,
        colours: impl FnOnce() -> Result<LevelColours> + Send,
    ) -> Result<LevelColours> {
        let Some(next) = self.after(n) else {
            return colours();
        };
        let (coloured, masks) = rayon::join(colours, || self.masks(octree, next, &map.table()));
        *ahead = Some((n + 1, masks));
        coloured
    }
}

impl Growing<'_> {
    /// The occupancies that make the level of `part`. `map` is the kernel map of the level above.
    fn masks(&self, octree: &Octree, part: &Geometry<'_>, map: &KernelMap) -> Result<Vec<u8>> {
        let (isa, cancel) = (self.decoder.isa(), self.decoder.cancel());
        let guide = self.inter.map(|inter| inter.geometry(octree, part.level)).transpose()?;
        let guide = guide.as_ref().map(GeometryGuide::guide);
        let slice = self.header.slice_voxels as usize;
        codec::decode_masks(isa, part.level, map, &part.slices, slice, guide, cancel)
    }
}

/// What a stream says of the colours of a level, to tell whether they were decoded as they were coded: XXH3-64 of Y, Co
/// and Cg of every voxel as 16-bit numbers, little-endian.
pub fn colour_hash(coloured: &LevelColours) -> u64 {
    let mut hasher = Xxh3Default::new();
    let mut bytes = Vec::with_capacity(6 * 1024);
    for part in coloured.values().chunks(1024) {
        bytes.clear();
        bytes.extend(part.as_flattened().iter().flat_map(|x| x.to_le_bytes()));
        hasher.update(&bytes);
    }
    hasher.digest()
}
