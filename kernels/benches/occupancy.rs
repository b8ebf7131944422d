//! How long one thread takes for the kernels that predict occupancies, in nanoseconds a call.
//! Least time of a few repeats. Arguments: the names of instruction sets.

use std::hint::black_box;
use std::time::Instant;

use b2p_kernels::hidden::{self, Narrow, Row, WIDTH};
use b2p_kernels::mixing::{self, CONTEXTS, Lanes};
use b2p_kernels::{Instructions, Isa, Work};

const CALLS: usize = 100_000;
/// Rows that are added up for a voxel.
const ROWS: usize = 20;

/// Kernels called again and again.
#[derive(Clone, Copy)]
enum Calls {
    AddUp,
    Sum,
    Learn,
    Mix,
    MixAndLearn,
}

impl Work for Calls {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, instructions: I) {
        let rows: Vec<Narrow> = (0..256)
            .map(|r| std::array::from_fn(|u| ((r * 7919 + u * 31) % 200) as i8))
            .collect();
        let features: Row = std::array::from_fn(|u| (u as i16 - 64) * 7);
        let (mut weights, mut lanes): (Row, Lanes) = ([5; WIDTH], [9830; 8]);
        let stretch: [i16; 4096] = std::array::from_fn(|i| (i as i16 - 2048) / 3);
        let mut tables = vec![[40_000 | 3 << 16; CONTEXTS]; 4096];
        let (mut at, mut all) = (0usize, 0i64);
        for _ in 0..CALLS {
            at = at.wrapping_mul(5).wrapping_add(1);
            let row = &rows[at & 255];
            all += match self {
                Calls::AddUp => {
                    let mut some = [row; ROWS];
                    for (i, row) in some.iter_mut().enumerate() {
                        *row = &rows[(at + i) & 255];
                    }
                    hidden::add_up(instructions, &some)[at & 127].into()
                }
                Calls::Sum => hidden::sum(instructions, &features, row, &weights).into(),
                Calls::Learn => {
                    hidden::learn(instructions, &features, row, 300, &mut weights);
                    0
                }
                Calls::Mix | Calls::MixAndLearn => {
                    let entries = &mut tables[at & 4095];
                    let (inputs, checks) = ([(at & 255) as i32, 20], [(at & 1) as u32; CONTEXTS]);
                    let mixed = mixing::mix(instructions, *entries, checks, inputs, &stretch, &lanes);
                    if let Calls::MixAndLearn = self {
                        let truths = [(at & 1) as i32 * 65_536, 30_000];
                        let error = truths[0] - 30_000;
                        *entries = mixing::learn(instructions, &mixed, error, truths, &mut lanes);
                    }
                    mixed.sum.into()
                }
            };
        }
        black_box((all, weights, lanes, tables));
    }
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let only: Vec<Isa> = args.iter().filter_map(|arg| arg.parse().ok()).collect();
    let kinds = [
        ("add up 20 rows", Calls::AddUp),
        ("hidden layer and sum", Calls::Sum),
        ("learn", Calls::Learn),
        ("mix", Calls::Mix),
        ("mix and learn", Calls::MixAndLearn),
    ];
    for isa in Isa::available() {
        if !only.is_empty() && !only.contains(&isa) {
            continue;
        }
        for (what, calls) in kinds {
            let mut least = f64::INFINITY;
            for _ in 0..7 {
                let start = Instant::now();
                isa.run(calls);
                least = least.min(start.elapsed().as_secs_f64());
            }
            let name = isa.to_string();
            println!("{name:>7} {what:<20} {:6.1} ns", least * 1e9 / CALLS as f64);
        }
    }
}
