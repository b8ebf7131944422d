//! What a picture calls for beyond opaque splats of one colour, seen through a pinhole: derived, or forced.

use std::fmt;
use std::str::FromStr;

use crate::gaussians::Gaussians;
use crate::projection::{Camera, Projection};

/// Whether an effect is on.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Choice {
    /// Where the scene calls for it.
    #[default]
    Auto,
    /// Always.
    On,
    /// Never.
    Off,
}

/// The effects that can be forced.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effect {
    /// Colour that depends on the direction of view.
    Harmonics,
    /// Opacity is taken back by as much as the pixel's blur widens a splat (the Mip filter): what is smaller than a pixel is dimmed
    /// and not grown. Called for by files made that way; a stream's Gaussians are trained without.
    Antialias,
}

/// The caller's choice for each effect.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Effects {
    /// [`Effect::Harmonics`].
    pub harmonics: Choice,
    /// [`Effect::Antialias`].
    pub antialias: Choice,
}

/// Which effects a picture is drawn with. What is off is not in the loops.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct EffectSet {
    /// [`Effect::Harmonics`].
    pub harmonics: bool,
    /// [`Effect::Antialias`].
    pub antialias: bool,
}

/// Something that changes how a picture is drawn, whether it does, and why.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Explanation {
    /// A word or two.
    pub name: &'static str,
    /// Whether it is on.
    pub on: bool,
    /// The reason.
    pub why: String,
}

impl Effects {
    /// Sets one.
    pub fn set(&mut self, effect: Effect, choice: Choice) {
        match effect {
            Effect::Harmonics => self.harmonics = choice,
            Effect::Antialias => self.antialias = choice,
        }
    }

    /// What `gaussians` call for, where it is not forced. Harmonics that there are none of cannot be forced on.
    pub fn derive(&self, gaussians: &Gaussians) -> EffectSet {
        let decide = |choice, called_for| match choice {
            Choice::Auto => called_for,
            Choice::On => true,
            Choice::Off => false,
        };
        let some = gaussians.harmonics.count > 0;
        EffectSet {
            harmonics: some && decide(self.harmonics, true),
            antialias: decide(self.antialias, gaussians.compensated),
        }
    }

    /// Everything that is decided for a picture, in words. Looks at every Gaussian: it is meant for people.
    pub fn explain(&self, gaussians: &Gaussians, camera: &Camera) -> Vec<Explanation> {
        let set = self.derive(gaussians);
        let forced = |choice, otherwise: &str| match choice {
            Choice::Auto => otherwise.to_owned(),
            Choice::On | Choice::Off => "forced".to_owned(),
        };
        let varying = gaussians.opacity.iter().filter(|o| **o != 1.0).count();
        let orthographic = camera.projection == Projection::Orthographic;
        let middle = [camera.width, camera.height].map(|side| f64::from(side) / 2.0);
        let line = |name, on, why| Explanation { name, on, why };
        vec![
            line(
                "opacity",
                varying > 0,
                format!("{varying} of {} Gaussians are not opaque", gaussians.len()),
            ),
            line(
                "harmonics",
                set.harmonics,
                match gaussians.harmonics.count {
                    0 => "no Gaussian has any".into(),
                    n => forced(self.harmonics, &format!("{n} coefficients a Gaussian")),
                },
            ),
            line(
                "antialias",
                set.antialias,
                forced(
                    self.antialias,
                    if gaussians.compensated {
                        "the file says so"
                    } else {
                        "nothing says that the Gaussians were made for it"
                    },
                ),
            ),
            line(
                "orthographic",
                orthographic,
                format!(
                    "the camera is {}",
                    if orthographic { "one" } else { "a pinhole" }
                ),
            ),
            line(
                "off-centre",
                [camera.cx, camera.cy] != middle,
                format!("the principal point is {}, {}", camera.cx, camera.cy),
            ),
        ]
    }
}

impl fmt::Display for Explanation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let on = if self.on { "on" } else { "off" };
        write!(f, "{} {on}: {}", self.name, self.why)
    }
}

impl FromStr for Effect {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        match name {
            "harmonics" => Ok(Effect::Harmonics),
            "antialias" => Ok(Effect::Antialias),
            _ => Err(format!("no effect `{name}`, but harmonics and antialias")),
        }
    }
}

impl FromStr for Choice {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        match word {
            "auto" => Ok(Choice::Auto),
            "on" => Ok(Choice::On),
            "off" => Ok(Choice::Off),
            _ => Err(format!("`{word}` is not on, off or auto")),
        }
    }
}
