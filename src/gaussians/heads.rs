//! What draws a level.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

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

    pub(crate) fn is_best(&self) -> bool {
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

/// What makes Gaussians of a level.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum HeadSet {
    /// The best heads of a model.
    Best,
    /// Its quick ones: less accurate in a fraction of the time.
    Quick,
    /// Opaque discs in closed form; no model file is needed. Of streams of version 3 alone.
    #[default]
    Surfels,
}

impl HeadSet {
    /// All, the most accurate first.
    pub const ALL: [HeadSet; 3] = [HeadSet::Best, HeadSet::Quick, HeadSet::Surfels];

    fn name(self) -> &'static str {
        match self {
            HeadSet::Best => "best",
            HeadSet::Quick => "quick",
            HeadSet::Surfels => "surfels",
        }
    }

    /// The heads of a model; surfels have none.
    pub fn learned(self) -> Option<Heads> {
        match self {
            HeadSet::Best => Some(Heads::Best),
            HeadSet::Quick => Some(Heads::Quick),
            HeadSet::Surfels => None,
        }
    }
}

impl From<Heads> for HeadSet {
    fn from(heads: Heads) -> Self {
        match heads {
            Heads::Best => HeadSet::Best,
            Heads::Quick => HeadSet::Quick,
        }
    }
}

impl fmt::Display for HeadSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for HeadSet {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        let all = HeadSet::ALL;
        all.into_iter().find(|h| h.name() == name).ok_or_else(|| {
            let names = all.map(HeadSet::name).join(", ");
            Error::Usage(format!("no heads `{name}`, but {names}"))
        })
    }
}
