//! The arithmetic that a network runs in.

use std::fmt;
use std::str::FromStr;

use crate::error::{Error, Result};

/// What Gaussians are generated in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Precision {
    /// Activations in ±2047 with a scale per layer, weights in ±2047 with a scale per channel, sums in 32 bits: the
    /// same bits on every machine and with any instruction set.
    #[default]
    Int16,
    /// f16 in memory, sums in f32.
    F16,
    /// The same, but products are summed in f16 before they are in f32 (`b2p_kernels::Precision::Half`). Only where
    /// [`crate::Isa::has_half`].
    Half,
}

impl Precision {
    /// All, the default first; of the last not every machine has what it needs.
    pub const ALL: [Precision; 3] = [Precision::Int16, Precision::F16, Precision::Half];

    fn name(self) -> &'static str {
        match self {
            Precision::Int16 => "int16",
            Precision::F16 => "f16",
            Precision::Half => "half",
        }
    }
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Precision {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        let all = Precision::ALL;
        all.into_iter().find(|p| p.name() == name).ok_or_else(|| {
            let names = all.map(Precision::name).join(", ");
            Error::Usage(format!("no precision `{name}`, but {names}"))
        })
    }
}
