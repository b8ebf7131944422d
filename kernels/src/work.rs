//! Plain loops compiled for each instruction set.

use crate::isa::Isa;
#[cfg(target_arch = "x86_64")]
use crate::isa::Level;

/// Work in plain Rust that is compiled once for every instruction set.
///
/// What it calls must be inlined into it (`#[inline(always)]`, closures): a function that is not stays as it is compiled for any processor. Results
/// are the same, as integers are everywhere, and floats whose order of operations is written down.
pub trait Work {
    /// What comes of it.
    type Output;

    /// Does it; `#[inline(always)]` in implementations.
    fn run(self) -> Self::Output;
}

impl Isa {
    /// Does work with this instruction set.
    pub fn run<W: Work>(self, work: W) -> W::Output {
        #[cfg(target_arch = "x86_64")]
        match self.level() {
            Level::Scalar => (),
            // SAFETY: an `Isa` of this level is only made where the processor has these features.
            Level::Avx2 | Level::AvxVnni => return unsafe { avx2(work) },
            // SAFETY: as above.
            Level::Avx512 | Level::Amx => return unsafe { avx512(work) },
        }
        // On AArch64 plain code uses NEON as it is.
        work.run()
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,f16c,bmi1,bmi2,popcnt,lzcnt")]
fn avx2<W: Work>(work: W) -> W::Output {
    work.run()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(
    enable = "avx2,fma,f16c,bmi1,bmi2,popcnt,lzcnt,avx512f,avx512bw,avx512cd,avx512dq,avx512vl,avx512vnni"
)]
fn avx512<W: Work>(work: W) -> W::Output {
    work.run()
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Sum<'a>(&'a [i16], &'a [i16]);

    impl Work for Sum<'_> {
        type Output = i32;

        #[inline(always)]
        fn run(self) -> i32 {
            let products = self.0.iter().zip(self.1);
            products.fold(0, |sum, (&a, &b)| {
                sum.wrapping_add(i32::from(a) * i32::from(b))
            })
        }
    }

    #[test]
    fn work_comes_to_the_same_on_every_instruction_set() {
        let a: Vec<i16> = (0..1000)
            .map(|i| (i * 7919 % 65_536) as u16 as i16)
            .collect();
        let b: Vec<i16> = a.iter().rev().copied().collect();
        let expected = Sum(&a, &b).run();
        for isa in Isa::available() {
            assert_eq!(isa.run(Sum(&a, &b)), expected, "{isa}");
        }
    }
}
