//! Gaussian generators as a model's description has them: the best, and where a model has them, quick ones.

use serde::{Deserialize, Serialize};

use crate::gaussians::Heads;

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
