//! The background of a picture and how exactly it is drawn.

use crate::renderer::shade::Channel;

/// What is seen where the Gaussians let light through.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Background {
    /// Nothing: the picture keeps its transparency.
    Transparent,
    /// A colour, red, green and blue in `[0, 1]`: the picture is opaque.
    Colour([f32; 3]),
}

impl Default for Background {
    /// White.
    fn default() -> Self {
        Background::WHITE
    }
}

impl Background {
    /// White.
    pub const WHITE: Background = Background::Colour([1.0; 3]);
    /// Black.
    pub const BLACK: Background = Background::Colour([0.0; 3]);

    /// What each channel takes of the transmittance, beyond what the Gaussians give it, and alpha beyond 1.
    pub(super) fn behind(self) -> [f32; 4] {
        match self {
            Background::Transparent => [0.0, 0.0, 0.0, -1.0],
            Background::Colour([r, g, b]) => [r, g, b, 0.0],
        }
    }
}

/// How much of splats may be left out. A splat is looked at in all the blocks of 4×4 pixels where its α may reach a
/// floor; what is left out adds up where many tails overlap, as beside the silhouette of many overlapping splats.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
#[non_exhaustive]
pub enum Quality {
    /// A floor of 1/255, as is usual: beside silhouettes, pictures are off by several steps of eight bits, and by many
    /// where splats are far smaller than pixels.
    Fast,
    /// A floor of 1/16384.
    #[default]
    Fine,
    /// A floor of [`LEAST_FLOOR`].
    Exact,
    /// A floor of one's own, from [`LEAST_FLOOR`] to 1.
    Floor(f32),
}

/// The least value of the minimum α.
pub const LEAST_FLOOR: f32 = 1.0 / (1 << 20) as f32;

impl Quality {
    /// The least α that is drawn.
    pub fn floor(self) -> f32 {
        match self {
            Quality::Fast => 1.0 / 255.0,
            Quality::Fine => 1.0 / 16384.0,
            Quality::Exact => LEAST_FLOOR,
            Quality::Floor(floor) => floor.clamp(LEAST_FLOOR, 1.0),
        }
    }
}

impl std::fmt::Display for Quality {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Quality::Fast => f.write_str("fast"),
            Quality::Fine => f.write_str("fine"),
            Quality::Exact => f.write_str("exact"),
            Quality::Floor(_) => write!(f, "floor 1/{:.0}", 1.0 / self.floor()),
        }
    }
}

impl std::str::FromStr for Quality {
    type Err = String;

    fn from_str(name: &str) -> std::result::Result<Self, String> {
        match name {
            "fast" => Ok(Quality::Fast),
            "fine" => Ok(Quality::Fine),
            "exact" => Ok(Quality::Exact),
            _ => Err(format!("no quality `{name}`, but fast, fine and exact")),
        }
    }
}

/// What to draw, on what background.
pub(super) struct OutputOptions {
    pub channel: Channel,
    pub background: Background,
}

impl Default for OutputOptions {
    fn default() -> Self {
        OutputOptions {
            channel: Channel::Colour,
            background: Background::Transparent,
        }
    }
}
