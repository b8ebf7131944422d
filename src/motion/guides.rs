//! What a previous frame tells of each level (`docs/format.md`, clauses 17.6, 17.7 and 17.10.7).

mod field;

use std::sync::{Arc, OnceLock};

use b2p_kernels::Isa;
use rayon::prelude::*;

use super::bricks::{Bricks, Near, Windows};
use super::lattice::Lattice;
use super::moved::Moved;
use super::payload::{Blocks, Head, Modes, of_level};
use super::previous::{Previous, PreviousLevel};
use super::warp::{Scattered, Warped};
use crate::colour::{self, Ycc};
use crate::error::{Error, Result};
use crate::geometry::codec::guide::{Guide, Mode};
use crate::geometry::{Octree, ones};
use field::{Block, Cursor, Field, moved};

/// A frame that is predicted: the previous frame and the motion.
#[derive(Debug, Clone)]
pub struct Inter {
    previous: Arc<Previous>,
    head: Head,
    /// What a lattice makes of the previous frame, if the frame is warped.
    warped: Option<Arc<Warped>>,
    /// L, the first level with sections of its own.
    base: u8,
    /// The motion's bytes behind the head, then of each level after L, until they are read.
    sections: Vec<Vec<u8>>,
    blocks: OnceLock<Blocks>,
    /// Of divided blocks.
    parts: OnceLock<Blocks>,
    /// The previous frame moved by the vectors of blocks, and of parts.
    moved: [OnceLock<Moved>; 2],
}

/// What a previous frame tells of the occupancies of a level.
#[derive(Debug, Clone, Default)]
pub struct GeometryGuide {
    modes: Vec<Mode>,
    windows: Vec<u64>,
    /// Of a warped frame, those of near cells.
    near: Option<Vec<u64>>,
}

/// What a previous frame tells of the colours of a level.
#[derive(Debug, Clone, Default)]
pub struct ColourGuide {
    modes: Vec<Mode>,
    moved: Vec<Option<Ycc>>,
}

impl GeometryGuide {
    /// As the coder of occupancies takes it.
    pub fn guide(&self) -> Guide<'_> {
        Guide {
            modes: &self.modes,
            windows: &self.windows,
            near: self.near.as_deref(),
        }
    }

    /// The window of every parent; 0 in [`Mode::Intra`].
    pub fn windows(&self) -> &[u64] {
        &self.windows
    }
}

impl ColourGuide {
    /// As the coder of colours takes it.
    pub fn guide(&self) -> colour::Guide<'_> {
        colour::Guide {
            modes: &self.modes,
            moved: &self.moved,
        }
    }

    /// Colours of every child in the moved previous frame; `None` also for children in [`Mode::Intra`].
    pub fn moved(&self) -> &[Option<Ycc>] {
        &self.moved
    }
}

/// How many levels after divided blocks the one is that is moved for the level after them.
const COARSE_REACH: u8 = 3;
/// Nodes per task.
const CHUNK: usize = 4096;

impl Inter {
    /// A frame of the levels `base` to `top`. `motion` is the motion of `base` and of the levels after it, as far as
    /// they are to be decoded.
    ///
    /// # Errors
    /// [`Error::Malformed`] if the motion is damaged.
    pub fn new(isa: Isa, previous: Arc<Previous>, motion: &[&[u8]], [base, top]: [u8; 2]) -> Result<Self> {
        let (head, first) = Head::parse(motion.first().copied().unwrap_or_default(), base, top)?;
        let (warped, first) = match head.warped {
            true => Self::warped(isa, &previous, head, base, first)?,
            false => (None, first),
        };
        let mut sections = vec![first.to_vec()];
        sections.extend(motion.iter().skip(1).map(|section| section.to_vec()));
        Ok(Inter {
            previous,
            head,
            warped,
            base,
            sections,
            blocks: OnceLock::new(),
            parts: OnceLock::new(),
            moved: Default::default(),
        })
    }

    /// Reads the lattice of a warped frame, and makes what it makes of the previous frame.
    fn warped<'a>(
        isa: Isa,
        previous: &Previous,
        head: Head,
        base: u8,
        bytes: &'a [u8],
    ) -> Result<(Option<Arc<Warped>>, &'a [u8])> {
        let ([level, least], words, rest) = head.lattice(base, bytes)?;
        let top = head.reference_level;
        let source = previous.at(top)?;
        let made = || {
            let mut lattice = Lattice::of(&source.nodes(top, level), level);
            lattice.read(words, "lattice", |vector| head.check(vector))?;
            Scattered::new(isa, source, &lattice, [top, head.unit_level], head.smooth).warped(least)
        };
        let warped = made().map_err(|error| of_level(error, base))?;
        Ok((Some(Arc::new(warped)), rest))
    }

    /// The same of motion that has been chosen; of a warped frame, with what the previous frame was warped to.
    pub fn of(
        previous: Arc<Previous>,
        head: Head,
        warped: Option<Arc<Warped>>,
        [blocks, parts]: [Blocks; 2],
        base: u8,
    ) -> Self {
        assert_eq!(
            head.warped,
            warped.is_some(),
            "a warped frame has a warped previous frame"
        );
        Inter {
            previous,
            head,
            warped,
            base,
            sections: Vec::new(),
            blocks: OnceLock::from(blocks),
            parts: OnceLock::from(parts),
            moved: Default::default(),
        }
    }

    /// The previous frame.
    pub fn previous(&self) -> &Previous {
        &self.previous
    }

    /// What the previous frame tells of the occupancies of `level`. The octree has the level above.
    ///
    /// # Errors
    /// [`Error::Malformed`] if the motion is damaged; [`Error::Usage`] if the previous frame lacks the level.
    pub fn geometry(&self, octree: &Octree, level: u8) -> Result<GeometryGuide> {
        let Some(warped) = &self.warped else {
            let (field, previous) = self.source(octree, level)?;
            let bricks = &previous.bricks;
            let (modes, found) = windows(&field, octree, level, bricks, |brick| [bricks.cells(brick)]);
            return Ok(GeometryGuide {
                modes,
                windows: found.into_iter().map(|[window]| window).collect(),
                near: None,
            });
        };
        let (field, warped) = (self.field(octree, level)?, warped.at(level)?);
        let bricks = &warped.near.bricks;
        let (modes, found) = windows(&field, octree, level, bricks, |brick| {
            [warped.voxels[brick], bricks.cells(brick)]
        });
        let (windows, near) = found.into_iter().map(|[voxels, near]| (voxels, near)).unzip();
        Ok(GeometryGuide {
            modes,
            windows,
            near: Some(near),
        })
    }

    /// What the previous frame tells of the colours of `level`, which the octree has. `known` is the last level that a
    /// decoder has the voxels of when it decodes these colours.
    ///
    /// # Errors
    /// Those of [`Inter::geometry`].
    pub fn colours(&self, octree: &Octree, level: u8, known: u8) -> Result<ColourGuide> {
        let parts = self.head.block_level + 1;
        let (field, previous) = match self.head.moves_coarse && level <= parts && parts <= known {
            true => (
                self.field(octree, level)?.stopped(),
                self.moved_level(octree, true, level)?,
            ),
            false => self.source(octree, level)?,
        };
        let nodes = octree.level(level - 1);
        let masks = octree.occupancy(level - 1);
        let mut cursor = field.cursor();
        let modes: Vec<Mode> = { nodes.keys().iter() }
            .map(|key| cursor.at(*key).modes.colours)
            .collect();
        let chunks: Vec<usize> = (0..nodes.len()).step_by(CHUNK).collect();
        let moved_of = |first: usize| {
            let mut found = Vec::new();
            let (mut field, mut near) = (field.cursor(), previous.near());
            for node in first..nodes.len().min(first + CHUNK) {
                let Block { shift, low, part, .. } = *field.at(nodes.keys()[node]);
                let own = nodes.coordinate(node).map(|x| 2 * x as i32);
                for octant in ones(masks[node]) {
                    let octant = [octant & 1, octant >> 1 & 1, octant >> 2].map(|x| x as i32);
                    let place = [0, 1, 2].map(|axis| own[axis] + octant[axis]);
                    found.push(match modes[node] {
                        Mode::Intra => None,
                        // Between voxels of no distance lies the voxel itself.
                        Mode::Inter if part == [0; 3] => {
                            near.index(moved(place, low)).map(|index| previous.values[index])
                        }
                        Mode::Skip => near.index(moved(place, shift)).map(|index| previous.values[index]),
                        Mode::Inter => interpolated(previous, &mut near, moved(place, low), part),
                    });
                }
            }
            found
        };
        let moved: Vec<Vec<_>> = chunks.into_par_iter().map(moved_of).collect();
        Ok(ColourGuide {
            modes,
            moved: moved.concat(),
        })
    }

    /// The motion at `level`, and what it moves. The octree has the level above.
    fn source<'a>(&'a self, octree: &'a Octree, level: u8) -> Result<(Field<'a>, &'a PreviousLevel)> {
        let field = self.field(octree, level)?;
        if let Some(warped) = &self.warped {
            return Ok((field, &warped.at(level)?.near));
        }
        let Head {
            block_level,
            reference_level,
            ..
        } = self.head;
        if !(block_level + 1..reference_level).contains(&level) {
            return Ok((field, self.previous.at(level)?));
        }
        let of_parts = self.head.is_of_parts(level);
        Ok((field.stopped(), self.moved_level(octree, of_parts, level)?))
    }

    /// A level of the frame moved by the vectors of blocks, or of parts, which is made when it is first asked for. The octree
    /// has their level.
    fn moved_level(&self, octree: &Octree, of_parts: bool, level: u8) -> Result<&PreviousLevel> {
        let made = &self.moved[usize::from(of_parts)];
        let moved = match made.get() {
            Some(moved) => moved,
            None => {
                let moved = self.moved(octree, of_parts)?;
                made.get_or_init(|| moved)
            }
        };
        moved
            .level(level)
            .ok_or_else(|| Error::Usage(format!("level {level} was not moved")))
    }

    fn moved(&self, octree: &Octree, of_parts: bool) -> Result<Moved> {
        let Head {
            divided,
            block_level,
            unit_level,
            reference_level,
            ..
        } = self.head;
        // One level needs no finer one.
        let (level, reference) = match (divided, of_parts) {
            (true, true) => (block_level + 1, reference_level),
            (true, false) => (block_level, reference_level.min(block_level + COARSE_REACH)),
            (false, _) => (block_level, reference_level),
        };
        let blocks = if of_parts {
            self.parts(octree)?
        } else {
            self.blocks(octree)?
        };
        let shifts: Vec<_> = { blocks.vectors.iter() }
            .map(|vector| Block::new(Modes::default(), *vector, unit_level, reference).shift)
            .collect();
        let (previous, keys) = (self.previous.at(reference)?, octree.level(level).keys());
        let coarse = of_parts && self.head.moves_coarse;
        let moved = Moved::new(previous, [level, reference], keys, |i| shifts[i], coarse);
        let moved = moved.map_err(|error| of_level(error, self.base))?;
        Ok(match divided && !of_parts {
            true => moved.coarsest(),
            false => moved,
        })
    }

    /// Checks the motion of level L, of which the octree has all voxels. No level needs it if its blocks are the voxels
    /// of the finest level.
    ///
    /// # Errors
    /// [`Error::Malformed`] if the motion is damaged.
    pub fn check(&self, octree: &Octree) -> Result<()> {
        let first = usize::from((self.head.block_level + 2).saturating_sub(self.base));
        match self.head.divided && first < self.sections.len() {
            true => self.parts(octree).map(drop),
            false => self.blocks(octree).map(drop),
        }
    }

    /// The blocks, read when they are first asked for. The octree has their level.
    fn blocks(&self, octree: &Octree) -> Result<&Blocks> {
        if let Some(blocks) = self.blocks.get() {
            return Ok(blocks);
        }
        let keys = octree.level(self.head.block_level).keys();
        let blocks = self.head.blocks(self.base, keys, &self.sections())?;
        Ok(self.blocks.get_or_init(|| blocks))
    }

    /// The parts of divided blocks, likewise.
    fn parts(&self, octree: &Octree) -> Result<&Blocks> {
        if let Some(parts) = self.parts.get() {
            return Ok(parts);
        }
        let level = self.head.block_level;
        let keys = [level, level + 1].map(|level| octree.level(level).keys());
        let parts = self.head.parts(self.base, keys, &self.sections())?;
        Ok(self.parts.get_or_init(|| parts))
    }

    fn sections(&self) -> Vec<&[u8]> {
        self.sections.iter().map(Vec::as_slice).collect()
    }

    /// The motion at `level`. The octree has the level above.
    fn field<'a>(&'a self, octree: &'a Octree, level: u8) -> Result<Field<'a>> {
        let head = &self.head;
        let block = |modes, vector| Block::new(modes, vector, head.unit_level, level);
        if level <= head.block_level {
            return Ok(Field {
                keys: &[0],
                down: u32::from(3 * (level - 1)),
                blocks: vec![block(head.root, head.vector)],
            });
        }
        let (own, blocks) = match head.is_of_parts(level) {
            true => (head.block_level + 1, self.parts(octree)?),
            false => (head.block_level, self.blocks(octree)?),
        };
        let voxels = octree.level(own);
        let modes = blocks.modes.get(usize::from(level - own - 1));
        let Some(modes) = modes else {
            return Err(Error::Usage(format!("the motion of level {level} is not there")));
        };
        let vectors = blocks.vectors.iter();
        Ok(Field {
            keys: voxels.keys(),
            down: u32::from(3 * (level - 1 - own)),
            blocks: modes
                .iter()
                .zip(vectors)
                .map(|(modes, vector)| block(*modes, *vector))
                .collect(),
        })
    }
}

/// The mode of every parent, and what cells there are of `level` around where its children were; none in [`Mode::Intra`].
/// `cells` tells those of a brick of `there`, of several kinds.
fn windows<const N: usize>(
    field: &Field,
    octree: &Octree,
    level: u8,
    there: &Bricks,
    cells: impl Fn(usize) -> [u64; N] + Sync,
) -> (Vec<Mode>, Vec<[u64; N]>) {
    let nodes = octree.level(level - 1);
    let parents = (0..nodes.len()).into_par_iter().with_min_len(CHUNK);
    let start = || (field.cursor(), there.near(), Windows::new(there, &cells));
    let window = |(field, near, windows): &mut (Cursor, Near, Windows<N, _>), parent: usize| {
        let Block { modes, shift, .. } = *field.at(nodes.keys()[parent]);
        let mut window = [0; N];
        if modes.geometry != Mode::Intra {
            let node = nodes.coordinate(parent).map(|x| x as i32);
            if shift == [0; 3] {
                let octant = (node[0] & 1 | (node[1] & 1) << 1 | (node[2] & 1) << 2) as usize;
                window = windows.of_brick(node.map(|x| x >> 1)).map(|windows| windows[octant]);
            } else {
                let at = moved(node.map(|x| 2 * x - 1), shift);
                for (i, window) in window.iter_mut().enumerate() {
                    *window = near.window_of(at, |brick| cells(brick)[i]);
                }
            }
        }
        (modes.geometry, window)
    };
    parents.map_init(start, window).unzip()
}

/// The colour of the previous frame between voxels: at a place, less `part` sixteenths of a voxel along each axis. The
/// mean of the voxels that are there, by their shares.
fn interpolated(previous: &PreviousLevel, near: &mut Near, at: [i32; 3], part: [i32; 3]) -> Option<Ycc> {
    near.go(at.map(|x| x - 1));
    let (mut sums, mut total) = ([0i64; 3], 0i64);
    for corner in 0..8 {
        let step = [corner & 1, corner >> 1 & 1, corner >> 2];
        let share = |axis: usize| if step[axis] == 1 { part[axis] } else { 16 - part[axis] };
        let weight = i64::from(share(0) * share(1) * share(2));
        if weight == 0 {
            continue;
        }
        if let Some(index) = near.index([0, 1, 2].map(|axis| at[axis] - step[axis])) {
            for (sum, value) in sums.iter_mut().zip(previous.values[index]) {
                *sum += weight * i64::from(value);
            }
            total += weight;
        }
    }
    (total > 0).then(|| sums.map(|sum| (2 * sum + total).div_euclid(2 * total) as i16))
}
