//! From the near cells of the finest level to those of all levels (`docs/format.md`, clause 17.10.6).

use crate::colour::Ycc;

/// A near cell: its key, whether it is a voxel, its weight, and its colour sums.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cell {
    pub key: u64,
    pub voxel: bool,
    pub weight: u64,
    pub sums: [i64; 3],
}

impl Cell {
    /// The mean, rounded to the nearest, halves up.
    fn colour(&self) -> Ycc {
        let weight = self.weight as i64;
        if weight >= 1 << 30 {
            return self.sums.map(|sum| (2 * sum + weight).div_euclid(2 * weight) as i16);
        }
        // Numbers of at most 47 bits over twice the weight, as halves of which the quotients are above 0 and farther from
        // whole numbers than 2⁻³³: floats round them down correctly.
        let least = 2 * weight * (1 << 15);
        let inverse = 1.0 / (2 * weight) as f64;
        self.sums.map(|sum| {
            let above = ((2 * sum + weight + least) as f64 + 0.5) * inverse;
            (above as i64 - (1 << 15)) as i16
        })
    }
}

/// The parents of cells in the order of keys.
pub(super) fn parents(cells: &[Cell]) -> Vec<Cell> {
    let mut parents: Vec<Cell> = Vec::with_capacity(cells.len() / 3 + 1);
    for cell in cells {
        let key = cell.key >> 3;
        match parents.last_mut().filter(|parent| parent.key == key) {
            Some(parent) => {
                parent.voxel |= cell.voxel;
                parent.weight += cell.weight;
                (0..3).for_each(|t| parent.sums[t] += cell.sums[t]);
            }
            None => parents.push(Cell { key, ..*cell }),
        }
    }
    parents
}

/// Near cells of a level, one after the other in the order of keys.
#[derive(Debug, Default)]
pub(super) struct Part {
    pub bricks: Vec<Brick>,
    pub values: Vec<Ycc>,
}

/// Cells of a brick: its key, and masks by Morton key.
#[derive(Debug)]
pub(super) struct Brick {
    pub key: u64,
    pub near: u64,
    pub voxels: u64,
}

impl Part {
    /// Bytes of memory of a cell at most: a brick for each.
    pub const fn bytes_per_cell() -> usize {
        size_of::<Brick>() + size_of::<Ycc>()
    }

    pub fn of(cells: &[Cell]) -> Self {
        let mut part = Part::default();
        part.add(cells);
        part
    }

    /// Adds cells that come after those that it has.
    pub fn add(&mut self, cells: &[Cell]) {
        for cells in cells.chunk_by(|a, b| a.key >> 6 == b.key >> 6) {
            let mut brick = Brick {
                key: cells[0].key >> 6,
                near: 0,
                voxels: 0,
            };
            for cell in cells {
                brick.near |= 1 << (cell.key & 63);
                brick.voxels |= u64::from(cell.voxel) << (cell.key & 63);
            }
            self.values.extend(cells.iter().map(Cell::colour));
            self.bricks.push(brick);
        }
    }
}
