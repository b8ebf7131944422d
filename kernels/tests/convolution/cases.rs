//! Data to convolve.

use b2p_kernels::{ABSENT, Output, Plan, Taps};

/// SplitMix64.
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    pub fn below(&mut self, n: usize) -> usize {
        (self.next() % n as u64) as usize
    }

    /// In −limit..=limit.
    pub fn signed(&mut self, limit: i32) -> i32 {
        self.below(2 * limit as usize + 1) as i32 - limit
    }

    /// In −1..1.
    pub fn unit(&mut self) -> f32 {
        (self.next() >> 40) as f32 / (1 << 23) as f32 - 1.0
    }
}

/// Row counts around the tile's and the block's edges.
pub const ROWS: [usize; 7] = [513, 600, 512, 127, 40, 33, 27];
pub const CHANNELS: [usize; 7] = [3, 8, 14, 16, 32, 72, 128];

/// All kinds of taps over `rows` output rows, and how many input rows each needs.
pub fn kernels(random: &mut Random, rows: usize) -> Vec<(Owned, usize)> {
    let inputs = rows + 5;
    let mut map = |volume: usize, density: usize| {
        let entry = |random: &mut Random| match random.below(100) < density {
            true => random.below(inputs) as u32,
            false => ABSENT,
        };
        let rows = (0..rows * volume).map(|_| entry(random)).collect();
        (Owned::Map(volume, rows), inputs)
    };
    let mut all = vec![map(27, 40), map(27, 0), map(27, 100), map(8, 60), map(1, 100)];
    all.push((Owned::Map(27, surface(rows)), rows));
    all.push((Owned::Same, rows));
    let parents = (0..rows).map(|_| random.below(inputs) as u32).collect();
    let octants = (0..rows).map(|_| random.below(8) as u8).collect();
    all.push((Owned::Octants(parents, octants), inputs));
    let parents = rows.div_ceil(8);
    all.push((Owned::Children, parents));
    let plan = Plan::new(rows);
    all.push((Owned::AllChildren(surface(parents), plan), 8 * parents));
    all
}

/// The 3³ kernel map of the first `count` voxels of a wavy surface, three of them one above the other at each place.
fn surface(count: usize) -> Vec<u32> {
    let voxels: Vec<[i32; 3]> = (0..count as i32)
        .map(|i| {
            let (x, y) = (i / 3 % 20, i / 60);
            let height = 4.0 * (f64::from(x) * 0.4).sin() * (f64::from(y) * 0.3).cos();
            [x, y, height as i32 + i % 3]
        })
        .collect();
    let neighbour = |v: &[i32; 3], k: i32| {
        let at = [v[0] + k % 3 - 1, v[1] + k / 3 % 3 - 1, v[2] + k / 9 - 1];
        let row = voxels.iter().position(|&voxel| voxel == at);
        row.map_or(ABSENT, |row| row as u32)
    };
    let rows = voxels.iter();
    rows.flat_map(|v| (0..27).map(move |k| (v, k)))
        .map(|(v, k)| neighbour(v, k))
        .collect()
}

pub enum Owned {
    Same,
    Map(usize, Vec<u32>),
    Octants(Vec<u32>, Vec<u8>),
    Children,
    AllChildren(Vec<u32>, Plan),
}

impl Owned {
    pub fn taps(&self) -> Taps<'_> {
        match self {
            Owned::Same => Taps::Same,
            Owned::Map(volume, rows) => Taps::Map {
                volume: *volume,
                rows,
                plan: None,
            },
            Owned::Octants(parents, octants) => Taps::Octants { parents, octants },
            Owned::Children => Taps::Children,
            Owned::AllChildren(neighbours, plan) => Taps::AllChildren { neighbours, plan },
        }
    }
}

/// The extents to test: every count of input channels and every count of output channels, with each kind of taps.
pub fn cases(random: &mut Random) -> Vec<(Owned, usize, usize, [usize; 2])> {
    let mut cases = Vec::new();
    for (i, &a) in CHANNELS.iter().enumerate() {
        let b = CHANNELS[(i * 3 + 1) % CHANNELS.len()];
        let rows = ROWS[i];
        for (taps, inputs) in kernels(random, rows) {
            cases.push((taps, rows, inputs, [a, b]));
        }
    }
    cases
}

/// All of a layer's rows, every one `stride` values of its own.
pub fn whole<'a, T, R>(rows: &'a mut [T], stride: usize, residual: Option<&'a [R]>, relu: bool) -> Output<'a, T, R> {
    Output {
        rows,
        stride,
        column: 0,
        residual,
        relu,
    }
}
