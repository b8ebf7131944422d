//! Which instruction sets there are, and which of them this machine has.

use std::fmt;
use std::str::FromStr;

use super::Scalar;
#[cfg(target_arch = "aarch64")]
use super::neon::{Neon, NeonDot, NeonHalf};
#[cfg(target_arch = "x86_64")]
use super::{
    avx2::{Avx2, AvxVnni},
    avx512::{Avx512, Bf16},
};

/// An instruction set that this machine has.
///
/// Only [`Isa::detect`], [`Isa::available`] and parsing make one, and they ask the processor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Isa(Level);

/// An instruction set with the tokens that prove it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) enum Level {
    Scalar(Scalar),
    #[cfg(target_arch = "x86_64")]
    Avx2(Avx2),
    /// AVX2, and products of pairs of i16 that are added in the same instruction: small processors without AVX-512 have it.
    #[cfg(target_arch = "x86_64")]
    AvxVnni(AvxVnni, Avx2),
    #[cfg(target_arch = "x86_64")]
    Avx512(Avx512),
    /// AVX-512, and matrix tiles of bytes and bf16.
    #[cfg(target_arch = "x86_64")]
    Amx(Amx, Avx512),
    #[cfg(target_arch = "aarch64")]
    Neon(Neon),
    /// NEON, and sums of four products of bytes.
    #[cfg(target_arch = "aarch64")]
    NeonDot(NeonDot, Neon),
}

impl Isa {
    /// What the target guarantees; every machine has it.
    pub const SCALAR: Isa = Isa(Level::Scalar(Scalar::TOKEN));

    /// The best that this machine has.
    pub fn detect() -> Isa {
        Isa::available().pop().unwrap_or(Isa::SCALAR)
    }

    /// Everything that this machine has, plainest first.
    pub fn available() -> Vec<Isa> {
        let levels = [
            Some(Level::Scalar(Scalar::TOKEN)),
            #[cfg(target_arch = "x86_64")]
            Avx2::new().map(Level::Avx2),
            #[cfg(target_arch = "x86_64")]
            AvxVnni::new()
                .zip(Avx2::new())
                .map(|(vnni, avx2)| Level::AvxVnni(vnni, avx2)),
            #[cfg(target_arch = "x86_64")]
            Avx512::new().map(Level::Avx512),
            #[cfg(target_arch = "x86_64")]
            Amx::new()
                .zip(Avx512::new())
                .map(|(amx, avx512)| Level::Amx(amx, avx512)),
            #[cfg(target_arch = "aarch64")]
            Neon::new().map(Level::Neon),
            #[cfg(target_arch = "aarch64")]
            NeonDot::new()
                .zip(Neon::new())
                .map(|(dot, neon)| Level::NeonDot(dot, neon)),
        ];
        levels.into_iter().flatten().map(Isa).collect()
    }

    /// Whether there are products of bf16 as well (AVX512_BF16).
    pub fn has_bf16(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        return self.bf16().is_some();
        #[cfg(not(target_arch = "x86_64"))]
        false
    }

    /// Whether there are products and sums of f16 as well (`fp16` on NEON).
    pub fn has_half(self) -> bool {
        #[cfg(target_arch = "aarch64")]
        return self.half().is_some();
        #[cfg(not(target_arch = "aarch64"))]
        false
    }

    /// Whether there are matrix tiles of bytes and bf16 (AMX).
    pub fn has_tiles(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        return self.tiles().is_some();
        #[cfg(not(target_arch = "x86_64"))]
        false
    }

    /// The token of products of bf16, for sets from AVX-512 on.
    #[cfg(target_arch = "x86_64")]
    pub(crate) fn bf16(self) -> Option<Bf16> {
        match self.0 {
            Level::Avx512(_) | Level::Amx(..) => Bf16::new(),
            _ => None,
        }
    }

    /// The token of matrix tiles.
    #[cfg(target_arch = "x86_64")]
    pub(crate) fn tiles(self) -> Option<Amx> {
        match self.0 {
            Level::Amx(amx, _) => Some(amx),
            _ => None,
        }
    }

    /// The token of products of f16, for NEON and above.
    #[cfg(target_arch = "aarch64")]
    pub(crate) fn half(self) -> Option<NeonHalf> {
        match self.0 {
            Level::Scalar(_) => None,
            Level::Neon(_) | Level::NeonDot(..) => NeonHalf::new(),
        }
    }

    /// The token of sums of four products of bytes (`dotprod`).
    #[cfg(target_arch = "aarch64")]
    pub(crate) fn dot(self) -> Option<NeonDot> {
        match self.0 {
            Level::NeonDot(dot, _) => Some(dot),
            _ => None,
        }
    }

    #[inline(always)]
    pub(crate) fn level(self) -> Level {
        self.0
    }

    fn name(self) -> &'static str {
        match self.0 {
            Level::Scalar(_) => "scalar",
            #[cfg(target_arch = "x86_64")]
            Level::Avx2(_) => "avx2",
            #[cfg(target_arch = "x86_64")]
            Level::AvxVnni(..) => "avxvnni",
            #[cfg(target_arch = "x86_64")]
            Level::Avx512(_) => "avx512",
            #[cfg(target_arch = "x86_64")]
            Level::Amx(..) => "amx",
            #[cfg(target_arch = "aarch64")]
            Level::Neon(_) => "neon",
            #[cfg(target_arch = "aarch64")]
            Level::NeonDot(..) => "dotprod",
        }
    }
}

impl fmt::Display for Isa {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Proof of AMX with bytes and bf16, which the operating system lets this process use, and of AVX-512 and AVX512_BF16.
#[cfg(target_arch = "x86_64")]
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct Amx(());

#[cfg(target_arch = "x86_64")]
impl Amx {
    /// The token, if processor and operating system have AMX. Asks once.
    pub fn new() -> Option<Amx> {
        static AMX: std::sync::OnceLock<bool> = std::sync::OnceLock::new();
        let avx512 = Avx512::new().is_some() && Bf16::new().is_some();
        (avx512 && *AMX.get_or_init(has_amx)).then_some(Amx(()))
    }
}

/// Whether there is AMX with bytes and bf16, on a processor that has AVX-512.
#[cfg(target_arch = "x86_64")]
fn has_amx() -> bool {
    use std::arch::x86_64::{__cpuid, __cpuid_count, _xgetbv};
    const BF16_TILE_INT8: u32 = 1 << 22 | 1 << 24 | 1 << 25;
    const TILE_STATE: u64 = 1 << 17 | 1 << 18;
    if __cpuid(0).eax < 7 || __cpuid_count(7, 0).edx & BF16_TILE_INT8 != BF16_TILE_INT8 {
        return false;
    }
    // SAFETY: AVX-512, which was found before, is found only where the system saves registers by XSAVE.
    let saved = unsafe { _xgetbv(0) };
    saved & TILE_STATE == TILE_STATE && tiles_permitted()
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
