//! Which instructions the kernels may use.

use std::fmt;
use std::str::FromStr;

#[cfg(target_arch = "x86_64")]
use crate::rows::PANEL;

/// An instruction set that this machine has: the kernels' licence to use it.
///
/// Only [`Isa::detect`], [`Isa::available`] and parsing make one, and they ask the processor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Isa(Level);

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) enum Level {
    Scalar,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// AVX2, and products of pairs of i16 that are added in the same step: small processors without AVX-512 have it.
    #[cfg(target_arch = "x86_64")]
    AvxVnni,
    #[cfg(target_arch = "x86_64")]
    Avx512,
    /// AVX-512, and tiles for what they serve.
    #[cfg(target_arch = "x86_64")]
    Amx,
    #[cfg(target_arch = "aarch64")]
    Neon,
    /// NEON, and sums of four products of bytes.
    #[cfg(target_arch = "aarch64")]
    NeonDot,
}

/// The smallest [`Isa::group`].
pub(crate) const MIN_GROUP: usize = 4;
/// Panels that AVX-512 multiplies at once, by the rows of the smallest group, where a layer has so many.
#[cfg(target_arch = "x86_64")]
pub(crate) const WIDE: usize = 4;

impl Isa {
    /// What the target guarantees; every machine has it.
    pub const SCALAR: Isa = Isa(Level::Scalar);

    /// The best that this machine has.
    pub fn detect() -> Isa {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2")
            && is_x86_feature_detected!("fma")
            && is_x86_feature_detected!("f16c")
            && is_x86_feature_detected!("bmi1")
            && is_x86_feature_detected!("bmi2")
            && is_x86_feature_detected!("popcnt")
            && is_x86_feature_detected!("lzcnt")
        {
            let avx512 = is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512cd")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("avx512vnni");
            return Isa(match avx512 {
                true if is_x86_feature_detected!("avx512bf16") && amx() => Level::Amx,
                true => Level::Avx512,
                false if is_x86_feature_detected!("avxvnni") => Level::AvxVnni,
                false => Level::Avx2,
            });
        }
        #[cfg(target_arch = "aarch64")]
        if std::arch::is_aarch64_feature_detected!("neon") {
            return Isa(match std::arch::is_aarch64_feature_detected!("dotprod") {
                true => Level::NeonDot,
                false => Level::Neon,
            });
        }
        Isa::SCALAR
    }

    /// Everything that this machine has, plainest first.
    pub fn available() -> Vec<Isa> {
        let levels = [
            Level::Scalar,
            #[cfg(target_arch = "x86_64")]
            Level::Avx2,
            #[cfg(target_arch = "x86_64")]
            Level::AvxVnni,
            #[cfg(target_arch = "x86_64")]
            Level::Avx512,
            #[cfg(target_arch = "x86_64")]
            Level::Amx,
            #[cfg(target_arch = "aarch64")]
            Level::Neon,
            #[cfg(target_arch = "aarch64")]
            Level::NeonDot,
        ];
        let best = Isa::detect();
        levels
            .into_iter()
            .map(Isa)
            .filter(|isa| *isa <= best && isa.is_here())
            .collect()
    }

    /// Whether this machine has what others below its best have: AVX-512 does not tell of AVX-VNNI.
    fn is_here(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        if self.0 == Level::AvxVnni {
            return is_x86_feature_detected!("avxvnni");
        }
        true
    }

    /// Whether there are products of bf16 besides (AVX512_BF16).
    pub fn has_bf16(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        if self.0 >= Level::Avx512 {
            return is_x86_feature_detected!("avx512bf16");
        }
        false
    }

    /// Whether there are products and sums of f16 besides (`fp16` on NEON).
    pub fn has_half(self) -> bool {
        #[cfg(target_arch = "aarch64")]
        if self.0 >= Level::Neon {
            return std::arch::is_aarch64_feature_detected!("fp16");
        }
        false
    }

    /// Output rows of a layer of `cout` channels that are multiplied by the same taps: those of a matrix tile, or as many as keep the
    /// registers busy. A multiple of [`MIN_GROUP`].
    pub(crate) fn group(self, cout: usize) -> usize {
        match self.0 {
            #[cfg(target_arch = "x86_64")]
            Level::Amx => 16,
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 if !cout.is_multiple_of(WIDE * PANEL) => 8,
            _ => {
                let _ = cout;
                MIN_GROUP
            }
        }
    }

    /// Whether there are matrix tiles of bytes and bf16 (AMX).
    pub fn has_tiles(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        if self.0 == Level::Amx {
            return true;
        }
        false
    }

    /// Whether there are sums of four products of bytes on NEON (`dotprod`).
    #[cfg(target_arch = "aarch64")]
    pub(crate) fn has_dot(self) -> bool {
        self.0 == Level::NeonDot
    }

    pub(crate) fn level(self) -> Level {
        self.0
    }

    fn name(self) -> &'static str {
        match self.0 {
            Level::Scalar => "scalar",
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => "avx2",
            #[cfg(target_arch = "x86_64")]
            Level::AvxVnni => "avxvnni",
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => "avx512",
            #[cfg(target_arch = "x86_64")]
            Level::Amx => "amx",
            #[cfg(target_arch = "aarch64")]
            Level::Neon => "neon",
            #[cfg(target_arch = "aarch64")]
            Level::NeonDot => "dotprod",
        }
    }
}

impl fmt::Display for Isa {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Whether there is AMX with bytes and bf16, and the system lets this process use it. Asks once.
#[cfg(target_arch = "x86_64")]
fn amx() -> bool {
    static AMX: std::sync::OnceLock<bool> = std::sync::OnceLock::new();
    *AMX.get_or_init(|| {
        use std::arch::x86_64::{__cpuid, __cpuid_count, _xgetbv};
        const BF16_TILE_INT8: u32 = 1 << 22 | 1 << 24 | 1 << 25;
        const TILE_STATE: u64 = 1 << 17 | 1 << 18;
        if __cpuid(0).eax < 7 || __cpuid_count(7, 0).edx & BF16_TILE_INT8 != BF16_TILE_INT8 {
            return false;
        }
        // SAFETY: AVX-512, which was found before, is found only where the system saves registers by XSAVE.
        let saved = unsafe { _xgetbv(0) };
        saved & TILE_STATE == TILE_STATE && tiles_permitted()
    })
}

/// Asks Linux for room for the tiles in this process's saved registers, which it grants once and for all threads.
#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
fn tiles_permitted() -> bool {
    const ARCH_PRCTL: i64 = 158;
    const ARCH_REQ_XCOMP_PERM: i64 = 0x1023;
    const XTILEDATA: i64 = 18;
    let answer: i64;
    // SAFETY: a system call that reads and writes no memory of this process, with the registers that it may change named.
    unsafe {
        std::arch::asm!(
            "syscall",
            inlateout("rax") ARCH_PRCTL => answer,
            in("rdi") ARCH_REQ_XCOMP_PERM,
            in("rsi") XTILEDATA,
            out("rcx") _,
            out("r11") _,
            options(nostack),
        );
    }
    answer == 0
}

/// Elsewhere it is not known how to ask.
#[cfg(all(target_arch = "x86_64", not(target_os = "linux")))]
fn tiles_permitted() -> bool {
    false
}

/// The name of an instruction set that this machine lacks, or that does not exist.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnknownIsa(String);

impl fmt::Display for UnknownIsa {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let have: Vec<_> = Isa::available().iter().map(|isa| isa.name()).collect();
        write!(f, "no instruction set `{}` here, but {}", self.0, have.join(", "))
    }
}

impl std::error::Error for UnknownIsa {}

impl FromStr for Isa {
    type Err = UnknownIsa;

    fn from_str(name: &str) -> Result<Self, UnknownIsa> {
        Isa::available()
            .into_iter()
            .find(|isa| isa.name() == name)
            .ok_or_else(|| UnknownIsa(name.to_owned()))
    }
}

/// Calls `$body(args…)` as compiled for `$isa`. Each compilation stays a function of its own, small enough for the compiler
/// to find the vectors in it.
macro_rules! dispatch {
    ($isa:expr, fn $body:ident $(<$($g:ident: $bound:path),* $(; const $n:ident)?>)? ($($arg:ident: $ty:ty),* $(,)?)) => {{
        #[inline(never)]
        fn scalar $(<$($g: $bound,)* $(const $n: usize)?>)? ($($arg: $ty),*) {
            $body $(::<$($g,)* $($n)?>)? ($($arg),*)
        }
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2,fma,f16c,bmi1,bmi2,popcnt,lzcnt")]
        fn avx2 $(<$($g: $bound,)* $(const $n: usize)?>)? ($($arg: $ty),*) {
            $body $(::<$($g,)* $($n)?>)? ($($arg),*)
        }
        #[cfg(target_arch = "x86_64")]
        #[target_feature(
            enable = "avx2,fma,f16c,bmi1,bmi2,popcnt,lzcnt,avx512f,avx512bw,avx512cd,avx512dq,avx512vl,avx512vnni"
        )]
        fn avx512 $(<$($g: $bound,)* $(const $n: usize)?>)? ($($arg: $ty),*) {
            $body $(::<$($g,)* $($n)?>)? ($($arg),*)
        }
        match $crate::isa::Isa::level($isa) {
            $crate::isa::Level::Scalar => scalar $(::<$($g,)* $($n)?>)? ($($arg),*),
            // Part of the baseline.
            #[cfg(target_arch = "aarch64")]
            $crate::isa::Level::Neon | $crate::isa::Level::NeonDot => scalar $(::<$($g,)* $($n)?>)? ($($arg),*),
            #[cfg(target_arch = "x86_64")]
            // SAFETY: an `Isa` of this level is only made where the processor has these features.
            $crate::isa::Level::Avx2 | $crate::isa::Level::AvxVnni => unsafe { avx2 $(::<$($g,)* $($n)?>)? ($($arg),*) },
            #[cfg(target_arch = "x86_64")]
            // SAFETY: as above.
            $crate::isa::Level::Avx512 | $crate::isa::Level::Amx => unsafe { avx512 $(::<$($g,)* $($n)?>)? ($($arg),*) },
        }
    }};
}
pub(crate) use dispatch;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_available_set_can_be_named_and_no_other() {
        for isa in Isa::available() {
            assert_eq!(isa.to_string().parse(), Ok(isa));
        }
        assert!(Isa::available().contains(&Isa::SCALAR));
        assert_eq!(Isa::available().last(), Some(&Isa::detect()));
        let error = "abacus".parse::<Isa>().unwrap_err().to_string();
        assert!(error.contains("abacus") && error.contains("scalar"));
    }
}
