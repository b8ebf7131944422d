//! How large a network is: everything about it but its weights.

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result, Stage};

/// Roles of the levels of a stream: the base level and up to two above it.
pub const ROLES: usize = 3;

/// How a level's context comes from the level before.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Upsample {
    /// Every child copies its parent.
    Nearest,
    /// Every child is a linear function of its parent, one function per octant.
    Learned,
}

/// The shape of a Gaussian head.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct HeadShape {
    /// The role of the level that it reads: 1 or 2.
    pub role: usize,
    /// Channels inside.
    pub channels: usize,
    /// ResBlocks before layer 4.
    pub blocks_before: usize,
    /// ResBlocks after layer 4.
    pub blocks_after: usize,
    /// Gaussians per voxel: 8 (layer 4 generates the children, opacity is learned) or 1 (opacity is 1).
    pub children: usize,
}

/// The shape of a network and the constants of its heads, as a model file's metadata holds them (JSON under the key `b2p`).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Shape {
    /// Version of the model format.
    pub format: u32,
    /// What the model is called.
    pub name: String,
    /// C: channels of features and contexts.
    pub channels: usize,
    /// K: latents per voxel.
    pub latents: usize,
    /// Inception blocks of a feature converter.
    pub fc_blocks: usize,
    /// Inception blocks of an entropy model.
    pub pem_blocks: usize,
    /// Inception blocks of a reconstruction.
    pub fr_blocks: usize,
    /// Gaussian heads, at most one per role.
    pub gg: Vec<HeadShape>,
    /// How contexts are made.
    pub upsample: Upsample,
    /// Whether an Inception block ends in a ReLU.
    pub inception_relu: bool,
    /// Whether a ResBlock ends in a ReLU.
    pub resblock_relu: bool,
    /// The encoder clamps latents to ±`latent_max`.
    pub latent_max: i16,
    /// Latents enter the reconstruction shifted left by this.
    pub latent_shift: u8,
    /// Offsets reach so many generated voxels.
    pub offset_range: f32,
    /// Scales are softplus values times so many generated voxels.
    pub scale_range: f32,
    /// Added to raw scales.
    pub scale_bias: f32,
    /// Added to raw opacities.
    pub opacity_bias: f32,
}

impl Shape {
    /// The paper's network: 64 channels, 8 latents, two blocks everywhere, 2.9 M weights to decode and 1.2 M more to encode.
    pub fn full() -> Shape {
        let head = |role, children| HeadShape {
            role,
            channels: 64,
            blocks_before: 2,
            blocks_after: 2,
            children,
        };
        Shape {
            format: 1,
            name: "full".into(),
            channels: 64,
            latents: 8,
            fc_blocks: 2,
            pem_blocks: 2,
            fr_blocks: 2,
            gg: vec![head(1, 8), head(2, 1)],
            upsample: Upsample::Learned,
            inception_relu: true,
            resblock_relu: true,
            latent_max: 31,
            latent_shift: 6,
            offset_range: 1.0,
            scale_range: 1.0,
            scale_bias: -0.31,
            opacity_bias: 2.0,
        }
    }

    /// A network small enough for tests: 8 channels, 4 latents, one block everywhere.
    pub fn tiny() -> Shape {
        let mut shape = Shape {
            name: "tiny".into(),
            channels: 8,
            latents: 4,
            fc_blocks: 1,
            pem_blocks: 1,
            fr_blocks: 1,
            ..Shape::full()
        };
        for head in &mut shape.gg {
            head.channels = 8;
            head.blocks_before = 1;
            head.blocks_after = 1;
        }
        shape
    }

    /// The head that reads the level of this role.
    pub fn head(&self, role: usize) -> Option<&HeadShape> {
        self.gg.iter().find(|head| head.role == role)
    }

    /// Fails with [`Error::Malformed`] naming the first field that no network can have.
    pub fn check(&self) -> Result<()> {
        at_most("format", self.format as usize, 1, 1)?;
        at_most("channels", self.channels, 4, 256)?;
        if !self.channels.is_multiple_of(4) {
            return Err(wrong("channels", self.channels, "a multiple of 4"));
        }
        at_most("latents", self.latents, 1, 64)?;
        for (field, blocks) in [
            ("fc_blocks", self.fc_blocks),
            ("pem_blocks", self.pem_blocks),
            ("fr_blocks", self.fr_blocks),
        ] {
            at_most(field, blocks, 0, 16)?;
        }
        let mut roles = Vec::new();
        for head in &self.gg {
            at_most("gg.role", head.role, 1, ROLES - 1)?;
            at_most("gg.channels", head.channels, 1, 256)?;
            at_most("gg.blocks_before", head.blocks_before, 0, 16)?;
            at_most("gg.blocks_after", head.blocks_after, 0, 16)?;
            if head.children != 1 && head.children != 8 {
                return Err(wrong("gg.children", head.children, "1 or 8"));
            }
            if roles.contains(&head.role) {
                return Err(wrong("gg.role", head.role, "one head per role"));
            }
            roles.push(head.role);
        }
        at_most("latent_shift", self.latent_shift.into(), 0, 10)?;
        let most = 2047 >> self.latent_shift;
        if !(1..=most).contains(&self.latent_max) {
            return Err(wrong("latent_max", self.latent_max, format!("1 to {most}")));
        }
        for (field, value) in [
            ("offset_range", self.offset_range),
            ("scale_range", self.scale_range),
            ("scale_bias", self.scale_bias),
            ("opacity_bias", self.opacity_bias),
        ] {
            if !(value.abs() <= 100.0) {
                return Err(wrong(field, value, "a number from −100 to 100"));
            }
        }
        Ok(())
    }
}

fn at_most(field: &'static str, value: usize, least: usize, most: usize) -> Result<()> {
    if (least..=most).contains(&value) {
        return Ok(());
    }
    Err(wrong(field, value, format!("{least} to {most}")))
}

fn wrong(field: &str, value: impl ToString, expected: impl ToString) -> Error {
    Error::malformed(Stage::Network, "the metadata", field, value, expected)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shapes_that_come_with_the_library_are_sound() {
        Shape::full().check().unwrap();
        Shape::tiny().check().unwrap();
    }

    #[test]
    fn a_shape_that_no_network_can_have_is_refused_by_name() {
        let refuse = |change: fn(&mut Shape), field: &str| {
            let mut shape = Shape::tiny();
            change(&mut shape);
            assert!(
                shape.check().unwrap_err().to_string().contains(field),
                "{field}"
            );
        };
        refuse(|s| s.channels = 6, "channels");
        refuse(|s| s.channels = 1 << 40, "channels");
        refuse(|s| s.latent_max = 32, "latent_max");
        refuse(|s| s.gg[1].role = 1, "gg.role");
        refuse(|s| s.scale_bias = f32::NAN, "scale_bias");
    }
}
