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

    /// Does it, with these instructions; `#[inline(always)]` in implementations.
    fn run<I: Instructions>(self, instructions: I) -> Self::Output;
}

/// What work is compiled for, and a licence for the kernels that it calls: a choice at run time would be made for each of them.
pub trait Instructions: Copy + sealed::Sealed {
    /// Whether there is AVX2.
    const AVX2: bool;
}

/// What every processor of the target has.
#[derive(Debug, Clone, Copy)]
pub struct Baseline;

/// AVX2 as well: made only where the processor has it.
#[cfg(target_arch = "x86_64")]
#[derive(Debug, Clone, Copy)]
pub struct Avx2(());

mod sealed {
    pub trait Sealed {}
}

impl sealed::Sealed for Baseline {}
impl Instructions for Baseline {
    const AVX2: bool = false;
}

#[cfg(target_arch = "x86_64")]
impl sealed::Sealed for Avx2 {}
#[cfg(target_arch = "x86_64")]
impl Instructions for Avx2 {
    const AVX2: bool = true;
}

#[cfg(all(test, target_arch = "x86_64"))]
impl Avx2 {
    /// If the processor has it.
    pub fn here() -> Option<Avx2> {
        (Isa::detect().level() >= Level::Avx2).then_some(Avx2(()))
    }
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
        work.run(Baseline)
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,f16c,bmi1,bmi2,popcnt,lzcnt")]
fn avx2<W: Work>(work: W) -> W::Output {
    work.run(Avx2(()))
}

#[cfg(target_arch = "x86_64")]
#[target_feature(
    enable = "avx2,fma,f16c,bmi1,bmi2,popcnt,lzcnt,avx512f,avx512bw,avx512cd,avx512dq,avx512vl,avx512vnni"
)]
fn avx512<W: Work>(work: W) -> W::Output {
    work.run(Avx2(()))
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Sum<'a>(&'a [i16], &'a [i16]);

    impl Work for Sum<'_> {
        type Output = i32;

        #[inline(always)]
        fn run<I: Instructions>(self, _: I) -> i32 {
            let products = self.0.iter().zip(self.1);
            products.fold(0, |sum, (&a, &b)| sum.wrapping_add(i32::from(a) * i32::from(b)))
        }
    }

    #[test]
    fn work_comes_to_the_same_on_every_instruction_set() {
        let a: Vec<i16> = (0..1000).map(|i| (i * 7919 % 65_536) as u16 as i16).collect();
        let b: Vec<i16> = a.iter().rev().copied().collect();
        let expected = Sum(&a, &b).run(Baseline);
        for isa in Isa::available() {
            assert_eq!(isa.run(Sum(&a, &b)), expected, "{isa}");
        }
    }
}
