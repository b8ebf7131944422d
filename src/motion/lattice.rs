//! The lattice of vectors that warps a frame (`docs/format.md`, clauses 17.10.1 to 17.10.3).

use super::models::Models;
use crate::coding::binary::{Coder, Decoder};
use crate::error::Result;
use crate::geometry::morton;

/// Levels from the lattice to the finest level: at least, and at most.
pub const DEPTHS: [u8; 2] = [2, 8];

/// Vectors at the corners of nodes, from level 0 to the level of the lattice.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Lattice {
    levels: Vec<Corners>,
}

/// The corners of a level's nodes, in ascending order of z, y and x, each with a vector.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Corners {
    /// [`place`] of each.
    places: Vec<u64>,
    pub vectors: Vec<[i16; 3]>,
}

/// The place of a corner as a number, in the order of corners.
#[inline]
fn place([x, y, z]: [u32; 3]) -> u64 {
    u64::from(x) | u64::from(y) << 21 | u64::from(z) << 42
}

/// The corner at a place.
fn at(place: u64) -> [u32; 3] {
    [0, 21, 42].map(|shift| (place >> shift) as u32 & 0x1f_ffff)
}

impl Corners {
    /// The corners of the nodes with these Morton keys, with vectors of 0.
    pub fn of(nodes: &[u64]) -> Self {
        let corners = |key: &u64| {
            let at = morton::decode(*key);
            (0..8).map(move |i| place([at[0] + (i & 1), at[1] + (i >> 1 & 1), at[2] + (i >> 2)]))
        };
        let mut places: Vec<u64> = nodes.iter().flat_map(corners).collect();
        places.sort_unstable();
        places.dedup();
        let vectors = vec![[0; 3]; places.len()];
        Corners { places, vectors }
    }

    /// The place of corner `i`, in nodes of the level.
    pub fn at(&self, i: usize) -> [u32; 3] {
        at(self.places[i])
    }

    /// The number of the corner at a place.
    ///
    /// # Panics
    /// If there is none.
    pub fn number(&self, corner: [u32; 3]) -> usize {
        self.places.partition_point(|other| *other < place(corner))
    }

    /// The prediction of corner `i` by those of the level above, or, if there is none, by the corner before.
    pub fn predicted(&self, above: Option<&Corners>, i: usize) -> [i16; 3] {
        let Some(above) = above else {
            return i.checked_sub(1).map_or([0; 3], |before| self.vectors[before]);
        };
        let at = self.at(i);
        let (mut sum, mut count) = ([0i32; 3], 0u32);
        for corner in 0..8u32 {
            let step = [corner & 1, corner >> 1 & 1, corner >> 2];
            // Along even axes there is one corner.
            if (0..3).any(|axis| step[axis] == 1 && at[axis] & 1 == 0) {
                continue;
            }
            let number = above.number([0, 1, 2].map(|axis| (at[axis] >> 1) + step[axis]));
            let vector = above.vectors[number];
            (0..3).for_each(|axis| sum[axis] += i32::from(vector[axis]));
            count += 1;
        }
        sum.map(|x| ((x + (count >> 1) as i32) >> count.trailing_zeros()) as i16)
    }

    /// Corners one less along each axis that `bent`, at most 2.
    fn near(&self, i: usize, bent: &[bool]) -> usize {
        let at = self.at(i);
        let bends = |axis: &usize| {
            let mut place = at;
            place[*axis].checked_sub(1).is_some_and(|less| {
                place[*axis] = less;
                let place = self::place(place);
                self.places[..i].binary_search(&place).is_ok_and(|other| bent[other])
            })
        };
        (0..3).filter(bends).count().min(2)
    }
}

impl Lattice {
    /// The lattice of level `level` of a frame whose nodes of that level have these keys, with vectors of 0.
    pub fn of(nodes: &[u64], level: u8) -> Self {
        let corners = |at: u8| {
            let mut nodes: Vec<u64> = nodes.iter().map(|key| key >> (3 * (level - at))).collect();
            nodes.dedup();
            Corners::of(&nodes)
        };
        Lattice {
            levels: (0..=level).map(corners).collect(),
        }
    }

    /// The corners of levels from 0 on.
    pub fn levels(&self) -> &[Corners] {
        &self.levels
    }

    /// The corners of a level, with those of the level above.
    pub fn level_mut(&mut self, level: u8) -> (Option<&Corners>, &mut Corners) {
        let (above, level) = self.levels.split_at_mut(usize::from(level));
        (above.last(), &mut level[0])
    }

    /// The corners of the finest level.
    ///
    /// # Panics
    /// If there are none.
    pub fn finest(&self) -> &Corners {
        self.levels.last().expect("a lattice has a level")
    }

    /// Whether all vectors are 0.
    pub fn is_still(&self) -> bool {
        self.finest().vectors.iter().all(|vector| *vector == [0; 3])
    }

    /// Reads the vectors. `check` checks one of them.
    ///
    /// # Errors
    /// [`crate::Error::Malformed`].
    pub fn read(&mut self, bytes: &[u8], at: &str, check: impl Fn([i16; 3]) -> Result<()>) -> Result<()> {
        let mut coder = Decoder::new(bytes);
        self.code(&mut coder, check)?;
        coder.finish(at)
    }

    /// The vectors as bytes.
    ///
    /// # Errors
    /// [`crate::Error::Malformed`] if a number has no code.
    #[cfg(feature = "encoder")]
    pub fn write(&self) -> Result<Vec<u8>> {
        let mut coder = crate::coding::binary::Encoder::default();
        self.clone().code(&mut coder, |_| Ok(()))?;
        Ok(coder.finish())
    }

    fn code(&mut self, coder: &mut impl Coder, check: impl Fn([i16; 3]) -> Result<()>) -> Result<()> {
        let mut models = Models::new(true);
        let last = self.levels.len() as u8 - 1;
        for level in 0..=last {
            let (above, corners) = self.level_mut(level);
            let kind = usize::from((last - level).min(2));
            let mut bent = Vec::with_capacity(corners.vectors.len());
            for i in 0..corners.vectors.len() {
                let predicted = corners.predicted(above, i);
                let near = corners.near(i, &bent);
                let vector = models.code_corner(coder, [kind, near], predicted, corners.vectors[i])?;
                bent.push(vector != predicted);
                check(vector)?;
                corners.vectors[i] = vector;
            }
        }
        Ok(())
    }
}
