//! Gaussian generators as a model's description has them: the best, and where a model has them, quick ones.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

/// One Gaussian generator.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Head {
    /// Which level's features it reads: 1 or 2 above the base level.
    pub role: usize,
    /// Its channels.
    pub channels: usize,
    /// Residual blocks before the fourth layer.
    pub blocks_before: usize,
    /// Residual blocks after it.
    pub blocks_after: usize,
    /// Gaussians per voxel: 8 for role 1, 1 for role 2.
    pub children: usize,
    /// Which set it belongs to.
    #[serde(default, skip_serializing_if = "Heads::is_best")]
    pub heads: Heads,
}

/// Which of a model's Gaussian generators are used. What a stream holds bears on neither, so that any stream of the model decodes with both.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Heads {
    /// Those that every model has.
    #[default]
    Best,
    /// Thinner ones for weak machines, which only some models have: less accurate in a fraction of the time.
    Quick,
}

impl Heads {
    /// All, the default first.
    pub const ALL: [Heads; 2] = [Heads::Best, Heads::Quick];

    fn name(self) -> &'static str {
        match self {
            Heads::Best => "best",
            Heads::Quick => "quick",
        }
    }

    fn is_best(&self) -> bool {
        *self == Heads::Best
    }
}

impl fmt::Display for Heads {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Heads {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        let all = Heads::ALL;
        all.into_iter().find(|h| h.name() == name).ok_or_else(|| {
            let names = all.map(Heads::name).join(", ");
            Error::Usage(format!("no heads `{name}`, but {names}"))
        })
    }
}

impl Head {
    /// What its tensors' names start with.
    pub(super) fn module(&self) -> String {
        match self.heads {
            Heads::Best => format!("gg.{}", self.role),
            Heads::Quick => format!("gg.quick.{}", self.role),
        }
    }

    /// How many scales a generator needs to run in integers: two chains, and the inside of every block.
    pub(super) fn scales(&self) -> usize {
        2 + self.blocks_before + self.blocks_after
    }
}
