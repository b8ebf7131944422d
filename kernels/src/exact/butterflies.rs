//! The two-point butterflies of eight octants, eight channels at a time, without branches on which octants are
//! occupied.
//!
//! A join replaces the values `a` and `b` by their difference `b − a` and by `a + ⌊(b − a)·f⌋`, where `f` is a fraction
//! in units of 2⁻¹⁴. An `f` of 0 leaves `a`, one of 1 replaces it by `b`.

use crate::simd::{I32Vector, Simd};

/// Number of joins of eight octants.
pub const JOINS: usize = 7;
/// Channels.
pub type Lanes = [i32; 8];
/// A join: its slot, and the octants of its two values.
pub type Join = (usize, usize, usize);

/// `⌊d·f⌋` for `|d|` up to 2¹⁶.
#[inline(always)]
fn share<S: Simd>(simd: S, d: S::I32, f: i32) -> S::I32 {
    (d * S::I32::splat(simd, f)).shr(14)
}

/// Joins `values` in the order of `joins`, each with its fraction. Returns the differences by slot. Differences must be
/// within ±2¹⁶.
#[inline(always)]
pub fn forward<S: Simd>(
    simd: S,
    joins: &[Join; JOINS],
    fractions: &[i32; JOINS],
    values: [Lanes; 8],
) -> [Lanes; JOINS] {
    forward_narrow(simd.narrow(), joins, fractions, values)
}

#[inline(always)]
fn forward_narrow<S: Simd>(
    simd: S,
    joins: &[Join; JOINS],
    fractions: &[i32; JOINS],
    mut values: [Lanes; 8],
) -> [Lanes; JOINS] {
    let mut differences = [[0; 8]; JOINS];
    for at in (0..8).step_by(S::LANES) {
        for (&(slot, a, b), &f) in joins.iter().zip(fractions) {
            let first = S::I32::load(simd, &values[a][at..]);
            let difference = S::I32::load(simd, &values[b][at..]) - first;
            difference.store(&mut differences[slot][at..]);
            (first + share(simd, difference, f)).store(&mut values[a][at..]);
        }
    }
    differences
}

/// Undoes the joins in reverse order, from the mean in octant 0: `a` becomes `a − ⌊d·f⌋`, `b` becomes the new `a` plus
/// `d`. Differences must be within ±2¹⁶, and 0 in slots without a join.
#[inline(always)]
pub fn inverse<S: Simd>(
    simd: S,
    joins: &[Join; JOINS],
    fractions: &[i32; JOINS],
    mean: Lanes,
    differences: &[Lanes; JOINS],
) -> [Lanes; 8] {
    inverse_narrow(simd.narrow(), joins, fractions, mean, differences)
}

#[inline(always)]
fn inverse_narrow<S: Simd>(
    simd: S,
    joins: &[Join; JOINS],
    fractions: &[i32; JOINS],
    mean: Lanes,
    differences: &[Lanes; JOINS],
) -> [Lanes; 8] {
    let mut values = [mean; 8];
    for at in (0..8).step_by(S::LANES) {
        for (&(slot, a, b), &f) in joins.iter().zip(fractions).rev() {
            let difference = S::I32::load(simd, &differences[slot][at..]);
            let first = S::I32::load(simd, &values[a][at..]) - share(simd, difference, f);
            first.store(&mut values[a][at..]);
            (first + difference).store(&mut values[b][at..]);
        }
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Isa, Work};
    use proptest::prelude::*;

    const ALL: [Join; JOINS] = [
        (3, 0, 4),
        (4, 1, 5),
        (5, 2, 6),
        (6, 3, 7),
        (1, 0, 2),
        (2, 1, 3),
        (0, 0, 1),
    ];

    struct There<'a>(&'a [i32; JOINS], [Lanes; 8]);

    impl Work for There<'_> {
        type Output = [Lanes; JOINS];

        #[inline(always)]
        fn run<S: Simd>(self, simd: S) -> [Lanes; JOINS] {
            forward(simd, &ALL, self.0, self.1)
        }
    }

    struct Back<'a>(&'a [i32; JOINS], Lanes, &'a [Lanes; JOINS]);

    impl Work for Back<'_> {
        type Output = [Lanes; 8];

        #[inline(always)]
        fn run<S: Simd>(self, simd: S) -> [Lanes; 8] {
            inverse(simd, &ALL, self.0, self.1, self.2)
        }
    }

    fn lanes(limit: i32) -> impl Strategy<Value = Lanes> {
        prop::array::uniform8(prop_oneof![-limit..=limit, Just(limit), Just(-limit)])
    }

    proptest! {
        #[test]
        fn every_instruction_set_joins_as_plain_code_does(
            fractions in prop::array::uniform7(0i32..=1 << 14),
            start in prop::array::uniform8(lanes(1 << 14)),
            mean in lanes(1 << 14),
            differences in prop::array::uniform7(lanes(1 << 16)),
        ) {
            let share = |join: usize, d: i32| (d * fractions[join]) >> 14;
            let (mut values, mut there, mut back) = (start, [[0; 8]; JOINS], [mean; 8]);
            for lane in 0..8 {
                for (join, (slot, a, b)) in ALL.into_iter().enumerate() {
                    there[slot][lane] = values[b][lane] - values[a][lane];
                    values[a][lane] += share(join, there[slot][lane]);
                }
                for (join, (slot, a, b)) in ALL.into_iter().enumerate().rev() {
                    back[a][lane] -= share(join, differences[slot][lane]);
                    back[b][lane] = back[a][lane] + differences[slot][lane];
                }
            }
            for isa in Isa::available() {
                prop_assert_eq!(isa.run(There(&fractions, start)), there, "{}", isa);
                prop_assert_eq!(isa.run(Back(&fractions, mean, &differences)), back, "{}", isa);
            }
        }
    }

    #[test]
    fn every_share_is_rounded_down() {
        for isa in Isa::available() {
            for f in (0..=1 << 14).step_by(127).chain([1 << 13, 1 << 14]) {
                for d in (-65_536..=65_536).step_by(77).chain(-50..50).chain([65_536]) {
                    let mut differences = [[0; 8]; JOINS];
                    differences[0] = [d; 8];
                    let back = isa.run(Back(&[f; JOINS], [0; 8], &differences));
                    let expected = -(i64::from(d) * i64::from(f)).div_euclid(1 << 14);
                    assert_eq!(back[0], [expected as i32; 8], "{isa}: {f} of {d}");
                }
            }
        }
    }
}
