//! Lanes of portable Rust.

use super::Ellipse;
use super::lanes::{Double, EXP2, LEAST_POWER, Lanes, Mask, ROUND, four, numbered, three};

/// Four floats, in plain Rust.
#[derive(Clone, Copy)]
#[repr(align(16))]
pub(super) struct Plain([f32; 4]);

#[derive(Clone, Copy)]
pub(super) struct PlainMask([bool; 4]);

#[derive(Clone, Copy)]
pub(super) struct PlainDouble([f64; 4]);

impl Plain {
    #[inline(always)]
    fn each(self, f: impl Fn(f32) -> f32) -> Self {
        Plain(four!(i => f(self.0[i])))
    }

    #[inline(always)]
    fn both(self, other: Self, f: impl Fn(f32, f32) -> f32) -> Self {
        Plain(four!(i => f(self.0[i], other.0[i])))
    }

    #[inline(always)]
    fn compare(self, other: Self, f: impl Fn(f32, f32) -> bool) -> PlainMask {
        PlainMask(four!(i => f(self.0[i], other.0[i])))
    }
}

impl Lanes for Plain {
    const COUNT: usize = 4;
    type Mask = PlainMask;
    type Double = PlainDouble;

    #[inline(always)]
    fn splat(x: f32) -> Self {
        Plain([x; 4])
    }

    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        Plain([from[0], from[1], from[2], from[3]])
    }

    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        to[..4].copy_from_slice(&self.0);
    }

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.both(other, |a, b| a + b)
    }

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.both(other, |a, b| a - b)
    }

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.both(other, |a, b| a * b)
    }

    #[inline(always)]
    fn div(self, other: Self) -> Self {
        self.both(other, |a, b| a / b)
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        self.mul(factor).add(term)
    }

    #[inline(always)]
    fn neg_mul_add(self, factor: Self, term: Self) -> Self {
        term.sub(self.mul(factor))
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        self.each(f32::sqrt)
    }

    #[inline(always)]
    fn abs(self) -> Self {
        self.each(f32::abs)
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.both(other, |a, b| if a < b { a } else { b })
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.both(other, |a, b| if a > b { a } else { b })
    }

    // By hand: without SSE 4.1 `ceil` and `floor` are calls.
    #[inline(always)]
    fn ceil(self) -> Self {
        self.each(|x| {
            let whole = x as i32 as f32;
            if whole < x { whole + 1.0 } else { whole }
        })
    }

    #[inline(always)]
    fn floor(self) -> Self {
        self.each(|x| {
            let whole = x as i32 as f32;
            if whole > x { whole - 1.0 } else { whole }
        })
    }

    #[inline(always)]
    fn lt(self, other: Self) -> PlainMask {
        self.compare(other, |a, b| a < b)
    }

    #[inline(always)]
    fn le(self, other: Self) -> PlainMask {
        self.compare(other, |a, b| a <= b)
    }

    #[inline(always)]
    fn select(mask: PlainMask, yes: Self, no: Self) -> Self {
        Plain(four!(i => if mask.0[i] { yes.0[i] } else { no.0[i] }))
    }

    #[inline(always)]
    fn keep(self, mask: PlainMask) -> Self {
        Self::select(mask, self, Plain([0.0; 4]))
    }

    #[inline(always)]
    fn exp2(self) -> Self {
        self.each(|x| {
            let x = if x > LEAST_POWER { x } else { LEAST_POWER };
            let shifted = x + ROUND;
            let f = x - (shifted - ROUND);
            let [a, b, c, d, e] = EXP2;
            let p = (((a * f + b) * f + c) * f + d) * f + e;
            f32::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 23))
        })
    }

    #[inline(always)]
    fn to_integer(self) -> Self {
        self.each(|x| f32::from_bits(x as u32))
    }

    #[inline(always)]
    fn add_integer(self, other: Self) -> Self {
        self.both(other, |a, b| f32::from_bits(a.to_bits().wrapping_add(b.to_bits())))
    }

    #[inline(always)]
    fn compress(self, which: u32) -> Self {
        // Each lane is written where the next that counts will be: no branch.
        let (mut first, mut kept) = ([0.0; 4], 0);
        for lane in 0..4 {
            first[kept % 4] = self.0[lane];
            kept += (which >> lane) as usize & 1;
        }
        Plain(first)
    }

    #[inline(always)]
    fn deal3(from: &[[f32; 3]]) -> [Self; 3] {
        let from = &from[..4];
        three!(k => Plain(four!(i => from[i][k])))
    }

    #[inline(always)]
    fn deal4(from: &[[f32; 4]]) -> [Self; 4] {
        let from = &from[..4];
        four!(k => Plain(four!(i => from[i][k])))
    }

    #[inline(always)]
    fn collect(fields: &[Self; 16], which: u32, to: &mut [Ellipse]) -> usize {
        let mut kept = 0;
        for lane in (0..4).filter(|lane| which >> lane & 1 == 1) {
            to[kept] = Ellipse::from_fields(std::array::from_fn(|k| fields[k].0[lane]));
            kept += 1;
        }
        kept
    }

    #[inline(always)]
    fn to_float(self) -> Self {
        self.each(|x| x.to_bits() as f32)
    }

    #[inline(always)]
    fn gather(all: &[Ellipse], keys: &[u64]) -> [Self; 16] {
        let records = four!(i => all[numbered(keys, i)].fields());
        let mut fields = [Plain([0.0; 4]); 16];
        for (k, field) in fields.iter_mut().enumerate() {
            *field = Plain(four!(i => records[i][k]));
        }
        fields
    }

    #[inline(always)]
    fn split(self) -> (Self, Self) {
        let one = 1.0f32.to_bits();
        let mantissa = self.each(|x| f32::from_bits(x.to_bits() & 0x007f_ffff | one));
        let exponent = self.each(|x| ((x.to_bits() >> 23) as i32 - 127) as f32);
        (mantissa, exponent)
    }
}

impl Mask for PlainMask {
    #[inline(always)]
    fn and(self, other: Self) -> Self {
        PlainMask(four!(i => self.0[i] & other.0[i]))
    }

    #[inline(always)]
    fn bits(self) -> u32 {
        (0..4).map(|i| u32::from(self.0[i]) << i).sum()
    }
}

impl Double for PlainDouble {
    type Lanes = Plain;
    type Mask = PlainMask;

    #[inline(always)]
    fn splat(x: f64) -> Self {
        PlainDouble([x; 4])
    }

    #[inline(always)]
    fn from_lanes(lanes: Plain) -> Self {
        PlainDouble(four!(i => f64::from(lanes.0[i])))
    }

    #[inline(always)]
    fn to_lanes(self) -> Plain {
        Plain(four!(i => self.0[i] as f32))
    }

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        PlainDouble(four!(i => self.0[i] * other.0[i]))
    }

    #[inline(always)]
    fn div(self, other: Self) -> Self {
        PlainDouble(four!(i => self.0[i] / other.0[i]))
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        PlainDouble(four!(i => self.0[i] * factor.0[i] + term.0[i]))
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        let least = |a: f64, b: f64| if a < b { a } else { b };
        PlainDouble(four!(i => least(self.0[i], other.0[i])))
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        let greatest = |a: f64, b: f64| if a > b { a } else { b };
        PlainDouble(four!(i => greatest(self.0[i], other.0[i])))
    }

    #[inline(always)]
    fn lt(self, other: Self) -> PlainMask {
        PlainMask(four!(i => self.0[i] < other.0[i]))
    }
}
