//! What a picture calls for beyond opaque splats of one colour, seen through a pinhole: derived, or forced.

use std::fmt;
use std::str::FromStr;

use serde::Serialize;

use crate::gaussians::Gaussians;
use crate::renderer::camera::{Camera, Projection};

use super::Stats;
use super::splat_sizes::typical_width;

/// Standard deviations of splats from this many samples on count as resolved.
pub const RESOLVED: f64 = 1.5;
/// The most samples along each side of a pixel.
pub const MOST_SAMPLES: u32 = 32;

/// Whether an effect is on.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum EffectMode {
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
#[non_exhaustive]
pub enum Effect {
    /// Colour that depends on the direction of view.
    Harmonics,
    /// Opacity is taken back by as much as the pixel's blur widens a splat (the Mip filter): what is smaller than a
    /// pixel is dimmed and not grown. Called for by files made that way; a stream's Gaussians are trained without.
    Antialias,
    /// Each pixel is the mean of several samples a side, as many as it takes to bring the typical splat to [`RESOLVED`]
    /// of them, and at most [`MOST_SAMPLES`]. Many overlapping dimmed splats transmit light that the undimmed would
    /// not, and only what is resolved is free of that. Called for by anti-aliasing where splats fall under a pixel.
    Supersample,
    /// What reaches over the near plane is drawn as what of it is beyond the plane, evaluated in space along each
    /// pixel's ray: it has no sensible image in the plane, and its centre may be behind. Called for where there are
    /// such Gaussians.
    Near,
    /// In each pixel, splats are blended in the order of their depths there, not in that of their centres, as far as
    /// the eight nearest of them tell. Called for by nothing: Gaussians are made for the order of their centres.
    Order,
}

impl Effect {
    /// All effects.
    pub const ALL: [Effect; 5] = [
        Effect::Harmonics,
        Effect::Antialias,
        Effect::Supersample,
        Effect::Near,
        Effect::Order,
    ];

    /// The name, in lower case.
    pub fn name(self) -> &'static str {
        match self {
            Effect::Harmonics => "harmonics",
            Effect::Antialias => "antialias",
            Effect::Supersample => "supersample",
            Effect::Near => "near",
            Effect::Order => "order",
        }
    }
}

/// The caller's choice for each effect.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Effects {
    /// [`Effect::Harmonics`].
    pub harmonics: EffectMode,
    /// [`Effect::Antialias`].
    pub antialias: EffectMode,
    /// [`Effect::Supersample`].
    pub supersample: EffectMode,
    /// [`Effect::Near`].
    pub near: EffectMode,
    /// [`Effect::Order`].
    pub order: EffectMode,
}

/// Which effects a picture is drawn with. What is off is not in the loops.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct EffectSet {
    /// [`Effect::Harmonics`].
    pub harmonics: bool,
    /// [`Effect::Antialias`].
    pub antialias: bool,
    /// [`Effect::Supersample`]: samples along each side of a pixel, a power of two; 1 if it is off.
    pub supersample: u32,
    /// [`Effect::Near`]: whether anything crossed the near plane, once a picture is drawn.
    pub near: bool,
    /// [`Effect::Order`].
    pub order: bool,
}

impl Default for EffectSet {
    fn default() -> Self {
        EffectSet {
            harmonics: false,
            antialias: false,
            supersample: 1,
            near: false,
            order: false,
        }
    }
}

impl EffectSet {
    /// Whether an effect changes the colours of Gaussians, so that they are shaded for each view.
    pub(super) fn shades(&self) -> bool {
        self.harmonics
    }

    /// Whether the picture is drawn with this effect.
    pub fn is_on(&self, effect: Effect) -> bool {
        match effect {
            Effect::Harmonics => self.harmonics,
            Effect::Antialias => self.antialias,
            Effect::Supersample => self.supersample > 1,
            Effect::Near => self.near,
            Effect::Order => self.order,
        }
    }
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
    /// Every effect where the scene calls for it.
    pub const AUTO: Effects = Effects {
        harmonics: EffectMode::Auto,
        antialias: EffectMode::Auto,
        supersample: EffectMode::Auto,
        near: EffectMode::Auto,
        order: EffectMode::Auto,
    };

    /// The same choices with another one for `effect`.
    pub fn with(mut self, effect: Effect, choice: EffectMode) -> Self {
        self.set(effect, choice);
        self
    }

    /// Sets one.
    #[doc(hidden)]
    pub fn set(&mut self, effect: Effect, choice: EffectMode) {
        match effect {
            Effect::Harmonics => self.harmonics = choice,
            Effect::Antialias => self.antialias = choice,
            Effect::Supersample => self.supersample = choice,
            Effect::Near => self.near = choice,
            Effect::Order => self.order = choice,
        }
    }

    /// What `gaussians` seen by `camera` call for, where it is not forced. Harmonics that there are none of cannot be
    /// forced on. Whether anything reaches over the near plane is found out only while drawing.
    pub fn derive(&self, gaussians: &Gaussians, camera: &Camera) -> EffectSet {
        let decide = |choice, called_for| match choice {
            EffectMode::Auto => called_for,
            EffectMode::On => true,
            EffectMode::Off => false,
        };
        let some = gaussians.harmonics.count > 0;
        let antialias = decide(self.antialias, gaussians.compensated);
        EffectSet {
            harmonics: some && decide(self.harmonics, true),
            antialias,
            supersample: match decide(self.supersample, antialias) {
                true => samples(typical_width(gaussians, camera), camera),
                false => 1,
            },
            near: decide(self.near, false),
            order: decide(self.order, false),
        }
    }

    /// Why each effect is on or off in a picture that took `stats`, in words. Looks at every Gaussian: it is meant for
    /// people.
    pub fn explain(&self, gaussians: &Gaussians, camera: &Camera, stats: &Stats) -> Vec<Explanation> {
        let set = &stats.effects;
        let effects = Effect::ALL.map(|effect| Explanation {
            name: effect.name(),
            on: set.is_on(effect),
            why: self.reason(effect, gaussians, camera, stats),
        });
        let line = |name, on, why| Explanation { name, on, why };
        let varying = gaussians.opacity.iter().filter(|o| **o != 1.0).count();
        let opacity = format!("{varying} of {} Gaussians are not opaque", gaussians.len());
        let orthographic = camera.projection == Projection::Orthographic;
        let kind = format!("the camera is {}", if orthographic { "one" } else { "a pinhole" });
        let middle = [camera.width, camera.height].map(|side| f64::from(side) / 2.0);
        let principal = format!("the principal point is {}, {}", camera.cx, camera.cy);
        let mut all = vec![line("opacity", varying > 0, opacity)];
        all.extend(effects);
        all.push(line("orthographic", orthographic, kind));
        all.push(line("off-centre", [camera.cx, camera.cy] != middle, principal));
        all
    }

    /// Why an effect is on or off in a picture that took `stats`.
    fn reason(&self, effect: Effect, gaussians: &Gaussians, camera: &Camera, stats: &Stats) -> String {
        let set = &stats.effects;
        let forced = |choice, otherwise: &str| match choice {
            EffectMode::Auto => otherwise.to_owned(),
            EffectMode::On | EffectMode::Off => "forced".to_owned(),
        };
        match effect {
            Effect::Harmonics => match gaussians.harmonics.count {
                0 => "no Gaussian has any".into(),
                n => forced(self.harmonics, &format!("{n} coefficients a Gaussian")),
            },
            Effect::Antialias if gaussians.compensated => forced(self.antialias, "the file says so"),
            Effect::Antialias => forced(self.antialias, "nothing says that the Gaussians were made for it"),
            Effect::Supersample => format!(
                "{0}×{0} samples a pixel; the typical splat is {1:.2} px wide{2}",
                set.supersample,
                typical_width(gaussians, camera),
                match (self.supersample, set.antialias) {
                    (EffectMode::Off, _) => ", forced",
                    (EffectMode::Auto, false) => ", without anti-aliasing none are called for",
                    _ => "",
                }
            ),
            Effect::Near => match (self.near, stats.crossing) {
                (_, 0) => "no Gaussian in view reaches over the near plane".into(),
                (EffectMode::Off, n) => format!("forced; {n} Gaussians reach over the near plane"),
                (_, n) => format!("{n} Gaussians in view reach over the near plane"),
            },
            Effect::Order => forced(self.order, "Gaussians are made for the order of their centres"),
        }
    }
}

/// How many samples a side bring a typical splat, `width` pixels wide, to [`RESOLVED`].
fn samples(width: f64, camera: &Camera) -> u32 {
    let room = Camera::MAX_SIDE / camera.width.max(camera.height);
    let mut samples = 1;
    while f64::from(samples) < RESOLVED / width && samples < MOST_SAMPLES && 2 * samples <= room {
        samples *= 2;
    }
    samples
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
        let mut all = Effect::ALL.into_iter();
        all.find(|effect| effect.name() == name).ok_or_else(|| {
            let names = Effect::ALL.map(Effect::name).join(", ");
            format!("no effect `{name}`, but {names}")
        })
    }
}

impl FromStr for EffectMode {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        match word {
            "auto" => Ok(EffectMode::Auto),
            "on" => Ok(EffectMode::On),
            "off" => Ok(EffectMode::Off),
            _ => Err(format!("`{word}` is not on, off or auto")),
        }
    }
}
