//! Which instruction sets there are, and which of them this machine has.

use std::fmt;
use std::str::FromStr;

#[cfg(target_arch = "x86_64")]
use super::amx::Amx;
#[cfg(target_arch = "x86_64")]
use super::avx2::{Avx2, AvxVnni};
#[cfg(target_arch = "x86_64")]
use super::avx512::Bf16;
#[cfg(target_arch = "aarch64")]
use super::neon::{Neon, NeonDot, NeonHalf};
use super::scalar::Scalar;
use super::vector::Simd;

/// An instruction set that this machine has.
///
/// Only [`Isa::detect`], [`Isa::available`] and parsing make one, and they ask the processor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Isa {
    level: Level,
    extension: Option<Extension>,
}

macro_rules! define_level {
    ($([$cfg:meta] $module:ident::$token:ident, $with:ident;)+) => {
        /// An instruction set, with the token that proves it.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub(crate) enum Level {
            $(#[cfg($cfg)] $token(super::$module::$token),)+
        }

        impl Level {
            /// All that this machine has, plainest first.
            fn available() -> impl Iterator<Item = Level> {
                let levels = [$(#[cfg($cfg)] super::$module::$token::new().map(Level::$token),)+];
                levels.into_iter().flatten()
            }

            fn name(self) -> &'static str {
                match self {
                    $(#[cfg($cfg)] Level::$token(_) => stringify!($module),)+
                }
            }

            /// Lanes of 32 bits.
            fn lanes(self) -> usize {
                match self {
                    $(#[cfg($cfg)] Level::$token(_) => <super::$module::$token as Simd>::LANES,)+
                }
            }
        }
    };
}
pub(crate) use define_level;

instruction_sets! { define_level }

/// What some processors have besides, which some kernels are written for by hand.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
enum Extension {
    /// Of AVX2: products of pairs of i16 that are added in the same instruction. Small processors without AVX-512 have
    /// it.
    #[cfg(target_arch = "x86_64")]
    AvxVnni(AvxVnni),
    /// Of AVX-512: matrix tiles of bytes and bf16.
    #[cfg(target_arch = "x86_64")]
    Amx(Amx),
    /// Of NEON: sums of four products of bytes.
    #[cfg(target_arch = "aarch64")]
    NeonDot(NeonDot),
}

impl Extension {
    /// That of an instruction set, if this machine has it.
    fn of(level: Level) -> Option<Extension> {
        match level {
            #[cfg(target_arch = "x86_64")]
            Level::Avx2(_) => AvxVnni::new().map(Extension::AvxVnni),
            #[cfg(target_arch = "x86_64")]
            Level::Avx512(_) => Amx::new().map(Extension::Amx),
            #[cfg(target_arch = "aarch64")]
            Level::Neon(_) => NeonDot::new().map(Extension::NeonDot),
            _ => None,
        }
    }
}

impl Isa {
    /// What the target guarantees; every machine has it.
    pub const SCALAR: Isa = Isa {
        level: Level::Scalar(Scalar::TOKEN),
        extension: None,
    };

    /// The best that this machine has.
    pub fn detect() -> Isa {
        Isa::available().pop().unwrap_or(Isa::SCALAR)
    }

    /// Everything that this machine has, plainest first.
    pub fn available() -> Vec<Isa> {
        let each = |level| {
            [None]
                .into_iter()
                .chain(Extension::of(level).map(Some))
                .map(move |extension| Isa { level, extension })
        };
        Level::available().flat_map(each).collect()
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

    /// Lanes of 32 bits of a vector.
    pub(crate) fn lanes(self) -> usize {
        self.level.lanes()
    }

    /// The token of AVX2, for sets from that on.
    #[cfg(target_arch = "x86_64")]
    pub(crate) fn avx2(self) -> Option<Avx2> {
        match self.level {
            Level::Avx2(avx2) => Some(avx2),
            Level::Avx512(avx512) => Some(avx512.base()),
            _ => None,
        }
    }

    /// The token of AVX2 with products of pairs that are added.
    #[cfg(target_arch = "x86_64")]
    pub(crate) fn vnni(self) -> Option<AvxVnni> {
        match self.extension {
            Some(Extension::AvxVnni(vnni)) => Some(vnni),
            _ => None,
        }
    }

    /// The token of products of bf16, for sets from AVX-512 on.
    #[cfg(target_arch = "x86_64")]
    pub(crate) fn bf16(self) -> Option<Bf16> {
        match self.level {
            Level::Avx512(_) => Bf16::new(),
            _ => None,
        }
    }

    /// The token of matrix tiles.
    #[cfg(target_arch = "x86_64")]
    pub(crate) fn tiles(self) -> Option<Amx> {
        match self.extension {
            Some(Extension::Amx(amx)) => Some(amx),
            _ => None,
        }
    }

    /// The token of NEON, for it and its extension.
    #[cfg(target_arch = "aarch64")]
    pub(crate) fn neon(self) -> Option<Neon> {
        match self.level {
            Level::Neon(neon) => Some(neon),
            _ => None,
        }
    }

    /// The token of products of f16, for NEON and its extension.
    #[cfg(target_arch = "aarch64")]
    pub(crate) fn half(self) -> Option<NeonHalf> {
        self.neon().and_then(|_| NeonHalf::new())
    }

    /// The token of sums of four products of bytes (`dotprod`).
    #[cfg(target_arch = "aarch64")]
    pub(crate) fn dot(self) -> Option<NeonDot> {
        match self.extension {
            Some(Extension::NeonDot(dot)) => Some(dot),
            _ => None,
        }
    }

    #[inline(always)]
    pub(crate) fn level(self) -> Level {
        self.level
    }

    fn name(self) -> &'static str {
        match self.extension {
            None => self.level.name(),
            #[cfg(target_arch = "x86_64")]
            Some(Extension::AvxVnni(_)) => "avxvnni",
            #[cfg(target_arch = "x86_64")]
            Some(Extension::Amx(_)) => "amx",
            #[cfg(target_arch = "aarch64")]
            Some(Extension::NeonDot(_)) => "dotprod",
        }
    }
}

impl fmt::Display for Isa {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
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
