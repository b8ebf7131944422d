//! Names of the heads, which make Gaussians from a decoded level.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

/// Quality of a model's heads. Streams do not depend on it: every stream of a model can be drawn with either.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Heads {
    /// The accurate heads, which every model has.
    #[default]
    Best,
    /// Heads with fewer channels for slow machines: less accurate, several times faster. Only some models have them.
    Quick,
}

impl Heads {
    /// All values, the default first.
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

/// Method that makes the Gaussians of a level.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[non_exhaustive]
pub enum HeadSet {
    /// The accurate learned heads of a model.
    Best,
    /// The fast learned heads of a model: less accurate, several times faster.
    Quick,
    /// Opaque discs in closed form, without a model file. Streams of version 3 only.
    #[default]
    Surfels,
}

impl HeadSet {
    /// All values, the most accurate first.
    pub const ALL: [HeadSet; 3] = [HeadSet::Best, HeadSet::Quick, HeadSet::Surfels];

    fn name(self) -> &'static str {
        match self {
            HeadSet::Best => "best",
            HeadSet::Quick => "quick",
            HeadSet::Surfels => "surfels",
        }
    }

    /// The learned heads, or `None` for surfels.
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
